"""Local origins and polylines, shared by the importers of vector maps."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.errors import InputError, extra_module
from rcirl_jax.types import Lane

FAR_M = 1e4  # m; coordinates beyond it are moved to a local origin
ORIGIN_STEP_M = 1000.0  # m, local origins are multiples of it
MAX_COORDINATE_M = 1e8  # m, farther than any map projection on Earth reaches
MIN_HALF_WIDTH_M = 0.1  # m, lanes taper to a point at forks
MAX_LIMIT_MPS = 60.0  # m/s; faster "limits" are none
MARGIN_M = 150.0  # m of a map that are read around the tracks
CHUNK = 100_000  # points whose distances are found at once
FRACTION_DIGITS = 7  # fractions of a line that differ by less are one


def local_origin(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the origin [2] m to subtract: zero unless positions lie far from (0, 0).

    The package computes in float32 later, which resolves 1 mm at 10 km only.
    """
    middle = np.array([np.median(x), np.median(y)]) if x.size else np.zeros(2)
    if np.all(np.abs(middle) <= FAR_M):
        return np.zeros(2)
    return np.round(middle / ORIGIN_STEP_M) * ORIGIN_STEP_M


def origin_notes(origin: np.ndarray) -> list[str]:
    """Returns the note that says where a local origin lies; none for (0, 0)."""
    if not origin.any():
        return []
    return [f"local origin at x = {origin[0]:.0f} m, y = {origin[1]:.0f} m"]


def check_coordinates(
    path: Path | str, where: str, fields: Sequence[str], values: np.ndarray
) -> None:
    """Checks that every coordinate is finite and on Earth.

    Args:
      path: file, named in errors.
      where: what the coordinates belong to.
      fields: names of the columns of `values`.
      values: [n, len(fields)] m.
    """
    # NaN compares false
    bad = np.argwhere(~(np.abs(values) <= MAX_COORDINATE_M))
    if bad.size:
        row, column = bad[0]
        raise InputError(
            f"{path}: {where}: {fields[column]}: {values[row, column]:g} at point "
            f"{row}: expected a number within {MAX_COORDINATE_M:g} m"
        )


def arc_length(points: np.ndarray) -> np.ndarray:
    """Returns the length [n] m of a polyline [n, 2] up to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def fractions(points: np.ndarray) -> np.ndarray:
    """Returns the arc length at each point over the line's length, [n] from 0 to 1."""
    arc = arc_length(points)
    return arc / max(arc[-1], 1e-9)


def resample(points: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Returns points [len(at), 2] of a polyline at fractions of its length."""
    share = fractions(points)
    return np.stack([np.interp(at, share, points[:, i]) for i in (0, 1)], axis=1)


def centre_of_area(corners: np.ndarray) -> np.ndarray:
    """Returns the centre [2] m of a polygon's area; the corners' mean if it has none.

        c = sum (p_i + p_i+1) (p_i x p_i+1) / (3 sum p_i x p_i+1)

    Args:
      corners: [n, 2] m, in order, the first not repeated at the end or repeated.
    """
    middle = corners.mean(axis=0)
    here = corners - middle  # large coordinates would cancel
    after = np.roll(here, -1, axis=0)
    cross = here[:, 0] * after[:, 1] - here[:, 1] * after[:, 0]
    if abs(cross.sum()) < 1e-9:
        return middle
    return middle + ((here + after) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum())


def moves(points: np.ndarray) -> np.ndarray:
    """Returns a mask [n] of points that differ from the one before; the first does."""
    return np.concatenate([[True], np.any(np.diff(points, axis=0) != 0.0, axis=1)])


def facing(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns points [m, 2] of both bounds of a lane at equal shares of their lengths.

    Both run in driving direction. Points between which the middle stands still are one.
    """
    at = np.concatenate([fractions(left), fractions(right)])
    at = np.unique(np.round(at, FRACTION_DIGITS))
    left, right = resample(left, at), resample(right, at)
    keep = moves(left + right)
    return left[keep], right[keep]


def lane_between(
    name: str,
    bounds: tuple[np.ndarray, np.ndarray],
    **known: Any,  # noqa: ANN401
) -> Lane:
    """Makes a lane midway between two bounds whose points face each other.

    Args:
      name: its id.
      bounds: [m, 2] m, left and right, in driving direction.
      known: other fields of the lane.
    """
    left, right = bounds
    half = np.maximum(0.5 * np.hypot(*(left - right).T), MIN_HALF_WIDTH_M)
    centre = 0.5 * (left + right)
    return Lane(id=name, centre=centre, left_width=half, right_width=half, **known)


def limit_of(value: object) -> float | None:
    """Returns a map's speed limit [m/s]; None where it is no number, 0 or too fast."""
    if isinstance(value, int | float) and 0.0 < value <= MAX_LIMIT_MPS:
        return float(value)
    return None


def distances_to_lines(
    points: np.ndarray, lines: Sequence[np.ndarray], which: np.ndarray
) -> np.ndarray:
    """Returns distances [n] m of points [n, 2] from polylines, by shapely.

    Near zero, coordinates lose no digits; prepared lines are searched by a tree.

    Args:
      points: m.
      lines: [m >= 1, 2] m each.
      which: [n] number of each point's line.
    """
    shapely = extra_module("shapely")
    corner = lines[0][0]
    # its lines have two points or more
    long = [line if len(line) > 1 else np.tile(line, (2, 1)) for line in lines]
    owner = np.repeat(np.arange(len(long)), [len(line) for line in long])
    whole = shapely.linestrings(np.concatenate(long) - corner, indices=owner)
    shapely.prepare(whole)
    found = np.empty(len(points))
    for start in range(0, len(points), CHUNK):
        part = slice(start, start + CHUNK)
        places = shapely.points(points[part] - corner)
        found[part] = shapely.length(shapely.shortest_line(whole[which[part]], places))
    return found


def distance_to_line(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Returns distances [n] m of points [n, 2] from one polyline [m >= 1, 2]."""
    return distances_to_lines(points, [line], np.zeros(len(points), np.int64))


def line_across(
    centre: np.ndarray, left: np.ndarray, right: np.ndarray, point: np.ndarray
) -> np.ndarray:
    """Returns end points [2, 2] m, left first, of a line across a lane near a point.

    It lies where the point falls on the centre line, at most at its ends.

    Args:
      centre: [m >= 2, 2] m, consecutive points differ.
      left: [m] m, distance of the left bound.
      right: [m] m, of the right one.
      point: [2] m.
    """
    start, step = centre[:-1], np.diff(centre, axis=0)
    square = np.sum(step * step, axis=1)
    share = np.clip(np.sum((point - start) * step, axis=1) / square, 0.0, 1.0)
    foot = start + share[:, None] * step
    nearest = int(np.argmin(np.hypot(*(foot - point).T)))
    ahead = step[nearest] / np.sqrt(square[nearest])
    normal = np.array([-ahead[1], ahead[0]])
    at = nearest + share[nearest]
    sides = [np.interp(at, np.arange(len(centre)), width) for width in (left, right)]
    return foot[nearest] + np.array([sides[0], -sides[1]])[:, None] * normal


class Roads:
    """Lanes of a large map by place: centre lines [m >= 2, 2] m, lanes by number."""

    def __init__(
        self, centres: Sequence[np.ndarray], lane: Callable[[int], Lane]
    ) -> None:
        self._lane = lane
        boxes = [(line.min(axis=0), line.max(axis=0)) for line in centres]
        self._low, self._high = np.array(boxes).reshape(-1, 2, 2).swapaxes(0, 1)

    def around(
        self, x: np.ndarray, y: np.ndarray, origin: np.ndarray, margin: float = MARGIN_M
    ) -> tuple[Lane, ...]:
        """Returns lanes within a margin of positions [m], less the origin."""
        low = np.array([x.min(), y.min()]) - margin
        high = np.array([x.max(), y.max()]) + margin
        near = (self._high >= low).all(axis=1) & (self._low <= high).all(axis=1)
        return tuple(
            dataclasses.replace(
                lane,
                centre=lane.centre - origin,
                stop_line=None if lane.stop_line is None else lane.stop_line - origin,
            )
            for lane in map(self._lane, np.flatnonzero(near).tolist())
        )
