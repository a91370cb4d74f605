"""A few refused recordings of many: ended with one line, or left out and counted."""

import dataclasses

import pytest

from rcirl_jax.data.formats import parts
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.inputs import InputFile, recordings_of
from rcirl_jax.data.quality import format_quality
from rcirl_jax.data.recording import LEAVE_OUT
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.errors import InputError
from tests.data.formats.fixtures import waymo
from tests.data.small_logs import CONFIG, write_logs

STRICT = ImportConfig(
    format="waymo",
    collect=CollectConfig(require_speed_change=False, require_obstacles=False),
)
LENIENT = dataclasses.replace(STRICT, leave_out=1)


def shard(folder, *scenarios):
    """One file; the recording car, the only one seen for long, counts as human."""
    folder.mkdir(parents=True)
    (folder / "a.tfrecord").write_bytes(waymo.tfrecord(scenarios))
    found, spec = parts("waymo", folder)
    spec = {**spec, "recording_car": "human"}
    return [InputFile(format="waymo", input=path, spec=spec) for path in found]


def good(name):
    return waymo.scenario(scenario_id=f"scenario-{name}")


# times that go backwards
BAD = waymo.scenario(timestamps_seconds=waymo.STAMPS[::-1], scenario_id="scenario-bad")


def test_one_scenario_of_a_file_is_left_out(tmp_path):
    mixed = shard(tmp_path / "mixed", good("a"), BAD, good("b"))
    lenient = dataclasses.replace(mixed[0], spec={**mixed[0].spec, LEAVE_OUT: True})
    assert [bool(x.refused) for x in recordings_of(lenient)] == [False, True, False]
    made = import_logs(mixed, tmp_path / "data", LENIENT)
    plain = import_logs(
        shard(tmp_path / "plain", good("a"), good("b")), tmp_path / "other", STRICT
    )
    assert made.count == plain.count > 0
    assert made.quality["refused"] == 1
    assert "refused" not in plain.quality
    assert any("left out: " in note and "record 1" in note
               for note in made.quality["notes"])  # fmt: skip
    assert "1 recording refused and left out" in format_quality(made.quality)
    assert made.sources == plain.sources
    assert made.rate_hz == plain.rate_hz
    assert made.import_flags["leave_out"] == 1
    assert "leave_out" not in plain.import_flags


def test_a_share_is_judged_at_the_end(tmp_path):
    logs = shard(tmp_path / "logs", good("a"), BAD, good("b"))
    half = dataclasses.replace(STRICT, leave_out_share=0.5)
    made = import_logs(logs, tmp_path / "data", half)
    assert made.quality["refused"] == 1
    assert made.import_flags["leave_out_share"] == 0.5
    few = dataclasses.replace(STRICT, leave_out_share=0.3)
    with pytest.raises(
        InputError, match=r"1 of 3 recordings refused, .*record 1: .*up to 30 %"
    ):
        import_logs(logs, tmp_path / "other", few)
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    ("config", "words"),
    [(LENIENT, r"record 3: .*; recordings left out before: 1"), (STRICT, "record 1: ")],
)
def test_one_too_many_ends_the_import(tmp_path, config, words):
    other = waymo.scenario(
        timestamps_seconds=[0.0] * waymo.NUM_STEPS, scenario_id="scenario-worse"
    )
    logs = shard(tmp_path / "logs", good("a"), BAD, good("b"), other)
    with pytest.raises(InputError, match=words):
        import_logs(logs, tmp_path / "data", config)
    assert not (tmp_path / "data").exists()


def test_a_file_that_breaks_off_gives_what_it_has(tmp_path):
    """The rest of it is one refused recording; other files are read."""
    logs = write_logs(tmp_path / "logs", files=3)
    text = logs[1].input.read_text().splitlines()
    logs[1].input.write_text("\n".join([*text[:40], "1.0,x,not a number,0"]))
    config = dataclasses.replace(CONFIG, leave_out=2)
    made = import_logs(logs, tmp_path / "data", config)
    rest = import_logs([logs[0], logs[2]], tmp_path / "other", CONFIG)
    assert made.count == rest.count > 0
    assert made.quality["refused"] == 1
    assert "logs/log01.csv, the rest" in made.recordings
