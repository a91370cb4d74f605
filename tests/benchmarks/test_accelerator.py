"""What an accelerator is asked: parts that fail or have no time, and a rehearsal."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

# in processes of their own: a benchmark's flags collide with those of others
SHOWN = """
import json, time
from benchmarks import accelerator
def broken(dataset, sizes):
    raise ValueError("no such card")
{change}
found = dict(accelerator.run_parts(None, accelerator.SMALL, {ends}))
print(json.dumps([list(accelerator.PARTS), found]))
"""


def parts(change: str, ends: str) -> tuple[list, dict]:
    """Names of all parts, and what they find, as JSON has it."""
    command = [sys.executable, "-c", SHOWN.format(change=change, ends=ends)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def test_a_part_that_fails_is_noted_and_the_next_begins():
    change = "accelerator.PARTS = {'broken': broken, 'devices': accelerator.devices}"
    _, found = parts(change, "time.monotonic() + 60.0")
    assert found["broken"]["error"] == "ValueError: no such card"
    assert found["devices"]["jax_devices"]


def test_what_there_is_no_time_for_is_left_out():
    names, found = parts("", "time.monotonic()")
    assert list(found) == names
    assert names[0] == "devices"
    assert len(found) == 7
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
    assert found["sweep"]["members"] == 4
    assert found["paper"]["slice"]["frames"] > 0
    assert not found["paper"]["slice"]["complete"]
