"""Lanes parallel to the x axis, for logs whose road is straight."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.recording import check_lanes_length, check_span
from rcirl_jax.types import Lane

LANE_STEP_M = 5.0  # m between points of a fitted lane
NEIGHBOUR_WIDTHS = 1.6  # lane widths between centres up to which lanes adjoin


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
    """Lanes parallel to the x axis, with bounds midway between neighbours.

    Lanes are neighbours if they are driven the same way and no more than
    `NEIGHBOUR_WIDTHS` lane widths apart; outer bounds lie half a width out, which is a
    guess.
    """
    for lane in found:
        ends = np.array([lane.lower, lane.upper])
        check_span(f"{path}: lane {lane.id}", "position along the road", ends)
    check_lanes_length(str(path), sum(lane.upper - lane.lower for lane in found))
    lanes = []
    for lane in found:
        above = _beside(lane, found, width, +1.0)
        below = _beside(lane, found, width, -1.0)
        up = 0.5 * width if above is None else 0.5 * (above.y - lane.y)
        down = 0.5 * width if below is None else 0.5 * (lane.y - below.y)
        left, right = (above, below) if lane.forward else (below, above)
        sides = (up, down) if lane.forward else (down, up)
        ids = [None if beside is None else beside.id for beside in (left, right)]
        made = parallel_lane(lane, sides, ids, limit)
        is_guessed = above is None or below is None
        lanes.append(dataclasses.replace(made, width_assumed=is_guessed))
    return tuple(lanes)


def parallel_lane(
    lane: StraightLane,
    sides: tuple[float, float],
    beside: Sequence[str | None],
    limit: float | None,
) -> Lane:
    """A lane parallel to the x axis, driven the way that it is.

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


def _beside(
    lane: StraightLane, found: Sequence[StraightLane], width: float, side: float
) -> StraightLane | None:
    """The nearest lane on the side of +y (side = 1) or -y (side = -1), if adjoining.

    Lanes nearer than 0.4 widths are one lane under two names (on- and off-ramp).
    """
    apart = {
        other.id: side * (other.y - lane.y)
        for other in found
        if other.forward == lane.forward
    }
    near = [
        other
        for other in found
        if 0.4 * width < apart.get(other.id, 0.0) < NEIGHBOUR_WIDTHS * width
    ]
    return min(near, key=lambda other: apart[other.id], default=None)
