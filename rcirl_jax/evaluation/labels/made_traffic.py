"""True decisions and tags of simulated drivers, from their own state.

The drivers of `data.synthetic` follow, change lanes and stop by their own models. What
they did is read from their lanes, stations and speeds without noise, never from
`data/scenes/labels.py`. Their wishes are in `reactions`. With E and O the lanes of
the labelled driver and of another car over the window, and "ahead" of box before box:

    O ahead, later behind, with a common lane                overtake
    O behind all the time                                    ignore
    E steady, O the same lane all the time, ahead            follow
    E steady, O leaves that lane after FOLLOWED_S, ahead     follow
    E steady, O comes into it, ahead                         yield if E wants to brake
                                                             for it; else follow
    never a common lane                                      ignore: these drivers
                                                             never move aside

All else is left unscored, as is what lies near the edge of a definition.
"""

import dataclasses
from collections.abc import Set

import numpy as np

from rcirl_jax.data.synthetic.roads import GRID_M
from rcirl_jax.data.synthetic.stops import schedule
from rcirl_jax.data.synthetic.traffic import Log
from rcirl_jax.evaluation.labels.reactions import Arrival
from rcirl_jax.types import Decision, Tag

CLEAR_M = 1.0  # m between bumpers beyond doubt
FOLLOWED_S = 2.5  # s in the way beyond doubt for a followed car (rule: 2 s)
ENTERS_S = 1.0  # s after the frame from which coming into the lane counts
CUT_IN_S = (2.6, 4.2)  # s of headway: surely near, surely not (rule: 3 s and 5 m)
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


def decision(
    ego: Drive, other: Drive, rate_hz: float, came: Arrival | None = None
) -> Decision | None:
    """What the driver decided about the other (module docstring); None: unscored.

    Args:
      ego: the driver.
      other: another car.
      rate_hz: samples per second.
      came: how the other comes into the driver's lane, if it does.
    """
    apart = other.s - ego.s
    half = 0.5 * (ego.length + other.length)
    ahead, behind = apart > half + CLEAR_M, apart < -half - CLEAR_M
    common = (ego.lanes & other.lanes) != 0
    if not common.any() or behind.all():
        return Decision.IGNORE
    if ahead[0] and behind[-1]:
        alone = np.array([is_single(mask) for mask in ego.lanes.tolist()])
        alone &= ego.lanes == other.lanes
        return Decision.OVERTAKE if (alone & (ahead | behind)).any() else None
    if ego.is_steady and ahead[common].all():
        return _ahead(common, other, rate_hz, came)
    return None


def _ahead(
    common: np.ndarray, other: Drive, rate_hz: float, came: Arrival | None
) -> Decision | None:
    """About somebody ahead in a steady driver's lane, or who comes or goes."""
    goes = other.changes and bool(common[0])
    alone = np.count_nonzero(other.lanes == other.lanes[0])
    if other.is_steady or (goes and alone >= FOLLOWED_S * rate_hz):
        return Decision.FOLLOW
    comes = other.changes and bool(common[-1])
    comes &= bool(np.argmax(common) >= ENTERS_S * rate_hz)
    if came is None or not comes or not came.is_nearest:
        return None
    if came.brakes and came.headway_s < CUT_IN_S[0]:
        return Decision.YIELD
    lasts = np.count_nonzero(common) >= FOLLOWED_S * rate_hz
    return Decision.FOLLOW if came.brakes is False and lasts else None


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


def cuts_in(
    ego: Drive, other: Drive | None, rate_hz: float, came: Arrival | None = None
) -> bool | None:
    """Whether the other changes lane into the gap ahead of a steady driver."""
    if other is None or not ego.is_steady:
        return None
    common = (ego.lanes & other.lanes) != 0
    if not common.any() or other.is_steady:
        return False
    if came is None:  # behind, or in the lane from the start
        return False if common[0] or other.s[0] < ego.s[0] else None
    if came.headway_s > CUT_IN_S[1]:
        return False
    surely = other.changes and came.is_nearest
    surely = surely and np.argmax(common) >= ENTERS_S * rate_hz
    return True if surely and came.headway_s < CUT_IN_S[0] else None


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
