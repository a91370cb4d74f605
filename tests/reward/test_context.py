"""Rewards conditioned on the scene: gains, equality of both layouts, training."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.reward import Normaliser, RewardConfig, init_reward, value
from rcirl_jax.units import TIMES_S

F, T, K = 21, TIMES_S.size, 5
FEATURES = feature_map("paper21")
CONFIG = RewardConfig(context=FEATURES.context)


def normaliser():
    rng = np.random.default_rng(4)
    full = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return Normaliser(
        lower=full(np.full(F, -3.0)),
        upper=full(np.full(F, 3.0)),
        location=full(rng.normal(size=F)),
        scale=full(rng.uniform(0.5, 2.0, F)),
    )


def test_an_untrained_context_changes_nothing():
    drawn = np.random.default_rng(1).normal(0.0, 2.0, (K, T, F))
    x, valid = jnp.asarray(drawn, jnp.float32), jnp.ones((K, T), bool)
    params = init_reward(jax.random.key(3), F, CONFIG)
    got = value(params, normaliser(), x, valid, CONFIG)
    plain = params.replace(context=None)
    want = value(plain, normaliser(), x, valid, RewardConfig())
    np.testing.assert_array_equal(got, want)


def test_acceleration_and_jerk_at_the_start_set_no_gain():
    """Nor does anything else that candidates do not share."""
    own = {n for n, c in zip(FEATURES.names, FEATURES.context, strict=True) if not c}
    assert {"acceleration", "jerk"} <= own
    assert "velocity" not in own


def test_a_context_of_another_length_is_refused():
    with pytest.raises(InputError, match=r"context: 2 columns: expected 21"):
        init_reward(jax.random.key(0), F, RewardConfig(context=(1, 0)))
