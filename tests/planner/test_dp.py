"""The lattice plan against enumeration, the network and coarser planners."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.features import feature_map
from rcirl_jax.features.columns import path_view
from rcirl_jax.planner.dp import (
    DpConfig,
    Objective,
    backward,
    dp_policy,
    make_lattice,
    make_layers,
    search,
    smoothed,
)
from rcirl_jax.planner.rank import RankConfig, learned_score, ranking, ranking_score
from rcirl_jax.reward import RewardConfig, effective_params, init_params
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.sampling.sampler import as_candidates
from rcirl_jax.types import Normaliser
from rcirl_jax.units import DT_S
from tests.helpers.scenes import random_scene

FEATURES = feature_map("paper21")
SHAPE = RewardConfig()
COARSE = DpConfig(step=4.0, max_speed=26.0, max_way=160.0)


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
    return jax.jit(lambda s, w: best(s, w, config))


def best(scene, w, config, **objective):
    """The best plan of a search."""
    config = dataclasses.replace(config, proposals=1)
    plans = search(scene, w, FEATURES, SHAPE.activation, config, Objective(**objective))
    return jax.tree.map(lambda x: x[0], plans)


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
    # the lattice takes no plan whose speed turns negative at the last counted time, or
    # that is too fast for a bend
    v = np.asarray(trajectory.v)[:, 1 : depth + 2]
    fastest = np.maximum(v, np.diff(np.asarray(s))[:, : depth + 1] * 17 / 8)
    kappa = np.abs(np.asarray(jax.vmap(path_view, (None, 0))(made, s).kappa))
    bend = fastest**2 * kappa[:, 1 : depth + 2]
    counted = (v.min(axis=1) > -1e-3) & (bend.max(axis=1) < 4.0)
    values = np.asarray(SCORE(w, made, as_candidates(trajectory)))
    return values[counted], np.asarray(plans)[counted]


@pytest.mark.parametrize("seed", [1, 4])
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


def total(made, trajectory, w, own, gain):
    """V_own + gain V of one trajectory, as the planner values it."""
    one = as_candidates(trajectory)
    params = ranking(w, own, gain)
    return float(RANKED(params, made, one)[0])


RANKED = jax.jit(ranking_score(FEATURES, SHAPE.activation))


def nearest_body(made, trajectory):
    """m to who is ahead at t = 0; who comes from behind is not the plan's to avoid."""
    o = made.obstacles
    behind = 0.5 * (o.s_lower[:, 0] + o.s_upper[:, 0]) < made.ego.s
    ahead = made.replace(obstacles=o.replace(valid=o.valid & ~behind[:, None]))
    row = VALUES(ahead, trajectory)
    return float(row[1:, FEATURES.names.index("collision_distance")].min())


@pytest.mark.parametrize("own", ["+velocity", "hand-set DP"])
def test_an_own_cost_that_is_a_sum_is_searched_exactly(own):
    """The recursion adds up what the planner's score says; nobody is run into."""
    gain, found = 3.0, 0
    plan_of = jax.jit(lambda made, w: best(made, w, COARSE, gain=gain, own=own))
    for seed in range(6):
        made, w = scene_of(seed), weights(seed, scene_gating=True)
        plan = plan_of(made, w)
        if not bool(plan.feasible):
            assert float(plan.value) < -1e4
            continue
        found += 1
        value = total(made, plan.trajectory, w, own, gain)
        if own == "+velocity":  # all plans have the same speed at t = 0
            value -= float(made.ego.v) / 18
        assert float(plan.value) == pytest.approx(value, rel=1e-4, abs=1e-4)
        assert nearest_body(made, plan.trajectory) > 0.0
    assert found >= 3


def test_a_search_is_by_the_own_cost_where_v_does_not_know_the_scene(monkeypatch):
    """A speed that never varied in training: as it is now, and 1.1 scales away."""
    made = scene_of(0)
    params, norm = weights(0)
    at, gains = FEATURES.names.index("velocity"), []

    def found(scene, w, features, activation, config, objective):
        gains.append(float(objective.gain))
        raise StopIteration

    monkeypatch.setattr("rcirl_jax.planner.dp.search", found)
    for own in ("+velocity", "constant V"):
        policy = dp_policy(FEATURES, SHAPE.activation, RankConfig(), COARSE, own)
        for off in (0.0, 1.1):
            usual = norm.location.at[at].set(made.ego.v + off * norm.scale[at])
            empty = {x: getattr(norm, x).at[at].set(1.0) for x in ("lower", "upper")}
            w = params, norm.replace(location=usual, **empty)
            searching = ranking(w, own, 3.0), jnp.asarray(False)
            with jax.disable_jit(), pytest.raises(StopIteration):
                policy(searching, made, jax.random.key(0))
    assert gains == [3.0, 0.0, 3.0, 3.0]


def test_ratios_are_linear_about_the_reference():
    """A step away from it, the sum moves by as much as Apollo's cost does."""
    made = free(scene_of(2))
    w, s0, v0 = weights(2), float(made.ego.s), 10.0
    made = made.replace(ego=made.ego.replace(v=jnp.asarray(v0), a=jnp.asarray(0.0)))
    lattice = DpConfig(step=1.0, max_speed=26.0, max_way=200.0)
    m0, on_path = round(v0 / lattice.speed_step), jax.jit(trajectory_on_path)

    def plan(*changes):
        """A plan on the lattice: accelerations in steps from each time on."""
        w_i = np.full(17, m0)
        for at, by in changes:
            w_i[at:] += by
        s = s0 + lattice.station_step * np.concatenate([[0], np.cumsum(w_i)])
        return on_path(made, jnp.asarray(s, jnp.float32))

    # jerk and speed change at many times, so that no term is at a kink
    base = [(2, 1), (5, -2), (8, 3), (11, -2), (14, 2)]
    reference, moved = plan(*base), plan(*base, (9, 1))
    tables = lambda made, w, x: make_lattice(  # noqa: E731
        made, w, FEATURES, lattice, Objective(gain=0.0, reference=x, own="hand-set")
    )
    sums = jax.jit(tables)(made, w, reference).own

    def sum_of(x):
        n = np.round((np.asarray(x.s) - s0) / lattice.station_step).astype(int)
        u = np.round(2 * np.asarray(x.v) / lattice.speed_step).astype(int)
        points = np.asarray(sums.point)[np.arange(1, 18), u[1:], n[1:]].sum()
        return points + np.asarray(sums.of_jerk(x.j)).sum()

    of_sum = sum_of(moved) - sum_of(reference)
    of_cost = total(made, moved, w, "hand-set", 0.0) - total(
        made, reference, w, "hand-set", 0.0
    )
    assert abs(of_cost) > 0.01
    assert of_sum == pytest.approx(of_cost, rel=0.15)


def test_smoothing_keeps_what_is_smooth_and_takes_out_steps():
    made = scene_of(0)
    v, a, t = float(made.ego.v), float(made.ego.a), np.arange(18) * 8 / 17
    even = float(made.ego.s) + v * t + 0.5 * a * t**2
    assert even[-1] > even.max() - 1e-6  # it never moves backwards
    kept = np.asarray(smoothed(made, jnp.asarray(even, jnp.float32)))
    np.testing.assert_allclose(kept, even, atol=2e-3)
    uneven = even + np.where(np.arange(18) % 4 == 0, 0.15, 0.0)
    uneven[0] = even[0]
    smooth = np.asarray(smoothed(made, jnp.asarray(uneven, jnp.float32)))
    jerk = lambda s: np.abs(np.diff(s, 3)).mean()  # noqa: E731
    assert jerk(smooth) < 0.2 * jerk(uneven)
    assert np.abs(smooth - uneven).max() < 0.2


def test_values_at_full_size_equal_a_recursion_in_float64():
    """Large sums may not go wrong in fusions of XLA (jax-ml/jax issue 39103)."""
    made, own, config = scene_of(1), weights(1), DpConfig()
    objective = Objective(gain=2.0, own="+velocity")
    tables = lambda *x: make_lattice(*x, FEATURES, config, objective)  # noqa: E731
    lattice = jax.jit(tables)(made, own)
    layers = make_layers(own, FEATURES, lattice.first_row)
    solved = jax.jit(lambda a, b: backward(a, b, config, SHAPE.activation)[0])
    found = np.asarray(solved(lattice, layers))

    in_float64 = lambda leaf: np.asarray(leaf, np.float64)  # noqa: E731
    x = lattice.replace(own=None)
    x, y = jax.tree.map(in_float64, (x, layers))
    actions, count = config.actions, config.num_stations
    a = np.asarray(actions) * config.step
    w = np.arange(config.num_speeds) * config.speed_step
    n, m = np.arange(count), np.arange(config.num_speeds)[:, None]
    bounded = lambda z, of: np.clip(z, *of)[..., None]  # noqa: E731

    def rewards(t, i):
        """Of action i after every other [K, M, N], and where speed is kept [M, N]."""
        v = w + 0.5 * a[i] * DT_S
        rows = x.c0[t] + x.c1[t] * v[:, None, None] + x.c2[t] * v[:, None, None] ** 2
        rows = np.clip(rows, y.lower, y.upper) @ y.first + y.offset  # [M, N, H]
        j = (a[i] - a) / DT_S
        motion = bounded(a[i], y.bounds_a) * y.of_a + bounded(j, y.bounds_j) * y.of_j
        total = np.stack([np.tanh(rows + one) @ y.kernels[0][:, 0] for one in motion])
        total = x.weight[t] * total + np.maximum(v, 0.0)[:, None] * 1.0 / 18.0
        fits = (v >= 0.0)[:, None] & (
            np.maximum(v, w)[:, None] <= x.speed_cap[t] + 1e-4
        )
        return total, fits

    values = np.empty((len(actions), config.num_speeds, count))
    for i in range(len(actions)):
        total, fits = rewards(17, i)
        values[i] = np.where(fits, total[i], -1e6)
    for t in range(16, 1, -1):
        best = np.full(values.shape, -1e6)
        for i, k in enumerate(actions):
            to_m, to_n = m + k, n + m + k
            there = (to_m >= 0) & (to_m < config.num_speeds) & (to_n < count)
            at_m, at_n = np.where(there, to_m, 0), np.where(there, to_n, 0)
            there &= ~x.blocked[t + 1].astype(bool)[at_n]
            there &= ~x.blocked_after[t].astype(bool)[np.where(there, n + at_n, 0)]
            total, fits = rewards(t, i)
            ahead = np.where(there & fits, values[i, at_m, at_n], -1e6)
            for before, of in enumerate(total):
                if abs(before - i) <= config.jerk_reach:
                    best[before] = np.maximum(best[before], of + ahead)
        values = np.maximum(best, -1e6)
    may = values > -1e5
    assert 0.05 < may.mean() < 0.95
    np.testing.assert_array_equal(found > -1e5, may)
    np.testing.assert_allclose(found[may], values[may], rtol=1e-4, atol=1e-3)
