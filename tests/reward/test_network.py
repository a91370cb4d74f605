"""The Flax module: its equation, parameters, scale, signs, gates, other modules."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.reward import (
    Normaliser,
    RewardConfig,
    RewardModel,
    effective_params,
    init_params,
    value,
)
from rcirl_jax.reward.network import user_module
from rcirl_jax.units import TIMES_S

FEATURES = feature_map("paper21")
F, T, K = 21, TIMES_S.size, 5
GATED = RewardConfig(scene_gating=FEATURES.context)


def drawn(config, seed=0):
    """Parameters that are nowhere 0."""
    params, rng = init_params(jax.random.key(seed), F, config), np.random.default_rng(1)
    add = lambda x: x + jnp.asarray(rng.normal(0.0, 0.3, x.shape), jnp.float32)  # noqa: E731
    return jax.tree.map(add, params)


def normaliser():
    rng = np.random.default_rng(4)
    full = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return Normaliser(
        lower=full(np.full(F, -3.0)),
        upper=full(np.full(F, 3.0)),
        location=full(rng.normal(size=F)),
        scale=full(rng.uniform(0.5, 2.0, F)),
    )


def trajectories(count=K, seed=2):
    """Features [K, T, F] that are alike at t = 0 as those of one scene are."""
    x = np.random.default_rng(seed).normal(0.0, 2.0, (count, T, F))
    shared = np.asarray(FEATURES.context) > 0
    x[:, 0, shared] = x[0, 0, shared]
    return jnp.asarray(x, jnp.float32)


def values(params, x, config, valid=None):
    valid = jnp.ones(T, bool) if valid is None else valid
    every = jnp.broadcast_to(valid, x.shape[:-1])
    return value(RewardModel(config), params, normaliser(), x, every)


def test_a_linear_reward_is_its_definition():
    """V = sum over valid t of gamma_t w . z_t, by numpy in float64."""
    config = RewardConfig(hidden=(), scale_constraint="none")
    params, x, valid = drawn(config), trajectories(), np.arange(T) < 11
    gamma, kernel = params["gamma"], params["point"]["out"]["kernel"]
    assert np.ptp(gamma) > 0.1
    norm = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), normaliser())
    z = (np.clip(x, norm.lower, norm.upper) - norm.location) / norm.scale
    want = np.einsum("t,ktf,f->k", gamma * valid, z, np.asarray(kernel)[:, 0])
    found = values(params, x, config, jnp.asarray(valid))
    np.testing.assert_allclose(found, want, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_a_fixed_scale_keeps_the_order(activation):
    free = RewardConfig(activation=activation, scale_constraint="none")
    unit = RewardConfig(activation=activation, scale_constraint="unit")
    params, x = drawn(free), trajectories(50)
    unit_values = values(params, x, unit)
    if activation == "tanh":
        free_values = values(params, x, free)
        np.testing.assert_array_equal(np.argsort(free_values), np.argsort(unit_values))
    out = {"kernel": 7.0 * params["point"]["out"]["kernel"]}
    grown = {"gamma": 10.0 * params["gamma"], "point": {**params["point"], "out": out}}
    np.testing.assert_allclose(values(grown, x, unit), unit_values, rtol=1e-4)
    effective = effective_params(params, unit)
    for part in (effective["gamma"], effective["point"]["out"]["kernel"]):
        assert float(jnp.linalg.norm(part)) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("hidden", [(), (8, 4)])
def test_monotone_rewards_never_fall_with_a_safety_term(hidden):
    signs = (1, -1, *[0] * (F - 2))
    config = RewardConfig(hidden=hidden, constraint="monotone", signs=signs)
    moved = np.zeros(2)
    for seed in range(5):
        params, x = drawn(config, seed), trajectories(40, seed)
        slope = jax.grad(lambda x, p=params: jnp.sum(values(p, x, config)))(x)
        slope = np.asarray(slope)
        assert (slope[..., 0] >= 0.0).all()
        assert (slope[..., 1] <= 0.0).all()
        moved += np.abs(slope[..., 2]).max(), (slope[..., 2] < 0).mean()
    assert (moved > 0).all()


def test_an_untrained_gating_changes_nothing():
    params = init_params(jax.random.key(3), F, GATED)
    got = values(params, trajectories(), GATED)
    del params["scene_gating"]
    np.testing.assert_array_equal(got, values(params, trajectories(), RewardConfig()))


def test_acceleration_and_jerk_at_the_start_set_no_gate():
    """The gates are those of the scene, whichever trajectory they are read from."""
    params, x = drawn(GATED), trajectories()
    first = [FEATURES.names.index(name) for name in ("acceleration", "jerk")]
    moved, valid = x.at[:, 0, jnp.asarray(first)].add(1.0), jnp.arange(T) > 0
    plain = values(params, x, GATED, valid)
    np.testing.assert_array_equal(plain, values(params, moved, GATED, valid))
    other = x.at[:, 0, FEATURES.names.index("velocity")].add(0.1)
    assert np.abs(values(params, other, GATED, valid) - plain).max() > 1e-4
    rows = jnp.asarray(moved.at[1:].set(x[1:])).transpose(2, 1, 0)
    (found,) = RewardModel(GATED).apply({"params": params}, normaliser(), valid, rows)
    np.testing.assert_allclose(found, plain, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"activation": "step"}, "activation: step: expected one of"),
        ({"hidden": (15,), "constraint": "nonnegative"}, "hidden: "),
        ({"scene_gating": (1, 0)}, "scene_gating: 2 columns: expected 21"),
        ({"module": "no_such_room:Reward"}, "no_such_room.*No module named"),
        ({"module": "json:JSONDecoder"}, "no flax.linen.Module"),
        ({"module": "tests.reward.others:Wide"}, r"\(2, 18, 3\) of \(2, 18, 21\): "),
        ({"module": "tests.reward.others:Stateful"}, r"\['batch_stats', 'params'\]"),
        (
            {"module": "tests.reward.others:Nameless"},
            "scale_constraint: unit.*last layer `out`",
        ),
        (
            {"module": "tests.reward.others:Wide", "constraint": "monotone"},
            "constraint: monotone: expected none",
        ),
    ],
)
def test_what_does_not_fit_is_one_line(given, says):
    with pytest.raises(InputError, match=says):
        init_params(jax.random.key(0), F, RewardConfig(**given))


def test_a_module_without_an_out_layer_trains_free():
    made = RewardConfig(module="tests.reward.others:Nameless", scale_constraint="none")
    assert set(init_params(jax.random.key(0), F, made)) == {"gamma", "point"}
    assert user_module(made.module) is user_module(made.module)
    with pytest.raises(InputError, match=r"weights\.msgpack"):
        dataclasses.replace(made).check_own()
