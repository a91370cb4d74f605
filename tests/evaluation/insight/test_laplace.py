"""Last-layer Laplace: identity of Phi, Hessian, rate, coverage on simulated pairs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import expit

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.insight.laplace import (
    difference_std,
    laplace,
    last_layer_features,
    most_probable,
)
from rcirl_jax.reward import (
    LossConfig,
    Normaliser,
    RewardConfig,
    RewardParams,
    loss_sums,
    normalise,
    value,
)
from rcirl_jax.units import NUM_TIMES
from tests.reward.compared import compared

T, F = NUM_TIMES, 6
S, K = 12, 5
PRIOR = 0.7

NORMALISER = Normaliser(
    lower=jnp.full(F, -4.0),
    upper=jnp.full(F, 4.0),
    location=jnp.linspace(-1.0, 1.0, F),
    scale=jnp.linspace(0.5, 2.0, F),
)


def network(hidden):
    """Random effective parameters."""
    rng = np.random.default_rng(0)
    sizes = (F, *hidden, 1)
    draw = lambda *shape: jnp.asarray(rng.normal(0, 0.5, shape), jnp.float32)  # noqa: E731
    return RewardParams(
        gamma=draw(T),
        kernels=tuple(map(draw, sizes[:-1], sizes[1:])),
        biases=tuple(map(draw, hidden)),
    )


phi_of = jax.jit(last_layer_features, static_argnames="activation")
value_of = jax.jit(value, static_argnames="config")


def scenes(seed=1):
    rng = np.random.default_rng(seed)
    features = jnp.asarray(rng.normal(0, 2, (S, 1 + K, T, F)), jnp.float32)
    valid = np.arange(T) < rng.integers(9, T + 1, (S, 1, 1))
    valid = jnp.asarray(np.broadcast_to(valid, (S, 1 + K, T)))
    return features, valid, rng.random((S, K)) < 0.8


@pytest.mark.parametrize(
    ("hidden", "activation"), [((), "identity"), ((7,), "tanh"), ((5, 3), "relu")]
)
def test_value_is_linear_in_the_output_weights(hidden, activation):
    params = network(hidden)
    features, valid, _ = scenes()
    phi = phi_of(params, NORMALISER, features, valid, activation)
    w = params.kernels[-1][:, 0]
    assert phi.shape == (S, 1 + K, *w.shape)
    config = RewardConfig(hidden=hidden, activation=activation, pin="none")
    want = value_of(params, NORMALISER, features, valid, config)
    np.testing.assert_allclose(phi @ w, want, rtol=1e-4, atol=1e-5)


def test_linear_reward_sums_its_normalised_features():
    params = network(())
    features, valid, _ = scenes()
    phi = phi_of(params, NORMALISER, features, valid, "identity")
    x = np.asarray(normalise(NORMALISER, features), np.float64)
    want = np.einsum("t,skt,sktf->skf", params.gamma, valid, x)
    np.testing.assert_allclose(phi, want, rtol=1e-4, atol=1e-5)


def test_features_at_invalid_times_are_not_read():
    params = network((7,))
    features, valid, _ = scenes()
    spoiled = jnp.where(valid[..., None], features, jnp.nan)
    np.testing.assert_array_equal(
        phi_of(params, NORMALISER, features, valid, "tanh"),
        phi_of(params, NORMALISER, spoiled, valid, "tanh"),
    )


@pytest.mark.parametrize(("hidden", "activation"), [((), "identity"), ((7,), "tanh")])
def test_precision_is_the_hessian_of_the_training_loss(hidden, activation):
    """The loss as the trainer computes it, through the whole network."""
    params = network(hidden)
    features, valid, feasible = scenes()
    phi = phi_of(params, NORMALISER, features, valid, activation)
    w = params.kernels[-1][:, 0]
    config = RewardConfig(hidden=hidden, activation=activation, pin="none")

    def loss(w):
        changed = params.replace(kernels=(*params.kernels[:-1], w[:, None]))
        v = value(changed, NORMALISER, features, valid, config)
        seen = compared(v[:, 0], v[:, 1:], counts=feasible)
        sums = loss_sums("logistic", seen, LossConfig())
        return sums.loss + 0.5 * PRIOR * jnp.sum(w**2)

    got = laplace(phi[:, 0], phi[:, 1:], feasible, w, PRIOR)
    want = np.asarray(jax.jit(jax.hessian(loss))(w))
    np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-4 * np.abs(want).max())


def test_infeasible_pairs_are_not_read():
    rng = np.random.default_rng(3)
    human, candidates = rng.normal(size=(S, 3)), rng.normal(size=(S, K, 3))
    feasible, w = rng.random((S, K)) < 0.6, rng.normal(size=3)
    spoiled = np.where(feasible[..., None], candidates, np.nan)
    want = PRIOR * np.eye(3)
    for s, k in zip(*np.nonzero(feasible), strict=True):
        d = candidates[s, k] - human[s]
        p = 1.0 / (1.0 + np.exp(-d @ w))
        want += p * (1.0 - p) * np.outer(d, d)
    got = laplace(human, spoiled, feasible, w, PRIOR)
    np.testing.assert_allclose(got, want, rtol=1e-12)


def test_std_falls_like_the_root_of_the_amount_of_data():
    rng = np.random.default_rng(4)
    human, candidates = rng.normal(size=(S, 3)), rng.normal(size=(S, K, 3))
    feasible, w = np.ones((S, K), bool), rng.normal(size=3)
    a, b = rng.normal(size=(2, 9, 3))

    def std(times):
        tiled = (np.concatenate([x] * times) for x in (human, candidates, feasible))
        return difference_std(laplace(*tiled, w, 1e-6), a, b)

    for times in (4, 25):
        np.testing.assert_allclose(std(1) / std(times), times**0.5, rtol=1e-5)


def test_std_without_data_is_the_priors():
    nothing = np.zeros((S, K), bool)
    rng = np.random.default_rng(5)
    precision = laplace(
        rng.normal(size=(S, 3)), rng.normal(size=(S, K, 3)), nothing, np.ones(3), 4.0
    )
    a, b = np.array([[3.0, 0.0, 4.0], [1.0, 1.0, 1.0]]), np.zeros(3)
    std = difference_std(precision, a, b)
    np.testing.assert_allclose(std, [2.5, 0.5 * 3.0**0.5])
    assert difference_std(precision, a[0], a[0]) == 0.0
    assert difference_std(precision, a[:, None], a).shape == (2, 2)


def fitted(differences, prior):
    """Minimum of the pair loss, by scipy's Newton method with a trust region."""

    def loss(w):
        return np.logaddexp(0.0, differences @ w).sum() + 0.5 * prior * w @ w

    def slope(w):
        return differences.T @ expit(differences @ w) + prior * w

    def hessian(w):
        p = expit(differences @ w)
        return (differences.T * (p * (1.0 - p))) @ differences + prior * np.eye(w.size)

    start = np.zeros(differences.shape[1])
    return minimize(loss, start, jac=slope, hess=hessian, method="trust-exact").x


def test_the_most_probable_weights_are_the_minimum():
    rng = np.random.default_rng(9)
    human, candidates = rng.normal(size=(S, 3)), rng.normal(size=(S, K, 3))
    feasible = rng.random((S, K)) < 0.7
    want = fitted((candidates - human[:, None])[feasible], PRIOR)
    got = most_probable(human, candidates, feasible, PRIOR)
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-8)
    assert np.abs(want).max() > 0.1


def test_intervals_cover_the_true_differences():
    """95 % intervals of new differences, w* drawn from the prior."""
    rng = np.random.default_rng(6)
    scenes, size, prior, hits, repeats = 120, 3, 0.5, 0, 300
    for _ in range(repeats):
        truth = rng.normal(0, prior**-0.5, size)
        one, other = rng.normal(size=(2, scenes, size))
        first_wins = rng.random(scenes) < expit((one - other) @ truth)
        human = np.where(first_wins[:, None], one, other)
        candidate = np.where(first_wins[:, None], other, one)
        w = fitted(candidate - human, prior)
        all_pairs = np.ones((scenes, 1), bool)
        precision = laplace(human, candidate[:, None], all_pairs, w, prior)
        a, b = rng.normal(size=(2, size))
        std = difference_std(precision, a, b)
        hits += abs((a - b) @ (w - truth)) < 1.959964 * std
    assert 0.88 <= hits / repeats <= 0.99


def test_input_that_does_not_fit_is_refused():
    human, candidates = np.zeros((S, 3)), np.zeros((S, K, 3))
    feasible, w = np.ones((S, K), bool), np.zeros(3)
    with pytest.raises(InputError, match=r"expected \[S, H\], \[S, K, H\]"):
        laplace(human[:, :2], candidates, feasible, w, PRIOR)
    with pytest.raises(InputError, match=r"expected \[S, H\], \[S, K, H\]"):
        laplace(human, candidates[0], feasible, w, PRIOR)
    with pytest.raises(InputError, match=r"w: shape \(2,\): expected \(3,\)"):
        laplace(human, candidates, feasible, w[:2], PRIOR)
    with pytest.raises(InputError, match="prior_precision: 0"):
        laplace(human, candidates, feasible, w, 0.0)
    with pytest.raises(InputError, match="NaN or infinite"):
        laplace(human + np.nan, candidates, feasible, w, PRIOR)
    with pytest.raises(InputError, match=r"expected \[H, H\]"):
        difference_std(np.eye(3), np.zeros(2), np.zeros(3))
    with pytest.raises(InputError, match="that broadcast"):
        difference_std(np.eye(3), np.zeros((2, 3)), np.zeros((4, 3)))
    with pytest.raises(InputError, match="not positive definite"):
        difference_std(-np.eye(3), np.zeros(3), np.ones(3))
    params = network((7,))
    features, valid, _ = scenes()
    with pytest.raises(InputError, match="last_layer_features: time_valid"):
        last_layer_features(params, NORMALISER, features, valid[0], "tanh")


def test_clusters_give_the_sandwich():
    """By a loop over scenes; many pairs of one scene are no more than the scene."""
    rng = np.random.default_rng(8)
    human, candidates = rng.normal(size=(S, 3)), rng.normal(size=(S, K, 3))
    feasible, w = rng.random((S, K)) < 0.8, rng.normal(size=3)
    cluster = np.arange(S) // 3
    scores = np.zeros((cluster.max() + 1, 3))
    hessian = PRIOR * np.eye(3)
    for s in range(S):
        for k in range(K):
            d = (candidates[s, k] - human[s]) * feasible[s, k]
            chance = expit(d @ w)
            scores[cluster[s]] += chance * d
            hessian += chance * (1.0 - chance) * np.outer(d, d)
    count = len(scores)
    spread = count * np.cov(scores, rowvar=False) + PRIOR * np.eye(3)
    want = hessian @ np.linalg.inv(spread) @ hessian
    got = laplace(human, candidates, feasible, w, PRIOR, cluster)
    np.testing.assert_allclose(got, want, rtol=1e-9)
    with pytest.raises(InputError, match="cluster: 1 clusters: expected at least 2"):
        laplace(human, candidates, feasible, w, PRIOR, np.zeros(S))
