"""Planned paths in closed loop: lanes that are free, and those that are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.common import untrained
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate.types import GateConfig
from rcirl_jax.export.closed_loop import gate_baselines, table_rows
from rcirl_jax.features import feature_map
from rcirl_jax.planner.mobil import MOBIL_ROW
from rcirl_jax.planner.rank import ONLINE_PATHS, RankConfig
from rcirl_jax.planner.safety import SafetyConfig
from rcirl_jax.reward.speed_dp import SPEED_DP_ROW
from rcirl_jax.simulation.cases import EgoState
from rcirl_jax.simulation.rollout import first_scenes
from rcirl_jax.simulation.rows import baseline_row
from rcirl_jax.simulation.world import Vehicle, lane_centre
from rcirl_jax.simulators.drive import refuse_paths
from rcirl_jax.units import STATION_STEP_M
from tests.helpers.own_planner import drawn_reward
from tests.simulation.drives import drive, stack
from tests.simulation.worlds import make_case

PATHS = RankConfig(sampler=ONLINE_PATHS, safety=SafetyConfig(entry=True))
ROW = baseline_row("hand-set", "paper21", untrained(), PATHS)
SLOW = {"s": 60.0, "v": 6.0, "desired": 6.0}


def road(agents=(), lanes=(1, 0), **more):
    return make_case([SLOW, *agents], speed=15.0, limit=20.0, lanes=lanes, **more)


def closed_left(case):
    left = np.full_like(case.road.route_left, 1.75)
    return case.replace(road=case.road.replace(route_left=left))


@pytest.fixture(scope="module")
def driven():
    fast = {"s": -25.0, "l": 3.5, "v": 25.0, "desired": 25.0}
    parked = {**SLOW, "l": 3.5, "v": 0.0, "phases": [(0.0, 0.0, 1.0)]}
    cases = [road(), road(lanes=(0, 0)), road([fast]), road([parked], lanes=(1, 1)),
             closed_left(road())]  # fmt: skip
    record, shot = drive(cases, 250, policy=ROW.policy, params=ROW.params)
    assert record.at_fault.sum() == 0
    return record, shot


def test_a_slow_car_is_passed_where_there_is_a_lane(driven):
    record, _ = driven
    free, none, _, right, closed = record.l[:, -1]
    assert free == pytest.approx(3.5, abs=0.1)
    assert right == pytest.approx(-3.5, abs=0.1)  # somebody stands on the left
    assert np.abs(record.l[1]).max() < 0.05
    assert np.abs(record.l[4]).max() < 0.05  # the route does not lead there
    assert none == pytest.approx(closed)
    assert record.s[0, -1] > record.s[1, -1] + 100.0


def test_nobody_is_cut_up(driven):
    """A car at 25 m/s comes from 25 m behind: it is let past, or never met."""
    record, shot = driven
    entered = np.abs(record.l[2]) > 0.7
    behind = shot.agents.s[2, :, 1] < record.s[2]
    assert not (entered & behind & shot.agents.present[2, :, 1]).any()
    assert record.induced_braking[2].max() < 1.0


def test_the_plan_is_what_is_driven_inside_the_limits_of_the_steering(driven):
    record, shot = driven
    np.testing.assert_allclose(shot.plan_l[:, 1:, 0], record.l[:, :-1], atol=0.15)
    assert np.abs(record.curvature).max() <= Vehicle().max_curvature
    assert np.abs(record.v**2 * record.curvature).max() < 4.0


def test_offsets_are_from_the_lane_that_goes_on():
    """The ego is in the lane on the right, which ends after 100 m."""
    case = make_case(path_l=-3.5, lanes=(1, 1))
    ends = np.where(
        np.arange(len(case.road.kappa)) * STATION_STEP_M < 100.0, -5.75, -1.75
    )
    ends = ends.astype(np.float32)
    short = case.replace(road=case.road.replace(route_right=ends))
    scenes = first_scenes(stack([case, short]), steers=True)
    np.testing.assert_allclose(scenes.ego.l, [0.0, -3.5], atol=1e-6)
    np.testing.assert_allclose(scenes.path.road_right[:, 0], [-2.25, -5.75], atol=1e-6)
    np.testing.assert_allclose(scenes.path.road_left[:, 0], [9.25, 5.75], atol=1e-6)
    now = EgoState(**dict.fromkeys(EgoState.__dataclass_fields__, jnp.float32(0.0)))
    lanes = jax.tree.map(jnp.asarray, case.road)
    assert float(lane_centre(lanes, now.replace(l=jnp.float32(9.0)))) == 3.5


def test_weights_plan_what_they_were_trained_to_plan(tmp_path):
    """Beside them hand-set does too, unless it is told; the speed DP knows no paths."""
    columns = feature_map("paper21")
    reward = drawn_reward(tmp_path / "w.msgpack", columns, mode="path_speed")
    asked = [str(tmp_path / "w.msgpack")], ["hand-set", SPEED_DP_ROW, "IDM"]
    steers = lambda **how: [row.steers for row in table_rows(*asked, **how)]  # noqa: E731
    assert reward.mode == "path_speed"
    assert MOBIL_ROW in gate_baselines(asked[0][0], GateConfig())
    assert steers() == [True, True, False, False]
    assert steers(mode="speed") == [True, False, False, False]
    assert steers(dp=True) == [True, True, True, True, False, False]
    with pytest.raises(InputError, match=r"mode: path_speed: .* in nuPlan rows"):
        refuse_paths(ROW, "nuPlan")
