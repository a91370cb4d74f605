"""Attribution against closed forms, completeness, and the paper's axioms."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.evaluation.attribution import attribute
from rcirl_jax.reward import Normaliser, effective_model, normalise, value
from rcirl_jax.reward.network import point_of
from rcirl_jax.units import NUM_TIMES

T, F = NUM_TIMES, 21
VALID = np.arange(T) < T - 3

run = jax.jit(attribute, static_argnames=("activation", "steps"))
value_of = jax.jit(value, static_argnames="model")


def floats(x):
    return jnp.asarray(x, jnp.float32)


def normaliser():
    rng = np.random.default_rng(5)
    return Normaliser(
        lower=jnp.full(F, -6.0),
        upper=jnp.full(F, 7.0),
        location=floats(rng.normal(0, 1, F)),
        scale=floats(rng.uniform(0.5, 3.0, F)),
    )


def network(hidden=(15,), seed=0):
    """Random weights of about the size that keeps units out of saturation."""
    rng = np.random.default_rng(seed)
    sizes = (F, *hidden, 1)
    gamma = floats(rng.uniform(0.1, 0.4, T))
    kernels = [
        floats(rng.normal(0, i**-0.5, (i, o))) for i, o in itertools.pairwise(sizes)
    ]
    biases = [floats(rng.normal(0, 0.3, h)) for h in hidden]
    return {"gamma": gamma, "point": point_of(kernels, biases)}


def difference(params, a, b, activation="tanh"):
    """V(a) - V(b) as the package has it."""
    model = effective_model(params, activation)
    both = jnp.stack([a, b])
    worth = value_of(model, params, normaliser(), both, jnp.stack([VALID] * 2))
    return float(worth[0] - worth[1])


def trajectories(seed=1):
    """Two [T, F] of normalised features with variance 1, some beyond the bounds."""
    rng, norm = np.random.default_rng(seed), normaliser()
    return [floats(norm.location + norm.scale * x) for x in rng.normal(0, 1, (2, T, F))]


def test_linear_reward_gives_the_terms_of_its_sum():
    params = network(())
    a, b = trajectories()
    x_a, x_b = (np.asarray(normalise(normaliser(), f), np.float64) for f in (a, b))
    gamma = np.asarray(params["gamma"], np.float64)[:, None] * VALID[:, None]
    want = gamma * np.asarray(params["point"]["out"]["kernel"])[:, 0] * (x_a - x_b)
    got = run(params, normaliser(), a, b, VALID, "identity", steps=1)
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6)


def test_a_feature_counts_up_to_its_bound_and_one_that_does_not_differ_gets_nothing():
    params, (a, b) = network(), trajectories()
    a = a.at[:, 4].set(b[:, 4])
    # beyond its upper bound in both: the network sees no difference either
    a, b = a.at[:, 9].set(8.0), b.at[:, 9].set(50.0)
    got = np.asarray(run(params, normaliser(), a, b, VALID, "tanh"))
    np.testing.assert_array_equal(got[:, [4, 9]], 0.0)
    assert np.all(np.abs(got[VALID][:, [0, 3]]) > 0.0)
    ends = [
        run(params, normaliser(), b.at[:, 2].set(end), b, VALID, "tanh")
        for end in (7.0, 700.0)
    ]
    np.testing.assert_array_equal(*ends)


def test_invalid_times_contribute_nothing_whatever_is_there():
    params, (a, b) = network(), trajectories()
    a, b = a.at[~VALID].set(jnp.nan), b.at[~VALID].set(1e6)
    got = np.asarray(run(params, normaliser(), a, b, VALID, "tanh"))
    np.testing.assert_array_equal(got[~VALID], 0.0)
    assert np.all(np.isfinite(got))
    assert float(got.sum()) == pytest.approx(difference(params, a, b), rel=1e-3)
