"""The sampler: fixed K, feasibility, families, determinism."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.planner.rank import ONLINE_PATHS
from rcirl_jax.sampling import (
    FAMILIES,
    SamplerConfig,
    hard_negatives,
    num_candidates,
    sample,
    trajectory_on_path,
)
from rcirl_jax.sampling.sampler import speed_envelope
from rcirl_jax.types import Kind
from rcirl_jax.units import STATION_STEP_M, TIMES_S
from tests.helpers.scenes import random_scene, sampled, scene

CONFIGS = {mode: SamplerConfig(mode=mode) for mode in ("speed", "path_speed")}
SAMPLE = {
    mode: jax.jit(lambda key, made, c=config: sample(key, made, c))
    for mode, config in CONFIGS.items()
}


NEGATIVES = jax.jit(hard_negatives, static_argnums=(3, 4))


def family(candidates, name):
    return np.flatnonzero(np.asarray(candidates.family) == FAMILIES.index(name))


@pytest.mark.parametrize("mode", CONFIGS)
@given(seed=st.integers(0, 10_000))
def test_any_scene_gives_k_finite_candidates_from_the_ego_state(mode, seed):
    made = random_scene(seed)
    candidates = SAMPLE[mode](jax.random.key(seed), made)
    count = num_candidates(CONFIGS[mode])
    assert candidates.trajectory.s.shape == (count, TIMES_S.size)
    for leaf in jax.tree.leaves(candidates.trajectory):
        assert np.isfinite(np.asarray(leaf)).all()
    start = jax.tree.map(lambda x: np.asarray(x)[:, 0], candidates.trajectory)
    np.testing.assert_allclose(start.s, 0.0, atol=1e-5)
    np.testing.assert_allclose(start.v, made.ego.v)
    np.testing.assert_allclose(start.a, made.ego.a)
    stations = np.asarray(candidates.trajectory.s)
    assert (np.diff(stations, axis=1) >= 0.0).all()
    assert np.asarray(candidates.feasible)[family(candidates, "emergency")][:3].all()


@pytest.mark.parametrize("mode", CONFIGS)
def test_feasible_means_inside_the_limits(mode):
    config = CONFIGS[mode]
    for seed in range(5):
        made = random_scene(seed)
        candidates = SAMPLE[mode](jax.random.key(seed), made)
        valid = np.asarray(made.time_valid).copy()
        valid[0] = False
        emergency = np.asarray(candidates.family) == FAMILIES.index("emergency")
        keep = np.asarray(candidates.feasible) & ~emergency
        a = np.asarray(candidates.trajectory.a)[keep][:, valid]
        j = np.asarray(candidates.trajectory.j)[keep][:, valid]
        assert a.min() >= config.min_acceleration
        assert a.max() <= config.max_acceleration
        assert np.abs(j).max() <= config.max_jerk


def test_families_do_what_they_are_named_for():
    leader = {"s": 40.0, "speed": 8.0}
    made = scene(v=12.0, boxes=[leader])
    candidates = SAMPLE["speed"](jax.random.key(0), made)
    stations = np.asarray(candidates.trajectory.s)
    speeds = np.asarray(candidates.trajectory.v)
    np.testing.assert_allclose(
        stations[family(candidates, "constant_speed")[0]], 12.0 * TIMES_S, rtol=1e-5
    )
    rear = 40.0 + 8.0 * 8.0 - 2.25
    followers = family(candidates, "follow")
    at_end = stations[followers, -1] + 2.45
    gaps = rear - at_end
    assert ((gaps > 2.0) & (gaps < 20.0)).sum() >= 4
    assert stations[family(candidates, "overtake"), -1].max() > rear + 4.5
    assert np.abs(speeds[family(candidates, "emergency"), -1]).max() < 0.5


def test_stops_before_the_line():
    line = {"s": 40.0, "kind": Kind.STOP, "length": 0.0, "width": 40.0}
    made = scene(v=10.0, boxes=[line])
    candidates = SAMPLE["speed"](jax.random.key(0), made)
    fronts = np.asarray(candidates.trajectory.s)[family(candidates, "stop"), -1] + 2.45
    assert ((fronts > 36.0) & (fronts <= 40.0)).sum() >= 4


def test_lateral_profiles_reach_the_neighbouring_lanes():
    made = scene(v=15.0)
    candidates = SAMPLE["path_speed"](jax.random.key(0), made)
    ends = np.asarray(candidates.trajectory.l)[np.asarray(candidates.feasible), -1]
    for target in (0.0, 3.6, -3.6, 0.4, -0.8):
        assert np.abs(ends - target).min() < 0.05


def test_lanes_beyond_the_road_are_not_feasible():
    made = scene(v=15.0)
    lane = {"road_left": made.path.lane_left, "road_right": made.path.lane_right}
    narrow = made.replace(path=made.path.replace(**lane))
    candidates = SAMPLE["path_speed"](jax.random.key(0), narrow)
    ends = np.asarray(candidates.trajectory.l)[np.asarray(candidates.feasible), -1]
    assert np.abs(ends).max() < 1.0


def test_what_stands_in_the_way_is_passed_on_both_sides_and_the_way_leads_back():
    """A car 30 m ahead whose left side is at 0.9 m: the ego passes with 0.45 m."""
    made = scene(v=8.0, boxes=[{"s": 30.0, "kind": Kind.STATIC}])
    candidates = sampled(jax.random.key(0), made, ONLINE_PATHS)
    x, fine = candidates.trajectory, np.asarray(candidates.feasible)
    s, l = np.asarray(x.s)[fine], np.asarray(x.l)[fine]
    beside = np.abs(s - 30.0) < 0.5 * (4.5 + 4.9)
    offset = 0.9 + 0.45 + 1.0
    for side in (1.0, -1.0):
        passes = (np.where(beside, side * l, 9.0).min(axis=1) > offset - 0.02) & (
            beside.any(axis=1) & (s[:, -1] > 60.0) & (np.abs(l[:, -1]) < 0.05)
        )
        assert passes.any()


def test_a_move_takes_its_time_at_the_speed_that_is_driven():
    """Four seconds to the next lane, braking or accelerating."""
    made = scene(v=15.0)
    candidates = sampled(jax.random.key(0), made, ONLINE_PATHS)
    fine = np.asarray(candidates.feasible)
    s, l = (
        np.asarray(x)[fine] for x in (candidates.trajectory.s, candidates.trajectory.l)
    )
    there = np.abs(l - 3.6) < 0.02
    first = np.where(there.any(axis=1), TIMES_S[there.argmax(axis=1)], np.inf)
    quick = np.abs(first - 4.0) < 0.3
    assert np.ptp(s[quick, -1]) > 40.0


def test_only_the_random_family_depends_on_the_key():
    made = random_scene(2)
    one = SAMPLE["speed"](jax.random.key(0), made)
    same = SAMPLE["speed"](jax.random.key(0), made)
    other = SAMPLE["speed"](jax.random.key(1), made)
    np.testing.assert_array_equal(one.trajectory.s, same.trajectory.s)
    differs = np.any(one.trajectory.s != other.trajectory.s, axis=1)
    assert set(np.flatnonzero(differs)) <= set(family(one, "random"))
    assert differs.sum() > 40


def test_hard_negatives_depart_from_the_human_with_time_along_or_aside():
    made = scene(v=12.0)
    human = trajectory_on_path(made, 12.0 * jnp.asarray(TIMES_S))
    near = NEGATIVES(jax.random.key(0), made, human, CONFIGS["path_speed"], 12)
    aside = np.asarray(near.trajectory.l - human.l)
    along = np.asarray(near.trajectory.s - human.s)
    drifts = np.isin(np.arange(12), [4, 5, 10, 11])
    assert (aside[~drifts] == 0.0).all()
    assert (along[drifts] == 0.0).all()
    assert (aside[:, 0] == 0.0).all()
    assert (along[:, 0] == 0.0).all()
    last = np.abs(aside[drifts, -1])
    assert ((last >= 0.24) & (last <= 1.51)).all()
    assert sorted(np.sign(aside[drifts, -1])) == [-1, -1, 1, 1]
    last = along[~drifts, -1]
    assert ((np.abs(last) >= 0.99) & (np.abs(last) <= 6.01)).all()
    assert (last > 0).sum() == 4


def stepped_scene(first=15.0, second=8.0, station=60.0, **changes):
    """The limit changes at a station."""
    made = scene(speed_limit=first, **changes)
    stations = STATION_STEP_M * jnp.arange(made.path.speed_limit.shape[0])
    limit = jnp.where(stations < station, first, second)
    return made.replace(path=made.path.replace(speed_limit=limit))


def test_speed_envelope_equals_its_definition():
    made = stepped_scene(kappa=0.01)
    lateral, braking = np.array([2.0, 0.5]), np.array([1.0, 0.7])
    found = speed_envelope(made, jnp.asarray(lateral), jnp.asarray(braking))
    stations = STATION_STEP_M * np.arange(found.shape[1])
    limit = np.asarray(made.path.speed_limit)
    for row, a, b in zip(np.asarray(found), lateral, braking, strict=True):
        cap = np.minimum(limit**2, a / 0.01)
        for i in range(0, stations.size, 7):
            ways = stations[i:] - stations[i]
            expected = np.sqrt(np.min(cap[i:] + 2.0 * b * ways))
            assert row[i] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("change", [(15.0, 8.0, 60.0), (8.0, 15.0, 20.0)])
def test_envelope_drives_up_to_a_changing_limit(change):
    """Below it throughout, and close to it where there was time to get there."""
    first, second, station = change
    made = stepped_scene(first, second, station, v=0.95 * first)
    candidates = SAMPLE["speed"](jax.random.key(0), made)
    index = family(candidates, "envelope")[0]
    s, v = candidates.trajectory.s[index], np.asarray(candidates.trajectory.v[index])
    limit = np.asarray(jnp.interp(s, STATION_STEP_M * jnp.arange(made.path.l.size),
                                  made.path.speed_limit))  # fmt: skip
    assert (v[1:] <= limit[1:] + 0.1).all()
    assert v[-1] > 0.85 * second
    assert np.asarray(candidates.feasible)[index]
    assert np.abs(candidates.trajectory.a[index]).max() < 2.5
