"""Lanes of logs without a map: the source TOML's, or straight ones along x."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.options import number, path_option
from rcirl_jax.data.readers.tables.rows import RowStats
from rcirl_jax.data.readers.tables.table import fields_of, open_table, read
from rcirl_jax.data.recording import check_lanes_length, check_span
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane

LANE_WIDTH_M = 3.5  # m, where nobody says it
LANE_STEP_M = 5.0  # m between points of a fitted lane
NEIGHBOUR_WIDTHS = 1.6  # lane widths between centres up to which lanes adjoin
SIDES = ("left", "right")
COLUMNS = {"id": "text", "x": "number", "y": "number"}  # of a table of lanes
OPTIONAL = {
    **{"width": "number", "speed_limit": "number"},
    **{"left": "text", "right": "text", "successor": "text"},
}


def lane_file_of(spec: Mapping) -> str:
    """Returns the name of the lanes' own CSV ([lanes] file); "" without one."""
    lanes = spec.get("lanes", [])
    return path_option(lanes, "file") if isinstance(lanes, dict) else ""


def lanes_of_toml(
    path: Path, spec: Mapping, metres: Callable[[np.ndarray], np.ndarray] = np.asarray
) -> tuple[Lane, ...]:
    """Returns the lanes that a source TOML gives: [[lanes]], or [lanes] with a file.

    Args:
      path: the log; a table of lanes lies beside it, or beside its folder.
      spec: source TOML.
      metres: positions [n, 2] of the log -> m, less the recording's origin.
    """
    given, width = spec.get("lanes", []), number(spec, "lane_width_m", LANE_WIDTH_M)
    if isinstance(given, dict):
        given = _lanes_of_file(path, lane_file_of(spec))
    if not all(isinstance(lane, dict) for lane in given):
        raise InputError(f"source TOML: lanes: {given}: expected tables [[lanes]]")
    return tuple(_given_lane(path, lane, width, metres) for lane in given)


def _lanes_of_file(path: Path, name: str) -> list[dict]:
    """Polylines from a CSV beside the log: id, x, y and perhaps width, ..."""
    places = [folder / name for folder in (path.parent, path.parent.parent)]
    file = next((place for place in places if place.is_file()), None)
    if not name or file is None:
        raise InputError(
            f"{path}: lanes.file: {name}: expected this CSV beside the log"
        )
    opened = open_table(file)
    fields = fields_of(opened, COLUMNS, OPTIONAL)
    table = read(opened, fields, RowStats(path=file, allowed=0.0))
    lanes = []
    for name in dict.fromkeys(table["id"].tolist()):
        rows = table["id"] == name
        found = {key: table[key][rows] for key in table if key in OPTIONAL}
        lane = {
            "id": name,
            "points": np.stack([table["x"][rows], table["y"][rows]], axis=1),
            "successors": sorted(set(found.pop("successor", [])) - {""}),
        }
        if "width" in found:
            lane["width"] = found.pop("width")
        firsts = {key: values[0] for key, values in found.items()}
        # NaN is not itself
        lanes.append(lane | {k: v for k, v in firsts.items() if v != "" and v == v})
    return lanes


def _given_lane(
    path: Path, lane: dict, usual: float, metres: Callable[[np.ndarray], np.ndarray]
) -> Lane:
    name, limit = str(lane.get("id", "(no id)")), lane.get("speed_limit")
    where = f"{path}: lanes {name}"
    try:
        points = np.array(lane.get("points", []), np.float64)
        width = np.array(lane.get("width", np.nan), np.float64)
        limit = None if limit is None else float(limit)
    except (ValueError, TypeError) as error:
        raise InputError(f"{where}: {error}: expected numbers") from error
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
        raise InputError(
            f"{where}: points: {points.shape}: expected at least two [x, y]"
        )
    if width.shape not in ((), (len(points),)):
        raise InputError(f"{where}: width: {width.shape}: expected one, or one a point")
    half = np.zeros(len(points)) + 0.5 * np.where(np.isnan(width), usual, width)
    left, right = (None if one is None else str(one) for one in map(lane.get, SIDES))
    return Lane(
        id=name,
        centre=metres(points),
        left_width=half,
        right_width=half.copy(),
        speed_limit=limit,
        successors=tuple(map(str, lane.get("successors", []))),
        left=left,
        right=right,
        width_assumed=bool(np.isnan(width).any()),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class StraightLane:
    """A lane parallel to the x axis, as observed."""

    id: str
    y: float  # m, of the centre line
    lower: float  # m, first x
    upper: float  # m, last x
    forward: bool = True  # driven towards +x


def straight_lanes(
    path: Path, found: Sequence[StraightLane], width: float, limit: float | None
) -> tuple[Lane, ...]:
    """Returns lanes parallel to the x axis, with bounds midway between neighbours.

    Lanes are neighbours if they are driven the same way and no more than
    `NEIGHBOUR_WIDTHS` lane widths apart; outer bounds lie half a width out, which is a
    guess. Lanes nearer than 0.4 widths are one lane under two names (on- and off-ramp).
    """
    for lane in found:
        ends = np.array([lane.lower, lane.upper])
        check_span(f"{path}: lane {lane.id}", "position along the road", ends)
    check_lanes_length(str(path), sum(lane.upper - lane.lower for lane in found))

    def beside(lane: StraightLane, side: float) -> StraightLane | None:
        """The nearest adjoining lane on the side of +y (side = 1) or -y (-1)."""
        apart = {
            side * (other.y - lane.y): other
            for other in reversed(found)
            if other.forward == lane.forward
        }
        near = [a for a in apart if 0.4 * width < a < NEIGHBOUR_WIDTHS * width]
        return apart[min(near)] if near else None

    lanes = []
    for lane in found:
        above, below = beside(lane, +1.0), beside(lane, -1.0)
        up = 0.5 * width if above is None else 0.5 * (above.y - lane.y)
        down = 0.5 * width if below is None else 0.5 * (lane.y - below.y)
        ids = [None if other is None else other.id for other in (above, below)]
        turn = slice(None, None, 1 if lane.forward else -1)  # left before right
        made = parallel_lane(lane, (up, down)[turn], ids[turn], limit)
        lanes.append(dataclasses.replace(made, width_assumed=None in ids))
    return tuple(lanes)


def parallel_lane(
    lane: StraightLane,
    sides: Sequence[float],
    beside: Sequence[str | None],
    limit: float | None,
) -> Lane:
    """Returns a lane parallel to the x axis, driven the way that it is.

    Args:
      lane: where it lies.
      sides: m, from the centre line to the left and right bound.
      beside: ids of the lanes to the left and to the right.
      limit: m/s, or None.
    """
    steps = int((lane.upper - lane.lower) / LANE_STEP_M)
    x = np.linspace(lane.lower, lane.upper, steps + 2)
    x = x if lane.forward else x[::-1]
    return Lane(
        id=lane.id,
        centre=np.stack([x, np.full(x.shape, lane.y)], axis=1),
        left_width=np.full(x.shape, sides[0]),
        right_width=np.full(x.shape, sides[1]),
        speed_limit=limit,
        left=beside[0],
        right=beside[1],
    )
