"""The one operator from positions to derivatives, against float64 numpy."""

import jax.numpy as jnp
import numpy as np

from rcirl_jax.sampling import trajectory_from_positions
from rcirl_jax.units import TIMES_S
from tests.helpers.scenes import random_positions, random_scene, scene

T = TIMES_S.size


def test_what_lies_beyond_the_mask_changes_nothing_inside():
    made = random_scene(5).replace(time_valid=jnp.arange(T) < 11)
    s, l = random_positions(5, made)
    one = trajectory_from_positions(made, s, l)
    other = trajectory_from_positions(made, s.at[11:].add(50.0), l)
    for name in ("v", "a", "j"):
        np.testing.assert_array_equal(
            getattr(one, name)[:11], getattr(other, name)[:11]
        )


def test_standing_still_has_zero_lateral_derivatives():
    made = scene(v=0.0)
    still = trajectory_from_positions(made, jnp.zeros(T), jnp.linspace(0.0, 1.0, T))
    assert not np.asarray(still.dl).any()
    assert not np.asarray(still.ddl).any()
