"""Obstacles of Apollo's perception and prediction messages, many at a time.

A minute of traffic holds 1e5 obstacle states. Messages are collected, and their
obstacles decoded together with numpy; the field numbers come from the record's
own descriptors.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rcirl_jax.data.importers.perception import UNKNOWN
from rcirl_jax.data.readers.wire import ENUM, FIXED, Plan, WireError
from rcirl_jax.data.readers.wire_columns import MAX_SMALL, Record
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
SCALARS = ("timestamp", "id", "theta", "length", "width", "type")
BATCH_BYTES = 4 * 1024**2  # bytes of messages decoded together
COLUMNS = 11  # of a row, see `Obstacles.rows`
KIND_OF = {1: "double", 2: "float"}  # descriptor's type -> what `columns` reads


class Obstacles:
    """Messages of one channel as rows of numbers."""

    def __init__(self, where: str, plan: Plan) -> None:
        """Finds the fields.

        Args:
          where: file and channel, named in errors.
          plan: of PerceptionObstacles or PredictionObstacles.

        Raises:
          WireError: the type lacks a field that is needed, or has another one.
        """
        self.where = where
        self._header, below = _entry(plan, "header")
        self._stamp = _entry(below, "timestamp_sec")[0]
        self._inner: int | None = None
        if any(entry[0] == "prediction_obstacle" for entry in plan.values()):
            self._list, below = _entry(plan, "prediction_obstacle")
            self._inner, below = _entry(below, "perception_obstacle")
        else:
            self._list, below = _entry(plan, "perception_obstacle")
        # name -> number and its entry in the plan
        self._fields = {entry[0]: (number, entry) for number, entry in below.items()}
        for name in ("id", "position", "velocity"):
            _entry(below, name)
        self.count = 0  # obstacles decoded since the last `rows`
        self._waiting: list[tuple[float, bytes]] = []
        self._size = 0
        self._done: list[np.ndarray] = []

    def add(self, time: float, content: memoryview) -> None:
        """A message and the time [s] of its recording."""
        self._waiting.append((time, bytes(content)))
        self._size += len(content)
        if self._size > BATCH_BYTES:
            self._decode()

    def rows(self) -> np.ndarray:
        """Obstacles since the last call, [n, 11].

        Times [s] of header, recording and measurement; id; x, y [m]; heading
        [rad]; speed [m/s]; length, width [m]; kind. NaN where a position or
        velocity was not recorded.
        """
        self._decode()
        done, self._done, self.count = self._done, [], 0
        return np.concatenate([np.zeros((0, COLUMNS)), *done])

    def _decode(self) -> None:
        waiting, self._waiting, self._size = self._waiting, [], 0
        if not waiting:
            return
        record = Record(self.where, b"".join(content for _, content in waiting))
        ends = np.cumsum([len(content) for _, content in waiting]).tolist()
        spans, stamps = [], []
        for start, end in zip([0, *ends[:-1]], ends, strict=True):
            stamp, found = self._spans(record, (start, end))
            stamps.append(stamp)
            spans.append(found)
        counts = [len(found) for found in spans]
        times = np.array([time for time, _ in waiting])
        head = np.stack([np.array(stamps), times], axis=1)
        body = self._obstacles(record, np.concatenate(spans))
        rows = np.concatenate([np.repeat(head, counts, axis=0), body], axis=1)
        self._done.append(rows)
        self.count += len(rows)

    def _spans(self, record: Record, span: Sequence[int]) -> tuple[float, np.ndarray]:
        """Stamp [s] of a message and the byte spans of its obstacles [n, 2]."""
        top = record.walk(span, (self._header, self._list))
        header = top.spans(self._header).tolist()
        stamp = 0.0
        if header:
            stamp = record.walk(header[-1], (self._stamp,)).double(self._stamp)
        found = top.spans(self._list)
        if self._inner is not None:
            inner = [
                record.walk(outer, (self._inner,)).spans(self._inner)[-1:]
                for outer in found.tolist()
            ]
            found = np.concatenate([np.zeros((0, 2), np.int64), *inner])
        return stamp, found

    def _obstacles(self, record: Record, spans: np.ndarray) -> np.ndarray:
        """Columns 2 to 10 of the rows."""
        values = self._columns(record, spans, (*SCALARS, "position", "velocity"))
        x, y = self._point(record, "position", values["position"])
        vx, vy = self._point(record, "velocity", values["velocity"])
        numbers, inverse = np.unique(values["type"], return_inverse=True)
        names = self._fields["type"][1][3] if "type" in self._fields else {}
        kinds = [KIND_NAMES.get(names.get(int(n), ""), UNKNOWN) for n in numbers]
        sizes = [SIZES_M.get(Kind(max(kind, 0)), OTHER_SIZE_M) for kind in kinds]
        default = np.array(sizes, np.float64).reshape(-1, 2)[inverse].T
        length, width = (
            np.where(values[name] == 0.0, usual, values[name])
            for name, usual in zip(("length", "width"), default, strict=True)
        )
        series = (
            *(values["timestamp"], values["id"], x, y, values["theta"]),
            *(np.hypot(vx, vy), length, width, np.array(kinds, np.int64)[inverse]),
        )
        return np.stack([np.asarray(one, np.float64) for one in series], axis=1)

    def _point(
        self, record: Record, name: str, spans: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """X and y [n]; NaN where the point is not set."""
        below: Plan = self._fields[name][1][3]
        numbers = {axis: _entry(below, axis)[0] for axis in "xy"}
        kinds = {number: _kind(axis, below[number]) for axis, number in numbers.items()}
        found = record.columns(spans, kinds)
        is_set = spans[:, 0] < spans[:, 1]
        x, y = (np.where(is_set, found[numbers[axis]], np.nan) for axis in "xy")
        return x, y

    def _columns(
        self, record: Record, spans: np.ndarray, names: Sequence[str]
    ) -> dict[str, np.ndarray]:
        """Singular fields of all obstacles; 0 (or no span) where not set.

        Few obstacles are large (long contours); those are read one by one.
        """
        known = [name for name in names if name in self._fields]
        kinds = {
            number: _kind(name, entry)
            for name, (number, entry) in self._fields.items()
            if name in known
        }
        large = np.flatnonzero(spans[:, 1] - spans[:, 0] > MAX_SMALL)
        small = spans.copy()
        small[large] = 0
        found = record.columns(small, kinds)
        for row in large.tolist():
            entry = record.walk(spans[row].tolist(), kinds)
            for number, kind in kinds.items():
                found[number][row] = _single(entry, number, kind)
        none = np.zeros(len(spans))
        return {
            name: found[self._fields[name][0]] if name in known else none
            for name in names
        }


def _entry(plan: Plan, name: str) -> tuple[int, Any]:
    """Number of a field and the plan of the message in it."""
    for number, entry in plan.items():
        if entry[0] == name:
            return number, entry[3]
    raise WireError(f"field {name}: not among the descriptors")


def _kind(name: str, entry: tuple[str, int, bool, Any]) -> str:
    """What `columns` reads a field as."""
    kind = entry[1]
    if isinstance(entry[3], dict) and kind != ENUM:
        return "message"
    if kind in FIXED and kind not in KIND_OF:
        raise WireError(f"field {name}: type {kind}: expected a number")
    return KIND_OF.get(kind, "int")


def _single(entry: Any, number: int, kind: str) -> Any:  # noqa: ANN401 - as `columns`
    """The last value of a field that was walked; 0 where it is not set."""
    if kind == "message":
        spans = entry.spans(number)
        return spans[-1] if len(spans) else np.zeros(2, np.int64)
    if kind == "float":
        raise WireError(f"field {number}: float in a message of {MAX_SMALL} bytes")
    return entry.double(number) if kind == "double" else entry.whole(number)
