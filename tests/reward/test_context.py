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
COLUMNS = feature_map("paper21").context
CONFIG = RewardConfig(context=COLUMNS)


def draw(config=CONFIG, seed=0, spread=0.3):
    params = init_reward(jax.random.key(seed), F, config)
    noise = np.random.default_rng(seed).normal(0.0, spread, (F, F))
    return params.replace(context=jnp.asarray(noise, jnp.float32))


def normaliser():
    rng = np.random.default_rng(4)
    full = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return Normaliser(
        lower=full(np.full(F, -3.0)),
        upper=full(np.full(F, 3.0)),
        location=full(rng.normal(size=F)),
        scale=full(rng.uniform(0.5, 2.0, F)),
    )


def features(seed=1):
    drawn = np.random.default_rng(seed).normal(0.0, 2.0, (K, T, F))
    return jnp.asarray(drawn, jnp.float32)


def test_an_untrained_context_changes_nothing():
    plain = RewardConfig()
    params = init_reward(jax.random.key(3), F, CONFIG)
    valid = jnp.ones((K, T), bool)
    got = value(params, normaliser(), features(), valid, CONFIG)
    want = value(params.replace(context=None), normaliser(), features(), valid, plain)
    np.testing.assert_array_equal(got, want)


def test_acceleration_and_jerk_at_the_start_set_no_gain():
    params, names = draw(), feature_map("paper21").names
    valid, x = jnp.ones((K, T), bool), features()
    first = [names.index(name) for name in ("acceleration", "jerk")]
    moved = x.at[:, 0, jnp.asarray(first)].add(1.0)
    mask = valid.at[:, 0].set(False)
    values = [value(params, normaliser(), one, mask, CONFIG) for one in (x, moved)]
    np.testing.assert_array_equal(*values)
    moved = x.at[:, 0, names.index("velocity")].add(0.1)
    other = value(params, normaliser(), moved, mask, CONFIG)
    assert np.abs(other - values[0]).max() > 1e-4


def test_a_context_of_another_length_is_refused():
    with pytest.raises(InputError, match=r"context: 2 columns: expected 21"):
        init_reward(jax.random.key(0), F, RewardConfig(context=(1, 0)))
