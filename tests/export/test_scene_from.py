"""Scenes from Cartesian input: what they hold, and what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.export.own_planner.builder import plain_scene, scene_from
from rcirl_jax.export.own_planner.inputs import Body, Car, CentreLine, Signal
from rcirl_jax.simulation.cases import LineKind
from rcirl_jax.simulation.world import observe, road_limit, start
from rcirl_jax.types import Kind
from rcirl_jax.units import TIMES_S
from tests.helpers.own_planner import entries
from tests.simulation.worlds import make_case

EGO = Car(x=50.0, y=0.5, heading=0.1, speed=10.0, length=4.8, width=2.0)
ROAD = CentreLine(points=[[0.0, 0.0], [150.0, 0.0], [400.0, 0.0]], speed_limit=15.0)
LEAD = Body(x=80.0, y=0.0, heading=0.0, speed=8.0, length=4.0, width=1.8)


def built(**changes):
    return plain_scene(scene_from(**{"ego": EGO, "centre_line": ROAD, **changes}))


def turned(angle, at, thing):
    """A thing with x, y and perhaps a heading, turned about the origin and moved."""
    c, s = np.cos(angle), np.sin(angle)
    moved = {
        "x": c * thing.x - s * thing.y + at[0],
        "y": s * thing.x + c * thing.y + at[1],
    }
    if hasattr(thing, "heading"):
        moved["heading"] = thing.heading + angle
    return dataclasses.replace(thing, **moved)


def test_the_ego_and_the_road():
    made = built()
    assert made.ego.s == 0.0
    assert made.ego.l == pytest.approx(0.5, abs=1e-4)
    assert made.ego.dl == pytest.approx(np.tan(0.1), abs=1e-5)
    assert made.ego.v == pytest.approx(10.0 * np.cos(0.1), abs=1e-5)
    assert (made.ego.length, made.ego.width) == pytest.approx((4.8, 2.0))
    np.testing.assert_allclose(made.path.kappa, 0.0, atol=1e-6)
    np.testing.assert_array_equal(made.path.speed_limit, 15.0)
    assert made.obstacles == []
    assert made.num_valid == TIMES_S.size


def test_a_bend_has_its_curvature_and_limit():
    angle = np.linspace(-0.5, 2.0, 200)
    circle = np.stack([60.0 * np.sin(angle), 60.0 * (1.0 - np.cos(angle))], axis=1)
    ego = dataclasses.replace(EGO, x=0.0, y=0.0, heading=0.0, curvature=0.02)
    made = built(ego=ego, centre_line=CentreLine(points=circle, speed_limit=30.0))
    np.testing.assert_allclose(made.path.kappa[:40], 1.0 / 60.0, rtol=0.01)
    np.testing.assert_allclose(made.path.speed_limit[:40], np.sqrt(120.0), rtol=0.01)
    assert made.ego.ddl == pytest.approx(0.02 - 1.0 / 60.0, abs=3e-4)


def test_limits_hold_from_their_point_and_are_braked_for():
    road = dataclasses.replace(ROAD, speed_limit=[15.0, 10.0, 10.0])
    limit = built(centre_line=road).path.speed_limit
    np.testing.assert_allclose(limit[51:], 10.0)  # 102 m ahead of the ego
    assert limit[0] == pytest.approx(15.0)
    assert limit[44] == pytest.approx(np.sqrt(100.0 + 2.0 * 10.0), abs=0.3)


def test_given_futures_take_the_place_of_predicted_ones():
    stops = [(0.0, 80.0, 0.0, 0.0), (2.0, 90.0, 0.0, 0.0), (4.0, 90.0, 1.0, 0.0)]
    behind = dataclasses.replace(LEAD, x=20.0)
    keeps = [(0.0, 20.0, 0.0, 0.0), (8.0, 84.0, 0.0, 0.0)]
    made = built(obstacles=[behind, LEAD], predictions=[keeps, stops])
    lead, rear = made.obstacles
    np.testing.assert_array_equal(lead.valid, TIMES_S <= 4.0)
    at = np.interp(TIMES_S, [0.0, 2.0, 4.0], [28.0, 38.0, 38.0])
    np.testing.assert_allclose(lead.s_lower[lead.valid], at[lead.valid], atol=1e-3)
    assert lead.l_lower[8] == pytest.approx(-0.9 + 0.5 * (TIMES_S[8] - 2.0), abs=1e-3)
    assert (lead.speed[0], lead.speed[8]) == pytest.approx((5.0, 0.5), abs=1.2)
    np.testing.assert_allclose(rear.s_lower, -32.0 + 8.0 * TIMES_S, atol=1e-3)
    assert rear.valid.all()


@pytest.mark.parametrize(
    ("states", "station"),
    [
        (("red", "red"), 30.0),
        (("off", "stop"), 60.0),
        (("yellow", "green"), 30.0),
        (("green", "off"), None),
    ],
)
def test_the_nearest_line_that_demands_a_stop_is_a_wall(states, station):
    behind = Signal(x=52.0, y=0.0, state="red")  # under the ego
    lines = [
        Signal(x=x, y=0.0, state=s) for x, s in zip((80, 110), states, strict=True)
    ]
    made = built(signals=[behind, *lines])
    if station is None:
        assert made.obstacles == []
        return
    (wall,) = made.obstacles
    assert wall.kind == Kind.STOP
    np.testing.assert_allclose(wall.s_lower, station, atol=1e-3)
    assert wall.valid.all()


def test_yellow_is_passed_where_braking_would_be_hard():
    near = Signal(x=60.0, y=0.0, state="yellow")  # 7.6 m before the front, at 10 m/s
    assert built(signals=[near]).obstacles == []


def test_the_destination_is_a_line_at_the_front():
    (wall,) = built(destination=(150.0, 0.0)).obstacles
    assert wall.kind == Kind.VIRTUAL
    assert wall.s_lower[0] == pytest.approx(102.4, abs=1e-3)
    assert built(destination=(40.0, 0.0)).obstacles == []


def test_the_frame_does_not_matter():
    """Turned by 40 degrees, in UTM coordinates."""
    angle, at = 0.7, (5.5e5, 5.8e6)
    c, s = np.cos(angle), np.sin(angle)
    points = np.asarray(ROAD.points) @ np.array([[c, s], [-s, c]]) + at
    other = built(
        ego=turned(angle, at, EGO),
        centre_line=dataclasses.replace(ROAD, points=points),
        obstacles=[turned(angle, at, LEAD)],
        signals=[turned(angle, at, Signal(x=120.0, y=0.0, state="red"))],
    )
    one = built(obstacles=[LEAD], signals=[Signal(x=120.0, y=0.0, state="red")])
    assert other.ego.l == pytest.approx(one.ego.l, abs=1e-3)
    assert other.ego.dl == pytest.approx(one.ego.dl, abs=1e-4)
    for found, wanted in zip(other.obstacles, one.obstacles, strict=True):
        for name in ("s_lower", "s_upper", "l_lower", "l_upper", "speed"):
            got, want = getattr(found, name), getattr(wanted, name)
            np.testing.assert_allclose(got, want, atol=2e-3)


def test_it_is_what_the_observer_sees():
    """A moment of the simulator on a straight road, where x is s and y is l."""
    agents = [
        {"s": 60.0, "v": 8.0},
        {"s": 30.0, "l": 3.5, "v": 14.0},
        {"s": -25.0, "l": -3.5, "v": 9.0, "heading": 0.1},
        {"s": 45.0, "l": -4.0, "v": 1.2, "heading": np.pi / 2, "kind": Kind.PEDESTRIAN},
    ]
    light = {"kind": LineKind.LIGHT, "s": 90.0, "offset": 12.0, "green": 10.0}
    case = make_case(agents, [light | {"yellow": 1.0, "red": 60.0}], lanes=(1, 1))
    case = jax.tree.map(jnp.asarray, case)
    world = jax.jit(start)(case)
    seen = jax.jit(lambda *now: observe(*now, road_limit(now[0].road)))(case, world)
    own = float(world.ego.s)
    made = scene_from(
        ego=Car(x=own, y=0.0, heading=0.0, speed=10.0, length=4.933, width=2.11),
        centre_line=CentreLine(
            points=[[own - 60.0, 0.0], [own + 600.0, 0.0]], speed_limit=15.0,
            lane_width=3.5, road_left=5.75, road_right=5.75,
        ),
        obstacles=[
            Body(
                kind=Kind(int(case.agents.kind[i])).name.lower(),
                x=float(world.agents.s[i]), y=float(world.agents.l[i]),
                heading=float(world.agents.heading[i]), speed=float(world.agents.v[i]),
                length=4.6, width=1.9,
            )
            for i in range(len(agents))
        ],
        signals=[Signal(x=90.0, y=0.0, state="red")],
    )  # fmt: skip
    for found, wanted in zip(
        entries(plain_scene(made), ()), entries(plain_scene(seen), ()), strict=True
    ):
        assert found[0] == wanted[0]
        np.testing.assert_allclose(found[1], wanted[1], atol=2e-3, err_msg=found[0])
    for name, bound in vars(seen.path).items():
        np.testing.assert_allclose(getattr(made.path, name), bound, atol=1e-3)


GIVEN = {"ego": EGO, "body": LEAD, "road": ROAD}


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"ego": {"length": 0.0}}, "ego.length: 0.0: expected over 0 m"),
        ({"ego": {"x": np.nan}}, "ego.x: nan: expected finite numbers up to 1e+09"),
        (
            {"road": {"points": [[0.0009 * i, 0.0] for i in range(2000)]}},
            "centre_line.points: 2000 points, 0 m long: expected a line of 1 m to",
        ),
        ({"ego": {"heading": 90.0}}, "ego.heading: 90: expected radians, not degrees"),
        ({"ego": {"y": 30.0}}, "ego: 30.0 m beside the centre line: expected at most"),
        (
            {"ego": {"x": 390.0}},
            "centre_line: ends 10.0 m ahead of the ego: expected 80.0 m, what it",
        ),
        (
            {"road": {"speed_limit": [10.0, 12.0]}},
            "centre_line.speed_limit: 2 numbers: expected one for each of the 3",
        ),
        (
            {"signals": [Signal(x=80.0, y=0.0, state="rot")]},
            "signals[0].state: rot: expected one of red, stop, yellow, green, off",
        ),
        ({"predictions": []}, "predictions: 0: expected 1, one for each obstacle"),
        (
            {"predictions": [[(1.0, 80.0, 0.0, 0.0)]]},
            "predictions[0]: t: [1.]: expected from 0 s, rising",
        ),
        ({"path": [[60.0, 0.0], [40.0, 0.0]]}, "path: turns back: expected driving"),
    ],
)
def test_wrong_input_has_one_line(changes, line):
    given = {
        name: dataclasses.replace(good, **changes.pop(name, {}))
        for name, good in GIVEN.items()
    }
    with pytest.raises(InputError) as caught:
        scene_from(
            ego=given["ego"],
            centre_line=given["road"],
            obstacles=[given["body"]],
            **changes,
        )
    assert str(caught.value).startswith(f"scene_from: {line}")
