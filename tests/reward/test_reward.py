"""Normaliser and the hand-set lattice cost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.features import feature_map
from rcirl_jax.reward import (
    fit_normaliser,
    lattice_cost,
    lattice_costs,
    normalise,
)
from rcirl_jax.sampling import SamplerConfig, trajectory_from_positions
from rcirl_jax.units import TIMES_S
from tests.helpers.scenes import random_scene, sampled, scene

F, T = 21, TIMES_S.size


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

    @jax.jit
    def cost(made, s):
        return lattice_cost(made, trajectory_from_positions(made, s, jnp.zeros(T)))

    free = scene(v=20.0, speed_limit=20.0)
    t = jnp.asarray(TIMES_S)
    crawling = jax.lax.cummax(20.0 * t - 1.2 * t**2)
    assert cost(free, 20.0 * t) < cost(free, crawling)
    wall = scene(v=10.0, speed_limit=10.0, boxes=[{"s": 60.0, "speed": 0.0}])
    braking = 10.0 * jnp.minimum(t, 5.0) - jnp.minimum(t, 5.0) ** 2
    assert cost(wall, braking) < cost(wall, 10.0 * t)


def test_costs_of_all_candidates_are_those_of_each():
    scene = random_scene(5)
    candidates = sampled(jax.random.key(1), scene, SamplerConfig())
    of_each = jax.jit(jax.vmap(lattice_cost, in_axes=(None, 0)))
    each = of_each(scene, candidates.trajectory)
    together = jax.jit(lattice_costs)(scene, candidates.trajectory)
    np.testing.assert_allclose(together, each, rtol=1e-5, atol=1e-5)
