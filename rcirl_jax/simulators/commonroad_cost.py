"""A reward as the cost function of CommonRoad's reactive planner. Needs numpy, msgpack.

It has the shape of `commonroad_rp.cost_function.CostFunction`:

    cost = RewardCost("weights.msgpack", dt=0.1, rear_axle=1.42)
    planner.set_cost_function(cost)
    cost.look(scene, station)  # before each planner.plan()

The planner's samples are those of the rear axle on its reference path, a scene's those
of the centre, from the ego on. V alone is the cost, also of a reward with a prior cost:
its gain is the same for all samples of a scene. `evaluate_all` knows the costs of many
samples at once, in a fiftieth of the time; the planner asks for them one by one.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rcirl_jax.export.own_planner.features import (
    TIMES_S,
    FeatureMap,
    Kind,
    Obstacle,
    Scene,
)
from rcirl_jax.export.reader import load_weights


class RewardCost:
    """Minus the value of a sample.

    Args:
      weights: file of the reward.
      dt: s between the states of a sample.
      rear_axle: m from the rear axle to the car's centre.
    """

    def __init__(self, weights: str, dt: float, rear_axle: float) -> None:
        self.reward = load_weights(weights)
        self.columns = FeatureMap(self.reward.names, self.reward.units)
        self.dt, self.rear_axle = dt, rear_axle
        self.scene: Scene | None = None
        self.station = 0.0
        # (sample, cost) by the sample's identity, its own while it is kept here
        self._known: dict[int, tuple[Any, float]] = {}

    def look(self, scene: Scene, station: float) -> None:
        """Take the present frame, and the station m of the ego's centre on the path."""
        self.scene, self.station, self._known = scene, station, {}

    def evaluate(self, trajectory: Any) -> float:  # noqa: ANN401
        """Return the cost of a `TrajectorySample` of theirs; lower is better."""
        if (known := self._known.get(id(trajectory))) is not None:
            return known[1]
        return float(self._costs([trajectory])[0])

    def evaluate_all(self, trajectories: Sequence[Any]) -> None:
        """Work out at once the costs that `evaluate` is asked for next."""
        costs = self._costs(trajectories) if trajectories else ()
        self._known = {
            id(x): (x, float(cost)) for x, cost in zip(trajectories, costs, strict=True)
        }

    def _costs(self, trajectories: Sequence[Any]) -> np.ndarray:
        """Return minus the values of samples [K]."""
        assert self.scene is not None, "look at a scene before planning"
        ways = []  # stations and offsets m of the ego's centre at `TIMES_S`
        for found in (sample.curvilinear for sample in trajectories):
            s = found.s + self.rear_axle * np.cos(found.theta) - self.station
            l = found.d + self.rear_axle * np.sin(found.theta)
            time = self.dt * np.arange(len(s))
            ways.append([np.interp(TIMES_S, time, x) for x in (s, l)])
        s, l = np.stack(ways, axis=1)
        features = self.columns(self.scene, s, l)
        return -self.reward.value(features, self.scene.time_valid)


def obstacle(kind: str, size: tuple[float, float], track: np.ndarray) -> Obstacle:
    """Return a body with a known future.

    Args:
      kind: "vehicle", "cyclist", "pedestrian" or "static".
      size: length and width m.
      track: [n, 5] rows (t s, s m, l m, heading against the road rad, speed m/s), t
        rising; it is not there before the first nor after the last.
    """
    t, *columns = track.T
    s, l, turn, speed = (np.interp(TIMES_S, t, x) for x in columns)
    along, across = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    half_s = 0.5 * (size[0] * along + size[1] * across)
    half_l = 0.5 * (size[0] * across + size[1] * along)
    return Obstacle(
        kind=Kind[kind.upper()],
        s_lower=s - half_s,
        s_upper=s + half_s,
        l_lower=l - half_l,
        l_upper=l + half_l,
        speed=speed * np.cos(turn),
        valid=(t[0] - 1e-6 <= TIMES_S) & (t[-1] + 1e-6 >= TIMES_S),
    )
