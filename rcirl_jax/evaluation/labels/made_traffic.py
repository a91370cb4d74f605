"""What simulated drivers did: decisions and tags from their own state.

The drivers of `data.synthetic` follow, change lanes and stop by their own models. What
they did is read from their lanes, stations and speeds without noise, never from
`data/scenes/labels.py`. With E and O the lanes of the labelled driver and of another
car over the window, and "ahead" of box before box:

    E steady, O the same lane all the time, ahead            follow; behind: ignore
    E steady, O leaves that lane after FOLLOWED_S, ahead     follow; behind: ignore
    E steady, O comes into it, ahead                         yield (and a cut-in)
    E steady, O comes into it, behind                        overtake
    E changes lane, O stays in the old one, is passed        overtake
    E changes lane, O was ahead in the new one, is passed    overtake
    never a common lane, passed slowly and near              nudge; else ignore

All else is left unscored, as is what lies near the edge of a definition.
"""

import dataclasses
from collections.abc import Set

import numpy as np

from rcirl_jax.data.synthetic.roads import GRID_M
from rcirl_jax.data.synthetic.stops import schedule
from rcirl_jax.data.synthetic.traffic import Log
from rcirl_jax.types import Decision, Tag

CLEAR_M = 1.0  # m between bumpers beyond doubt
FOLLOWED_S = 2.5  # s in the way beyond doubt for a followed car (rule: 2 s)
COMES_M = 55.0  # m, who comes into the lane farther away is not scored
ENTERS_S = 1.0  # s after the frame from which coming into the lane counts
NUDGE_M = (2.7, 3.3)  # m beside: surely near, surely not (rule: 3 m)
SLOWER_MPS = (2.4, 1.6)  # m/s: surely passed, surely not (rule: 2 m/s)
PASSING_S = 0.7  # s of it, so that one of the times of the scene sees it
STANDS_MPS = 0.05  # m/s, beyond doubt
ROLLS_MPS = 1.0  # m/s, surely not standing
STANDS_S = 1.0  # s
AT_LINE_M = (-0.5, 8.0)  # m from front to line: surely waiting at it
OFF_LINE_M = 15.0  # m: surely not
LINE_SEEN_M = (60.0, 160.0)  # m to a red light: surely in the scene, surely not
AMBER_S = 0.5  # s around a light's change without a word on the tag


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drive:
    """One car at all samples of a window; arrays [m]."""

    s: np.ndarray  # m
    l: np.ndarray  # m
    v: np.ndarray  # m/s
    lanes: np.ndarray  # bit masks
    length: float  # m
    width: float  # m

    @property
    def is_steady(self) -> bool:
        """In one lane all the time."""
        return is_single(self.lanes[0]) and bool(np.all(self.lanes == self.lanes[0]))

    @property
    def changes(self) -> bool:
        """Begins and ends one change of lane inside the window."""
        first, last = self.lanes[0], self.lanes[-1]
        between = np.isin(self.lanes, (first, first | last, last)).all()
        return bool(between) and is_single(first) and is_single(last) and last != first


def is_single(mask: int) -> bool:
    """One lane alone."""
    return mask > 0 and mask & (mask - 1) == 0


def drive_of(log: Log, number: int, window: slice) -> Drive | None:
    """A vehicle over a window, or None if it is not there all the time."""
    slots = np.flatnonzero(log.vehicle[window.start] == number)
    if slots.size == 0 or np.any(log.vehicle[window, slots[0]] != number):
        return None
    s, l, v, lanes = (x[window, slots[0]] for x in (log.s, log.l, log.v, log.lanes))
    driver = log.drivers[number]
    length, width = float(driver["length"]), float(driver["width"])
    return Drive(s=s, l=l, v=v, lanes=lanes, length=length, width=width)


# ----------------------------------------------------------------- decisions


def decision(ego: Drive, other: Drive, rate_hz: float) -> Decision | None:
    """What the driver decided about the other (module docstring); None: unscored."""
    apart = other.s - ego.s
    half = 0.5 * (ego.length + other.length)
    common = (ego.lanes & other.lanes) != 0
    if not common.any():
        return _beside(ego, other, rate_hz)
    if ego.is_steady:
        return _in_lane(common, apart, half, other, rate_hz)
    if ego.changes and other.is_steady:
        was_old = other.lanes[0] == ego.lanes[0]
        behind = apart < -half - CLEAR_M
        if apart[0] > half + CLEAR_M and behind[-1]:
            return Decision.OVERTAKE
        return Decision.IGNORE if was_old and behind.all() else None
    return None


def _in_lane(
    common: np.ndarray, apart: np.ndarray, half: float, other: Drive, rate_hz: float
) -> Decision | None:
    """About somebody who is in a steady driver's lane, or comes or goes."""
    ahead, behind = apart > half + CLEAR_M, apart < -half - CLEAR_M
    stays = other.is_steady
    goes = other.changes and bool(common[0])
    enters = int(np.argmax(common))
    comes = other.changes and bool(common[-1]) and enters >= ENTERS_S * rate_hz
    near = abs(apart[enters]) < COMES_M and abs(apart[0]) < COMES_M
    if behind[common].all():
        if stays or goes:
            return Decision.IGNORE
        return Decision.OVERTAKE if comes and near else None
    if not ahead[common].all():
        return None
    alone = np.count_nonzero(other.lanes == other.lanes[0])
    if stays or (goes and alone >= FOLLOWED_S * rate_hz):
        return Decision.FOLLOW
    return Decision.YIELD if comes and near else None


def _beside(ego: Drive, other: Drive, rate_hz: float) -> Decision | None:
    """About somebody in other lanes all the time."""
    half = 0.5 * (ego.length + other.length)
    abreast = np.abs(other.s - ego.s) < half
    gap = np.abs(other.l - ego.l) - 0.5 * (ego.width + other.width)
    slower = ego.v - other.v
    surely = abreast & (gap < NUDGE_M[0]) & (slower > SLOWER_MPS[0])
    maybe = np.abs(other.s - ego.s) < half + CLEAR_M
    maybe &= (gap < NUDGE_M[1]) & (slower > SLOWER_MPS[1])
    if not maybe.any():
        return Decision.IGNORE
    if np.count_nonzero(surely) < PASSING_S * rate_hz:
        return None
    at = np.argmax(surely)
    is_left = ego.l[at] > other.l[at]
    return Decision.NUDGE_LEFT if is_left else Decision.NUDGE_RIGHT


def line_decision(log: Log, ego: Drive, rate_hz: float) -> Decision | None:
    """STOP where the driver waits at the next line, IGNORE where he does not."""
    lines = np.array([stop.station for stop in log.road.stops])
    lines = lines[lines > ego.s[0] + 0.5 * ego.length]
    if lines.size == 0 or lines[0] - ego.s[0] > LINE_SEEN_M[0]:
        return None
    gap = lines[0] - ego.s - 0.5 * ego.length
    waits = (ego.v < STANDS_MPS) & (gap > AT_LINE_M[0]) & (gap < AT_LINE_M[1])
    if np.count_nonzero(waits) >= STANDS_S * rate_hz:
        return Decision.STOP
    near = (gap > -2.0) & (gap < OFF_LINE_M)
    return None if np.any(near & (ego.v < ROLLS_MPS)) else Decision.IGNORE


# ---------------------------------------------------------------------- tags


def motion_tags(log: Log, ego: Drive) -> dict[Tag, bool | None]:
    """Tags of the driver's own motion; None: too close to say."""
    grid = np.arange(log.road.heading.size) * GRID_M
    turned = np.diff(np.interp(ego.s[[0, -1]], grid, log.road.heading))[0]
    change = True if ego.changes else None
    return {
        **speed_tags(ego.v, float(turned)),
        Tag.LANE_CHANGE: False if ego.is_steady else change,
    }


def speed_tags(v: np.ndarray, turned: float) -> dict[Tag, bool | None]:
    """Tags of exact speeds and of the road's turn; None: too close to say.

    Moving is above 2 m/s, standing below 0.5 m/s, cruising a change below
    1.5 m/s above 5 m/s; a third of each threshold is left as doubt.

    Args:
      v: [n] m/s, of the driver over the scene.
      turned: rad, by which the road turns under it.
    """
    first, last, top, low = v[0], v[-1], v.max(), v.min()
    return {
        Tag.STOPPING: clear(first - 2.0, 0.6, 0.5 - last, 0.2),
        Tag.STARTING: clear(0.5 - first, 0.2, last - 2.0, 0.6),
        Tag.CRUISING: clear(1.5 - (top - low), 0.5, low - 5.0, 0.5),
        Tag.STANDING: clear(0.5 - top, 0.2),
        Tag.TURNING: clear(abs(np.rad2deg(turned)) - 30.0, 6.0),
    }


def tags_of_decisions(
    known: Set[Decision | None], *, complete: bool
) -> dict[Tag, bool | None]:
    """Tags that some decision makes true; false only where all are known."""
    nudges = {Decision.NUDGE_LEFT, Decision.NUDGE_RIGHT}
    groups = {
        Tag.FOLLOWING: {Decision.FOLLOW},
        Tag.YIELDING: {Decision.YIELD},
        Tag.OVERTAKING: {Decision.OVERTAKE},
        Tag.NUDGING: nudges,
    }
    rest = False if complete else None
    return {tag: True if known & members else rest for tag, members in groups.items()}


def clear(*margins: float) -> bool | None:
    """True if every value of (value, tolerance, ...) is above its tolerance.

    False if one is below minus its tolerance, None if it is too close to say.
    """
    pairs = list(zip(margins[::2], margins[1::2], strict=True))
    if any(value < -doubt for value, doubt in pairs):
        return False
    return True if all(value > doubt for value, doubt in pairs) else None


def cuts_in(ego: Drive, other: Drive | None, rate_hz: float) -> bool | None:
    """Whether the other comes into a steady driver's lane, ahead."""
    if other is None or not ego.is_steady:
        return None
    common = (ego.lanes & other.lanes) != 0
    if not common.any() or (common.all() and other.is_steady):
        return False
    made = decision(ego, other, rate_hz)
    if made == Decision.YIELD:
        return True
    return None if made is None else False


def red_light(log: Log, ego: Drive, now: float) -> bool | None:
    """Whether a light ahead is red at the frame, `now` [s]."""
    front = ego.s[0] + 0.5 * ego.length
    answer: bool | None = False
    for stop, offset in zip(log.road.stops, log.signal_offset, strict=True):
        gap = stop.station - front
        if stop.is_sign or not -2.0 < gap < LINE_SEEN_M[1]:
            continue
        starts, colours = schedule(log.road.cycle, float(offset), now + 1.0)
        index = int(np.searchsorted(starts, now, side="right")) - 1
        near_change = np.any(np.abs(starts - now) < AMBER_S)
        if near_change or not 0.5 < gap < LINE_SEEN_M[0]:
            answer = None if colours[index] == "red" or near_change else answer
        elif colours[index] == "red":
            return True
    return answer
