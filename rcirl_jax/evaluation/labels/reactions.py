"""Whether a simulated driver brakes for one that comes into its lane.

The truth is the driver's own model (`data.synthetic.drivers`), not its speeds: the
acceleration that it wants with the other ahead, and what it would want without it.
"""

import dataclasses

import numpy as np

from rcirl_jax.data.synthetic.drivers import (
    desired_speed,
    free_acceleration,
    interaction,
)
from rcirl_jax.data.synthetic.roads import GRID_M
from rcirl_jax.data.synthetic.traffic import Log

AFTER_S = 4.0  # s after it comes in which the driver reacts
WANTS_MPS2 = 0.8  # m/s^2, surely braking
CONTENT_MPS2 = 0.2  # m/s^2, surely not braking
LASTS_S = 1.5  # s of wanting to brake: a speed given up that can be seen


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arrival:
    """A road user that enters the driver's lane ahead of it."""

    headway_s: float  # s, gap over the driver's speed when it comes
    is_nearest: bool  # nobody drives between them
    brakes: bool | None  # the driver wants to brake for it; None: too close to say


def arrival(
    log: Log, own: int, number: int, window: slice, rate_hz: float
) -> Arrival | None:
    """The entry of car `number` into the lane of the driver `own`; None if none.

    Both are there all the time.
    """
    rows = np.arange(window.start, window.stop)
    me, it = (np.argmax(log.vehicle[rows] == n, axis=1) for n in (own, number))
    gaps, shared = _gaps(log, rows, me)
    gap = gaps[np.arange(rows.size), it]
    common = shared[np.arange(rows.size), it]
    at = int(np.argmax(common))
    if not common.any() or at == 0 or gap[at] <= 0.0:
        return None
    ahead = np.where(shared & (gaps > 0.0), gaps, np.inf)
    speed = log.v[rows, me]
    return Arrival(
        headway_s=float(gap[at] / max(speed[at], 0.1)),
        is_nearest=bool(gap[at] <= ahead[at].min()),
        brakes=_brakes(log, own, rows, (me, it), ahead, at, rate_hz),
    )


def _gaps(log: Log, rows: np.ndarray, me: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gaps [k, n] m to all others, and whether they share a lane [k, n]."""
    there = log.vehicle[rows] >= 0
    length = np.where(there, log.drivers["length"][log.vehicle[rows]], 0.0)
    mine = np.arange(rows.size), me
    own_s, own_length = log.s[rows][mine][:, None], length[mine][:, None]
    gaps = log.s[rows] - own_s - 0.5 * (length + own_length)
    shared = there & ((log.lanes[rows] & log.lanes[rows][mine][:, None]) != 0)
    shared[mine] = False
    return gaps, shared


def _brakes(
    log: Log,
    own: int,
    rows: np.ndarray,
    slots: tuple[np.ndarray, np.ndarray],
    ahead: np.ndarray,
    at: int,
    rate: float,
) -> bool | None:
    """Whether the driver wants to brake with it ahead, and would not without it."""
    if log.road.stops:
        return None  # lines make drivers brake as well
    part = slice(at, min(at + int(AFTER_S * rate), rows.size))
    each, me, it = rows[part], slots[0][part], slots[1][part]
    driver, v = log.drivers[own], log.v[each, me]
    place = (log.s[each, me] / GRID_M).astype(int)
    place = np.clip(place, 0, log.road.kappa.size - 1)
    desired = desired_speed(
        driver,
        log.road.limit_envelope()[place],
        log.road.curve_envelope()[place],
        1.0 - log.road.kappa[place] * log.l[each, me],
    )
    free = free_acceleration(v, desired, driver["acceleration"], driver["deceleration"])
    count = np.arange(each.size)
    with_it = ahead[part]
    without = with_it.copy()
    without[count, it] = np.inf
    wants, else_wants = (
        free - _interaction(log, each, v, gaps, driver) for gaps in (with_it, without)
    )
    if np.all(wants > -CONTENT_MPS2):
        return False
    for_it = (wants < -WANTS_MPS2) & (else_wants > -CONTENT_MPS2)
    return True if np.count_nonzero(for_it) >= LASTS_S * rate else None


def _interaction(
    log: Log, rows: np.ndarray, v: np.ndarray, gaps: np.ndarray, driver: np.ndarray
) -> np.ndarray:
    """[k] m/s^2 that the nearest of those ahead takes from the driver's wish."""
    nearest = np.argmin(gaps, axis=1)
    gap = gaps[np.arange(rows.size), nearest]
    a, b = driver["acceleration"], driver["deceleration"]
    return interaction(
        v, gap, log.v[rows, nearest], a, b, driver["headway"], driver["jam_gap"]
    )
