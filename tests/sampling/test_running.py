"""Running extrema against numpy's accumulate, to the bit."""

import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.sampling.kinematics import remaining_min, running_max


@pytest.mark.parametrize("shape", [(1,), (4, 18)])
def test_as_numpy_accumulates(shape):
    x = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    np.testing.assert_array_equal(
        running_max(jnp.asarray(x)), np.maximum.accumulate(x, axis=-1)
    )
    backwards = np.minimum.accumulate(x[..., ::-1], axis=-1)[..., ::-1]
    np.testing.assert_array_equal(remaining_min(jnp.asarray(x)), backwards)


def test_infinities_and_nan_pass_on():
    x = np.array([-np.inf, 1.0, np.inf, 2.0, np.nan, 3.0], np.float32)
    np.testing.assert_array_equal(running_max(jnp.asarray(x)), np.maximum.accumulate(x))
