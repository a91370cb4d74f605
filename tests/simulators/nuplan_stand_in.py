"""Stand-ins for what of nuPlan the planner touches: its public names, nothing of it."""

import dataclasses
import enum
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

Layer = enum.Enum("SemanticMapLayer", ["ROADBLOCK", "ROADBLOCK_CONNECTOR"])
Light = enum.Enum("TrafficLightStatusType", ["GREEN", "YELLOW", "RED", "UNKNOWN"])
Tracked = enum.Enum(
    "TrackedObjectType", ["VEHICLE", "PEDESTRIAN", "BICYCLE", "TRAFFIC_CONE"]
)


struct = dataclasses.make_dataclass
StateSE2 = struct("StateSE2", ["x", "y", ("heading", float, 0.0)])
StateVector2D = struct("StateVector2D", ["x", "y"])
TimePoint = struct("TimePoint", ["time_us"])
DetectionsTracks = struct("DetectionsTracks", ["tracked_objects"])
InterpolatedTrajectory = struct("InterpolatedTrajectory", ["states"])


@dataclasses.dataclass
class EgoState:
    """The state of the centre; its box is 5.2 m by 2.3 m."""

    center: Any
    center_velocity_2d: Any
    center_acceleration_2d: Any
    tire_steering_angle: float
    time_point: Any
    vehicle_parameters: Any = dataclasses.field(
        default_factory=lambda: SimpleNamespace(wheel_base=3.1)
    )

    @classmethod
    def build_from_center(cls, **leaves):
        return cls(**leaves)

    @property
    def dynamic_car_state(self):
        return self

    @property
    def car_footprint(self):
        box, parameters = {"length": 5.2, "width": 2.3}, self.vehicle_parameters
        return SimpleNamespace(**box, vehicle_parameters=parameters)


class AbstractPlanner:
    """As nuPlan's: the simulation calls `compute_trajectory`."""

    requires_scenario = False

    def compute_trajectory(self, current_input):
        return self.compute_planner_trajectory(current_input)


class Lane:
    """A lane of a route; points 5 m apart."""

    def __init__(self, name, begin, end, limit=None):
        count = int(np.hypot(*np.subtract(end, begin)) / 5.0) + 1
        points = np.linspace(begin, end, count)
        self.id, self.speed_limit_mps = name, limit
        self.baseline_path = SimpleNamespace(
            length=float(np.hypot(*np.subtract(end, begin))),
            discrete_path=[StateSE2(*point) for point in points.tolist()],
        )
        self.incoming_edges, self.outgoing_edges = [], []

    def then(self, *lanes):
        self.outgoing_edges += lanes
        for lane in lanes:
            lane.incoming_edges.append(self)


class Map:
    """Road blocks by their ids; those that begin with c are connectors."""

    def __init__(self, **blocks):
        self.blocks = {k: SimpleNamespace(interior_edges=v) for k, v in blocks.items()}

    def get_map_object(self, name, layer):
        of_it = (layer is Layer.ROADBLOCK_CONNECTOR) == name.startswith("c")
        return self.blocks.get(name) if of_it else None


def tracked(kind, x, y, speed=None, heading=0.0, size=(4.5, 1.9)):
    """A tracked object; without a speed one that has no velocity at all."""
    made = SimpleNamespace(
        tracked_object_type=Tracked[kind],
        center=StateSE2(x, y, heading),
        box=SimpleNamespace(length=size[0], width=size[1]),
    )
    if speed is not None:
        made.velocity = StateVector2D(speed * np.cos(heading), speed * np.sin(heading))
    return made


# module of nuPlan -> what is taken from it
MODULES = {
    "common.actor_state.ego_state": [EgoState],
    "common.actor_state.state_representation": [StateSE2, StateVector2D, TimePoint],
    "common.maps.maps_datatypes": [Layer],
    "planning.simulation.observation.observation_type": [DetectionsTracks],
    "planning.simulation.planner.abstract_planner": [AbstractPlanner],
    "planning.simulation.trajectory.interpolated_trajectory": [InterpolatedTrajectory],
}


def install(monkeypatch):
    """Make `import nuplan. ...` find the stand-ins."""
    for name, classes in MODULES.items():
        parts = ["nuplan", *name.split(".")]
        for depth in range(1, len(parts) + 1):
            path = ".".join(parts[:depth])
            if path not in sys.modules:
                monkeypatch.setitem(sys.modules, path, ModuleType(path))
        for kind in classes:
            setattr(sys.modules["nuplan." + name], kind.__name__, kind)
