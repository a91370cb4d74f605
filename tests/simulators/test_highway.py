"""highway-env: what is seen is what the simulator says."""

import numpy as np
import pytest

highway = pytest.importorskip("rcirl_jax.simulators.highway")

from highway_env.envs import MergeEnv  # noqa: E402

from rcirl_jax.simulators.drive import Seen  # noqa: E402
from tests.simulators.straight import moved  # noqa: E402


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
    episode.step(moved(2.5, 26.0, 1.0))
    after = episode.look()
    assert after.way == 2.5
    assert after.ego.x - before.ego.x == pytest.approx(2.5, abs=1e-3)
    assert after.ego.y == pytest.approx(before.ego.y, abs=1e-3)
    assert (after.ego.speed, after.ego.acceleration) == (26.0, 1.0)
    assert after.centre_line is before.centre_line


def test_only_lanes_that_go_on_may_be_driven_on(episode):
    """highway-v0 has lanes at y = 0, 4, 8 m and so on; merge-v1 two, and a ramp's."""
    line = episode.look().centre_line
    others = 2 if isinstance(episode.env, MergeEnv) else 3
    lane = episode.ego.lane_index[2]
    edges = ((others - 0.5 - lane) * 4.0, (0.5 + lane) * 4.0)
    assert (line.road_left, line.road_right) == edges


def test_a_planned_path_leads_into_the_next_lane(episode):
    """To the lane at smaller y, 0.2 m in every 2 m: the frame becomes that lane's."""
    begins, start = episode.look(), np.array(episode.ego.position)
    lane, offset, asides = episode.ego.lane_index[2], 0.0, []
    assert lane == 1
    for _ in range(20):
        offset -= 0.2
        episode.step(moved(2.0, 20.0, beside=(offset, -0.1, 0.001)))
        view = episode.look()
        asides.append(view.aside)
        offset -= view.aside
        assert view.ego.heading == pytest.approx(-np.arctan(0.1))
        assert view.ego.curvature == pytest.approx(0.001, rel=0.02)
    assert [x for x in asides if x] == [-4.0]
    assert asides.index(-4.0) == 10  # behind the line between both
    assert offset == pytest.approx(0.0, abs=1e-9)
    driven = np.array(episode.ego.position) - start
    np.testing.assert_allclose(driven, [40.0, -4.0], atol=0.02)
    assert episode.ego.lane_index[2] == 0
    assert view.way == pytest.approx(40.0)
    assert view.centre_line is not begins.centre_line
    scene, _ = Seen(1).scenes([view])
    assert float(scene.ego.l[0]) == pytest.approx(0.0, abs=0.02)
    assert float(scene.ego.dl[0]) == pytest.approx(-0.1, abs=2e-3)


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
