"""Held-out drives of a dataset by their command."""

import json

import pytest

from rcirl_jax.data.importing import import_logs
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.export.closed_loop import write_tuned_idm
from rcirl_jax.planner.baselines import Idm
from tests.data.small_logs import CONFIG, write_logs
from tests.helpers.commands import succeeded
from tests.helpers.weights_files import random_weights


@pytest.mark.multiprocess
def test_held_out_drives_are_measured_against_the_human(tmp_path):
    root = tmp_path
    import_logs(write_logs(root / "logs", 3), root / "data", CONFIG)
    random_weights(root / "w.msgpack")
    write_tuned_idm(root / "idm.json", Idm(headway=1.0))
    done = succeeded(
        "rcirl_jax", "simulate", f"--weights={root}/w.msgpack", f"--output={root}/out",
        "--baselines=", "--suite=heldout", f"--data={root}/data", "--cases=4",
        f"--tuned_idm={root}/idm.json", "--filter=collision",
    )  # fmt: skip
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
