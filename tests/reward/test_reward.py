"""Value network, normaliser, losses: oracles, pins, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.reward import (
    LossConfig,
    Normaliser,
    RewardConfig,
    fit_normaliser,
    init_reward,
    lattice_cost,
    lattice_costs,
    loss_sums,
    normalise,
    pinned,
    scenes_value,
    value,
)
from rcirl_jax.sampling import SamplerConfig, trajectory_from_positions
from rcirl_jax.units import TIMES_S
from tests.helpers.scenes import random_scene, sampled, scene
from tests.reward.compared import compared

F, T = 21, TIMES_S.size
SHAPES = {"linear": (), "paper": (15,), "deep": (8, 4)}


def unit_normaliser():
    one = jnp.ones(F)
    return Normaliser(lower=-9 * one, upper=9 * one, location=0 * one, scale=one)


def draw(config, seed=0):
    params = init_reward(jax.random.key(seed), F, config)
    noise = np.random.default_rng(seed)
    return jax.tree.map(
        lambda x: x + jnp.asarray(noise.normal(0, 0.3, x.shape), jnp.float32), params
    )


def test_parameters_of_another_shape_are_refused():
    """Filling up hidden units hides no row that is missing."""
    config = RewardConfig(hidden=(5,))
    params = draw(config)
    first, out = params.kernels
    x = jnp.zeros((1, F, T, 2))
    for kernels in (first[:-1], out), (first, out[:-1]):
        wrong = pinned(params.replace(kernels=kernels), config)
        with pytest.raises(TypeError, match=r"contracting|shape"):
            scenes_value(wrong, unit_normaliser(), [x], jnp.ones((1, T), bool), "tanh")


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_pin_keeps_the_order_and_fixes_the_scale(activation):
    free = RewardConfig(activation=activation, pin="none")
    unit = RewardConfig(activation=activation, pin="unit")
    params = draw(free)
    x = jnp.asarray(np.random.default_rng(0).normal(size=(50, T, F)), jnp.float32)
    valid = jnp.ones((50, T), bool)
    free_values = value(params, unit_normaliser(), x, valid, free)
    unit_values = value(params, unit_normaliser(), x, valid, unit)
    if activation == "tanh":
        np.testing.assert_array_equal(np.argsort(free_values), np.argsort(unit_values))
    grown = params.replace(
        gamma=10.0 * params.gamma,
        kernels=(*params.kernels[:-1], 7.0 * params.kernels[-1]),
    )
    np.testing.assert_allclose(
        value(grown, unit_normaliser(), x, valid, unit), unit_values, rtol=1e-4
    )
    effective = pinned(params, unit)
    assert float(jnp.linalg.norm(effective.gamma)) == pytest.approx(1.0, abs=1e-4)
    assert float(jnp.linalg.norm(effective.kernels[-1])) == pytest.approx(1.0, abs=1e-4)


def test_unpinned_rank_loss_has_no_lower_bound_and_pinned_has():
    """Growing the output layer makes the loss as negative as one likes."""
    rng = np.random.default_rng(0)
    human = jnp.asarray(rng.normal(1.0, 0.1, (8, T, F)), jnp.float32)
    others = jnp.asarray(rng.normal(-1.0, 0.1, (8, 5, T, F)), jnp.float32)

    def loss(scale, pin):
        config = RewardConfig(hidden=(), pin=pin)
        params = init_reward(jax.random.key(0), F, config)
        params = params.replace(kernels=(scale * jnp.ones((F, 1)),))
        v, w = (
            value(params, unit_normaliser(), x, jnp.ones(x.shape[:-1], bool), config)
            for x in (human, others)
        )
        sums = loss_sums("rank", compared(v, w), LossConfig())
        return float(sums.loss / sums.terms)

    assert loss(100.0, "none") == pytest.approx(100.0 * loss(1.0, "none"), rel=1e-3)
    assert loss(100.0, "unit") == pytest.approx(loss(1.0, "unit"), rel=1e-3)


def test_normaliser_is_robust_and_never_divides_by_little():
    features = feature_map("paper21")
    rng = np.random.default_rng(0)
    rows = rng.normal(0.0, 1.0, (1000, F))
    rows[:, 13] = 100.0  # nobody to overtake
    rows[:5, 13] = 3.0
    rows[0, 6] = 1e9  # an outlier, clipped by its cap
    rows[:, 12] *= 1e-3
    made = fit_normaliser(rows, features)
    narrow = features.specs[12]
    assert float(made.scale[12]) == pytest.approx(0.03 * (narrow.upper - narrow.lower))
    assert (np.asarray(made.scale) > 0.0).all()
    assert float(made.location[13]) == 100.0
    assert float(made.scale[13]) > 1.0
    assert abs(float(made.location[6])) < 1.0
    assert float(made.scale[6]) < 5.0
    x = np.asarray(normalise(made, jnp.asarray(rows, jnp.float32)))
    assert np.isfinite(x).all()


def test_lattice_cost_prefers_what_it_should():
    """Cruising at the limit beats crawling; braking for a wall beats hitting it."""

    def cost(made, s):
        return float(
            lattice_cost(made, trajectory_from_positions(made, s, jnp.zeros(T)))
        )

    free = scene(v=20.0, speed_limit=20.0)
    t = jnp.asarray(TIMES_S)
    crawling = jax.lax.cummax(20.0 * t - 1.2 * t**2)
    assert cost(free, 20.0 * t) < cost(free, crawling)
    wall = scene(v=10.0, speed_limit=10.0, boxes=[{"s": 60.0, "speed": 0.0}])
    braking = 10.0 * jnp.minimum(t, 5.0) - jnp.minimum(t, 5.0) ** 2
    assert cost(wall, braking) < cost(wall, 10.0 * t)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"activation": "step"}, "activation: step: expected one of"),
        ({"pin": "loose"}, "pin: loose: expected one of"),
        ({"hidden": (15,), "constraint": "nonnegative"}, "hidden: "),
    ],
)
def test_unknown_names_are_one_line(given, says):
    with pytest.raises(InputError, match=says):
        RewardConfig(**given)


@pytest.mark.parametrize("hidden", SHAPES.values(), ids=SHAPES.keys())
def test_monotone_rewards_never_fall_with_a_safety_term(hidden):
    signs = (1, -1, *[0] * (F - 2))
    config = RewardConfig(hidden=hidden, constraint="monotone", signs=signs)
    rng, moved = np.random.default_rng(0), np.zeros(2)
    all_times = jnp.ones(T, bool)
    of = lambda f, p: value(p, unit_normaliser(), f, all_times, config)  # noqa: E731
    for seed in range(5):
        x = jnp.asarray(rng.normal(0, 2, (40, T, F)), jnp.float32)
        slope = jax.vmap(jax.grad(of), (0, None))(x, draw(config, seed))
        slope = np.asarray(slope)
        assert (slope[..., 0] >= 0.0).all()
        assert (slope[..., 1] <= 0.0).all()
        moved += np.abs(slope[..., 2]).max(), (slope[..., 2] < 0).mean()
    assert (moved > 0).all()


def test_nonnegative_reward_is_a_sum_of_costs():
    config = RewardConfig(hidden=(), constraint="nonnegative")
    params = draw(config)
    x = np.random.default_rng(0).normal(0, 2, (7, T, F)).astype(np.float32)
    found = value(
        params, unit_normaliser(), jnp.asarray(x), jnp.ones((7, T), bool), config
    )
    weights = np.abs(np.asarray(params.kernels[0], np.float64)[:, 0])
    weights /= np.linalg.norm(weights)
    gamma = np.abs(np.asarray(params.gamma, np.float64))
    gamma /= np.linalg.norm(gamma)
    costs = np.concatenate([np.maximum(x, 0), np.maximum(-x, 0)], axis=-1) @ weights
    np.testing.assert_allclose(found, -costs @ gamma, rtol=1e-4)
    assert (np.asarray(found) <= 0.0).all()


def test_costs_of_all_candidates_are_those_of_each():
    scene = random_scene(5)
    candidates = sampled(jax.random.key(1), scene, SamplerConfig())
    each = jax.vmap(lambda x: lattice_cost(scene, x))(candidates.trajectory)
    together = lattice_costs(scene, candidates.trajectory)
    np.testing.assert_allclose(together, each, rtol=1e-5, atol=1e-5)
