"""Argoverse 2 vector map (log_map_archive_<id>.json) -> Lanes.

Every lane segment has a left and a right boundary in driving direction; the
centre line lies midway between them, as in the data set's own devkit. Maps of
the motion data set also hold a `centerline`, those of the sensor data set do
not; it is not read. There are no speed limits, signals or stop lines.
"""

import dataclasses
from pathlib import Path

import numpy as np

from rcirl_jax.data.importers.options import lane_types
from rcirl_jax.data.importers.shapes import between_bounds, check_coordinates
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import parse_json
from rcirl_jax.types import Lane

MAX_FILE_BYTES = 64 * 1024**2  # bytes of a map; published ones have 0.1 to 1 MB
LANE_TYPES = ("VEHICLE", "BUS", "BIKE")
DRIVEN = ("VEHICLE", "BUS")  # read unless the source TOML says otherwise


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
    segments = _segments(path)
    lanes: dict[str, Lane] = {}
    others, empty = 0, 0
    for key, segment in segments.items():
        where = f"lane segment {key[:40]}"
        if _lane_type(path, where, segment) not in wanted:
            others += 1
            continue
        lane = _lane(path, where, segment, origin)
        if lane.id in lanes:
            raise InputError(
                f"{path}: {where}: id: {lane.id}: met twice: expected once"
            )
        if len(lane.centre) < 2:
            empty += 1
        else:
            lanes[lane.id] = lane
    if not lanes:
        raise InputError(
            f"{path}: lane_segments: {len(segments)}, none of type "
            f"{', '.join(wanted)}: expected at least one"
        )
    notes = []
    if others:
        notes.append(f"{others} lanes not of type {', '.join(wanted)} left out")
    if empty:
        notes.append(f"{empty} lanes without length left out")
    return tuple(_same_way(lane, lanes) for lane in lanes.values()), notes


def _segments(path: Path) -> dict:
    if path.stat().st_size > MAX_FILE_BYTES:
        raise InputError(
            f"{path}: size: {path.stat().st_size} bytes: "
            f"expected at most {MAX_FILE_BYTES}"
        )
    try:
        content = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: json: {error}: expected JSON") from error
    segments = content.get("lane_segments") if isinstance(content, dict) else None
    if not isinstance(segments, dict):
        found = type(segments).__name__
        raise InputError(f"{path}: lane_segments: {found}: expected an object")
    return segments


def _lane_type(path: Path, where: str, segment: object) -> str:
    if not isinstance(segment, dict):
        found = type(segment).__name__
        raise InputError(f"{path}: {where}: {found}: expected an object")
    if segment.get("lane_type") not in LANE_TYPES:
        raise InputError(
            f"{path}: {where}: lane_type: {str(segment.get('lane_type'))[:40]}: "
            f"expected one of {', '.join(LANE_TYPES)}"
        )
    return str(segment["lane_type"])


def _lane(path: Path, where: str, segment: dict, origin: np.ndarray) -> Lane:
    sides = {
        side: _points(path, where, f"{side}_lane_boundary", segment)
        for side in ("left", "right")
    }
    centre, half = between_bounds(sides["left"] - origin, sides["right"] - origin)
    successors = segment.get("successors")
    if not isinstance(successors, list):
        raise InputError(
            f"{path}: {where}: successors: {str(successors)[:40]}: expected a list"
        )
    return Lane(
        id=_id(path, where, "id", segment.get("id")),
        centre=centre,
        left_width=half,
        right_width=half,
        speed_limit=None,
        successors=tuple(_id(path, where, "successors", s) for s in successors),
        left=_neighbour(path, where, "left_neighbor_id", segment),
        right=_neighbour(path, where, "right_neighbor_id", segment),
    )


def _id(path: Path, where: str, field: str, value: object) -> str:
    if isinstance(value, bool) or not isinstance(value, int):
        raise InputError(
            f"{path}: {where}: {field}: {str(value)[:40]}: expected a whole number"
        )
    return str(value)


def _neighbour(path: Path, where: str, field: str, segment: dict) -> str | None:
    value = segment.get(field)
    return None if value is None else _id(path, where, field, value)


def _points(path: Path, where: str, field: str, segment: dict) -> np.ndarray:
    """Points [n, 2] m of a boundary; heights are not read."""
    points = segment.get(field)
    try:
        rows = [(point["x"], point["y"]) for point in points or ()]
        found = np.array(rows)
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path}: {where}: {field}: {error}: expected points with x and y"
        ) from error
    if found.shape[1:] != (2,) or len(found) < 2 or found.dtype.kind not in "if":
        raise InputError(
            f"{path}: {where}: {field}: {str(points)[:60]}: "
            "expected two or more points with numbers x and y"
        )
    found = found.astype(np.float64)
    check_coordinates(path, f"{where}: {field}", ("x", "y"), found)
    return found


def _same_way(lane: Lane, lanes: dict[str, Lane]) -> Lane:
    """The lane without neighbours that are driven the other way."""
    chord = lane.centre[-1] - lane.centre[0]

    def kept(name: str | None) -> str | None:
        other = lanes.get(name or "")
        if other is None or chord @ (other.centre[-1] - other.centre[0]) <= 0.0:
            return None
        return name

    return dataclasses.replace(lane, left=kept(lane.left), right=kept(lane.right))
