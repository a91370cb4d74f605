"""Running extrema against numpy's accumulate, to the bit."""

import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.geometry.running import remaining_min, running_max


@pytest.mark.parametrize("shape", [(1,), (2,), (18,), (3, 5), (4, 128)])
def test_as_numpy_accumulates(shape):
    x = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    np.testing.assert_array_equal(
        running_max(jnp.asarray(x)), np.maximum.accumulate(x, axis=-1)
    )
    backwards = np.minimum.accumulate(x[..., ::-1], axis=-1)[..., ::-1]
    np.testing.assert_array_equal(remaining_min(jnp.asarray(x)), backwards)
