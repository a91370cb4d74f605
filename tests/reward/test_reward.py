"""Value network, normaliser, losses: oracles, pins, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.reward import (
    LOSSES,
    Normaliser,
    RewardConfig,
    fit_normaliser,
    init_reward,
    lattice_cost,
    normalise,
    pair_sums,
    pinned,
    value,
)
from rcirl_jax.sampling import trajectory_from_positions
from rcirl_jax.units import TIMES_S
from tests.scenes import scene

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


@pytest.mark.parametrize("hidden", SHAPES.values(), ids=SHAPES.keys())
@pytest.mark.parametrize("activation", ["tanh", "relu", "leaky_relu"])
@pytest.mark.parametrize("pin", ["unit", "none"])
def test_value_against_float64_loops(hidden, activation, pin):
    config = RewardConfig(hidden=hidden, activation=activation, pin=pin)
    params = pinned(draw(config), config)
    rng = np.random.default_rng(1)
    x, valid = rng.normal(0, 2, (T, F)), rng.uniform(size=T) < 0.7
    act = {
        "tanh": np.tanh,
        "relu": lambda v: np.maximum(v, 0.0),
        "leaky_relu": lambda v: np.where(v >= 0.0, v, 0.01 * v),
    }[activation]
    total = 0.0
    for t in range(T):
        h = np.clip(x[t], -9, 9)
        for kernel, bias in zip(params.kernels[:-1], params.biases, strict=True):
            h = act(h @ np.asarray(kernel, np.float64) + np.asarray(bias, np.float64))
        reward = (h @ np.asarray(params.kernels[-1], np.float64))[0]
        total += float(params.gamma[t]) * reward * valid[t]
    found = value(
        draw(config),
        unit_normaliser(),
        jnp.asarray(x, jnp.float32),
        jnp.asarray(valid),
        config,
    )
    assert float(found) == pytest.approx(total, rel=1e-4, abs=1e-4)


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
        params = init_reward(jax.random.key(0), F, config).replace(
            kernels=(scale * jnp.ones((F, 1)),)
        )
        valid = jnp.ones((8, T), bool)
        v = value(params, unit_normaliser(), human, valid, config)
        w = value(params, unit_normaliser(), others, jnp.ones((8, 5, T), bool), config)
        total, _, count = pair_sums(
            "rank", v, w, jnp.ones((8, 5), bool), jnp.ones(8), 0.05
        )
        return float(total / count)

    assert loss(100.0, "none") == pytest.approx(100.0 * loss(1.0, "none"), rel=1e-3)
    assert loss(100.0, "unit") == pytest.approx(loss(1.0, "unit"), rel=1e-3)


@given(y=st.floats(-20, 20, width=32), a=st.sampled_from([0.01, 0.05, 0.3]))
def test_rank_loss_is_the_papers(y, a):
    found = float(LOSSES["rank"](jnp.float32(y), a))
    assert found == pytest.approx(y if y >= 0 else a * y, rel=1e-5, abs=1e-6)


@given(y=st.floats(-20, 20, width=32))
def test_logistic_loss_is_bradley_terry(y):
    found = float(LOSSES["logistic"](jnp.float32(y), 0.05))
    assert found == pytest.approx(np.log1p(np.exp(y)), rel=1e-4, abs=1e-6)
    # antisymmetry: L(y) - L(-y) = y
    assert found - float(LOSSES["logistic"](jnp.float32(-y), 0.05)) == pytest.approx(
        y, abs=1e-4
    )


def test_pair_sums_leave_out_padding_and_infeasible():
    human = jnp.array([1.0, 1.0])
    values = jnp.array([[2.0, 0.0, 1.0], [5.0, 5.0, 5.0]])
    counts = jnp.array([[True, True, True], [True, True, True]])
    weight = jnp.array([1.0, 0.0])
    total, wins, pairs = pair_sums("rank", human, values, counts, weight, 0.05)
    assert (float(total), float(wins), float(pairs)) == pytest.approx((0.95, 1.5, 3.0))
    total, _, pairs = pair_sums(
        "rank", human, values, counts.at[0, 0].set(False), weight, 0.05
    )
    assert (float(total), float(pairs)) == pytest.approx((-0.05, 2.0))


def test_an_infeasible_candidate_may_not_poison_the_gradient():
    def total(v):
        values = jnp.stack([v * jnp.inf, v])[None]
        return pair_sums(
            "rank", jnp.zeros(1), values, jnp.array([[False, True]]), jnp.ones(1), 0.05
        )[0]

    assert np.isfinite(float(total(jnp.float32(1.0))))


def test_normaliser_is_robust_and_never_divides_by_little():
    features = feature_map("paper21")
    rng = np.random.default_rng(0)
    rows = rng.normal(0.0, 1.0, (1000, F))
    rows[:, 13] = 100.0  # nobody to overtake
    rows[:5, 13] = 3.0
    rows[0, 6] = 1e9  # an outlier, clipped by its cap
    made = fit_normaliser(rows, features)
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


def test_unknown_names_are_one_line():
    with pytest.raises(InputError, match="--activation: step: expected one of"):
        RewardConfig(activation="step")
    with pytest.raises(InputError, match="--pin: loose: expected one of"):
        RewardConfig(pin="loose")
