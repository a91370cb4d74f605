"""Obstacles of Apollo's perception and prediction messages as rows of numbers."""

import array
import operator
from collections.abc import Iterable, Mapping

import numpy as np

from rcirl_jax.data.importers.perception import UNKNOWN
from rcirl_jax.data.readers.protobuf import Message
from rcirl_jax.types import Kind

KIND_NAMES = {
    "PEDESTRIAN": Kind.PEDESTRIAN,
    "BICYCLE": Kind.CYCLIST,
    "VEHICLE": Kind.VEHICLE,
    "UNKNOWN_UNMOVABLE": Kind.STATIC,
}
# m, [length, width] where perception measured none; others: 1 m
SIZES_M = {
    Kind.VEHICLE: (4.5, 1.8),
    Kind.CYCLIST: (1.8, 0.6),
    Kind.PEDESTRIAN: (0.5, 0.5),
}
OTHER_SIZE_M = (1.0, 1.0)  # m
FIELDS = (
    *("timestamp", "id", "position.x", "position.y", "theta"),
    *("velocity.x", "velocity.y", "length", "width", "type"),
)
COLUMNS = 11  # of a row, see `Obstacles.rows`

_read = operator.attrgetter(*FIELDS)


class Obstacles:
    """Obstacles of one channel as rows of numbers."""

    def __init__(self, types: Mapping[int, str]) -> None:
        """Holds none; `types` are names of the obstacles' types."""
        self._types = types
        self._values = array.array("d")  # of times and fields, one row after the other

    @property
    def count(self) -> int:
        """Obstacles since the last `rows`."""
        return len(self._values) // (2 + len(FIELDS))

    def add(self, stamp: float, time: float, obstacles: Iterable[Message]) -> None:
        """Obstacles of a message, the times [s] of its header and recording."""
        for obstacle in obstacles:
            self._values.extend((stamp, time, *_read(obstacle)))

    def rows(self) -> np.ndarray:
        """Obstacles since the last call, [n, 11].

        Times [s] of header, recording and measurement; id; x, y [m]; heading
        [rad]; speed [m/s]; length, width [m]; kind. NaN where a position or
        velocity was not recorded.
        """
        table = np.array(self._values).reshape(-1, 2 + len(FIELDS))
        self._values = array.array("d")
        head, (vx, vy, length, width, number) = table[:, :7], table[:, 7:].T
        numbers, inverse = np.unique(number, return_inverse=True)
        names = [self._types.get(int(found), "") for found in numbers]
        kinds = [KIND_NAMES.get(name, UNKNOWN) for name in names]
        sizes = [SIZES_M.get(Kind(max(kind, 0)), OTHER_SIZE_M) for kind in kinds]
        usual = np.array(sizes, np.float64).reshape(-1, 2)[inverse].T
        series = (
            np.hypot(vx, vy),
            np.where(length == 0.0, usual[0], length),
            np.where(width == 0.0, usual[1], width),
            np.array(kinds, np.float64)[inverse],
        )
        return np.concatenate([head, np.stack(series, axis=1)], axis=1)
