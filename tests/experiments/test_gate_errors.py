"""Drivers of known truth: what the gate says of drives that are so by construction."""

import json

import pytest

from experiments.known_drivers import (
    OTHER,
    SLOWER,
)
from tests.helpers.commands import succeeded


@pytest.mark.slow
@pytest.mark.multiprocess
def test_by_its_command(tmp_path):
    """Driven: other candidates drive otherwise and as far, slower ones less far."""
    out = tmp_path / "errors.json"
    short = ("--suite=free_cruise,curve_speed", "--cases=15", "--duration=10")
    succeeded("experiments.gate_errors", f"--output={out}", "--seeds=2", *short)
    body = json.loads(out.read_text())
    assert (body["cases"], body["made_by"]["flags"]["seeds"]) == (60, 2)
    found = {one["candidate"]: one for one in body["kinds"]}
    assert found[OTHER]["way"] == pytest.approx(1.0, abs=0.01)
    assert found[OTHER]["way"] != 1.0
    slower, slowest = (found[name] for name in SLOWER)
    assert slowest["way"] < slower["way"] < 0.99
    assert slowest["each"] == {"do not ship": 2}
    assert all("ship" not in found[name]["each"] for name in (*SLOWER, OTHER))
