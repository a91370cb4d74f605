"""The line that an ego is moved along, smooth, with its heading and curvature."""

import math

import numpy as np

from rcirl_jax.export.own_planner.inputs import CentreLine
from rcirl_jax.geometry.frenet import reference_line_from_polyline
from rcirl_jax.units import STATION_STEP_M

FADING_M = 15.0  # m of way in which an offset falls to 1 / e


class Way:
    """A lane's middle by station; `centre_line` is it as the planner gets it.

    Args:
      points: [m, 2] m, in driving direction.
      speed_limit: m/s, one, or one for each point from which it holds.
      lane_width: m.
    """

    def __init__(
        self,
        points: np.ndarray,
        speed_limit: float | np.ndarray,
        lane_width: float,
    ) -> None:
        points = np.asarray(points, float)
        arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
        size = int(arc[-1] / STATION_STEP_M) + 1
        origin = points[0]
        line = reference_line_from_polyline(
            points - origin, size=size, step=STATION_STEP_M
        )
        self.stations = np.arange(size) * STATION_STEP_M
        self._x = np.asarray(line.x, float) + origin[0]
        self._y = np.asarray(line.y, float) + origin[1]
        self._heading = np.asarray(line.heading, float)
        self._kappa = np.asarray(line.kappa, float)
        limits = np.broadcast_to(speed_limit, arc.shape)
        last = np.searchsorted(arc, self.stations, "right") - 1
        self.limits = limits[np.clip(last, 0, None)]
        self.centre_line = CentreLine(
            points=np.stack([self._x, self._y], axis=1),
            speed_limit=self.limits,
            lane_width=lane_width,
        )

    def place(self, s: float) -> tuple[float, float, float, float]:
        """(x, y) m, heading rad and curvature 1/m at a station."""
        at = lambda table: float(np.interp(s, self.stations, table))  # noqa: E731
        heading = at(self._heading)
        return at(self._x), at(self._y), heading, at(self._kappa)

    def station(self, x: float, y: float) -> float:
        """Station m of the point of the line next to a place."""
        n = int(np.argmin((self._x - x) ** 2 + (self._y - y) ** 2))
        h = self._heading[n]
        return float(
            self.stations[n]
            + (x - self._x[n]) * np.cos(h)
            + (y - self._y[n]) * np.sin(h)
        )

    def offset(self, x: float, y: float) -> float:
        """How far m a place lies left of the line."""
        at, left, heading, _ = self.place(self.station(x, y))
        return (y - left) * math.cos(heading) - (x - at) * math.sin(heading)

    def limit(self, s: float) -> float:
        """Posted limit m/s at a station."""
        n = int(s / STATION_STEP_M)
        return float(self.limits[min(max(n, 0), len(self.limits) - 1)])


def fading(offset: float, way: float) -> tuple[float, float]:
    """What is left m of an offset from the line after some way m, and its slope by way.

    Exponential: planned anew on the way, it goes on as before.
    """
    left = offset * math.exp(-way / FADING_M)
    return left, -left / FADING_M
