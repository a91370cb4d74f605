"""The safety filter against dense sampling, and its rules one by one."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.planner.rank import ONLINE, ONLINE_PATHS
from rcirl_jax.planner.safety import (
    Reason,
    SafetyConfig,
    Verdict,
    check,
    choose,
    explain,
    first_contact,
    last_resort,
    motion_of,
)
from rcirl_jax.sampling.kinematics import trajectory_from_positions, trajectory_on_path
from rcirl_jax.sampling.sampler import as_candidates
from rcirl_jax.types import Kind
from rcirl_jax.units import DT_S, TIMES_S
from tests.helpers.scenes import random_scene, sampled, scene

BARE = SafetyConfig(margin_along=0.0, margin_growth=0.0, margin_across=0.0)


@functools.cache
def scene_and_candidates(seed):
    made = jax.tree.map(jnp.asarray, random_scene(seed))
    return made, sampled(jax.random.key(seed), made, ONLINE)


contact = jax.jit(lambda s, c: first_contact(s, motion_of(c.trajectory), BARE))
judge = jax.jit(lambda s, c: check(s, c))


def dense_contact(made, x, steps=40):
    """Whether boxes overlap anywhere between the times, by linear sub-sampling."""
    o, ego = made.obstacles, made.ego
    half = 0.5 * float(ego.length), 0.5 * float(ego.width)
    kind = np.asarray(o.kind)
    tilt = np.arctan(np.asarray(x.dl))
    half_s = half[0] * np.cos(tilt) + half[1] * np.abs(np.sin(tilt))
    half_l = half[0] * np.abs(np.sin(tilt)) + half[1] * np.cos(tilt)
    for n in np.flatnonzero((kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)):
        low, high = np.asarray(o.s_lower[n]), np.asarray(o.s_upper[n])
        right, left = np.asarray(o.l_lower[n]), np.asarray(o.l_upper[n])
        s, l = np.asarray(x.s), np.asarray(x.l)
        middle, across = 0.5 * (low + high), 0.5 * (right + left)
        beside = abs(across[0] - l[0]) >= half_l[0] + (left - right)[0] / 2
        if middle[0] < s[0] and not beside:
            continue
        for i in range(17):
            if not (o.valid[n, i] and o.valid[n, i + 1]):
                continue
            u = np.linspace(0, 1, steps)
            at = lambda a, i=i, u=u: a[i] + u * (a[i + 1] - a[i])  # noqa: E731
            wide = lambda a, i=i: max(a[i], a[i + 1])  # noqa: E731
            reach_s = wide(half_s) + wide((high - low) / 2)
            reach_l = wide(half_l) + wide((left - right) / 2)
            near_s = np.abs(at(middle) - at(s)) <= reach_s
            if np.any(near_s & (np.abs(at(across) - at(l)) <= reach_l)):
                return TIMES_S[i]
    return np.inf


@pytest.mark.parametrize("seed", range(3))
def test_swept_boxes_equal_dense_sampling(seed):
    made, candidates = scene_and_candidates(seed)
    found = np.asarray(contact(made, candidates))
    for k in range(0, 64, 5):
        x = jax.tree.map(lambda a, k=k: a[k], candidates.trajectory)
        expected = dense_contact(made, x)
        # sampling can only miss a graze; a found contact must be there
        if np.isfinite(expected):
            assert found[k] <= expected + 1e-5
        elif np.isfinite(found[k]):
            assert np.isfinite(dense_contact(made, x, steps=4000))


def straight(made, v):
    """One candidate of constant speed."""
    x = trajectory_on_path(made, v * jnp.asarray(TIMES_S))
    return as_candidates(x)


def with_obstacle(kind, s, l, v=10.0, speed=0.0, sideways=0.0, length=4.0, width=1.8):
    """A straight empty road with one obstacle; the ego drives v."""
    box = {"kind": kind, "s": s, "l": l + sideways * TIMES_S, "speed": speed}
    box |= {"length": length, "width": width}
    return scene(v=v, speed_limit=30.0, boxes=[box])


def passes(made, v, judge=judge):
    """Whether the candidate of constant speed is admissible."""
    return bool(judge(made, straight(made, v)).admissible[0])


def with_path(made, **leaves):
    """A scene whose path has other values."""
    flat = jnp.ones_like(made.path.l)
    path = made.path.replace(**{name: x * flat for name, x in leaves.items()})
    return made.replace(path=path)


def test_a_body_that_slips_through_between_two_times_is_caught():
    """It crosses the ego's corridor inside one interval of 0.47 s."""
    meet = 4.5 * DT_S
    made = with_obstacle(
        Kind.VEHICLE, 10.0 * meet, -20.0 * meet, sideways=20.0, length=1.0, width=1.0
    )
    at_times = np.asarray(made.obstacles.l_lower[0])
    assert not np.any((at_times > -1.5) & (at_times < 1.1))  # no time shows it
    found = contact(made, straight(made, 10.0))
    assert float(found[0]) == pytest.approx(float(TIMES_S[4]))


def test_lines_are_walls_until_they_are_passed():
    wall = with_obstacle(Kind.STOP, 30.0, 0.0, length=0.1, width=40.0)
    assert not passes(wall, 10.0)
    assert passes(wall, 2.0)
    assert passes(with_obstacle(Kind.STOP, 1.0, 0.0, length=0.1, width=40.0), 10.0)


def test_road_edge_and_speed_limit():
    free = with_obstacle(Kind.NONE, 0.0, 0.0)
    assert passes(free, 10.0)
    narrow = jnp.where(jnp.arange(128) > 15, -0.5, -6.0)
    assert not passes(with_path(free, road_right=narrow), 10.0)
    slow = with_path(free, speed_limit=8.0)
    assert not passes(slow, 10.0)
    assert passes(slow, 7.9)


def test_distance_to_the_leader_follows_rss():
    """v rho + v^2 / 2b - v_l^2 / 2b_l + standstill, judged after 0.94 s."""
    c = SafetyConfig()
    needed = 10 * c.reaction + 100 / (2 * c.ego_braking)
    needed += -100 / (2 * c.leader_braking) + c.standstill
    for extra, ok in ((0.3, True), (-0.3, False)):
        gap = needed + extra
        place = 0.5 * 4.933 + gap + 2.0
        made = with_obstacle(Kind.VEHICLE, place, 0.0, speed=10.0)
        made = made.replace(ego=made.ego.replace(length=jnp.float32(4.933)))
        verdict = judge(made, straight(made, 10.0))
        assert bool(verdict.admissible[0]) is ok
        assert float(verdict.rss_margin[0]) == pytest.approx(extra, abs=0.02)


def test_without_an_admissible_candidate_the_hardest_brake_is_chosen():
    made = with_obstacle(Kind.VEHICLE, 6.0, 0.0, v=12.0, length=4.0)
    candidates = sampled(jax.random.key(0), made, ONLINE)
    verdict = judge(made, candidates)
    assert not bool(verdict.admissible.any())
    index, nothing = choose(verdict, candidates, jnp.arange(64.0))
    assert bool(nothing)
    assert float(candidates.trajectory.s[index, -1]) <= float(
        candidates.trajectory.s[:, -1].min() + 1.0
    )


def test_the_later_contact_is_preferred_and_scores_decide_the_rest():
    _, candidates = scene_and_candidates(0)
    two = jax.tree.map(lambda x: x[:3], candidates).replace(feasible=jnp.ones(3, bool))
    verdict = Verdict(
        admissible=jnp.array([False, False, False]),
        contact_s=jnp.array([1.0, 3.0, 2.0]),
        contact_v=jnp.zeros(3),
        rss_margin=jnp.zeros(3),
    )
    assert int(choose(verdict, two, jnp.array([9.0, 0.0, 0.0]))[0]) == 1
    some = verdict._replace(admissible=jnp.array([True, False, True]))
    index, nothing = choose(some, two, jnp.array([1.0, 9.0, 2.0]))
    assert int(index) == 2
    assert not bool(nothing)
    # not a number: never the best, and nothing to choose from if all are
    scores = jnp.array([1.0, 9.0, jnp.nan])
    assert [int(x) for x in choose(some, two, scores)] == [0, 0]
    assert [int(x) for x in choose(some, two, jnp.full(3, jnp.nan))] == [1, 1]


def test_the_collision_track_forbids_contacts_and_lines_only():
    """25 m/s where 20 are allowed; 7.6 m behind a leader, where RSS asks for 12.6 m.

    At 20 m/s both: 20 0.4 + 20^2/14 - 20^2/16 + 1 m.
    """
    only = jax.jit(lambda s, c: check(s, c, SafetyConfig(track="collision")))
    fast = with_path(with_obstacle(Kind.NONE, 0.0, 0.0, v=25.0), speed_limit=20.0)
    near = with_obstacle(Kind.VEHICLE, 12.0, 0.0, v=20.0, speed=20.0)
    for made, v in ((fast, 25.0), (near, 20.0)):
        assert not passes(made, v)
        assert passes(made, v, only)
    for kind in (Kind.VEHICLE, Kind.STOP):
        assert not passes(with_obstacle(kind, 30.0, 0.0, v=20.0), 20.0, only)


ENTRY = jax.jit(lambda s, c: check(s, c, SafetyConfig(entry=True)))


def moving_left(made, v, seconds=4.0):
    """Candidates of constant speed: one in its lane, one to 3.6 m on the left."""
    t = jnp.asarray(TIMES_S)
    u = jnp.clip(t / seconds, 0.0, 1.0)
    l = 3.6 * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    paths = jnp.stack([0.0 * l, l])
    make = jax.vmap(trajectory_from_positions, in_axes=(None, None, 0))
    return as_candidates(make(made, v * t, paths))


@pytest.mark.parametrize(
    ("gap", "speed", "fine"),
    [
        # behind, as fast: 0.6 s and 1 m, here 13 m; ahead, as fast: RSS, here 12.6 m
        (-12.0, 20.0, False), (-14.0, 20.0, True),
        (11.0, 20.0, False), (14.0, 20.0, True),
        # 24 m/s from behind needs 0.6 s, 29 m to brake to 20 m/s with 3 m/s^2, and 1 m
        (-45.0, 24.0, False),
    ],
)  # fmt: skip
def test_whoever_is_met_in_a_lane_that_is_entered_has_room(gap, speed, fine):
    half = 0.5 * (4.9 + 4.0)
    s = gap + (half if gap > 0.0 else -half)
    made = with_obstacle(Kind.VEHICLE, s, 3.6, v=20.0, speed=speed)
    both = moving_left(made, 20.0)
    assert np.asarray(ENTRY(made, both).admissible).tolist() == [True, fine]
    told = explain(*jax.tree.map(np.asarray, (made, both)), SafetyConfig(entry=True))
    assert told.reason[0] == Reason.NONE
    assert (told.reason[1] == Reason.NONE) == fine
    if not fine:
        assert (told.reason[1], told.obstacle[1]) == (Reason.ENTRY, 0)


@pytest.mark.parametrize(("gap", "fine"), [(33.0, True), (24.0, False)])
def test_whoever_has_room_to_brake_is_taken_to_brake(gap, fine):
    """At 10 m/s it reaches the ego at 5 m/s, unless it brakes, for which 19.5 m do."""
    s = -gap - 0.5 * (4.9 + 4.0)
    made = with_obstacle(Kind.VEHICLE, s, 3.6, v=5.0, speed=10.0)
    both = moving_left(made, 5.0)
    there = np.asarray(judge(made, both).contact_s)
    assert np.isinf(there[0])  # without rule 5 it drives on, into the ego
    assert np.isfinite(there[1])
    assert np.asarray(ENTRY(made, both).admissible).tolist() == [True, fine]
    needs = last_resort(made, both, ENTRY(made, both), SafetyConfig(entry=True))
    assert np.isfinite(needs.contact_s[1])  # nobody relies on it in need


def test_one_who_changes_lane_towards_the_ego_is_not_entered():
    made = with_obstacle(Kind.VEHICLE, -30.0, 3.6, v=20.0, speed=20.0, sideways=-0.4)
    keeps = jax.tree.map(lambda x: x[:1], moving_left(made, 20.0))
    assert bool(ENTRY(made, keeps).admissible[0])


def test_room_is_kept_before_what_never_moves():
    """To 6 m before a parked car, or on to the left; who is nearer may stay."""
    made = with_obstacle(Kind.STATIC, 30.0, 0.0, v=5.0)
    t = jnp.asarray(TIMES_S)

    def stops(way):
        to = jnp.minimum(t, way / 2.5)  # 5 m/s until it stands
        return 5.0 * to - 0.5 * (25.0 / (2.0 * way)) * to**2

    gap = 30.0 - 0.5 * (4.9 + 4.0)
    make = jax.vmap(trajectory_from_positions, in_axes=(None, 0, None))
    ways = jnp.array([gap - 6.0, gap - 9.0])
    halts = as_candidates(make(made, jax.vmap(stops)(ways), 0.0 * t))
    assert np.asarray(judge(made, halts).admissible).all()
    assert np.asarray(ENTRY(made, halts).admissible).tolist() == [False, True]
    near = with_obstacle(Kind.STATIC, 10.0, 0.0, v=0.0)
    assert bool(ENTRY(near, straight(near, 0.0)).admissible[0])


def test_in_need_the_ego_brakes_beside_a_body_and_not_into_it():
    """0.1 m beside a cyclist: all touch its margins at once; braking is left."""
    made = with_obstacle(
        Kind.CYCLIST, 1.0, -1.6, v=8.0, speed=5.0, length=1.8, width=1.0
    )
    made = jax.tree.map(jnp.asarray, made)
    candidates = sampled(jax.random.key(0), made, ONLINE_PATHS)
    verdict = ENTRY(made, candidates)
    assert not np.asarray(verdict.admissible).any()
    there = jax.jit(last_resort, static_argnums=3)
    need = there(made, candidates, verdict, SafetyConfig(entry=True))
    index, _ = choose(need, candidates, jnp.zeros_like(need.contact_s))
    assert np.isinf(need.contact_s[index])
    assert np.abs(candidates.trajectory.l[index]).max() < 0.05
    assert float(candidates.trajectory.v[index, -1]) < 0.5
    red = with_obstacle(Kind.STOP, 14.0, 0.0, v=8.0, length=0.1, width=40.0)
    need = there(red, candidates, ENTRY(red, candidates), SafetyConfig(entry=True))
    rolls = np.asarray(candidates.trajectory.s[:, -1]) > 20.0
    assert np.isfinite(np.asarray(need.contact_s)[rolls]).all()
