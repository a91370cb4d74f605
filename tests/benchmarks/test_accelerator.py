"""What an accelerator is asked: parts that fail or have no time, and a rehearsal."""

import json
import subprocess
import sys
from pathlib import Path

import pytest


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
