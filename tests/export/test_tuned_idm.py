"""Rows of a closed-loop table from files: the tuned IDM, several weights."""

import dataclasses
import json
import shutil

import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.export.closed_loop import (
    gate_job,
    left_out,
    read_tuned_idm,
    table_rows,
    write_tuned_idm,
)
from rcirl_jax.export.loading import load_runs, open_reward, row_name
from rcirl_jax.planner.baselines import TUNED_IDM_ROW, Idm
from tests.helpers.weights_files import random_weights

TUNED = Idm(headway=1.1, standstill_gap=2.5)


def test_a_tuned_idm_comes_back_and_is_a_row(tmp_path):
    file = tmp_path / "idm.json"
    write_tuned_idm(file, TUNED)
    assert read_tuned_idm(file) == TUNED
    weights = str(random_weights(tmp_path / "w.msgpack"))
    names = [row.name for row in table_rows([weights], ["IDM"], tuned_idm=TUNED)]
    assert names[1:] == ["IDM", TUNED_IDM_ROW]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"headway": -1.0}, "headway: -1.0: expected a number > 0"),
        ({"gap": 1.0}, "gap: unknown"),
        (None, "expected JSON, a tuned IDM"),
    ],
)
def test_a_wrong_file_is_one_line(change, message, tmp_path):
    file = tmp_path / "idm.json"
    body = {**dataclasses.asdict(TUNED), **(change or {})}
    file.write_text(json.dumps(body) if change else "{")
    with pytest.raises(InputError) as caught:
        read_tuned_idm(file)
    (line,) = str(caught.value).splitlines()
    assert line.startswith(str(file))
    assert message in line


def test_weights_of_one_shape_and_seed_are_told_apart_by_their_file(tmp_path):
    """As rows of the closed loop and of a ranking; a name twice takes its folder."""
    one = random_weights(tmp_path / "one.msgpack")
    files = [str(one)]
    for name in ("a/two", "b/two"):
        (tmp_path / name).parent.mkdir()
        files.append(str(shutil.copy(one, tmp_path / f"{name}.msgpack")))
    name = row_name(open_reward(files[0]))
    parent = tmp_path.name
    shown = [f"{parent}/one.msgpack", "a/two.msgpack", "b/two.msgpack"]
    expected = [f"{name} ({x})" for x in shown]
    assert [row.name for row in table_rows(files, [])] == expected
    assert [*load_runs(files)[0]] == expected
    assert [row.name for row in table_rows(files[1:2], [])] == [name]
    for read in (load_runs, lambda twice: table_rows(twice, [])):
        with pytest.raises(InputError, match="met twice"):
            read([files[0]] * 2)


@pytest.mark.parametrize("track", ["full", "collision"])
def test_a_gate_under_another_filter_has_left_something_out(track, tmp_path):
    weights = str(random_weights(tmp_path / "w.msgpack"))
    job, _ = gate_job(
        weights, "hand-set", suite="full", cases=None, duration_s=None,
        catalogue_seed=0, plan_every=1, track=track,
    )  # fmt: skip
    assert job.track == track
    assert ("only forbids collisions" in left_out(job)) is (track == "collision")
