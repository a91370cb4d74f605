"""The lattice plan against enumeration, the network and coarser planners."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.features import feature_map
from rcirl_jax.planner.dp import DpConfig, plan_dp
from rcirl_jax.planner.rank import learned_score
from rcirl_jax.reward import RewardConfig, effective_params, init_params
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.sampling.sampler import as_candidates
from rcirl_jax.types import Normaliser
from tests.helpers.scenes import random_scene

FEATURES = feature_map("paper21")
SHAPE = RewardConfig()
COARSE = DpConfig(step=4.0, max_speed=26.0, max_way=160.0)
MIDDLE = DpConfig(step=2.0, max_speed=26.0, max_way=160.0)


@functools.cache
def weights(seed=0, scene_gating=False):
    params = init_params(jax.random.key(seed), 21, SHAPE)
    if scene_gating:
        drawn = np.random.default_rng(seed).normal(0.0, 0.3, (21, 21))
        drawn *= np.asarray(FEATURES.context)[:, None]
        params["scene_gating"] = jnp.asarray(drawn, jnp.float32)
    params = effective_params(params, SHAPE)
    lower = np.array([s.lower for s in FEATURES.specs])
    upper = np.array([s.upper for s in FEATURES.specs])
    return params, Normaliser(
        lower=jnp.asarray(lower, jnp.float32),
        upper=jnp.asarray(upper, jnp.float32),
        location=jnp.asarray(0.5 * (lower + upper), jnp.float32),
        scale=jnp.asarray(0.25 * (upper - lower), jnp.float32),
    )


VALUES = jax.jit(FEATURES)
SCORE = jax.jit(learned_score(FEATURES, SHAPE.activation))


@functools.cache
def planner(config):
    return jax.jit(lambda s, w: plan_dp(s, w, FEATURES, SHAPE.activation, config))


@jax.jit
def network_value(scene, trajectory, w):
    return SCORE(w, scene, as_candidates(trajectory))[0]


def scene_of(seed):
    made = jax.tree.map(jnp.asarray, random_scene(seed))
    valid = jnp.ones_like(made.time_valid)
    v = jnp.minimum(made.ego.v, 12.0)
    limit = jnp.full_like(made.path.speed_limit, 25.0)
    return made.replace(
        time_valid=valid,
        ego=made.ego.replace(v=v, a=jnp.clip(made.ego.a, -1.0, 1.0)),
        path=made.path.replace(speed_limit=limit),
    )


def test_value_of_the_plan_is_the_networks_own():
    feasible = 0
    for seed in range(12):
        made, own = scene_of(seed), weights(seed, scene_gating=True)
        plan = planner(MIDDLE)(made, own)
        feasible += bool(plan.feasible)
        again = float(network_value(made, plan.trajectory, own))
        if bool(plan.feasible):
            assert float(plan.value) == pytest.approx(again, rel=1e-4, abs=1e-4)
        else:
            assert float(plan.value) < -1e4
    assert feasible >= 8


def free(made):
    """The same scene without obstacles."""
    obstacles = made.obstacles
    return made.replace(
        obstacles=obstacles.replace(valid=jnp.zeros_like(obstacles.valid))
    )


def enumerate_best(made, config, depth, w):
    """The best of all lattice plans that differ in their first `depth` choices."""
    step_v, step_s = config.speed_step, config.station_step
    a0, v0 = float(made.ego.a), float(made.ego.v)
    expected = v0 + 0.5 * a0 * 8 / 17
    means = [
        m
        for m in range(config.num_speeds)
        if abs(m * step_v - expected) <= config.first_reach
    ] or [round(expected / step_v)]
    plans = []
    for m1 in means:
        for ks in itertools.product(config.actions, repeat=depth):
            js = [(ks[0] * config.step - a0) / (8 / 17)]
            if abs(js[0]) > max(config.max_jerk, config.step / (8 / 17)):
                continue
            if any(abs(b - a) > config.jerk_reach for a, b in itertools.pairwise(ks)):
                continue
            m, n, stations = m1, m1, [0, m1]
            for k in (*ks, *[0] * (16 - depth)):
                m += k
                if not 0 <= m < config.num_speeds:
                    break
                n += m
                stations.append(n)
            if len(stations) == 18 and n < config.num_stations:
                plans.append(stations)
    s = jnp.asarray(plans, jnp.float32) * step_s + made.ego.s
    trajectory = jax.jit(jax.vmap(trajectory_on_path, (None, 0)))(made, s)
    # the lattice takes no plan whose speed turns negative at the last counted time
    counted = np.asarray(trajectory.v)[:, : depth + 2].min(axis=1) > -1e-3
    values = np.asarray(SCORE(w, made, as_candidates(trajectory)))
    return values[counted], np.asarray(plans)[counted]


@pytest.mark.parametrize("seed", [1, 3, 4])
def test_equals_brute_force_on_a_small_lattice(seed):
    """Only the first 6 times count, so that all plans can be written down."""
    made = free(scene_of(seed))
    made = made.replace(time_valid=jnp.arange(18) < 6)
    plan = planner(COARSE)(made, weights(seed))
    values, plans = enumerate_best(made, COARSE, 4, weights(seed))
    assert len(plans) > 10
    assert float(plan.value) == pytest.approx(values.max(), rel=1e-4, abs=1e-4)
    best = plans[int(values.argmax())]
    np.testing.assert_array_equal(np.asarray(plan.n)[:6], best[:6])


@pytest.mark.slow
def test_a_nested_lattice_is_never_worse():
    fine = DpConfig(step=1.0, max_speed=26.0, max_way=160.0)
    gains = []
    for seed in (1, 4, 5):
        made, w = scene_of(seed), weights(seed)
        values = [float(planner(c)(made, w).value) for c in (COARSE, MIDDLE, fine)]
        assert values[1] >= values[0] - 1e-3
        assert values[2] >= values[1] - 1e-3
        gains.append((values[1] - values[0], values[2] - values[1]))
    # it converges: the second halving gains less than the first, on the whole
    assert sum(b for _, b in gains) < sum(a for a, _ in gains)


def test_walls_and_bodies_are_not_entered():
    for seed in range(6):
        made = scene_of(seed)
        plan = planner(MIDDLE)(made, weights(seed, scene_gating=True))
        if not bool(plan.feasible):
            continue
        # a body that overlaps the ego from behind at t = 0 is not the plan's to avoid
        o = made.obstacles
        behind = 0.5 * (o.s_lower[:, 0] + o.s_upper[:, 0]) < made.ego.s
        ahead = made.replace(obstacles=o.replace(valid=o.valid & ~behind[:, None]))
        row = VALUES(ahead, plan.trajectory)
        names = FEATURES.names
        assert float(row[1:, names.index("collision_distance")].min()) > 0.0
