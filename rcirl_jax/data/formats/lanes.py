"""Lanes of logs without a map: the source TOML's, straight ones, or paths driven.

Straight lanes are parallel to the x axis, one for each lane number. Else the longest
paths become lanes; whoever drives within a lane's width of one, the same way, is on it.
Long drives are cut into pieces that follow each other, and a piece that meets the start
of another ends there: a lap closes.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.options import number, path_option
from rcirl_jax.data.readers.tables.rows import RowStats
from rcirl_jax.data.readers.tables.table import fields_of, open_table, read
from rcirl_jax.data.recording import check_lanes_length, check_span
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, Track

LANE_WIDTH_M = 3.5  # m, where nobody says it
LANE_STEP_M = 5.0  # m between points of a fitted lane
NEIGHBOUR_WIDTHS = 1.6  # lane widths between centres up to which lanes adjoin
PIECE_M = 400.0  # m, longest lane along a path
EXTRA_M = 20.0  # m of lane beyond both ends of a path
MAX_PATHS = 200  # longest tracks tried as lanes
MOVING_MPS = 0.5  # m/s; below it positions only jitter
MIN_POINTS = 3  # points of the shortest lane
MIN_ALIGNED = 0.7  # cosine of the largest angle between a path and its lane
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
    path: Path,
    spec: Mapping,
    metres: Callable[[np.ndarray], np.ndarray] = np.asarray,
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


def path_lanes(
    tracks: Sequence[Track], width: float, limit: float | None
) -> tuple[Lane, ...]:
    """Returns lanes along the paths of the longest vehicle tracks.

    Args:
      tracks: road users; others than vehicles make no lanes.
      width: m, of every lane; nobody has measured it.
      limit: m/s, or None.
    """
    vehicles = [track for track in tracks if track.kind == Kind.VEHICLE]
    vehicles.sort(key=lambda track: -np.hypot(np.ptp(track.x), np.ptp(track.y)))
    fitted = _Fitted(width)
    for track in vehicles[:MAX_PATHS]:
        points = _thin(track)
        if len(points) >= MIN_POINTS:
            fitted.add(points)
    lanes = []
    for place, line in enumerate(fitted.lines):
        half = np.full(len(line), 0.5 * width)
        after = [fitted.after[place]] if place in fitted.after else []
        lane = Lane(
            id=f"path-{place}",
            centre=line,
            left_width=half,
            right_width=half,
            speed_limit=limit,
            width_assumed=True,
            successors=tuple(f"path-{other}" for other in after),
        )
        lanes.append(lane)
    return tuple(lanes)


def _thin(track: Track) -> np.ndarray:
    """[n, 2] m, a point per step of the path; standing still adds none.

    Both ends are continued straight, so that nobody ends at a lane's very end.
    """
    points = np.stack([track.x, track.y], axis=1)
    steps = np.hypot(*np.diff(points, axis=0).T) * (track.speed[1:] > MOVING_MPS)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    kept = points[np.unique(arc // LANE_STEP_M, return_index=True)[1]]
    if len(kept) < MIN_POINTS:
        return kept
    ends = []
    for near, far, end in (
        (kept[0], kept[2], points[0]),
        (kept[-1], kept[-3], points[-1]),
    ):
        out = (near - far) / max(float(np.hypot(*(near - far))), 1e-9)
        ends.append(end + EXTRA_M * out)
    return np.concatenate([ends[:1], kept, ends[1:]])


def _ways(points: np.ndarray) -> np.ndarray:
    """Unit vectors [n, 2] along a path."""
    step = np.gradient(points, axis=0)
    return step / np.maximum(np.hypot(*step.T), 1e-9)[:, None]


class _Fitted:
    """Centre lines so far, in order; their points with directions; which follows."""

    def __init__(self, width: float) -> None:
        self.width = width
        self.lines: list[np.ndarray] = []
        self.after: dict[int, int] = {}  # number of a line -> of the next one
        self.points, self.ways = np.zeros((0, 2)), np.zeros((0, 2))

    def add(self, points: np.ndarray) -> None:
        """Appends the uncovered stretches of a path as successive lanes."""
        ways, size = _ways(points), int(PIECE_M / LANE_STEP_M)
        first, before = 0, -1  # first point of the piece; lane it continues
        while first + MIN_POINTS <= len(points):
            last = min(first + size, len(points))
            if len(points) - last < MIN_POINTS:
                last = len(points)
            # [n, m] whether point n is near lane point m, and heads the same way
            piece = points[first:last]
            low, high = piece.min(axis=0) - self.width, piece.max(axis=0) + self.width
            near = np.all((self.points >= low) & (self.points <= high), axis=1)
            gap = piece[:, None] - self.points[None, near]
            known = np.zeros((len(piece), len(near)), bool)
            known[:, near] = ways[first:last] @ self.ways[near].T > MIN_ALIGNED
            known[:, near] &= np.hypot(gap[..., 0], gap[..., 1]) < self.width
            if known.any(axis=1).mean() > 0.5:
                first, before = last - 1, -1
                continue
            starts = np.cumsum([0, *map(len, self.lines)])[:-1]
            met = known[:, starts]
            met[:MIN_POINTS] = False
            rows, meets = np.flatnonzero(met.any(axis=1)), -1
            if rows.size:
                last = first + int(rows[0])
                meets = int(np.flatnonzero(met[rows[0]])[0])
            line = points[first:last]
            number = len(self.lines)
            if before >= 0:
                self.after[before] = number
            if meets >= 0:
                line = np.concatenate([line, self.lines[meets][:1]])
                self.after[number] = meets
            self.lines.append(line)
            self.points = np.concatenate([self.points, line])
            self.ways = np.concatenate([self.ways, _ways(line)])
            first, before = last - 1, -1 if meets >= 0 else number
            if last == len(points):
                break
