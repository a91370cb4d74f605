"""Every benchmark that needs neither recordings nor PyTorch, as small as it goes.

Nothing is timed here: a result must be written, with the machine it was made on.
"""

import json
import re

import pytest

from tests.conftest import REPO
from tests.helpers.commands import fresh as command

RESULTS = sorted((REPO / "benchmarks" / "results").rglob("*.json"))
SMALL = {
    "paper_scale": ["--seconds=1"],
    "single_plan": ["--calls=5"],
    "suite": ["--duration=1", "--rounds=1", "--single=1"],
    "sweep": ["--members=8", "--scenes=64", "--single=1", "--rounds=1", "--commands=1"],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_benchmark_writes_its_result(name, tmp_path):
    done = command(f"benchmarks.{name}", *SMALL[name], f"--output={tmp_path}")
    assert done.returncode == 0, done.stderr
    made = json.loads((tmp_path / f"{name}.json").read_text())
    assert made["machine"]["cores"] >= 1
    for fact in ("git_commit", "code_sha256", "versions", "date"):
        assert made["made_by"][fact]
    assert made["made_by"]["flags"]["output"] == tmp_path.name


@pytest.mark.parametrize("file", RESULTS, ids=lambda file: file.stem)
def test_no_result_names_a_path_of_its_machine(file):
    assert not re.findall(r'"/[^"/ ]+/[^"]*"', file.read_text())
