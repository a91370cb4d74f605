"""Held-out drives of a dataset by their command."""

import json

import pytest

from rcirl_jax.data.importing import import_parts
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.export.tuned_idm import write_tuned_idm
from rcirl_jax.planner.baselines import Idm
from tests.data.small_logs import CONFIG, write_logs
from tests.helpers.commands import command
from tests.helpers.weights_files import random_weights


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("heldout")
    import_parts(write_logs(folder / "logs", 3), folder / "data", CONFIG)
    random_weights(folder / "w.msgpack")
    write_tuned_idm(folder / "idm.json", Idm(headway=1.0))
    return folder


def drive(root, *flags):
    weights = f"--weights={root}/w.msgpack"
    return command(
        "experiments.simulate", weights, f"--output={root}/out", "--baselines=", *flags
    )


@pytest.mark.multiprocess
def test_held_out_drives_are_measured_against_the_human(root):
    data, idm = f"--data={root}/data", f"--tuned_idm={root}/idm.json"
    done = drive(root, "--suite=heldout", data, idm, "--cases=4", "--filter=collision")
    assert done.returncode == 0, done.stderr[-2000:]
    body = json.loads((root / "out" / "likeness.json").read_text())
    learned, tuned = (name for name in body["rows"] if name != "recorded human")
    assert tuned == "IDM, tuned"
    assert body["drives"] == 4
    assert body["rows"]["recorded human"]["distance_m"]["mean"] < 0.05
    assert body["rows"][learned]["distance_m"]["mean"] > 0.0
    assert set(body["rows"][learned]["minus"]) == {tuned}
    assert body["made_by"]["data_hash"] == open_dataset(root / "data").hash
    assert body["made_by"]["weights_sha256"]
    assert (root / "out" / "table.txt").read_text() in done.stdout
    assert "left out: IDM, tuned" not in done.stdout


@pytest.mark.multiprocess
@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--suite=heldout",), "--data: []: expected distinct datasets"),
        (("--suite=smoke", "--data=somewhere"), "--data: with --suite=smoke"),
        (("--suite=heldout", "--duration=3"), "--duration: of --suite=heldout"),
        (("--tuned_idm=none.json",), "none.json"),
    ],
)
def test_wrong_flags_are_one_line(flags, message, root):
    done = drive(root, *flags)
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert message in line
