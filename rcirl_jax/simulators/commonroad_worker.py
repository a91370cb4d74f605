"""One CommonRoad scenario step by step, in the environment that has CommonRoad.

    python -m rcirl_jax.simulators.commonroad_worker SCENARIO [default|WEIGHTS]

Says what there is at first as a line of JSON, then, for every line that it reads, what
there is a step later; `null` where the scenario is over. The others drive as recorded.
With a second argument the reactive planner drives the ego: by its own cost, or by a
reward as its cost. Its settings are the default ones but for the horizon, 8 s.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
import json
import os
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from commonroad.common.file_reader import CommonRoadFileReader
from commonroad.scenario.traffic_sign import SupportedTrafficSignCountry
from commonroad.scenario.traffic_sign_interpreter import TrafficSignInterpreter
from commonroad_clcs.pycrccosy import CartesianProjectionDomainError
from commonroad_rp.reactive_planner import ReactivePlanner
from commonroad_rp.state import ReactivePlannerState
from commonroad_rp.utility.config import ReactivePlannerConfiguration
from commonroad_rp.utility.utils_coordinate_system import (
    create_coordinate_system,
    create_initial_ref_path,
)

from rcirl_jax.export.own_planner.features import (
    HORIZON_S,
    NUM_STATIONS,
    STATION_STEP_M,
    TIMES_S,
    Ego,
    Path,
    Scene,
)
from rcirl_jax.geometry.limits import LOOK_AHEAD_M, planning_limit
from rcirl_jax.simulators.commonroad_cost import RewardCost, obstacle

BEHIND_M, AHEAD_M = 60.0, 400.0  # m by which a reference path goes on straight
USUAL_LIMIT_MPS = 29.06  # m/s, where no sign says another: 65 mph
NEAREST = 8  # others that a reward is shown
KINDS = {"bicycle": "cyclist", "pedestrian": "pedestrian"}


class Scenario:
    """A scenario file, its first planning problem and the reference path there."""

    def __init__(self, path: str) -> None:
        self.scenario, problems = CommonRoadFileReader(path).open()
        self.problem = next(iter(problems.planning_problem_dict.values()))
        network, others = self.scenario.lanelet_network, self.scenario.dynamic_obstacles
        points = create_initial_ref_path(network, self.problem)
        self.system = create_coordinate_system(longer(points))
        self.first = self.problem.initial_state.time_step
        # the last step at which somebody was recorded
        ends = [o.prediction.final_time_step for o in others if o.prediction]
        self.recorded = max(ends, default=self.first)
        country = SupportedTrafficSignCountry(self.scenario.scenario_id.country_id)
        self._signs = TrafficSignInterpreter(country, network)

    def limit(self, position: np.ndarray) -> float:
        """Return the posted limit m/s at a place."""
        network = self.scenario.lanelet_network
        lanelets = network.find_lanelet_by_position([position])[0]
        return float(self._signs.speed_limit(frozenset(lanelets)) or USUAL_LIMIT_MPS)

    def others(self, step: int) -> list[list]:
        """Return [kind, x, y, heading, speed, acceleration, length, width] of each."""
        found = []
        for body in self.scenario.obstacles:
            state = body.state_at_time(step)
            if state is not None:
                speed = getattr(state, "velocity", None) or 0.0
                change = getattr(state, "acceleration", None) or 0.0
                place = [*state.position, state.orientation, speed, change]
                found.append([kind_of(body), *map(float, place), *size_of(body)])
        return found

    def projected(self, body: Any, first: int, last: int) -> np.ndarray:  # noqa: ANN401
        """Return rows (t s from the first step, s, l, heading on the road, speed)."""
        rows = []
        for step in range(first, last + 1):
            state = body.state_at_time(step)
            try:
                s, l = self.system.convert_to_curvilinear_coords(*state.position)
            except (AttributeError, CartesianProjectionDomainError):
                continue  # not there, or far from the road
            road = np.interp(s, self.system.ref_pos, self.system.ref_theta)
            speed = getattr(state, "velocity", None) or 0.0
            turn = np.angle(np.exp(1j * (state.orientation - road)))
            t = (step - first) * self.scenario.dt
            rows.append((t, s, l, turn, speed))
        return np.array(rows).reshape(-1, 5)


def longer(points: np.ndarray) -> np.ndarray:
    """Extend a path straight at both ends, as its last two metres go."""
    arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    near = np.interp([2.0, arc[-1] - 2.0], arc, np.arange(len(points)))
    inner = points[near.round().astype(int)]
    ways = (points[[0, -1]] - inner) / np.hypot(*(points[[0, -1]] - inner).T)[:, None]
    behind = points[0] + np.arange(BEHIND_M, 0.0, -1.0)[:, None] * ways[0]
    ahead = points[-1] + np.arange(1.0, AHEAD_M)[:, None] * ways[1]
    return np.vstack([behind, points, ahead])


def kind_of(body: Any) -> str:  # noqa: ANN401
    """Return the kind of a body, by our names."""
    moves = hasattr(body, "prediction")
    return KINDS.get(body.obstacle_type.value, "vehicle") if moves else "static"


def size_of(body: Any) -> tuple[float, float]:  # noqa: ANN401
    """Return length and width m of the box around a body's shape."""
    left, low, right, high = body.obstacle_shape.shapely_object.bounds
    return float(right - left), float(high - low)


class RewardPlanner(ReactivePlanner):
    """The reactive planner, whose feasible samples a `RewardCost` values at once."""

    def _check_kinematics(self, *args: Any) -> Any:  # noqa: ANN401
        found = super()._check_kinematics(*args)
        if isinstance(self.cost_function, RewardCost):
            self.cost_function.evaluate_all(found[0])
        return found


class Planned:
    """The reactive planner as the driver of a scenario's ego."""

    def __init__(self, given: Scenario, cost: str) -> None:
        self.given, config = given, ReactivePlannerConfiguration()
        config.debug.multiproc, config.debug.logging_level = False, "ERROR"
        config.planning.dt = given.scenario.dt
        config.planning.time_steps_computation = round(HORIZON_S / given.scenario.dt)
        config.update(given.scenario, given.problem)
        self.planner, self.car = RewardPlanner(config), config.vehicle
        self.planner.set_reference_path(coordinate_system=given.system)
        self.cost: RewardCost | None = None
        if cost != "default":
            self.cost = RewardCost(cost, config.planning.dt, self.car.wb_rear_axle)
            self.planner.set_cost_function(self.cost)
        self.every = config.planning.replanning_frequency
        self.state, self.plan, self.at = self.planner.x_0, None, 0

    def step(self) -> bool:
        """Advance one step; return whether there is a plan to follow.

        A plan is made every third step; where none is found, the last is followed on.
        """
        if self.at % self.every == 0:
            self._plan_anew()
        self.at += 1
        if self.plan is None or self.at >= len(self.plan[0].state_list):
            return False
        self.state = self.plan[0].state_list[self.at]
        return True

    def _plan_anew(self) -> None:
        planner = self.planner
        if self.plan is not None:
            _, along, across = self.plan
            planner.reset(
                initial_state_cart=self.state,
                initial_state_curv=(along[self.at], across[self.at]),
                collision_checker=planner.collision_checker,
                coordinate_system=planner.coordinate_system,
            )
        planner.set_desired_velocity(current_speed=self.state.velocity)
        if self.cost is not None:
            self.cost.look(*scene_of(self.given, self.state, self.car))
        found = planner.plan()
        if found is not None:
            self.plan, self.at = found, 0


def scene_of(
    given: Scenario,
    state: ReactivePlannerState,
    car: Any,  # noqa: ANN401
) -> tuple[Scene, float]:
    """Return the frame that a reward reads, and the centre's station m on the path.

    The others' future is the recorded one, which the planner checks collisions with;
    times beyond the record do not count.
    """
    system, now = given.system, state.time_step
    heading = np.array([np.cos(state.orientation), np.sin(state.orientation)])
    centre = state.position + car.wb_rear_axle * heading
    s, l = system.convert_to_curvilinear_coords(*centre)
    road = np.interp(s, system.ref_pos, system.ref_theta)
    turn = float(np.angle(np.exp(1j * (state.orientation - road))))
    size = NUM_STATIONS + int(LOOK_AHEAD_M / STATION_STEP_M)
    at = s + STATION_STEP_M * np.arange(size)
    kappa = np.interp(at, system.ref_pos, system.ref_curv, right=0.0)
    posted = np.full(size, given.limit(centre))
    limit = planning_limit(kappa, 0.0 * at, posted, STATION_STEP_M)
    shrink = max(1.0 - kappa[0] * l, 0.1)
    last = now + round(HORIZON_S / given.scenario.dt)
    there = [o for o in given.scenario.obstacles if o.state_at_time(now) is not None]
    away = lambda o: np.hypot(*(o.state_at_time(now).position - centre))  # noqa: E731
    boxes = []
    for body in sorted(there, key=away)[:NEAREST]:
        rows = given.projected(body, now, last)
        if len(rows):
            boxes.append(obstacle(kind_of(body), size_of(body), rows - [0, s, 0, 0, 0]))
    known = (given.recorded - now) * given.scenario.dt + 1e-6 >= TIMES_S
    scene = Scene(
        ego=Ego(
            l=l,
            dl=np.tan(turn) * shrink,
            ddl=np.tan(state.steering_angle) / car.wheelbase - kappa[0],
            v=state.velocity * np.cos(turn) / shrink,
            a=state.acceleration,
            length=car.length,
            width=car.width,
        ),
        path=Path(
            kappa=kappa[:NUM_STATIONS],
            l=np.zeros(NUM_STATIONS),
            speed_limit=limit[:NUM_STATIONS],
        ),
        obstacles=boxes,
        num_valid=max(int(np.sum(known)), 2),
    )
    return scene, float(s)


def seen(given: Scenario, driver: Planned | None, step: int) -> dict:
    """Return what there is at a step: the ego if driven here, and the others."""
    said: dict[str, Any] = {"others": given.others(step)}
    if driver is not None:
        state, car = driver.state, driver.car
        centre = ReactivePlannerState.shift_state_to_center(state, car.wb_rear_axle)
        curvature = np.tan(state.steering_angle) / car.wheelbase
        ego = [*centre.position, state.orientation, state.velocity]
        said["ego"] = [*map(float, ego), float(state.acceleration), float(curvature)]
        said["limit"] = given.limit(centre.position)
    return said


def steps(given: Scenario, driver: Planned | None) -> Iterator[dict | None]:
    """Yield what is said at first and after every line that is read."""
    start = given.problem.initial_state
    ego = [*start.position, start.orientation, start.velocity, 0.0, 0.0]
    yield {
        **seen(given, None, given.first),
        "ego": [float(x) for x in ego],
        "line": given.system.reference.tolist(),
        "limit": given.limit(start.position),
        "dt": given.scenario.dt,
    }
    for step in range(given.first + 1, given.recorded + 1):
        if driver is not None and not driver.step():
            break
        yield seen(given, driver, step)
    yield None


def main(scenario: str, cost: str | None = None) -> None:
    """Answer line by line; what libraries print goes to stderr."""
    with os.fdopen(os.dup(1), "w") as said:
        os.dup2(2, 1)
        given = Scenario(scenario)
        driver = None if cost is None else Planned(given, cost)
        for line in steps(given, driver):
            print(json.dumps(line), file=said, flush=True)
            if not sys.stdin.readline():
                return


if __name__ == "__main__":
    main(*sys.argv[1:])
