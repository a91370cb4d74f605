"""How often a candidate plans otherwise than its own cost would."""

import numpy as np
import pytest

from benchmarks.common import untrained
from rcirl_jax.evaluation.closed_loop.decided import decided
from rcirl_jax.planner.rank import RankConfig
from rcirl_jax.runtime.compiling import compiles
from rcirl_jax.simulation.rows import baseline_row
from rcirl_jax.simulation.suite import build, drive_row, rollout_config, suite_refs

SECONDS = 9.0  # moments at 0, 4 and 8 s


def test_shares_of_plans_that_differ():
    """None against itself; before a light "as fast as possible" is no hand-set cost.

    The programs are those of the drives.
    """
    refs = suite_refs("free_cruise,red_light", 3)
    cases, weights = build(refs, SECONDS), untrained()
    fast, own = (
        baseline_row(name, "paper21", weights, RankConfig())
        for name in ("+velocity", "hand-set")
    )
    part = lambda first, last: build(refs[first:last], SECONDS)  # noqa: E731
    drive_row(own, part, len(refs), rollout_config(own, SECONDS, 1), chunk=len(refs))
    given = cases, [ref.family for ref in refs], np.arange(len(refs)), SECONDS
    with compiles("jit(run)") as made:
        same, other = (decided(row, own, *given) for row in (own, fast))
    assert not made
    assert list(other) == ["all", "free_cruise", "red_light"]
    assert [one["moments"] for one in other.values()] == [18, 9, 9]
    assert all(one["share"] == one["apart_m"] == 0.0 for one in same.values())
    assert 0.2 < other["red_light"]["share"] < 1.0
    assert other["red_light"]["apart_m"] > 0.1
    parts = [other[name]["share"] for name in ("free_cruise", "red_light")]
    assert other["all"]["share"] == pytest.approx(np.mean(parts))
    assert other["all"]["low"] <= other["all"]["share"] <= other["all"]["high"]
    assert other["free_cruise"]["low"] is None  # three cases are too few
    assert same["all"]["high"] == pytest.approx(0.459, abs=1e-3)  # of six that never do
