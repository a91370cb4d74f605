"""Places and quaternions of messages, and places that are given from the ego."""

import dataclasses
import math

import numpy as np

from rcirl_jax.data.formats.ros2.bag_file import Message
from rcirl_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class Pose:
    """A place on the ground."""

    x: float  # m
    y: float  # m
    heading: float  # rad, of the x axis; NaN where the quaternion is not set

    def moved(self, ahead: float, left: float) -> "Pose":
        """The place so far [m] ahead and to the left; NaN headings point along x."""
        heading = 0.0 if math.isnan(self.heading) else self.heading
        cos, sin = math.cos(heading), math.sin(heading)
        x, y = self.x + cos * ahead - sin * left, self.y + sin * ahead + cos * left
        return Pose(x, y, self.heading)


def pose_of(where: str, position: Message, orientation: Message) -> Pose:
    """A place from a point and a quaternion of any length.

        heading = atan2(2 (w z + x y), w^2 + x^2 - y^2 - z^2)

    Raises:
      InputError: a number that is not finite.
    """
    x, y, q = position.x, position.y, orientation
    for name, value in {"x": x, "y": y, "w": q.w, "z": q.z}.items():
        if not math.isfinite(value):
            field = "position" if name in "xy" else "orientation"
            raise InputError(
                f"{where}: {field}.{name}: {value}: expected a finite number"
            )
    if not any((q.x, q.y, q.z, q.w)):
        return Pose(x, y, math.nan)
    ahead = q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z
    return Pose(x, y, math.atan2(2.0 * (q.w * q.z + q.x * q.y), ahead))


def from_the_ego(
    ego: tuple[np.ndarray, ...],
    t: np.ndarray,
    place: tuple[np.ndarray, ...],
    max_gap_s: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Places that are given in the ego's frame, on the map.

    Args:
      ego: t, x, y, heading [m] of the ego on the map, t increasing, m > 0.
      t: [n] s.
      place: x, y, heading [n] in the ego's frame.
      max_gap_s: s between two poses of the ego, between which they are interpolated.

    Returns:
      x, y, heading [n] on the map, and whether there is a pose of the ego [n].
    """
    clock, x, y, heading = ego
    east, north = np.interp(t, clock, x), np.interp(t, clock, y)
    turn = np.interp(t, clock, np.unwrap(heading))
    after = np.clip(np.searchsorted(clock, t), 0, clock.size - 1)
    before = np.maximum(after - 1, 0)
    near = np.minimum(np.abs(clock[after] - t), np.abs(t - clock[before]))
    cos, sin = np.cos(turn), np.sin(turn)
    return (
        east + cos * place[0] - sin * place[1],
        north + sin * place[0] + cos * place[1],
        place[2] + turn,
        near <= max_gap_s,
    )
