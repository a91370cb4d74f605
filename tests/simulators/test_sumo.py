"""SUMO: what is seen is what libsumo says, and the ego does what a move says."""

import math

import pytest

pytest.importorskip("libsumo")

import libsumo

from rcirl_jax.simulators.drive import Seen
from rcirl_jax.simulators.sumo import KRAUSS, Sumo
from tests.simulators.straight import moved

NAMES = ["dense/0/0000", "single/0/0001", "sparse/0/0002"]


def move(view, acceleration=0.0, beside=None):
    speed = max(view.ego.speed + 0.1 * acceleration, 0.0)
    return moved(0.05 * (view.ego.speed + speed), speed, acceleration, beside)


@pytest.fixture(scope="module")
def corridors():
    """Ten seconds on, the egos at a constant speed unless somebody is near."""
    made = Sumo().start(NAMES, None)
    yield made
    made.close()


def test_the_view_is_the_simulators_state(corridors):
    for n, view in enumerate(corridors.look()):
        ego = f"{n}.ego"
        x, y = libsumo.vehicle.getPosition(ego)  # of the front bumper
        front = (
            view.ego.x + 0.5 * view.ego.length * math.cos(view.ego.heading),
            view.ego.y + 0.5 * view.ego.length * math.sin(view.ego.heading),
        )
        assert front == pytest.approx((x, y), abs=0.1)
        assert view.ego.speed == libsumo.vehicle.getSpeed(ego)
        assert view.speed_limit == libsumo.vehicle.getAllowedSpeed(ego)
        near = [
            name
            for name in libsumo.vehicle.getIDList()
            if name.startswith(f"{n}.")
            and name != ego
            and math.dist(libsumo.vehicle.getPosition(name), (x, y)) < 150.0
        ]
        assert len(view.obstacles) == len(near)


def test_the_gap_ahead_is_to_sumos_leader(corridors):
    _, free = Seen(3).scenes(corridors.look())
    compared = 0
    for n in range(3):
        leader = libsumo.vehicle.getLeader(f"{n}.ego", 100.0)
        if leader and leader[0] and leader[1] < 60.0:
            gap = leader[1] + libsumo.vehicle.getMinGap(f"{n}.ego")
            assert float(free.body[n]) == pytest.approx(gap, abs=0.2)
            speed = libsumo.vehicle.getSpeed(leader[0])
            assert float(free.speed[n]) == pytest.approx(speed, abs=0.05)
            compared += 1
    assert compared


def test_lights_lie_where_sumo_says_and_red_ones_are_walls(corridors):
    views = corridors.look()
    _, free = Seen(3).scenes(views)
    for n, view in enumerate(views):
        ahead = [x for x in libsumo.vehicle.getNextTLS(f"{n}.ego") if x[2] < 250.0]
        assert len(view.signals) == len(ahead)
        shown = zip(ahead, view.signals, strict=True)
        red = [distance for (*_, distance, _), s in shown if s.state == "red"]
        if red:
            assert float(free.line[n]) == pytest.approx(red[0], abs=0.2)
        else:
            assert math.isinf(free.line[n])


def test_a_move_is_what_the_ego_does(corridors):
    before = corridors.look()
    moves = [move(view, acceleration=-1.0) for view in before]
    corridors.step(moves)
    for then, asked, now in zip(before, moves, corridors.look(), strict=True):
        assert now.ego.speed == pytest.approx(asked.speed, abs=1e-6)
        assert now.way - then.way == pytest.approx(asked.way, abs=1e-2)
        assert now.ego.acceleration == -1.0
        assert now.centre_line is then.centre_line


def test_a_planned_path_leads_into_the_lane_beside(corridors):
    """0.3 m to the left in every step: SUMO has the ego there, the frame follows."""
    before = corridors.look()
    width = before[0].centre_line.lane_width
    edges = [x.centre_line.road_left / width for x in before]
    assert edges == pytest.approx([1.5, 0.5, 1.5])
    offsets, asides, driven = [0.0, 0.0, 0.0], [[], [], []], [0.0, 0.0, 0.0]
    steps = int(width / 0.3)
    for _ in range(steps):
        views = corridors.look()
        offsets = [l + 0.3 * (n != 1) for n, l in enumerate(offsets)]
        moves = [
            move(view, beside=(l, 0.3 / 1.5, 0.0))
            for view, l in zip(views, offsets, strict=True)
        ]
        corridors.step(moves)
        for n, view in enumerate(corridors.look()):
            driven[n] += moves[n].way
            offsets[n] -= view.aside
            asides[n] += [view.aside] if view.aside else []
            x, y = libsumo.vehicle.getPosition(f"{n}.ego")
            assert math.hypot(view.ego.x - x, view.ego.y - y) < 5.0
    assert asides == [[width], [], [width]]
    for n, (then, now) in enumerate(zip(before, corridors.look(), strict=True)):
        lane = libsumo.vehicle.getLaneID(f"{n}.ego")
        assert lane.endswith("_0" if n == 1 else "_1")
        assert now.way - then.way == pytest.approx(driven[n], abs=0.1)
        assert (now.centre_line is then.centre_line) == (n == 1)
        left = 0.5 * width
        assert now.centre_line.road_left == left
        scenes, _ = Seen(3).scenes(corridors.look())
        assert float(scenes.ego.l[n]) == pytest.approx(offsets[n], abs=0.05)


def test_yellow_stays_red_for_who_could_stop_when_it_began():
    """At 3 m/s2, from v within v^2 / 6; green ends it, yellow from too near is none."""
    running = Sumo().start(NAMES, None)
    ahead = [libsumo.vehicle.getNextTLS(f"{n}.ego") for n in range(3)]
    n, light = next((n, lights[0][0]) for n, lights in enumerate(ahead) if lights)
    links = len(libsumo.trafficlight.getRedYellowGreenState(light))
    go_on = lambda: running.step([view and move(view) for view in running.look()])  # noqa: E731

    def shown(letter):
        """What the ego sees when it shows a letter, and whether it can stop."""
        libsumo.trafficlight.setRedYellowGreenState(light, letter * links)
        go_on()
        view = running.look()[n]
        distance = libsumo.vehicle.getNextTLS(f"{n}.ego")[0][2]
        return view.signals[0].state, view.ego.speed**2 / 6.0 < distance

    while not running.look()[n].signals:
        go_on()
    assert shown("G") == ("green", True)
    assert shown("y") == ("red", True)
    while (seen := shown("y"))[1]:
        assert seen[0] == "red"
    assert seen == ("red", False)
    assert shown("G") == ("green", False)
    assert shown("y") == ("yellow", False)
    assert shown("r") == ("red", False)
    running.close()


def test_the_own_driver_stops_at_red_and_the_same_names_are_the_same_drives():
    ways = []
    for _ in range(2):
        running = Sumo().start(NAMES, KRAUSS)
        for _ in range(200):
            running.step([None] * 3)
            assert not any(view.passed_red for view in running.look() if view)
        ways.append([view.way for view in running.look()])
        running.close()
    assert ways[0] == ways[1]
    assert all(way > 20.0 for way in ways[0])
