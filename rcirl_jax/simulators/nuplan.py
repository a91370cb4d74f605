"""A reward as a planner of nuPlan (Caesar 2021), in the shape of its `AbstractPlanner`.

    _target_: rcirl_jax.simulators.nuplan.reward_planner   # a planner of nuPlan's hydra
    weights: weights.msgpack

It plans at 10 Hz along the middle of the lanes of its route; an offset that the ego has
fades away. Tested against stand-ins that follow nuPlan's public interface, not in
nuPlan: neither the devkit nor its data are among what this package depends on.
"""

import importlib
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from rcirl_jax.errors import InputError
from rcirl_jax.export.closed_loop import table_rows
from rcirl_jax.export.own_planner.inputs import STATES, Body, Car, Signal
from rcirl_jax.simulators.drive import Driver, Seen, refuse_paths
from rcirl_jax.simulators.simulators import STEP_S, Move, View, Way
from rcirl_jax.units import HORIZON_S

USUAL_LIMIT_MPS = 15.0  # m/s, where the map has none
BEYOND_M = 300.0  # m by which the route goes on straight
LANE_WIDTH_M = 3.6  # m
KINDS = {"VEHICLE": "vehicle", "PEDESTRIAN": "pedestrian", "BICYCLE": "cyclist"}


# what of nuPlan is made or asked for here, and the module below `nuplan` that has it
THEIRS = {
    "AbstractPlanner": "planning.simulation.planner.abstract_planner",
    "DetectionsTracks": "planning.simulation.observation.observation_type",
    "EgoState": "common.actor_state.ego_state",
    "InterpolatedTrajectory": "planning.simulation.trajectory.interpolated_trajectory",
    "SemanticMapLayer": "common.maps.maps_datatypes",
    "StateSE2": "common.actor_state.state_representation",
    "StateVector2D": "common.actor_state.state_representation",
    "TimePoint": "common.actor_state.state_representation",
}


def reward_planner(weights: str, seed: int = 0) -> Any:  # noqa: ANN401
    """Return an `AbstractPlanner` that drives by a weights file; imports nuPlan."""
    of = {name: importlib.import_module(f"nuplan.{at}") for name, at in THEIRS.items()}
    theirs = {name: getattr(module, name) for name, module in of.items()}
    kind = type("RewardPlanner", (Planner, theirs["AbstractPlanner"]), {})
    return kind(weights, seed, SimpleNamespace(**theirs))


class Planner:
    """The methods of an `AbstractPlanner`.

    Args:
      weights: file of the reward.
      seed: of the sampler.
      theirs: the classes of nuPlan that are made here.
    """

    def __init__(self, weights: str, seed: int, theirs: SimpleNamespace) -> None:
        self._row, self._seed, self._theirs = table_rows([weights], [])[0], seed, theirs
        refuse_paths(self._row, "nuPlan")

    def name(self) -> str:
        """Return the planner's name."""
        return self._row.name

    def observation_type(self) -> Any:  # noqa: ANN401
        """Return what the planner wants to see: tracked objects."""
        return self._theirs.DetectionsTracks

    def initialize(self, initialization: Any) -> None:  # noqa: ANN401
        """Take the route: which lanes lead farthest along it."""
        layers = self._theirs.SemanticMapLayer
        find = initialization.map_api.get_map_object
        # lane: m that its route still has, itself and the next lane
        self._route: dict[str, tuple[float, Any, Any]] = {}
        for name in reversed(initialization.route_roadblock_ids):
            block = find(name, layers.ROADBLOCK)
            block = block or find(name, layers.ROADBLOCK_CONNECTOR)
            for edge in block.interior_edges if block else ():
                after = [e for e in edge.outgoing_edges if e.id in self._route]
                follows = max(after, key=lambda e: self._route[e.id][0], default=None)
                left = self._route[follows.id][0] if follows else 0.0
                length = edge.baseline_path.length
                self._route[edge.id] = (length + left, edge, follows)
        if not self._route:
            raise InputError("nuplan: route_roadblock_ids: no lanes: expected a route")
        self._way: Way | None = None
        self._seen, self._driver = Seen(1), Driver(self._row, [self._seed])

    def compute_planner_trajectory(self, current_input: Any) -> Any:  # noqa: ANN401
        """Return the plan of one moment as an `InterpolatedTrajectory`."""
        ego, observation = current_input.history.current_state
        way = self._way or self._line(ego.center)
        view = self._view(way, ego, observation, current_input.traffic_light_data)
        scenes, _ = self._seen.scenes([view])
        (move,), _ = self._driver.moves(scenes, np.zeros(1, np.float32))
        return self._trajectory(way, ego, move)

    def _line(self, place: Any) -> Way:  # noqa: ANN401
        """Return the lanes from the one that is nearest to a place on."""

        def away(edge: Any) -> float:  # noqa: ANN401
            return np.min(np.hypot(*(_points(edge) - [place.x, place.y]).T))

        edge = min((edge for _, edge, _ in self._route.values()), key=away)
        chain = list(edge.incoming_edges[:1])
        while edge is not None:
            chain.append(edge)
            edge = self._route[edge.id][2]
        lanes = [_points(edge) for edge in chain]
        self._stops = {str(e.id): l[0] for e, l in zip(chain, lanes, strict=True)}
        posted = [edge.speed_limit_mps or USUAL_LIMIT_MPS for edge in chain]
        limits = np.repeat(posted, [len(lane) for lane in lanes])
        points = np.concatenate(lanes)
        last = points[-1] - points[-2]
        points = np.vstack([points, points[-1] + BEYOND_M * last / np.hypot(*last)])
        self._way = Way(points, np.append(limits, limits[-1]), LANE_WIDTH_M)
        return self._way

    def _view(self, way: Way, ego: Any, observation: Any, lights: Any) -> View:  # noqa: ANN401
        """Return what is seen at one moment."""
        car, state = ego.car_footprint, ego.dynamic_car_state
        turn = math.tan(ego.tire_steering_angle)
        return View(
            ego=Car(
                x=ego.center.x,
                y=ego.center.y,
                heading=ego.center.heading,
                speed=max(state.center_velocity_2d.x, 0.0),
                acceleration=state.center_acceleration_2d.x,
                curvature=turn / car.vehicle_parameters.wheel_base,
                length=car.length,
                width=car.width,
            ),
            centre_line=way.centre_line,
            obstacles=[_body(x) for x in observation.tracked_objects.tracked_objects],
            signals=[
                Signal(x=x, y=y, state=state if state in STATES else "off")
                for light in lights or ()
                if str(light.lane_connector_id) in self._stops
                for x, y in [self._stops[str(light.lane_connector_id)].tolist()]
                for state in [light.status.name.lower()]
            ],
            way=0.0,
            speed_limit=way.limit(way.project(ego.center.x, ego.center.y)[0]),
        )

    def _trajectory(self, way: Way, ego: Any, move: Move) -> Any:  # noqa: ANN401
        """Return the present state, then the planned ones, 0.1 s apart for 8 s."""
        theirs, (time, s, v) = self._theirs, move.future.T
        curve = CubicHermiteSpline(time, s, v)
        begin, offset = way.project(ego.center.x, ego.center.y)
        parameters = ego.car_footprint.vehicle_parameters
        states = [ego]
        for t in STEP_S * np.arange(1, round(HORIZON_S / STEP_S) + 1):
            gone = float(curve(t))
            *place, curvature = way.place(begin + gone, offset, gone)
            at = ego.time_point.time_us + round(1e6 * t)
            state = theirs.EgoState.build_from_center(
                center=theirs.StateSE2(*place),
                center_velocity_2d=theirs.StateVector2D(float(curve(t, 1)), 0.0),
                center_acceleration_2d=theirs.StateVector2D(float(curve(t, 2)), 0.0),
                tire_steering_angle=math.atan(curvature * parameters.wheel_base),
                time_point=theirs.TimePoint(at),
                vehicle_parameters=parameters,
            )
            states.append(state)
        return theirs.InterpolatedTrajectory(states)


def _points(edge: Any) -> np.ndarray:  # noqa: ANN401
    """Return the middle of a lane [m, 2] m."""
    return np.array([(point.x, point.y) for point in edge.baseline_path.discrete_path])


def _body(tracked: Any) -> Body:  # noqa: ANN401
    """Return a tracked object; what has no velocity stands."""
    velocity = getattr(tracked, "velocity", None)
    return Body(
        kind=KINDS.get(tracked.tracked_object_type.name, "static"),
        x=tracked.center.x,
        y=tracked.center.y,
        heading=tracked.center.heading,
        speed=math.hypot(velocity.x, velocity.y) if velocity is not None else 0.0,
        length=tracked.box.length,
        width=tracked.box.width,
    )
