"""Values and gradients of every loss and network against plain float64 numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rcirl_jax.reward import (
    LOSSES,
    CandidateInfo,
    Normaliser,
    RewardConfig,
    RewardModel,
    init_params,
)
from rcirl_jax.reward.network import layers_of
from rcirl_jax.train.state import FeatureBatch, TrainConfig
from rcirl_jax.train.step import gradient_sums, loss_inputs
from rcirl_jax.units import NUM_TIMES as T
from tests.reward.test_losses import compared, oracle

F, B, K = 4, 3, 5
STEP = 1e-6  # of the differences, in float64
NETWORKS = {
    "linear": RewardConfig(hidden=()),
    "paper": RewardConfig(hidden=(3,)),
    "relu": RewardConfig(hidden=(3,), activation="relu"),
    "deep": RewardConfig(
        hidden=(3, 2), activation="leaky_relu", scale_constraint="none"
    ),
    "nonnegative": RewardConfig(hidden=(), constraint="nonnegative"),
    "monotone": RewardConfig(hidden=(3,), constraint="monotone", signs=(1, -1, 0, 0)),
    "by context": RewardConfig(hidden=(3,), scene_gating=(1, 0, 1, 1)),
}


def unit(x):
    return x / np.sqrt(np.sum(x**2) + 1e-12)


def effective(p, config):
    """Float64 parameters with signs and scale as the configuration asks for."""
    gamma, (kernels, biases) = p["gamma"], layers_of(p["point"])
    context = None
    if config.scene_gating:
        context = p["scene_gating"] * np.array(config.scene_gating)[:, None]
    if config.constraint == "nonnegative":
        costs, gamma = unit(np.abs(kernels[0])), unit(np.abs(gamma))
        eye = np.eye(F)
        return gamma, [np.hstack([eye, -eye]), -costs], [np.zeros(2 * F)], context
    if config.constraint == "monotone":
        signs = np.array(config.signs)[:, None]
        kernels[0] = np.where(signs == 0, kernels[0], signs * np.abs(kernels[0]))
        kernels[1:] = [np.abs(kernel) for kernel in kernels[1:]]
        gamma = np.abs(gamma)
    if config.scale_constraint == "unit":
        if config.activation != "tanh":
            for i, bias in enumerate(biases):
                norm = np.sqrt(np.sum(kernels[i] ** 2, axis=0) + bias**2 + 1e-12)
                kernels[i], biases[i] = kernels[i] / norm, bias / norm
        kernels[-1], gamma = unit(kernels[-1]), unit(gamma)
    return gamma, kernels, biases, context


def value64(p, config, normaliser, features, valid):
    """V of features [..., T, F]."""
    gamma, kernels, biases, context = effective(p, config)
    lower, upper, location, scale = normaliser
    x = (np.clip(features, lower, upper) - location) / scale
    if context is not None:
        x = x * 2.0 / (1.0 + np.exp(-(x[..., :1, :] @ context)))
    act = {
        "tanh": np.tanh,
        "relu": lambda v: np.maximum(v, 0.0),
        "leaky_relu": lambda v: np.where(v >= 0.0, v, 0.01 * v),
        "identity": lambda v: v,
    }[config.hidden_activation]
    for kernel, bias in zip(kernels[:-1], biases, strict=True):
        x = act(x @ kernel + bias)
    return np.sum(np.where(valid, gamma * (x @ kernels[-1])[..., 0], 0.0), axis=-1)


def drawn(name, config, seed):
    """(parameters, normaliser, batch), float32; some candidates do not count."""
    rng = np.random.default_rng(seed)
    as32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    params = init_params(jax.random.key(seed), F, config)
    params = jax.tree.map(lambda x: x + as32(rng.normal(0, 0.3, x.shape)), params)
    if name == "gan":
        params["offset"] = as32(rng.normal())
    normaliser = Normaliser(
        lower=as32(np.full(F, -3.0)), upper=as32(np.full(F, 3.0)),
        location=as32(rng.normal(size=F)), scale=as32(rng.uniform(0.5, 2.0, F)),
    )  # fmt: skip
    pairs = lambda *x: as32(rng.uniform(*x, (B, K)))  # noqa: E731
    info = CandidateInfo(
        human_distance=as32(rng.uniform(0, 1, B)), human_collides=jnp.zeros(B, bool),
        distance=pairs(0, 20), collides=pairs(0, 1) < 0.3, breaks_rule=pairs(0, 1),
        human_density=as32(rng.normal(size=B)), density=pairs(-1, 1),
        human_own=as32(rng.normal(size=B)), own=pairs(-1, 1),
    )  # fmt: skip
    counts = rng.random((B, K)) < 0.7
    counts[:, 0], counts[1] = True, False  # one scene has nothing to compare
    human, candidates = rng.normal(0, 2, (B, T, F)), rng.normal(0, 2, (B, F, T, K))
    for feature in np.nonzero(config.scene_gating)[0]:  # shared at t = 0 in every scene
        candidates[:, feature, 0] = human[:, :1, feature]
    made = FeatureBatch(
        human=as32(human), candidates=as32(candidates), feasible=jnp.asarray(counts),
        time_valid=jnp.arange(T) < jnp.asarray(rng.integers(1, T + 1, (B, 1))),
        info=info, weight=jnp.ones(B), index=jnp.arange(B),
    )  # fmt: skip
    return params, normaliser, made


def loss64(name, config, params, normaliser, made):
    """Mean loss of float64 parameters."""
    as64 = lambda x: np.asarray(x, np.float64)  # noqa: E731
    box = tuple(as64(getattr(normaliser, n)) for n in
                ("lower", "upper", "location", "scale"))  # fmt: skip
    valid = np.asarray(made.time_valid)
    human = value64(params, config, box, as64(made.human), valid)
    points = as64(made.candidates).transpose(0, 3, 2, 1)
    values = value64(params, config, box, points, valid[:, None])
    info = jax.tree.map(as64, made.info)
    c = compared([0.0], [[0.0]])._replace(
        human=human, candidates=values, feasible=as64(made.feasible),
        weight=as64(made.weight) * as64(made.feasible).any(axis=1),
        offset=params.get("offset", np.zeros(())), info=info,
    )  # fmt: skip
    return oracle(name, c), human, values


PAIRS = [(name, "paper") for name in sorted(LOSSES)] + [
    ("logistic", network) for network in NETWORKS if network != "paper"
]


@pytest.mark.parametrize(("name", "network"), PAIRS)
@settings(max_examples=max(settings().max_examples // 12, 2))
@given(seed=st.integers(0, 10_000))
def test_loss_and_gradient_equal_float64(name, network, seed):
    config = NETWORKS[network]
    params, normaliser, made = drawn(name, config, seed)
    whole = TrainConfig(loss=name, reward=config)
    found, sums = SLOPES(RewardModel(config).apply, params, normaliser, made, whole)
    compared32 = VALUES(RewardModel(config).apply, params, normaliser, made)
    exact = jax.tree.map(lambda x: np.asarray(x, np.float64), params)
    loss, human, values = loss64(name, config, exact, normaliser, made)
    np.testing.assert_allclose(compared32.human, human, rtol=2e-4, atol=2e-4)
    np.testing.assert_allclose(compared32.candidates, values, rtol=2e-4, atol=2e-4)
    assert float(sums.loss / sums.terms) == pytest.approx(loss, rel=2e-4, abs=2e-4)
    leaves, structure = jax.tree.flatten(exact)
    slopes = jax.tree.leaves(found)
    for number, leaf in enumerate(leaves):
        for at in np.ndindex(leaf.shape):
            ends = []
            for sign in (STEP, -STEP):
                moved = [x.copy() for x in leaves]
                moved[number][at] += sign
                tried = jax.tree.unflatten(structure, moved)
                ends.append(loss64(name, config, tried, normaliser, made)[0])
            wanted = (ends[0] - ends[1]) / (2.0 * STEP)
            slope = float(slopes[number][at] / sums.terms)
            assert slope == pytest.approx(wanted, rel=2e-3, abs=5e-4), (number, at)


SLOPES = jax.jit(gradient_sums, static_argnums=(0, 4))
VALUES = jax.jit(loss_inputs, static_argnums=0)
