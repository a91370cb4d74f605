"""The gap of a plan to the finer solver."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.planner.dp import emergency_stop, optimality_gap
from rcirl_jax.planner.rank import ONLINE
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.sampling.sampler import as_candidates
from rcirl_jax.units import TIMES_S
from tests.helpers.scenes import sampled, scene
from tests.planner.test_dp import COARSE, FEATURES, SCORE, SHAPE, planner, weights
from tests.planner.test_safety import judge

MEASURE = jax.jit(
    lambda s, x, w: optimality_gap(s, x, w, FEATURES, SHAPE.activation, COARSE)
)
FREE = scene(v=14.0)


def test_the_gap_is_the_value_to_the_best_admissible_plan():
    """G(x) - G(y) = V(y) - V(x); the lattice's own plan and the stop are among them."""
    w = weights()
    lattice, stop = planner(COARSE)(FREE, w), emergency_stop(FREE)
    candidates = sampled(jax.random.key(0), FREE, ONLINE)
    fine = np.flatnonzero(judge(FREE, candidates).admissible)[[0, 7]]
    plans = [jax.tree.map(lambda x, i=i: x[i], candidates.trajectory) for i in fine]
    plans += [lattice.trajectory, stop]
    values = np.array([float(SCORE(w, FREE, as_candidates(x))[0]) for x in plans])
    passes = np.array(
        [bool(judge(FREE, as_candidates(x)).admissible[0]) for x in plans]
    )
    assert passes[2]
    assert values[2] > values[:2].max()  # so it is the best of every question
    found = [MEASURE(FREE, x, w) for x in plans]
    for v, gap in zip(values[passes], np.array(found)[passes], strict=True):
        assert gap["admissible"]
        assert gap["gap"] == pytest.approx(values[2] - v, abs=1e-4)
        spread = values[2] - values[3]
        assert gap["normalised"] == pytest.approx((values[2] - v) / spread, abs=1e-4)


def test_a_plan_that_may_not_be_driven_has_no_gap():
    wall = scene(v=14.0, boxes=[{"s": 12.0, "speed": 0.0}])
    through = trajectory_on_path(wall, 14.0 * jnp.asarray(TIMES_S, jnp.float32))
    found = MEASURE(wall, through, weights())
    assert not found["admissible"]
    assert np.isnan(found["gap"])
    assert np.isnan(found["normalised"])
