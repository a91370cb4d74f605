"""Recordings by construction: who did what is known before any label is made.

A `Case` is a planned drive in the frame of a road, with the decision towards
every other road user written down by whoever planned it. Nothing here reads
`data/scenes/labels.py`: tags follow from the exact, noise-free motion, and what lies
near a definition's edge is left unscored.

Time 0 is the planning frame. Stations are along the ego lane's centre line,
l is 0 there and positive to the left.
"""

import dataclasses
from collections.abc import Sequence, Set

import numpy as np

from rcirl_jax.evaluation.labels.cases.noise import NOISES, position_errors
from rcirl_jax.types import Decision, Kind, Lane, Recording, Signal, Tag, Track

RATE_HZ = 10.0  # 1/s, of the recordings
HISTORY_S = 2.0  # s recorded before the planning frame
FUTURE_S = 9.0  # s recorded after it
CLOCK = np.arange(-20, 91) / RATE_HZ  # [n] s, all samples of a case
FINE_S = 0.02  # s, step of the integration of accelerations
START_M = 130.0  # m, station of the ego on the road at the planning frame
ROAD_M = 560  # m, length of the road
LENGTH_M, WIDTH_M = 4.6, 1.8  # m, of cars unless said


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mover:
    """One road user of a case; arrays follow `CLOCK`."""

    id: str
    s: np.ndarray  # [n] m
    l: np.ndarray  # [n] m
    kind: Kind = Kind.VEHICLE
    length: float = LENGTH_M  # m
    width: float = WIDTH_M  # m
    rest: float = 0.0  # rad, heading against the road's while standing


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A planned drive and what is true of it."""

    family: str
    ego: Mover
    others: tuple[Mover, ...] = ()
    # decision by id of the other; ids that are missing are not scored
    truth: dict[str, Decision] = dataclasses.field(default_factory=dict)
    tags: dict[Tag, bool | None] = dataclasses.field(default_factory=dict)
    lane_m: float = 3.6  # m, width of a lane
    kappa: np.ndarray | None = None  # [ROAD_M + 1] 1/m; None: straight
    line_m: float | None = None  # m, station of a stop line
    light: Signal | None = None  # that governs the line; None: a stop sign
    line_truth: Decision | None = None  # towards the line or the destination
    destination_m: float | None = None  # m, station where the ego wants to stand

    def known_tags(self) -> dict[Tag, bool]:
        """Every tag that is beyond doubt: of the motion, the truth, the family."""
        found = {**motion_tags(self), **decision_tags(self), **self.tags}
        return {tag: value for tag, value in found.items() if value is not None}


# -------------------------------------------------------------------- motion


def drive(
    station: float, v0: float, pieces: Sequence[tuple[float, float]] = ()
) -> np.ndarray:
    """Stations [n] m: constant v0 first, then piecewise constant accelerations.

    Args:
      station: m, at t = 0.
      v0: m/s, at t = 0.
      pieces: (start s, acceleration m/s^2), each until the next; the speed
        never falls below zero.
    """
    fine = np.arange(-HISTORY_S, FUTURE_S + FINE_S / 2, FINE_S)
    a = np.zeros(fine.size)
    for start, value in pieces:
        a[fine >= start - 1e-9] = value
    v = np.empty(fine.size)
    v[0] = v0
    for i in range(1, fine.size):
        v[i] = max(v[i - 1] + a[i] * FINE_S, 0.0)
    s = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * FINE_S)])
    return station + np.interp(CLOCK, fine, s - np.interp(0.0, fine, s))


def delayed(s: np.ndarray, delay: float, gap: float) -> np.ndarray:
    """Newell's follower: s_f(t) = s(t - delay) - gap [m].

    Source: Newell, Transportation Research B 36 (2002), 195-205.
    """
    early = s[0] + (CLOCK - delay - CLOCK[0]) * (s[1] - s[0]) * RATE_HZ
    return (
        np.where(CLOCK - delay < CLOCK[0], early, np.interp(CLOCK - delay, CLOCK, s))
        - gap
    )


def shift(start: float, seconds: float, metres: float) -> np.ndarray:
    """A lateral move [n] m: quintic from 0 to `metres`, from `start` on."""
    u = np.clip((CLOCK - start) / seconds, 0.0, 1.0)
    return metres * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


def speed(s: np.ndarray) -> np.ndarray:
    """[n] m/s."""
    return np.gradient(s) * RATE_HZ


def at(values: np.ndarray, time: float) -> float:
    """Value at a time [s]."""
    return float(np.interp(time, CLOCK, values))


# --------------------------------------------------------------------- truth


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


def motion_tags(case: Case) -> dict[Tag, bool | None]:
    """Tags that are the ego's motion alone; None: too close to say."""
    seen = (CLOCK >= 0.0) & (CLOCK <= 8.0)
    side = float(np.max(np.abs(case.ego.l[seen] - case.ego.l[seen][0])))
    return {
        **speed_tags(speed(case.ego.s)[seen], _heading_change(case)),
        Tag.LANE_CHANGE: clear(side - 0.5 * case.lane_m, 0.15 * case.lane_m),
    }


def clear(*margins: float) -> bool | None:
    """True if every value of (value, tolerance, ...) is above its tolerance.

    False if one is below minus its tolerance, None if it is too close to say.
    """
    pairs = list(zip(margins[::2], margins[1::2], strict=True))
    if any(value < -doubt for value, doubt in pairs):
        return False
    return True if all(value > doubt for value, doubt in pairs) else None


def _heading_change(case: Case) -> float:
    """rad, of the road between the ego's stations at 0 and 8 s."""
    if case.kappa is None:
        return 0.0
    heading = np.concatenate([[0.0], np.cumsum(case.kappa[:-1])])
    ends = np.interp([at(case.ego.s, 0.0), at(case.ego.s, 8.0)], *_grid(heading))
    return float(ends[1] - ends[0])


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


def decision_tags(case: Case) -> dict[Tag, bool | None]:
    """Tags that say that some decision was made."""
    complete = all(other.id in case.truth for other in case.others)
    found = tags_of_decisions(set(case.truth.values()), complete=complete)
    return {**found, Tag.CUT_IN: False, Tag.RED_LIGHT: False}


# --------------------------------------------------------------------- world


def _grid(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(values.size, dtype=float), values


class _World:
    """Road coordinates -> local metres."""

    def __init__(self, kappa: np.ndarray | None) -> None:
        bend = np.zeros(ROAD_M + 1) if kappa is None else kappa
        self.heading = np.concatenate([[0.0], np.cumsum(bend[:-1])])
        middle = self.heading[:-1] + 0.5 * np.diff(self.heading)
        self.x = np.concatenate([[0.0], np.cumsum(np.cos(middle))])
        self.y = np.concatenate([[0.0], np.cumsum(np.sin(middle))])

    def place(self, s: np.ndarray, l: np.ndarray) -> tuple[np.ndarray, ...]:
        """x, y [m] and the road's heading [rad] at (s, l)."""
        grid = np.arange(ROAD_M + 1.0)
        heading = np.interp(s, grid, self.heading)
        x = np.interp(s, grid, self.x) - l * np.sin(heading)
        y = np.interp(s, grid, self.y) + l * np.cos(heading)
        return x, y, heading


def to_recording(case: Case, noise: str, rng: np.random.Generator) -> Recording:
    """The case as a log would show it.

    Args:
      case: the plan.
      noise: key of `NOISES`.
      rng: consumed, for the errors of the positions.
    """
    world = _World(case.kappa)
    movers = (case.ego, *case.others)
    tracks = [_track(world, mover, NOISES[noise], rng) for mover in movers]
    if case.destination_m is not None:
        end = np.array([case.destination_m])
        x, y, _ = world.place(end, np.zeros(1))
        goal = (float(x[0]), float(y[0]))
        tracks[0] = dataclasses.replace(tracks[0], destination=goal)
    return Recording(
        name=case.family,
        source="construction",
        licence="none",
        rate_hz=RATE_HZ,
        tracks=tuple(tracks),
        lanes=_lanes(world, case),
        signals=() if case.light is None else (case.light,),
    )


def _track(
    world: _World,
    mover: Mover,
    noise: tuple[float, float],
    rng: np.random.Generator,
) -> Track:
    x, y, road = world.place(mover.s, mover.l)
    vx, vy = np.gradient(x) * RATE_HZ, np.gradient(y) * RATE_HZ
    moving = np.hypot(vx, vy) > 0.3
    heading = np.where(moving, np.arctan2(vy, vx), road + mover.rest)
    dx, dy = position_errors(np.cumsum(moving) / RATE_HZ, noise, rng)
    return Track(
        id=mover.id,
        kind=mover.kind,
        length=mover.length,
        width=mover.width,
        t=CLOCK + HISTORY_S,
        x=x + dx,
        y=y + dy,
        heading=heading,
        speed=np.hypot(vx, vy),
    )


def _lanes(world: _World, case: Case) -> tuple[Lane, ...]:
    """Three lanes, the ego's in the middle."""
    s = np.arange(0.0, ROAD_M + 1.0, 4.0)
    half = np.full(s.size, 0.5 * case.lane_m)
    names = ("left", "mid", "right")
    lanes = []
    for i, name in enumerate(names):
        offset = (1 - i) * case.lane_m
        x, y, _ = world.place(s, np.full(s.size, offset))
        line = None
        if case.line_m is not None:
            ends = offset + np.array([0.5, -0.5]) * case.lane_m
            line = np.stack(world.place(np.full(2, case.line_m), ends)[:2], axis=1)
        lanes.append(
            Lane(
                id=name,
                centre=np.stack([x, y], axis=1),
                left_width=half,
                right_width=half,
                speed_limit=25.0,
                left=names[i - 1] if i else None,
                right=names[i + 1] if i < 2 else None,
                stop_line=line,
                signal_ids=() if case.light is None else (case.light.id,),
                stop_sign=line is not None and case.light is None,
            )
        )
    return tuple(lanes)
