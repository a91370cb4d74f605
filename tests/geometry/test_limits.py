"""What the planner may drive: values by hand, and numpy against jax.numpy."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.geometry.limits import planning_limit

FLAT = np.zeros(12)


def test_a_lower_sign_is_braked_for():
    """20 m/s, from 10 m on 8 m/s; it counts from 8 m, one grid point before."""
    posted = np.where(np.arange(12) < 5, 20.0, 8.0)
    found = planning_limit(FLAT, FLAT, posted, 2.0)
    expected = np.sqrt([80.0, 76.0, 72.0, 68.0, *[64.0] * 8])
    np.testing.assert_allclose(found, expected, atol=1e-12)


@given(seed=st.integers(0, 10_000), size=st.integers(4, 60))
def test_numpy_and_jax_agree_with_the_definition(seed, size):
    rng = np.random.default_rng(seed)
    kappa = rng.normal(0.0, 0.01, size)
    l = np.cumsum(rng.normal(0.0, 0.01, size))
    posted = rng.uniform(3.0, 30.0, size)
    found = planning_limit(kappa, l, posted, 2.0)
    bend = np.gradient(np.gradient(l, 2.0), 2.0)
    own = np.minimum(posted, np.sqrt(2.0 / np.abs(kappa + bend)))
    own = [min(own[i], own[min(i + 1, size - 1)]) for i in range(size)]
    far = [
        min(np.sqrt(own[j] ** 2 + 2.0 * 1.0 * 2.0 * (j - i)) for j in range(i, size))
        for i in range(size)
    ]
    np.testing.assert_allclose(found, far, rtol=1e-9)
    traced = jax.jit(lambda *x: planning_limit(*x, 2.0, jnp))(kappa, l, posted)
    np.testing.assert_allclose(traced, far, rtol=1e-4)
