"""Stop lines, signals and destinations as obstacles of a scene."""

from collections.abc import Sequence

import numpy as np

from rcirl_jax.data.scenes.config import SignalChecks
from rcirl_jax.data.scenes.lanes import LaneFrame, project
from rcirl_jax.types import Kind, Recording, Signal, Track
from rcirl_jax.units import EGO_LENGTH_M, LINE_HALF_WIDTH_M, TIMES_S

LOOK_AHEAD_M = 120.0  # m, lines farther ahead are not collected
STOP_SIGN_WAIT_S = 1.0  # s, a stop sign is obeyed after standing this long
MAX_RED_RUNNING = 0.1  # share of crossings on red above which a cycle is not true
PASSABLE = ("green", "yellow")  # states that let a driver pass
TOO_FEW = "has too few crossings"  # in a note on an unused signal
MIN_CROSSINGS = 3  # crossings needed to judge a cycle
OVER_M = 1.5  # m, a car that stands so far over a light's line still waits for it
STANDING_MPS = 0.5  # m/s
CREEP_M = 0.5  # m before the front at which such a car meets its line


def signal_state(signal: Signal, times: np.ndarray) -> np.ndarray:
    """State string at each time [s]."""
    index = np.searchsorted(signal.start, times + 1e-9, side="right") - 1
    return np.array(signal.state, object)[np.clip(index, 0, None)]


def trusted_signals(
    recording: Recording, checks: SignalChecks | None = None
) -> tuple[dict[str, Signal], list[str]]:
    """Signals whose phases agree with what the drivers did, and notes on others.

    Cycles written by a converter need not match the recording. Every crossing
    of a governed stop line is looked up in the cycle; if more than a tenth of
    at least three crossings happen on red, the signal is not used, nor is a cycle
    with fewer crossings: a short file alone cannot
    confirm it, many together can: where `checks` knows a signal's line its word
    decides, and of two lines with one light the one that bears it out.
    """
    by_id = {signal.id: signal for signal in recording.signals}
    counts = {name: [0, 0] for name in by_id}
    verdicts = checks.of_signals(recording) if checks else {}
    fronts = _fronts(recording.tracks) if by_id else None
    for lane in recording.lanes:
        names = [name for name in lane.signal_ids if name in by_id]
        if lane.stop_line is None or fronts is None or not names:
            continue
        for time in _crossings(fronts, lane.stop_line):
            states = [signal_state(by_id[n], np.array([time]))[0] for n in names]
            # another light of the line let the driver pass
            passable = any(state in PASSABLE for state in states)
            for name, state in zip(names, states, strict=True):
                counts[name][0] += 1
                counts[name][1] += state == "red" and not passable
    trusted = {name: by_id[name] for name, good in verdicts.items() if good}
    notes = [
        f"signal {name}: many files speak against it; unused"
        for name, good in verdicts.items()
        if not good
    ]
    for name, signal in by_id.items():
        if name in verdicts:
            continue
        crossings, reds = counts[name]
        wrong = crossings >= MIN_CROSSINGS and reds > MAX_RED_RUNNING * crossings
        unproved = not signal.is_recorded and crossings < MIN_CROSSINGS
        if wrong or unproved:
            why = "disagrees with the crossings" if wrong else TOO_FEW
            notes.append(f"signal {name}: {why} ({reds} on red of {crossings}); unused")
        else:
            trusted[name] = signal
    return trusted, notes


def _fronts(tracks: Sequence[Track]) -> tuple[np.ndarray, ...]:
    """Return the middle of every car's front bumper, all samples track after track.

    Four arrays [n]: x m, y m, t s and the number of the track.
    """

    def join(name: str) -> np.ndarray:
        return np.concatenate([np.zeros(0)] + [getattr(one, name) for one in tracks])

    sizes, heading = [track.t.size for track in tracks], join("heading")
    half = np.repeat([0.5 * track.length for track in tracks], sizes)
    owner = np.repeat(np.arange(len(tracks)), sizes)
    x, y = join("x") + half * np.cos(heading), join("y") + half * np.sin(heading)
    return x, y, join("t"), owner


def _crossings(fronts: tuple[np.ndarray, ...], line: np.ndarray) -> np.ndarray:
    """Return time [s] at which each front that does first crosses the segment [2, 2].

    By hand, because shapely first makes a line of every step: 50 times slower.
    """
    x, y, t, owner = fronts
    (x0, y0), (x1, y1) = line
    dx, dy = x1 - x0, y1 - y0
    side = (x - x0) * dy - (y - y0) * dx
    along = ((x - x0) * dx + (y - y0) * dy) / max(dx * dx + dy * dy, 1e-9)
    flips = (np.sign(side[1:]) != np.sign(side[:-1])) & (side[:-1] != 0.0)
    flips &= (along[1:] > 0.0) & (along[1:] < 1.0) & (owner[1:] == owner[:-1])
    where = np.flatnonzero(flips)
    _, first = np.unique(owner[where], return_index=True)
    return t[where[first] + 1]


def line_obstacles(
    frame: LaneFrame,
    track: Track,
    signals: dict[str, Signal],
    row: dict,
    clock: np.ndarray,
) -> list[dict]:
    """Stop lines ahead, by time of demand, and the destination.

    A light demands a stop while it is red, also where another light of the line
    (for another direction) is green: on the urban recordings that finds 78 % of the
    stands at red instead of 62 %, 96 % against 98 % precise. A stop sign does until a
    car that brakes evenly to the line has stood for a second. A car that stands
    with its front over a light's line meets the line just before its front, because it
    waits to be allowed to go.
    """
    rows, v0 = [], row["ego.v"]
    front = 0.5 * track.length
    for station, lane in frame.stop_lines:
        ahead = station - row["s0"]
        lights = [signals[name] for name in lane.signal_ids if name in signals]
        if lights and v0 < STANDING_MPS and 0.0 < front - ahead <= OVER_M:
            ahead = front + CREEP_M
        if not front <= ahead <= LOOK_AHEAD_M:
            continue
        states = np.array([signal_state(light, clock) for light in lights], object)
        demand = np.zeros(TIMES_S.size, bool)
        if lights:
            demand = (states == "red").any(axis=0)
        is_light = bool(demand[0])
        if lane.stop_sign:
            arrival = 2.0 * (ahead - front) / max(v0, 0.5)
            demand |= arrival + STOP_SIGN_WAIT_S > TIMES_S
        if demand.any():
            rows.append(_line(ahead, demand, Kind.STOP, is_light))
    if track.destination is not None:
        s, l = project(frame, *np.array(track.destination)[:, None])
        # the car stands ON its destination: the line lies at its front bumper
        ahead = float(s[0]) - row["s0"] + 0.5 * (track.length or EGO_LENGTH_M)
        if abs(l[0]) <= LINE_HALF_WIDTH_M and 0.0 < ahead <= LOOK_AHEAD_M:
            rows.append(_line(ahead, np.ones(TIMES_S.size, bool), Kind.VIRTUAL))
    return rows[:4]


def _line(
    station: float, demand: np.ndarray, kind: Kind, is_light: bool = False
) -> dict:
    return {
        "is_light": is_light,
        "s_lower": station,
        "s_upper": station,
        "l_lower": -LINE_HALF_WIDTH_M,
        "l_upper": LINE_HALF_WIDTH_M,
        "speed": 0.0,
        "valid": demand,
        "kind": int(kind),
    }
