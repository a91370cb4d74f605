"""Lanes of a generic CSV log: given ones, the lane column's, or the cars' paths."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.lanes import StraightLane, straight_lanes
from rcirl_jax.data.formats.options import number, path_option, stated
from rcirl_jax.data.formats.paths import path_lanes
from rcirl_jax.data.readers.tables.rows import RowStats
from rcirl_jax.data.readers.tables.table import fields_of, open_table, read
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane, Track

MARGIN_M = 50.0  # m of fitted lane beyond the first and last position
LANE_COLUMNS = {"id": "text", "x": "number", "y": "number"}
LANE_OPTIONAL = {
    **{"width": "number", "speed_limit": "number"},
    **{"left": "text", "right": "text", "successor": "text"},
}
LIMIT_MPS = 29.06  # m/s, 65 mph
LANE_WIDTH_M = 3.5  # m


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogTable:
    """One recording's rows in SI units, in local coordinates."""

    path: Path
    values: dict[str, np.ndarray]
    rate_hz: float
    origin: np.ndarray  # [2] m, subtracted from x, y
    notes: tuple[str, ...]
    # positions in the file's coordinates [n, 2] -> metres, before the origin is taken
    metres: Callable[[np.ndarray], np.ndarray] = np.asarray


def lane_file_of(spec: dict) -> str:
    """Name of the lanes' own CSV, "" without one."""
    lanes = spec.get("lanes", [])
    return path_option(lanes, "file") if isinstance(lanes, dict) else ""


def lanes_of(
    table: LogTable, spec: dict, tracks: tuple[Track, ...]
) -> tuple[tuple[Lane, ...], list[str]]:
    """The lanes given; else straight ones from the lane column; else paths."""
    given = spec.get("lanes", [])
    if isinstance(given, dict):
        given = _lanes_from_file(table.path, lane_file_of(spec))
    limit = stated(spec, "speed_limit")
    width = number(spec, "lane_width_m", LANE_WIDTH_M)
    if not all(isinstance(lane, dict) for lane in given):
        raise InputError(f"source TOML: lanes: {given}: expected tables [[lanes]]")
    if given:
        return tuple(_given_lane(table, lane, width) for lane in given), []
    if "lane" in table.values:
        found = _straight(table, tracks, width)
        if found is not None:
            lanes = straight_lanes(table.path, found, width, limit)
            return lanes, ["straight lanes fitted to the lane column"]
    lanes = path_lanes(tracks, width, limit)
    return lanes, [f"no lanes given; {len(lanes)} fitted to the longest paths"]


def _lanes_from_file(path: Path, name: str) -> list[dict]:
    """Polylines from a CSV beside the log: id, x, y and perhaps width, ..."""
    places = [folder / name for folder in (path.parent, path.parent.parent)]
    table_path = next((place for place in places if place.is_file()), None)
    if not name or table_path is None:
        raise InputError(
            f"{path}: lanes.file: {name}: expected this CSV beside the log"
        )
    opened = open_table(table_path)
    fields = fields_of(opened, LANE_COLUMNS, LANE_OPTIONAL)
    table = read(opened, fields, RowStats(path=table_path, allowed=0.0))
    lanes = []
    for lane in dict.fromkeys(table["id"].tolist()):
        rows = np.flatnonzero(table["id"] == lane)
        found = {key: table[key][rows] for key in table if key not in LANE_COLUMNS}
        lanes.append(
            {
                "id": lane,
                "points": np.stack([table["x"][rows], table["y"][rows]], axis=1),
                "successors": sorted(set(found.pop("successor", [])) - {""}),
                **{
                    k: v[0]
                    for k, v in found.items()
                    if k != "width" and _is_known(v[0])
                },
                **({"width": found["width"]} if "width" in found else {}),
            }
        )
    return lanes


def _is_known(value: str | float) -> bool:
    return value != "" and value == value


def _given_lane(table: LogTable, lane: dict, default_width: float) -> Lane:
    name = str(lane.get("id", "(no id)"))
    where = f"{table.path}: lanes {name}"
    try:
        points = np.array(lane.get("points", []), np.float64)
        width = np.array(lane.get("width", np.nan), np.float64)
        is_guessed = bool(np.isnan(width).any())
        half = 0.5 * np.where(np.isnan(width), default_width, width)
        limit = lane.get("speed_limit")
        speed_limit = None if limit is None else float(limit)
    except (ValueError, TypeError) as error:
        raise InputError(f"{where}: {error}: expected numbers") from error
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
        raise InputError(
            f"{where}: points: {points.shape}: expected at least two [x, y]"
        )
    if half.shape not in ((), (len(points),)):
        raise InputError(f"{where}: width: {half.shape}: expected one, or one a point")
    left, right = lane.get("left"), lane.get("right")
    return Lane(
        id=name,
        centre=table.metres(points) - table.origin,
        left_width=np.broadcast_to(half, (len(points),)).copy(),
        right_width=np.broadcast_to(half, (len(points),)).copy(),
        speed_limit=speed_limit,
        successors=tuple(str(s) for s in lane.get("successors", [])),
        left=None if left is None else str(left),
        right=None if right is None else str(right),
        width_assumed=is_guessed,
    )


def _straight(
    table: LogTable, tracks: tuple[Track, ...], width: float
) -> list[StraightLane] | None:
    """Lanes parallel to the x axis, or None where the rows of one are not."""
    x, y, names = (table.values[field] for field in ("x", "y", "lane"))
    towards = {}
    for track in tracks:
        towards[track.id.split("#")[0]] = float(track.x[-1] - track.x[0])
    travel = np.array([towards.get(str(i), 0.0) for i in table.values["id"]])
    found = []
    for name in np.unique(names[names != ""]):
        rows = names == name
        centre = float(np.median(y[rows]))
        if np.median(np.abs(y[rows] - centre)) > 0.5 * width:
            return None
        found.append(
            StraightLane(
                id=str(name),
                y=centre,
                lower=float(x[rows].min()) - MARGIN_M,
                upper=float(x[rows].max()) + MARGIN_M,
                forward=bool(np.median(travel[rows]) >= 0.0),
            )
        )
    return found or None
