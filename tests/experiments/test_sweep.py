"""The sweep by its command."""

import json

import pytest

from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.export.loading import open_reward
from tests.helpers.commands import refused, succeeded


@pytest.mark.slow
@pytest.mark.multiprocess
def test_a_small_sweep(tmp_path):
    config = ImportConfig(format="synthetic", collect=CollectConfig(stride_s=60.0))
    import_logs(read_recordings("synthetic", None), tmp_path / "d", config)
    flags = (
        "--quick", f"--data={tmp_path}/d", f"--output={tmp_path}/out",
        "--recipe=paper", "--leaky_rates=0.05,0.3", "--hidden_sizes=0,6x3",
    )  # fmt: skip
    done = succeeded("rcirl_jax", "sweep", *flags, "--workers=2")
    assert "member" in done.stderr
    assert done.stdout.count("<- chosen") == 1
    report = json.loads((tmp_path / "out" / "sweep.json").read_text())
    assert len(report["members"]) == 8
    assert report["made_by"]["flags"]["quick"] is True
    assert (tmp_path / "out" / "sweep.png").read_bytes()[:4] == b"\x89PNG"
    best = open_reward(str(tmp_path / "out" / "best.msgpack"))
    assert best.sha256 == report["members"][report["chosen"]["member"]]["sha256"]
    said = refused("rcirl_jax", "sweep", *flags, "--epochs=2", "--batch_size=32")
    assert "batch_size: 64: expected 32 to resume" in said
