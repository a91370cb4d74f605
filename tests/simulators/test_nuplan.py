"""The planner for nuPlan against stand-ins of its public interface."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from rcirl_jax.simulators.nuplan import reward_planner
from rcirl_jax.units import TIMES_S
from tests.helpers.weights_files import example_weights, of_the_preset, saved
from tests.simulators import nuplan_stand_in as theirs

X, Y = 664000.0, 3997000.0  # m, UTM: float32 alone would be off by decimetres


def place(x, y):
    return (X + x, Y + y)


def road():
    """100 m, a connector of 30 m that bends by nothing, 300 m; beside it a dead end."""
    before = theirs.Lane("10", place(-60, 0), place(0, 0), 12.0)
    first = theirs.Lane("11", place(0, 0), place(100, 0), 12.0)
    side = theirs.Lane("12", place(0, 3.5), place(100, 3.5), 12.0)
    turn = theirs.Lane("20", place(100, 0), place(130, 0))
    dead = theirs.Lane("21", place(100, 0), place(120, 20))
    last = theirs.Lane("31", place(130, 0), place(430, 0), 12.0)
    before.then(first)
    first.then(dead, turn)
    turn.then(last)
    return theirs.Map(b1=[first, side], c2=[dead, turn], b3=[last])


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A reward that likes speed and nothing else."""
    made = of_the_preset(example_weights(0, 21, TIMES_S.size, (), "identity"))
    liked = np.array([[name == "velocity"] for name in made.names], np.float32)
    made = dataclasses.replace(
        made, kernels=(liked,), biases=(np.zeros(1),), gamma=np.ones(TIMES_S.size)
    )
    path = tmp_path_factory.mktemp("weights") / "weights.msgpack"
    saved(path, made, np.zeros((1, TIMES_S.size, 21), np.float32))
    return str(path)


@pytest.fixture
def planner(monkeypatch, weights):
    theirs.install(monkeypatch)
    made = reward_planner(weights)
    given = SimpleNamespace(
        route_roadblock_ids=["b1", "c2", "gone", "b3"], map_api=road()
    )
    made.initialize(given)
    return made


def ego(x=20.0, y=0.0, speed=10.0, heading=0.0):
    return theirs.EgoState(
        center=theirs.StateSE2(*place(x, y), heading),
        center_velocity_2d=theirs.StateVector2D(speed, 0.0),
        center_acceleration_2d=theirs.StateVector2D(0.0, 0.0),
        tire_steering_angle=0.0,
        time_point=theirs.TimePoint(5_000_000),
    )


def planned(planner, state, *bodies, lights=None):
    """The planned states as rows (t s, x, y, heading, speed)."""
    observation = theirs.DetectionsTracks(SimpleNamespace(tracked_objects=bodies))
    history = SimpleNamespace(current_state=(state, observation))
    given = SimpleNamespace(history=history, traffic_light_data=lights)
    found = planner.compute_trajectory(given)
    assert isinstance(found, theirs.InterpolatedTrajectory)
    assert found.states[0] is state
    return np.array(
        [
            (
                1e-6 * (s.time_point.time_us - state.time_point.time_us),
                s.center.x - X,
                s.center.y - Y,
                s.center.heading,
                s.center_velocity_2d.x,
            )
            for s in found.states
        ]
    )


def light(name, status):
    return SimpleNamespace(lane_connector_id=name, status=theirs.Light[status])


def car(x, speed):
    return theirs.tracked("VEHICLE", *place(x, 0.0), speed)


def test_a_plan_lasts_for_8_s_and_moves_as_it_says(planner):
    t, x, _, _, v = planned(planner, ego()).T
    np.testing.assert_allclose(t, 0.1 * np.arange(81), atol=1e-6)
    np.testing.assert_allclose(np.gradient(x, t)[1:-1], v[1:-1], atol=0.1)
    assert x[0] == 20.0
    assert x[-1] > 20.0 + 8.0 * 10.0


def test_it_follows_the_route_and_comes_back_to_its_middle(planner):
    """The dead end beside the connector is not taken."""
    state = ego(x=60.0, y=0.8, speed=12.0)
    _, x, y, heading, _ = planned(planner, state, car(160.0, 12.0)).T
    gone = x - x[0]
    np.testing.assert_allclose(y[1:], 0.8 * np.exp(-gone[1:] / 15.0), atol=2e-2)
    np.testing.assert_allclose(heading[1:], np.arctan(-y[1:] / 15.0), atol=5e-3)


def test_it_stops_behind_who_stands_and_before_a_red_light(planner):
    bodies = [theirs.tracked("TRAFFIC_CONE", *place(70.0, 0.0), size=(0.6, 0.6))]
    x = planned(planner, ego(), *bodies)[:, 1]
    assert 55.0 < x[-1] + 2.6 < 70.0
    lights = [light(99, "RED"), light(20, "RED")]
    x = planned(planner, ego(x=40.0), lights=lights)[:, 1]
    assert 80.0 < x[-1] + 2.6 <= 100.0


def test_a_green_light_stops_nobody(planner):
    lights = [light(20, "GREEN"), light(31, "UNKNOWN")]
    assert planned(planner, ego(x=60.0), lights=lights)[-1, 1] > 130.0
