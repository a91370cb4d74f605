"""What an accelerator is asked: parts that fail or have no time, and a rehearsal."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks import accelerator


def test_a_part_that_fails_is_noted_and_the_next_begins(monkeypatch):
    def broken(dataset, sizes):
        raise ValueError("no such card")

    parts = {"broken": broken, "devices": accelerator.devices}
    monkeypatch.setattr(accelerator, "PARTS", parts)
    ends = time.monotonic() + 60.0
    found = dict(accelerator.run_parts(None, accelerator.SMALL, ends))
    assert found["broken"]["error"] == "ValueError: no such card"
    assert found["devices"]["jax_devices"]


def test_what_there_is_no_time_for_is_left_out():
    found = dict(accelerator.run_parts(None, accelerator.SMALL, time.monotonic()))
    assert list(found) == list(accelerator.PARTS)
    assert all(part == {"left_out": "no time left"} for part in found.values())


@pytest.mark.slow
def test_a_rehearsal_on_the_cpu(tmp_path):
    command = [sys.executable, "-m", "benchmarks.accelerator", "--small"]
    subprocess.run([*command, f"--output={tmp_path}"], check=True, cwd=Path.cwd())
    found = json.loads((tmp_path / "accelerator.json").read_text())
    assert found["equality"]["agrees"]
    assert found["equality"]["relative_difference"]["values"] == 0.0  # one device
    queries = found["training"]["queries"]
    assert all(q["8"][form]["per_s"] > 0 for q in queries.values() for form in q["8"])
    assert found["sweep"]["members"] == accelerator.SMALL.members
    assert found["paper"]["slice"]["frames"] > 0
    assert not found["paper"]["slice"]["complete"]
