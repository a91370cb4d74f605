"""highway-env (Leurent 2018), the gymnasium environments of others: two roads of it.

The ego is put where its plan has it (kinematically, at 10 Hz): along the middle of its
lane or, where paths are planned, beside it and in the lanes that go on as its own does.
The others are highway-env's IDMVehicles, which change lanes and react to the ego. The
own driver is an IDMVehicle in the ego's place: one that keeps its lane, and one that
overtakes.
"""

import math
import zlib
from collections.abc import Sequence
from typing import Any

import gymnasium
import highway_env
import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from rcirl_jax.export.own_planner.inputs import Body, Car
from rcirl_jax.simulators.simulators import (
    STEP_S,
    LockStep,
    Move,
    View,
    Way,
    drawn_names,
)

# kind: environment, what differs from its own configuration, x m where it ends
KINDS = {
    "highway": ("highway-v0", {"lanes_count": 3, "vehicles_count": 8}, math.inf),
    "dense": (
        "highway-v0",
        {"lanes_count": 3, "vehicles_count": 8, "vehicles_density": 2},
        math.inf,
    ),
    # its lanes say 20 m/s, which its IDMVehicles keep too; it ends behind the ramp
    "merge": ("merge-v1", {}, 370.0),
}
KEEPS, CHANGES = "IDMVehicle in its lane", "IDMVehicle overtaking"
POINT_STEP_M = 2.0  # m between points of a centre line
BEHIND_M, AHEAD_M = 30.0, 1500.0  # m of a lane before and beyond the ego's first place
NEAR_M = 200.0  # m within which others are shown
LANE_END_M = 0.1  # m before its end, where a lane's successor is asked for

gymnasium.register_envs(highway_env)


class Planned(Vehicle):
    """The ego: where a move puts it."""

    def act(self, action: object = None) -> None:
        """Do nothing: `put` moves the ego."""

    def step(self, dt: float) -> None:
        """Do nothing."""

    def put(self, x: float, y: float, heading: float, move: Move) -> None:
        """Set where the ego is after a move."""
        self.position = np.array([x, y])
        self.heading, self.speed = heading, move.speed
        self.action = {"acceleration": move.acceleration, "steering": 0.0}
        self.on_state_update()


class HighwayEnv:
    """Episodes of highway-v0 and merge-v1."""

    name = "highway_env"
    own_drivers = (KEEPS, CHANGES)
    together = 25
    changes_lanes = True

    def episodes(self, count: int, seed: int) -> list[str]:
        """Return KIND/SEED/NUMBER, the kinds in turn."""
        return drawn_names(list(KINDS), count, seed)

    def start(self, episodes: Sequence[str], own: str | None) -> LockStep:
        """Begin separate environments, stepped one after the other."""
        return LockStep([HighwayEpisode(name, own) for name in episodes])


class HighwayEpisode:
    """One environment; see `simulators.Episode`."""

    def __init__(self, name: str, own: str | None) -> None:
        environment, config, self._end = KINDS[name.split("/")[0]]
        self.env: Any = gymnasium.make(
            environment, config=config, disable_env_checker=True
        ).unwrapped
        self.env.reset(seed=zlib.crc32(name.encode()))
        self.road = self.env.road
        self._ways: dict[tuple, Way] = {}
        # our ego, or an IDMVehicle, in the place of the environment's
        theirs, kind = self.env.vehicle, Planned if own is None else IDMVehicle
        self.ego: Any = kind(self.road, theirs.position, theirs.heading, theirs.speed)
        if own is not None:
            self.ego.enable_lane_change = own == CHANGES
            self.ego.target_speed = float(self.ego.lane.speed_limit)
        self.road.vehicles[self.road.vehicles.index(theirs)] = self.ego
        self._lane, self._driven = self.ego.lane_index, 0.0
        self._station, _ = self.way().project(*self.ego.position)
        self._aside, self._curvature = 0.0, 0.0

    def way(self) -> Way:
        """Return the way along the ego's lane and those that follow it."""
        if self._lane not in self._ways:
            lane = self.road.network.get_lane(self._lane)
            beside = self._lanes_beside()
            width = lane.width_at(0.0)
            self._ways[self._lane] = Way(
                self._points(self._lane),
                lane.speed_limit,
                width,
                left=(0.5 + sum(l > 0.0 for l in beside)) * width,
                right=(0.5 + sum(l < 0.0 for l in beside)) * width,
            )
        return self._ways[self._lane]

    def _lanes_beside(self) -> dict[float, tuple]:
        """Return the other lanes that go on as the ego's does, by offset m to the left.

        Lanes of one direction have the same two nodes; one that ends, as a ramp's, is
        missing in a road further on.
        """
        network, (begin, end, own) = self.road.network, self._lane
        count, road = len(network.graph[begin][end]), (begin, end)
        while road[1] in network.graph:
            road = road[1], next(iter(network.graph[road[1]]))
            count = min(count, len(network.graph[road[0]][road[1]]))
        here = network.get_lane(self._lane)
        s = here.local_coordinates(self.ego.position)[0]
        found = {}
        for n in set(range(count)) - {own}:
            place = network.get_lane((begin, end, n)).position(s, 0.0)
            found[float(here.local_coordinates(place)[1])] = (begin, end, n)
        return found

    def _points(self, index: tuple) -> np.ndarray:
        """Return points of a lane and of its followers, straight beyond the last."""
        network, points = self.road.network, []
        lane = network.get_lane(index)
        s = max(lane.local_coordinates(self.ego.position)[0] - BEHIND_M, 0.0)
        for _ in range(int((BEHIND_M + AHEAD_M) / POINT_STEP_M)):
            if s > lane.length and index[1] in network.graph:
                end = lane.position(lane.length - LANE_END_M, 0.0)
                s, index = s - lane.length, network.next_lane(index, position=end)
                lane = network.get_lane(index)
            points.append(lane.position(s, 0.0))
            s += POINT_STEP_M
        return np.array(points)

    def look(self) -> View | None:
        """Return what is seen; None beyond the place where the kind ends."""
        ego, way = self.ego, self.way()
        if ego.position[0] > self._end:
            return None
        near = (
            other
            for other in (*self.road.vehicles, *self.road.objects)
            if other is not ego
            and math.hypot(*(other.position - ego.position)) < NEAR_M
        )
        action = getattr(ego, "action", {})
        return View(
            ego=Car(
                x=float(ego.position[0]),
                y=float(ego.position[1]),
                heading=float(ego.heading),
                speed=max(float(ego.speed), 0.0),
                acceleration=float(action.get("acceleration", 0.0)),
                length=float(ego.LENGTH),
                width=float(ego.WIDTH),
                curvature=self._curvature,
            ),
            centre_line=way.centre_line,
            obstacles=[_body(other) for other in near],
            way=self._driven,
            speed_limit=way.limit(0.0),
            aside=self._aside,
        )

    def step(self, move: Move | None) -> None:
        """Advance 0.1 s, the ego by its move or as its own driver drives."""
        before = np.array(self.ego.position)
        self._aside = 0.0
        if move is not None:
            self._station += move.way
            way = self.way().beside(self._station, move.beside)
            x, y, heading, self._curvature = way
            self.ego.put(x, y, heading, move)
            if move.beside is not None:
                self._change_lane(move.beside[0])
        self.road.act()
        self.road.step(STEP_S)
        if move is not None:
            self._driven += move.way
        else:
            self._lane = self.ego.lane_index
            self._driven += math.hypot(*(self.ego.position - before))

    def _change_lane(self, l: float) -> None:
        """Take the lane whose middle is nearest to an offset m as the ego's."""
        lanes = {0.0: self._lane, **self._lanes_beside()}
        self._aside = min(lanes, key=lambda middle: abs(l - middle))
        if self._aside:
            self._lane = lanes[self._aside]
            self._station, _ = self.way().project(*self.ego.position)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def _body(other: Vehicle) -> Body:
    """Return a vehicle or a standing object of the road."""
    moves = isinstance(other, Vehicle)
    action = getattr(other, "action", None) or {}
    return Body(
        kind="vehicle" if moves else "static",
        x=float(other.position[0]),
        y=float(other.position[1]),
        heading=float(math.remainder(other.heading, math.tau)),
        speed=float(other.speed) if moves else 0.0,
        acceleration=float(action.get("acceleration", 0.0)),
        length=float(other.LENGTH),
        width=float(other.WIDTH),
    )
