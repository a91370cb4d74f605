"""Lanes fitted to the paths that were driven, for logs without a map.

The longest paths become lanes; whoever drives within a lane's width of one, the
same way, is on it. Long drives are cut into pieces that follow each other, and
a piece that meets the start of another ends there: a lap closes.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rcirl_jax.types import Kind, Lane, Track

PATH_STEP_M = 5.0  # m between points of a lane
PIECE_M = 400.0  # m, longest lane
EXTRA_M = 20.0  # m of lane beyond both ends of a path
MAX_PATHS = 200  # longest tracks tried as lanes
MOVING_MPS = 0.5  # m/s; below it positions only jitter
MIN_POINTS = 3  # points of the shortest lane
MIN_ALIGNED = 0.7  # cosine of the largest angle between a path and its lane


@dataclasses.dataclass
class _Fitted:
    """Lanes so far: their points with directions, and where each starts."""

    lanes: list[Lane] = dataclasses.field(default_factory=list)
    points: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 2)))
    ways: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 2)))

    def near(self, points: np.ndarray, ways: np.ndarray, reach: float) -> np.ndarray:
        """[n, m] whether point n lies within reach of lane point m, the same way."""
        gap = points[:, None] - self.points[None]
        aligned = ways @ self.ways.T > MIN_ALIGNED
        return (np.hypot(gap[..., 0], gap[..., 1]) < reach) & aligned


def path_lanes(
    tracks: Sequence[Track], width: float, limit: float | None
) -> tuple[Lane, ...]:
    """Lanes along the paths of the longest vehicle tracks.

    Args:
      tracks: road users; others than vehicles make no lanes.
      width: m, of every lane; nobody has measured it.
      limit: m/s, or None.
    """
    vehicles = [track for track in tracks if track.kind == Kind.VEHICLE]
    length = {id(t): np.hypot(np.ptp(t.x), np.ptp(t.y)) for t in vehicles}
    fitted = _Fitted()
    for track in sorted(vehicles, key=lambda t: -length[id(t)])[:MAX_PATHS]:
        points = _thin(track)
        if len(points) >= MIN_POINTS:
            _fit(points, fitted, width, limit)
    return tuple(fitted.lanes)


def _thin(track: Track) -> np.ndarray:
    """[n, 2] m, a point per step of the path; standing still adds none.

    Both ends are continued straight, so that nobody ends at a lane's very end.
    """
    points = np.stack([track.x, track.y], axis=1)
    steps = np.hypot(*np.diff(points, axis=0).T) * (track.speed[1:] > MOVING_MPS)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    kept = points[np.unique(arc // PATH_STEP_M, return_index=True)[1]]
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


def _fit(
    points: np.ndarray, fitted: _Fitted, width: float, limit: float | None
) -> None:
    """Add what of a path is on no lane yet, in pieces that follow each other."""
    step = np.gradient(points, axis=0)
    ways = step / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
    size = int(PIECE_M / PATH_STEP_M)
    first, before = 0, -1  # first point of the piece; lane it continues
    while first + MIN_POINTS <= len(points):
        last = min(first + size, len(points))
        if len(points) - last < MIN_POINTS:
            last = len(points)
        piece = slice(first, last)
        known = fitted.near(points[piece], ways[piece], width)
        if known.any(axis=1).mean() > 0.5:
            first, before = last - 1, -1
            continue
        cut, meets = _meeting(known, fitted)
        if meets >= 0:
            last = first + cut
        line = points[first:last]
        if meets >= 0:
            line = np.concatenate([line, fitted.lanes[meets].centre[:1]])
        number = len(fitted.lanes)
        _append(line, fitted, width, limit, before, meets)
        first, before = last - 1, -1 if meets >= 0 else number
        if last == len(points):
            break


def _meeting(known: np.ndarray, fitted: _Fitted) -> tuple[int, int]:
    """(points before it, lane) where a piece meets a lane's start, or (0, -1)."""
    counts = [len(lane.centre) for lane in fitted.lanes]
    starts = np.cumsum([0, *counts[:-1]]) if counts else np.zeros(0, int)
    found = known[:, starts]
    found[:MIN_POINTS] = False
    rows = np.flatnonzero(found.any(axis=1))
    if rows.size == 0:
        return 0, -1
    return int(rows[0]), int(np.flatnonzero(found[rows[0]])[0])


def _append(
    line: np.ndarray,
    fitted: _Fitted,
    width: float,
    limit: float | None,
    before: int,
    after: int,
) -> None:
    """Add a lane; link it to the one before and to the one it leads into."""
    number = len(fitted.lanes)
    half = np.full(len(line), 0.5 * width)
    step = np.gradient(line, axis=0)
    fitted.points = np.concatenate([fitted.points, line])
    fitted.ways = np.concatenate(
        [fitted.ways, step / np.maximum(np.hypot(*step.T), 1e-9)[:, None]]
    )
    fitted.lanes.append(
        Lane(
            id=f"path-{number}",
            centre=line,
            left_width=half,
            right_width=half,
            speed_limit=limit,
            width_assumed=True,
            successors=() if after < 0 else (f"path-{after}",),
        )
    )
    if before >= 0:
        fitted.lanes[before] = dataclasses.replace(
            fitted.lanes[before], successors=(f"path-{number}",)
        )
