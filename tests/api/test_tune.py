"""The whole loop by one call."""

import json

import pytest

from tests.conftest import REPO
from tests.helpers.commands import python

TWICE = """
import sys
import rcirl_jax
for _ in range(2):
    verdict = rcirl_jax.tune(
        sys.argv[1], sys.argv[2], recipe="quick", epochs=1, suite="stopped_lead",
        cases=30, duration_s=2.0, drives=8,
    )
print("decision:", verdict.decision)
"""


@pytest.mark.slow
@pytest.mark.multiprocess
def test_it_ends_with_the_verdict_of_the_folder(examples, tmp_path):
    """And keeps all stages when it is called again."""
    run = tmp_path / "run"
    done = python(TWICE, examples / "data", run, cwd=REPO)
    assert done.returncode == 0, done.stderr[-2000:]
    verdict = json.loads((run / "verdict.json").read_text())
    assert verdict["cases"] == 30
    assert done.stdout.splitlines()[-1] == f"decision: {verdict['decision']}"
    assert verdict["decision"] != "ship"  # on a part of the suite
    assert (run / "weights.msgpack").is_file()
    assert (run / "report.html").is_file()
    stages = [x for x in done.stdout.splitlines() if x.startswith("[")]
    half = len(stages) // 2
    assert not [x for x in stages[:half] if x.endswith("kept")]
    assert all(x.endswith("kept") for x in stages[half:])
