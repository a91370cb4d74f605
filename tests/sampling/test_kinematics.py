"""Where the operator divides by little, and running extrema to the bit."""

import jax.numpy as jnp
import numpy as np

from rcirl_jax.sampling import trajectory_from_positions
from rcirl_jax.sampling.kinematics import remaining_min, running_max
from rcirl_jax.units import TIMES_S
from tests.helpers.scenes import scene

T = TIMES_S.size


def test_standing_still_has_zero_lateral_derivatives():
    made = scene(v=0.0)
    still = trajectory_from_positions(made, jnp.zeros(T), jnp.linspace(0.0, 1.0, T))
    assert not np.asarray(still.dl).any()
    assert not np.asarray(still.ddl).any()


def test_running_extrema_are_those_that_numpy_accumulates():
    x = np.random.default_rng(0).normal(size=(4, 18)).astype(np.float32)
    x[0, [2, 5, 9]] = -np.inf, np.inf, np.nan
    highest = np.maximum.accumulate(x, axis=-1)
    np.testing.assert_array_equal(running_max(jnp.asarray(x)), highest)
    lowest = np.minimum.accumulate(x[..., ::-1], axis=-1)[..., ::-1]
    np.testing.assert_array_equal(remaining_min(jnp.asarray(x)), lowest)
