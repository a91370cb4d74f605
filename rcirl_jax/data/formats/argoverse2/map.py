"""Argoverse 2 vector map (log_map_archive_<id>.json) -> Lanes.

Every lane segment has a left and a right boundary in driving direction; the
centre line lies midway between them, as in the data set's own devkit. Maps of
the motion data set also hold a `centerline`, those of the sensor data set do
not; it is not read. There are no speed limits, signals or stop lines.
"""

import collections
import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from rcirl_jax.data.formats.options import lane_types
from rcirl_jax.data.formats.shapes import between_bounds, check_coordinates
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import read_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.types import Lane

MAX_FILE_BYTES = 64 * 1024**2  # bytes of a map; published ones have 0.1 to 1 MB
LANE_TYPES = ("VEHICLE", "BUS", "BIKE")
DRIVEN = ("VEHICLE", "BUS")  # read unless the source TOML says otherwise


class _Point(msgspec.Struct):
    x: float
    y: float


_Bound = Annotated[list[_Point], msgspec.Meta(min_length=2)]


class _Segment(msgspec.Struct):
    """What is read of a lane segment."""

    id: int
    lane_type: Literal["VEHICLE", "BUS", "BIKE"]
    left_lane_boundary: _Bound
    right_lane_boundary: _Bound
    successors: list[int]
    left_neighbor_id: int | None = None
    right_neighbor_id: int | None = None


class _Map(msgspec.Struct):
    lane_segments: dict[str, dict]


def read_lanes(
    path: Path, origin: np.ndarray, spec: dict
) -> tuple[tuple[Lane, ...], list[str]]:
    """Lanes of the wanted types, and notes on what was left out.

    Args:
      path: the map.
      origin: [2] m, subtracted from all points.
      spec: source TOML; `lane_types` names the types that are read.
    """
    wanted = lane_types(spec, LANE_TYPES, DRIVEN)
    content = read_json(path, "JSON", MAX_FILE_BYTES)
    segments = [
        checked(segment, _Segment, f"{path}: lane segment {key[:40]}")
        for key, segment in checked(content, _Map, path).lane_segments.items()
    ]
    kept = [segment for segment in segments if segment.lane_type in wanted]
    if not kept:
        raise InputError(
            f"{path}: lane_segments: {len(segments)}, none of type "
            f"{', '.join(wanted)}: expected at least one"
        )
    found = [_lane(path, segment, origin) for segment in kept]
    lanes = {lane.id: lane for lane in found}
    if len(lanes) < len(found):
        ((twice, _),) = collections.Counter(one.id for one in found).most_common(1)
        raise InputError(f"{path}: lane segment {twice}: id: met twice: expected once")
    whole = {name: lane for name, lane in lanes.items() if len(lane.centre) > 1}
    notes = []
    if others := len(segments) - len(kept):
        notes.append(f"{others} lanes not of type {', '.join(wanted)} left out")
    if empty := len(lanes) - len(whole):
        notes.append(f"{empty} lanes without length left out")
    return tuple(_same_way(lane, whole) for lane in whole.values()), notes


def _lane(path: Path, segment: _Segment, origin: np.ndarray) -> Lane:
    bounds = []
    for side in ("left_lane_boundary", "right_lane_boundary"):
        points = np.array([(point.x, point.y) for point in getattr(segment, side)])
        where = f"lane segment {segment.id}: {side}"
        check_coordinates(path, where, ("x", "y"), points)
        bounds.append(points - origin)
    centre, half = between_bounds(*bounds)
    left, right = segment.left_neighbor_id, segment.right_neighbor_id
    return Lane(
        id=str(segment.id),
        centre=centre,
        left_width=half,
        right_width=half,
        speed_limit=None,
        successors=tuple(map(str, segment.successors)),
        left=None if left is None else str(left),
        right=None if right is None else str(right),
    )


def _same_way(lane: Lane, lanes: dict[str, Lane]) -> Lane:
    """The lane without neighbours that are driven the other way."""
    chord = lane.centre[-1] - lane.centre[0]

    def kept(name: str | None) -> str | None:
        other = lanes.get(name or "")
        if other is None or chord @ (other.centre[-1] - other.centre[0]) <= 0.0:
            return None
        return name

    return dataclasses.replace(lane, left=kept(lane.left), right=kept(lane.right))
