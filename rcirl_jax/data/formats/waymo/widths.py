"""Half widths of Waymo lanes: distances from the lines that bound them.

A lane names the road lines and edges beside it, each for a range of its points.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from rcirl_jax.data.formats.shapes import MIN_HALF_WIDTH_M, distances_to_lines

MAX_HALF_WIDTH_M = 5.0  # m; a farther line does not bound the lane
MEASURE_STEP = 4  # points (2 m) between those at which widths are measured
MAX_POINTS = 5_000_000  # of all lanes; 10,000 km of them are no map


@dataclasses.dataclass(frozen=True, kw_only=True)
class Segments:
    """Which line bounds which points of a lane; arrays of one length."""

    lane: np.ndarray  # number of the lane
    first: np.ndarray  # number of its first point
    last: np.ndarray  # and of its last, inclusive
    line: np.ndarray  # feature id of the line


def half_widths(
    lanes: Sequence[np.ndarray],
    lines: Mapping[int, np.ndarray],
    segments: Segments,
) -> list[np.ndarray | None]:
    """Distance [n] m of each lane's points from what bounds them on one side.

    Measured at every fourth point, interpolated between, held beyond; None of lanes
    without a known bound.

    Args:
      lanes: points [n, 2] m of each lane.
      lines: feature id -> points [m >= 1, 2] m.
      segments: of that side.
    """
    sizes = np.array([len(lane) for lane in lanes], np.int64)
    begins = np.cumsum(sizes) - sizes
    half = np.full(int(sizes.sum()), np.nan)
    low = np.maximum(segments.first, 0)
    high = np.minimum(segments.last, sizes[segments.lane] - 1)
    use = np.flatnonzero(np.isin(segments.line, [*lines]) & (low <= high))
    if use.size:
        count = (high[use] - low[use]) // MEASURE_STEP + 2
        owner = np.repeat(use, count)
        place = np.arange(owner.size) - np.repeat(np.cumsum(count) - count, count)
        point = np.minimum(low[owner] + MEASURE_STEP * place, high[owner])
        row = begins[segments.lane[owner]] + point
        keys, which = np.unique(segments.line[owner], return_inverse=True)
        bounds = [lines[key] for key in keys.tolist()]
        half[row] = distances_to_lines(np.concatenate(lanes)[row], bounds, which)
    return [_filled(part) for part in np.split(half, begins[1:])]


def _filled(half: np.ndarray) -> np.ndarray | None:
    """Half widths with the points between and beyond the measured ones."""
    known = np.flatnonzero(half <= MAX_HALF_WIDTH_M)  # NaN compares false
    if not known.size:
        return None
    filled = np.interp(np.arange(half.size), known, half[known])
    return np.maximum(filled, MIN_HALF_WIDTH_M)
