"""The gate by its command."""

import json

import pytest

from tests.helpers.commands import command
from tests.helpers.weights_files import random_weights

SHORT = ("--suite=free_cruise,stopped_lead", "--cases=20", "--duration=2")


@pytest.mark.multiprocess
def test_a_reward_against_itself(tmp_path):
    file, out = random_weights(tmp_path / "w.msgpack"), tmp_path / "verdict.json"
    names = ("collision_free", "min_ttc", "speed_limit", "on_road", "family_clean")
    margins = [f"--{name}_margin=0.2" for name in names]  # 40 cases prove no less
    flags = (f"--candidate={file}", f"--incumbent={file}", f"--output={out}", *SHORT)
    done = command("rcirl_jax", "gate", *flags, *margins)
    assert done.returncode == 2, done.stderr[-2000:]
    assert "verdict: COULD NOT JUDGE" in done.stdout
    assert "left out: IDM, tuned: --tuned_idm is not given" in done.stdout
    body = json.loads(out.read_text())
    assert body["decision"] == "could not judge"
    assert not [check for check in body["checks"] if check["outcome"] == "fail"]
    assert body["cases"] == 40
    hashes = body["result_sha256"]
    assert hashes["candidate"] == hashes["incumbent"] != hashes["IDM"]
    assert body["made_by"]["flags"]["cases"] == 20
