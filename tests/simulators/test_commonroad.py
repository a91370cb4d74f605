"""CommonRoad: the reward as a cost, and scenarios as episodes.

What needs CommonRoad's packages runs where RCIRL_COMMONROAD_PYTHON names an interpreter
of an environment that has them (docs/simulators.md).
"""

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.export.own_planner.features import Ego, FeatureMap, Path, Scene
from rcirl_jax.export.reader import load_weights
from rcirl_jax.simulators.commonroad import BY_REWARD, DEFAULT, CommonRoad, Replay
from rcirl_jax.simulators.commonroad_cost import RewardCost, obstacle
from rcirl_jax.simulators.simulators import open_simulator
from rcirl_jax.units import TIMES_S
from tests.data.formats import writers as w
from tests.onboard.programs import ONBOARD
from tests.simulators.straight import moved

WEIGHTS = str(ONBOARD / "conformance" / "paper21.msgpack")
OTHER = os.environ.get("RCIRL_COMMONROAD_PYTHON", "")
needs_commonroad = pytest.mark.skipif(
    not OTHER, reason="RCIRL_COMMONROAD_PYTHON: an interpreter that has CommonRoad"
)
MOVE = moved(1.5, 15.0)


def road(boxes=()):
    flat = np.zeros(128)
    ego = Ego(v=12.0, length=4.5, width=1.6)
    path = Path(kappa=flat, l=flat, speed_limit=flat + 14.0)
    return Scene(ego=ego, path=path, obstacles=boxes)


def sample(s, d, theta=0.0):
    """What the cost reads of a sample of the reactive planner."""
    return SimpleNamespace(
        curvilinear=SimpleNamespace(s=s, d=d, theta=np.full_like(s, theta))
    )


def test_the_cost_is_minus_the_value_of_the_centres_way():
    """Samples begin anywhere on the path and are those of the rear axle."""
    time = 0.1 * np.arange(81)
    track = np.stack(
        [time, 30.0 + 8.0 * time, 0 * time, 0 * time, 0 * time + 8.0], axis=1
    )
    scene = road([obstacle("vehicle", (4.5, 1.8), track)])
    cost = RewardCost(WEIGHTS, dt=0.1, rear_axle=1.4)
    cost.look(scene, station=100.0)
    theta, s = 0.02, 100.0 + 12.0 * time - 0.5 * time**2
    behind = sample(s - 1.4 * np.cos(theta), 0.3 + 0 * s - 1.4 * np.sin(theta), theta)
    ways = (12.0 * TIMES_S - 0.5 * TIMES_S**2)[None], np.full((1, 18), 0.3)
    reward = load_weights(WEIGHTS)
    columns = FeatureMap(reward.names, reward.units)
    wanted = -reward.value(columns(scene, *ways), scene.time_valid)[0]
    assert cost.evaluate(behind) == pytest.approx(wanted, abs=2e-2)


def test_costs_that_were_worked_out_at_once_are_those_of_one_by_one():
    """And they are forgotten with their scene."""
    cost = RewardCost(WEIGHTS, dt=0.1, rear_axle=1.4)
    cost.look(road(), station=0.0)
    time = 0.1 * np.arange(81)
    samples = [sample(a * time, 0.1 * a + 0 * time) for a in (8.0, 10.0, 13.0)]
    alone = [cost.evaluate(x) for x in samples]
    cost.evaluate_all(samples)
    assert [cost.evaluate(x) for x in samples] == pytest.approx(alone, rel=1e-6)
    cost.reward = None  # not asked again
    assert [cost.evaluate(x) for x in samples] == pytest.approx(alone, rel=1e-6)
    assert len(set(alone)) == 3
    cost.evaluate_all([])
    with pytest.raises(AttributeError):
        cost.evaluate(samples[0])


def test_a_known_future_is_a_box_along_the_road():
    """Abreast of the road it is as long as it is wide; gone after its last row."""
    rows = np.array([[0.0, 10.0, 3.0, np.pi / 2, 5.0], [4.0, 10.0, -5.0, np.pi / 2, 5]])
    box = obstacle("cyclist", (1.8, 0.6), rows)
    assert box.kind == 2
    assert box.valid.tolist() == [t <= 4.0 for t in TIMES_S]
    np.testing.assert_allclose(box.s_upper - box.s_lower, 0.6, atol=1e-6)
    np.testing.assert_allclose(box.l_lower[0], 3.0 - 0.9, atol=1e-6)
    np.testing.assert_allclose(box.l_upper[8], 3.0 - 2 * TIMES_S[8] + 0.9, atol=1e-5)
    np.testing.assert_allclose(box.speed, 0.0, atol=1e-6)


STAND_IN = """
import json, sys
line = [[2.0 * i - 40.0, 0.0] for i in range(200)]
for k in range(4):
    now = {"others": [["vehicle", 30.0 + k, 0.0, 0.0, 10.0, 0.0, 4.4, 1.8]]}
    if k == 0:
        now |= {"ego": [0.0, 0.5, 0.1, 15.0, 0.0, 0.0], "line": line, "limit": 20.0,
                "dt": %s}
    elif %s:
        now |= {"ego": [1.4 * k, 0.5, 0.1, 14.0, -1.0, 0.0], "limit": 18.0}
    print(json.dumps(now), flush=True)
    sys.stdin.readline()
print("null", flush=True)
sys.stdin.readline()
"""


def replay(dt=0.1, driven=False):
    return Replay([sys.executable, "-c", STAND_IN % (dt, driven), "FILE"])


def test_the_ego_goes_along_the_line_and_its_offset_fades():
    episode = replay()
    first = episode.look()
    assert (first.ego.x, first.ego.y, first.ego.speed) == (0.0, 0.5, 15.0)
    assert first.obstacles[0].x == 30.0
    episode.step(MOVE)
    view = episode.look()
    assert view.obstacles[0].x == 31.0
    assert view.centre_line is first.centre_line
    assert view.ego.x == pytest.approx(1.5, abs=1e-3)
    assert view.ego.y == pytest.approx(0.5 * np.exp(-0.1), abs=1e-3)
    assert view.ego.heading == pytest.approx(-0.5 * np.exp(-0.1) / 15.0, abs=1e-3)
    assert view.way == pytest.approx(1.5, abs=5e-3)
    assert view.speed_limit == 20.0
    for _ in range(3):
        episode.step(MOVE)
    assert episode.look() is None
    episode.close()


def test_an_own_driver_is_shown_where_the_worker_has_it():
    episode = replay(driven=True)
    for _ in range(2):
        episode.step(None)
    view = episode.look()
    assert (view.ego.x, view.ego.y, view.ego.speed) == (2.8, 0.5, 14.0)
    assert (view.ego.acceleration, view.speed_limit) == (-1.0, 18.0)
    assert view.way == pytest.approx(2.8)
    episode.close()


def test_other_steps_and_workers_that_end_are_refused():
    with pytest.raises(InputError, match=r"timeStepSize: 0\.04: expected 0\.1 s"):
        replay(dt=0.04)
    with pytest.raises(InputError, match="ended"):
        Replay([sys.executable, "-c", "", "FILE"])
    with pytest.raises(InputError, match="/none: No such file"):
        Replay(["/none"])


def test_scenarios_are_drawn_without_repeating_one(tmp_path):
    for n in range(5):
        w.commonroad(tmp_path / f"ZAM_Test-{n}_1_T-1.xml")
    simulator = open_simulator("commonroad", scenarios=str(tmp_path), python="python")
    names = simulator.episodes(5, seed=3)
    assert sorted(names) == [f"ZAM_Test/ZAM_Test-{n}_1_T-1" for n in range(5)]
    assert names == simulator.episodes(5, seed=3)
    assert simulator.own_drivers == (DEFAULT,)
    with pytest.raises(InputError, match="episodes: 6: expected at most 5"):
        simulator.episodes(6, seed=3)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({}, "options: missing a required argument: 'scenarios': expected NAME="),
        ({"scenarios": "/none", "python": "p"}, "scenarios: /none: none: expected XML"),
        ({"scenario": "x"}, "options: .*expected NAME=VALUE of scenarios, python"),
    ],
)
def test_wrong_options_have_one_line(options, line):
    with pytest.raises(InputError, match=line):
        open_simulator("commonroad", **options)


def scenario(folder):
    """A lane of 400 m; the ego at 10 m/s behind a car that drives at 6 m/s."""
    lane = w.lanelet(
        left=[(x, 1.75) for x in range(-40, 361, 20)],
        right=[(x, -1.75) for x in range(-40, 361, 20)],
    ).replace("</lanelet>", "<laneletType>urban</laneletType></lanelet>")
    ahead = [w.state(k, 25.0 + 0.6 * k, 0.0, speed=6.0) for k in range(1, 30)]
    car = w.car(x0=25.0, states=ahead).replace(
        "<exact>15.0</exact>", "<exact>6.0</exact>"
    )
    extra = w.exact("yawRate", 0.0) + w.exact("slipAngle", 0.0)
    goal = w.problem(
        "<position><rectangle><length>20</length><width>3</width>"
        "<center><x>200</x><y>0</y></center></rectangle></position>"
    ).replace("</initialState>", f"{extra}</initialState>")
    head = "<location><geoNameId>1</geoNameId><gpsLatitude>0</gpsLatitude>"
    head += "<gpsLongitude>0</gpsLongitude></location><scenarioTags><urban/>"
    return w.commonroad(
        folder / "ZAM_Follow-1_1_T-1.xml",
        f"{head}</scenarioTags>", lane, car, goal,
        attributes='benchmarkID="ZAM_Follow-1_1_T-1" author="a" affiliation="b" '
        'date="2026-01-01"',
    )  # fmt: skip


def driven(simulator, own):
    """The views of the one episode."""
    running, views = simulator.start(simulator.episodes(1, 0), own), []
    while (view := running.look()[0]) is not None:
        views.append(view)
        running.step([None])
    running.close()
    return views


@needs_commonroad
def test_the_reactive_planner_drives_by_both_costs(tmp_path):
    scenario(tmp_path)
    simulator = CommonRoad(str(tmp_path), OTHER, WEIGHTS)
    ways = {}
    for own in (DEFAULT, BY_REWARD):
        views = driven(simulator, own)
        assert len(views) == 30
        apart = [view.obstacles[0].x - view.ego.x for view in views]
        assert min(apart) > 4.45  # half of both lengths
        assert views[0].obstacles[0].x == 25.0
        assert views[10].obstacles[0].x == pytest.approx(31.0)
        assert views[10].obstacles[0].speed == 6.0
        ways[own] = views[-1].way
    assert min(ways.values()) > 10.0
    assert abs(ways[DEFAULT] - ways[BY_REWARD]) > 0.1


@needs_commonroad
def test_the_worker_needs_nothing_of_ours_but_numpy():
    program = (
        "import rcirl_jax.simulators.commonroad_worker, sys;"
        "print([m for m in ('jax', 'flax', 'msgspec') if m in sys.modules])"
    )
    done = subprocess.run([OTHER, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
