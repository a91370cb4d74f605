"""highway-env: what is seen is what the simulator says."""

import numpy as np
import pytest

highway = pytest.importorskip("rcirl_jax.simulators.highway")

from rcirl_jax.simulators.drive import Seen  # noqa: E402
from rcirl_jax.simulators.simulators import Move  # noqa: E402


def move(way, speed, acceleration=0.0):
    future = np.zeros((18, 3), np.float32)
    return Move(way=way, speed=speed, acceleration=acceleration, future=future)


@pytest.fixture(params=["dense/3/0001", "merge/0/0002"])
def episode(request):
    made = highway.HighwayEpisode(request.param, None)
    yield made
    made.close()


def ahead_in_lane(episode):
    """m to the rear of the next vehicle in the ego's lane, by highway-env itself."""
    front, _ = episode.road.neighbour_vehicles(episode.ego)
    lane = episode.ego.lane
    gap = lane.local_coordinates(front.position)[0]
    gap -= lane.local_coordinates(episode.ego.position)[0]
    return gap - 0.5 * (front.LENGTH + episode.ego.LENGTH), front.speed


def test_the_view_is_the_simulators_state(episode):
    view, ego = episode.look(), episode.ego
    assert (view.ego.x, view.ego.y) == pytest.approx(tuple(ego.position))
    assert view.ego.speed == pytest.approx(ego.speed)
    assert (view.ego.length, view.ego.width) == (5.0, 2.0)
    assert view.speed_limit == ego.lane.speed_limit
    assert view.centre_line.lane_width == 4.0
    others = {(v.position[0], v.position[1], v.speed) for v in episode.road.vehicles}
    moving = {(b.x, b.y, b.speed) for b in view.obstacles if b.kind == "vehicle"}
    assert moving
    assert moving <= others
    assert (*ego.position, ego.speed) not in moving
    standing = [b for b in view.obstacles if b.kind == "static"]
    assert len(standing) == len(
        [o for o in episode.road.objects if abs(o.position[0] - ego.position[0]) < 200]
    )


def test_the_gap_ahead_is_that_of_the_simulators_own_search(episode):
    gap, speed = ahead_in_lane(episode)
    _, free = Seen(1).scenes([episode.look()])
    assert float(free.body[0]) == pytest.approx(gap, abs=0.05)
    assert float(free.speed[0]) == pytest.approx(speed, abs=0.01)


def test_a_move_puts_the_ego_where_it_says(episode):
    before = episode.look()
    episode.step(move(2.5, 26.0, 1.0))
    after = episode.look()
    assert after.way == 2.5
    assert after.ego.x - before.ego.x == pytest.approx(2.5, abs=1e-3)
    assert after.ego.y == pytest.approx(before.ego.y, abs=1e-3)
    assert (after.ego.speed, after.ego.acceleration) == (26.0, 1.0)
    assert after.centre_line is before.centre_line


@pytest.mark.parametrize("own", highway.HighwayEnv.own_drivers)
def test_the_own_driver_drives_by_itself(own):
    running = highway.HighwayEnv().start(["dense/0/0000"], own)
    lanes = set()
    for _ in range(80):
        running.step([None])
        (view,) = running.look()
        lanes.add(round(view.ego.y / 4.0))
    assert view.way > 80.0
    assert len(lanes) == 1 or own == highway.CHANGES
    running.close()


def test_the_same_name_is_the_same_episode():
    first, second = (highway.HighwayEpisode("dense/5/0004", None) for _ in range(2))
    assert first.look().obstacles == second.look().obstacles
    other = highway.HighwayEpisode("dense/6/0004", None)
    assert first.look().obstacles != other.look().obstacles
