"""Contacts, faults and times to collision by hand and against shapely."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
import shapely.affinity
from hypothesis import given, settings
from hypothesis import strategies as st

from rcirl_jax.geometry.boxes import Box, contact_interval
from rcirl_jax.planner.baselines import rule, rule_policy
from rcirl_jax.simulation.agents import spawn_and_despawn, stopping_for_light
from rcirl_jax.simulation.world import contacts, off_road, start
from rcirl_jax.types import Kind
from tests.simulation.drives import drive
from tests.simulation.worlds import make_case


@jax.jit
def judged(case, ego_l, ego_v, heading):
    world = start(case)
    ego = world.ego.replace(l=ego_l, v=ego_v, heading=heading)
    state = spawn_and_despawn(case, ego, world.agents, world.step)
    return contacts(case, ego, state), off_road(case, ego)


def at(agent, ego_v=10.0, ego_l=0.0, heading=0.0, kappa=0.0, lanes=(1, 1)):
    case = make_case([agent], speed=ego_v, kappa=kappa, lanes=lanes)
    case = jax.tree.map(jnp.asarray, case)
    found, off = judged(
        case, jnp.float32(ego_l), jnp.float32(ego_v), jnp.float32(heading)
    )
    return jax.tree.map(lambda x: x[0], found), float(off)


AHEAD, BEHIND = {"s": 4.6, "v": 0.0}, {"s": -4.6, "v": 15.0}
BESIDE = {"s": -0.5, "l": 1.9, "v": 10.0}


@pytest.mark.parametrize(
    ("agent", "v", "l", "fault"),
    [
        ({**AHEAD, "v": 5.0}, 10.0, 0.0, True),  # into the car ahead
        ({**AHEAD, "kind": Kind.STATIC}, 10.0, 0.0, True),
        (BEHIND, 10.0, 0.0, False),  # hit from behind
        (BEHIND, 0.0, 0.0, False),  # a standing ego is never at fault
        (AHEAD, 0.0, 0.0, False),
        (BESIDE, 10.0, 0.0, False),  # side contact inside the own lane
        (BESIDE, 10.0, 1.0, True),  # side contact while straddling lanes
    ],
)
def test_fault_follows_nuplans_types(agent, v, l, fault):
    found, _ = at(agent, ego_v=v, ego_l=l)
    assert bool(found.hit)
    assert bool(found.at_fault) is fault


def polygon(x, y, angle, length, width):
    box = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
    box = shapely.affinity.rotate(box, angle, (0, 0), use_radians=True)
    return shapely.affinity.translate(box, x, y)


def test_clearance_on_a_bend_is_that_of_boxes_in_the_plane():
    kappa, rng = 0.03, np.random.default_rng(0)

    def plane(s, l, heading):
        """True x, y, angle on a circle of constant curvature."""
        turn, radius = kappa * s, 1 / kappa - l
        x, y = radius * np.sin(turn), 1 / kappa - radius * np.cos(turn)
        return x, y, heading + turn

    for _ in range(20):
        s, l = float(rng.uniform(-15, 15)), float(rng.uniform(-6, 6))
        heading = float(rng.uniform(-0.5, 0.5))
        agent = {"s": s, "l": l, "heading": heading, "v": 0.0}
        found, _ = at(agent, kappa=kappa)
        mine = polygon(*plane(0.0, 0.0, 0.0), 4.933, 2.11)
        other = polygon(*plane(s, l, heading), 4.6, 1.9)
        assert bool(found.hit) == mine.intersects(other)
        if not mine.intersects(other):
            # the largest axis gap is a lower bound of the distance
            assert float(found.clearance) <= mine.distance(other) + 1e-2


boxes = st.tuples(
    st.floats(-20, 20), st.floats(-20, 20), st.floats(-3, 3), st.floats(1, 6),
    st.floats(0.5, 3), st.floats(-15, 15), st.floats(-15, 15), st.floats(-3, 3),
)  # fmt: skip

interval = jax.jit(contact_interval)


@settings(max_examples=40, deadline=None)
@given(boxes)
def test_contact_interval_equals_dense_sampling(drawn):
    x, y, angle, length, width, vx, vy, own = drawn
    f = jnp.float32
    first = Box(x=f(0), y=f(0), heading=f(own), length=f(4.9), width=f(2.1))
    second = Box(x=f(x), y=f(y), heading=f(angle), length=f(length), width=f(width))
    enter, leave = (float(t) for t in interval(first, second, f(vx), f(vy)))
    mine, box = polygon(0, 0, own, 4.9, 2.1), polygon(0, 0, angle, length, width)
    for t in np.linspace(0.0, 4.0, 41):
        other = shapely.affinity.translate(box, x + vx * t, y + vy * t)
        apart = mine.distance(other)
        inside = enter <= t <= leave
        if apart > 0.05:
            assert not inside or min(abs(t - enter), abs(t - leave)) < 0.02
        elif mine.buffer(-0.05).intersects(other):
            assert inside


def test_time_to_collision_is_gap_over_closing_speed():
    found, _ = at({"s": 30.0, "v": 4.0}, ego_v=14.0)
    gap = 30.0 - 2.3 - 0.5 * 4.933
    assert float(found.ttc) == pytest.approx(gap / 10.0, rel=1e-3)
    assert np.isinf(float(at({"s": 30.0, "v": 15.0}, ego_v=14.0)[0].ttc))
    assert np.isinf(float(at({"s": 90.0, "v": 4.0}, ego_v=14.0)[0].ttc))  # beyond 3 s


def test_a_car_behind_hides_no_time_to_collision_ahead():
    ahead, behind = {"s": 30.0, "v": 4.0}, {"s": -12.0, "v": 25.0}
    cases = [make_case(x, speed=14.0) for x in ([ahead], [ahead, behind])]
    alone, both = drive(cases)[0].ttc[:, 0]
    assert both == alone < 2.6


def test_off_road_is_the_farthest_corner():
    _, off = at({"s": 100.0}, ego_l=2.0, lanes=(0, 0))
    assert off == pytest.approx(2.0 + 1.055 - 2.25, abs=1e-3)


def test_red_lights_and_stop_signs_are_seen_at_the_crossing():
    light = {"kind": 1, "s": 50.0, "green": 20.0, "yellow": 3.0, "red": 17.0}
    red, green = {**light, "offset": 23.0}, {**light, "offset": 0.0}
    sign = {"kind": 2, "s": 50.0}
    record, _ = drive([make_case(lines=[x], speed=10.0) for x in (red, green, sign)])
    crossing = int(np.argmax(record.s[0] + 2.4665 > 50.0))
    assert np.flatnonzero(record.red_light[0]).tolist() == [crossing]
    assert not record.red_light[1].any()
    assert np.flatnonzero(record.stop_sign[2]).tolist() == [crossing]


def test_a_light_that_has_demanded_a_stop_does_so_until_it_is_green():
    lines = make_case(
        lines=[{"kind": 1, "s": 70.0, "green": 20.0, "yellow": 4.0, "red": 16.0}]
    ).lines

    def halts(before, time, distance, v=18.0):  # stops within 54 m at 3 m/s^2
        asked = jnp.asarray([before] + [False] * (lines.s.size - 1))
        now, away = jnp.asarray(time), distance - 0 * lines.s
        return bool(stopping_for_light(lines, asked, now, away, jnp.asarray([v]))[0])

    assert not halts(False, 10.0, 60.0)  # green
    assert halts(False, 20.5, 60.0)
    assert not halts(False, 20.5, 50.0)  # too near to stop: it may go on
    assert halts(False, 21.0, 49.0, v=17.0)  # has braked since, and can stop now
    assert halts(True, 20.7, 50.0)  # was asked when it could
    assert halts(False, 25.0, 50.0)  # red
    assert not halts(True, 41.0, 50.0)  # green again


def test_a_served_stop_sign_is_not_run():
    """Brake to rest 2 m before the line, then go."""
    sign = {"kind": 2, "s": 60.0}
    case = make_case(lines=[sign], speed=10.0)
    record, _ = drive([case], steps=400, policy=rule_policy, params=rule("IDM"))
    assert record.v[0].min() < 0.1
    assert record.s[0, -1] > 70.0
    assert not record.stop_sign[0].any()


def test_a_crash_of_own_fault_ends_the_drive():
    wall = {"s": 40.0, "v": 0.0, "kind": Kind.STATIC}
    record, _ = drive([make_case([wall], speed=10.0)])
    hit = int(np.argmax(record.at_fault[0] > 0))
    assert record.at_fault[0].sum() == 1
    assert record.at_fault_object[0].sum() == 1
    assert record.valid[0, hit]
    assert not record.valid[0, hit + 1 :].any()
    assert np.all(record.s[0, hit:] == record.s[0, hit])
    assert record.impact_speed[0].max() == pytest.approx(10.0, abs=0.1)
