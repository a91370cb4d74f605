"""Held-out drives of a dataset by their command."""

import json

import pytest

from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.export.closed_loop import write_tuned_idm
from rcirl_jax.planner.baselines import Idm
from tests.helpers.commands import succeeded


@pytest.mark.multiprocess
def test_held_out_drives_are_measured_against_the_human(root, tmp_path):
    out, idm = tmp_path / "out", tmp_path / "idm.json"
    write_tuned_idm(idm, Idm(headway=1.0))
    done = succeeded(
        "rcirl_jax", "simulate", f"--weights={root}/w.msgpack", f"--output={out}",
        "--baselines=", "--suite=heldout", f"--data={root}/data", "--cases=4",
        f"--tuned_idm={idm}", "--filter=collision",
    )  # fmt: skip
    body = json.loads((out / "likeness.json").read_text())
    learned, tuned = (name for name in body["rows"] if name != "recorded human")
    assert tuned == "IDM, tuned"
    assert body["drives"] == 4
    assert body["rows"]["recorded human"]["distance_m"]["mean"] < 0.05
    assert body["rows"][learned]["distance_m"]["mean"] > 0.0
    assert set(body["rows"][learned]["minus"]) == {tuned}
    assert body["made_by"]["data_hash"] == open_dataset(root / "data").hash
    assert body["made_by"]["weights_sha256"]
    assert (out / "table.txt").read_text() in done.stdout
    assert "left out: IDM, tuned" not in done.stdout
