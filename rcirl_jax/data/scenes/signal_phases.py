"""Recorded signal phases checked against the drivers' behaviour.

A converter's cycle is a claim. It is tested by turning it: the written phase is
moved by every offset d of the cycle, and the agreement

    A(d) = (crossings not on red + stands on red) / (crossings + stands)

is looked for at one common offset of all recordings of a signal. Its p value is the
share of random turns, one per recording, that agree at least as well as what is
written. A stand is a car at rest, first before the line. Right turns are counted
apart: where these data come from they may cross on red.
"""

import collections
import dataclasses
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from rcirl_jax.data.inputs import InputFile, WorkUnit, recordings_in, work_units
from rcirl_jax.data.scenes.config import CONFIRMED, OPEN, REJECTED, TOGETHER, line_name
from rcirl_jax.data.scenes.lines import (
    MAX_RED_RUNNING,
    MIN_CROSSINGS,
    OVER_M,
    STANDING_MPS,
    signal_state,
)
from rcirl_jax.runtime.executors import Executor, Serial
from rcirl_jax.types import Lane, Recording, Signal, Track

ORDER = ("green", "yellow", "red", "off")
TURNS = 2000  # random turns of the cycles; p is known to 1 / 2001
STEP_S = 1.0  # s between the offsets that are tried
MAX_P = 0.05  # 1, above it a phase is not confirmed
REACH_M = 12.0  # m before a line within which standing is a stop at it
MIN_STAND_S = 1.0  # s at rest, at least
TURN_S = 6.0  # s after the line within which a right turn shows
RIGHT_RAD = np.deg2rad(30.0)  # rad to the right that make a right turn


@dataclasses.dataclass(frozen=True, kw_only=True)
class Event:
    """One car at one line: when it crossed, or a second in which it stood."""

    time: float  # s
    crossing: bool  # else a stand
    right: bool  # crosses and turns right
    signals: tuple[Signal, ...]  # that govern the line; any of them may allow

    def state(self, offset: float) -> str:
        """Return the line's most permissive colour, its cycles moved by `offset` s."""
        states = set()
        for signal in self.signals:
            cycle, first, time = period(signal), float(signal.start[0]), self.time
            if cycle is not None:
                time = first + (time - offset - first) % cycle
            states.add(str(signal_state(signal, np.array([time]))[0]))
        return next(name for name in ORDER if name in states)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhaseCheck:
    """Agreement of the drivers with one signal's recorded phase."""

    name: str
    recordings: int
    crossings: int  # straight on or to the left, as far as the tracks show
    right_turns: int
    stands: int  # cars at rest, first before the line
    period_s: float
    red_written: float  # share of crossings on red, phase as written
    stands_red_written: float  # share of stands on red, phase as written
    best_offset_s: float  # agrees best; the nearest to 0 among equals
    red_best: float  # share of crossings on red there
    p: float  # share of random turns that agree at least as well as the written
    verdict: str


def period(signal: Signal) -> float | None:
    """s, of a repeating schedule; None if it does not repeat or never changes."""
    if len(set(signal.state)) < 2:
        return None
    for count in range(2, len(signal.state)):
        if len(signal.state) > count and signal.state[0] == signal.state[count]:
            return float(signal.start[count] - signal.start[0])
    return None


# ------------------------------------------------------------------- observed


def before_line(track: Track, lane: Lane) -> tuple[np.ndarray, np.ndarray]:
    """Distance [n] m of the front to the lane's line, and where it is in reach.

    Positive before the line, along the lane; the front must lie within the
    line's ends and head the lane's way.
    """
    assert lane.stop_line is not None
    apart = np.hypot(*(lane.centre - lane.stop_line.mean(axis=0)).T)
    begin = max(int(apart.argmin()) - 1, 0)  # the line may be at either end
    ahead = lane.centre[begin + 1] - lane.centre[begin]
    ahead = ahead / np.hypot(*ahead)
    front = np.stack([track.x, track.y], axis=1) + 0.5 * track.length * np.stack(
        [np.cos(track.heading), np.sin(track.heading)], axis=1
    )
    a, b = lane.stop_line
    span = b - a
    normal = np.array([span[1], -span[0]]) / np.hypot(*span)
    normal *= np.sign(normal @ ahead) or 1.0
    distance = (a - front) @ normal
    share = (front - a) @ span / (span @ span)
    same_way = np.cos(track.heading) * ahead[0] + np.sin(track.heading) * ahead[1]
    return distance, (share > 0.0) & (share < 1.0) & (same_way > 0.5)


# events by the name of their line, each with the name of its recording
LineEvents = dict[str, list[tuple[str, Event]]]


def line_events(recording: Recording) -> LineEvents:
    """Crossings and stands of a recording at every line with signals; possibly none."""
    by_id = {signal.id: signal for signal in recording.signals}
    made: LineEvents = collections.defaultdict(list)
    for lane in recording.lanes:
        signals = tuple(by_id[i] for i in lane.signal_ids if i in by_id)
        if lane.stop_line is None or not signals:
            continue
        events = made[line_name(recording.name, [signal.id for signal in signals])]
        for track in recording.tracks:
            # when the track's front is first over the line
            distance, reach = before_line(track, lane)
            over = (distance[:-1] > 0.0) & (distance[1:] <= 0.0) & reach[1:]
            if over.any():
                time = float(track.t[1:][over][0])
                after = (track.t >= time) & (track.t <= time + TURN_S)
                heading = np.unwrap(track.heading)[after]
                right = bool(heading[0] - heading.min() > RIGHT_RAD)
                event = Event(time=time, crossing=True, right=right, signals=signals)
                events.append((recording.name, event))
        for times in first_stands(recording, lane).values():
            if times[-1] - times[0] >= MIN_STAND_S:
                time = float(np.mean(times))
                event = Event(time=time, crossing=False, right=False, signals=signals)
                events.append((recording.name, event))
    return dict(made)


def first_stands(recording: Recording, lane: Lane) -> dict[int, np.ndarray]:
    """Times [s] at which a track stands first before a lane's line, by its number."""
    nearest: dict[float, tuple[float, int]] = {}
    for number, track in enumerate(recording.tracks):
        distance, reach = before_line(track, lane)
        near = reach & (distance > -OVER_M) & (distance < REACH_M)
        for i in np.flatnonzero(near).tolist():
            time = round(float(track.t[i]), 3)
            found = (float(distance[i]), number)
            nearest[time] = min(nearest.get(time, found), found)
    stands: dict[int, list[float]] = collections.defaultdict(list)
    for time, (_, number) in sorted(nearest.items()):
        track = recording.tracks[number]
        if np.interp(time, track.t, track.speed) < STANDING_MPS:
            stands[number].append(time)
    return {number: np.array(times) for number, times in stands.items()}


# ---------------------------------------------------------------------- phases


def check_events(recorded: Iterable[LineEvents]) -> list[PhaseCheck]:
    """Return one check per line over all recordings, and one of all lines together.

    Lines are the same if their signals' ids are and the recordings' names agree up to
    the last "-", as in CommonRoad's names of places.
    """
    events: LineEvents = collections.defaultdict(list)
    for lines in recorded:
        for name, found in lines.items():
            events[name] += found
    checks = [_check(name, found) for name, found in sorted(events.items())]
    together = [pair for found in events.values() for pair in found]
    return [*checks, _check(TOGETHER, together)]


def check_written(
    parts: Sequence[InputFile], *, executor: Executor | None = None
) -> list[PhaseCheck]:
    """Recorded signals checked against all drivers of the logs, line by line.

    Args:
      parts: of `importers.parts`.
      executor: where they are read; default: this process. Changes no number.

    Raises:
      InputError: logs that cannot be read.
    """
    places = executor or Serial()
    return check_events(places.stream(_line_events, work_units(parts, places.workers)))


def _line_events(unit: WorkUnit) -> Iterator[LineEvents]:
    for _, recording in recordings_in(unit):
        yield line_events(recording)


def _check(name: str, found: Sequence[tuple[str, Event]]) -> PhaseCheck:
    right_turns = sum(event.right for _, event in found)
    found = [(where, event) for where, event in found if not event.right]
    events = [event for _, event in found]
    cycles = [period(s) for event in events for s in event.signals]
    cycle = max((c for c in cycles if c is not None), default=0.0)
    offsets = np.arange(0.0, max(cycle, STEP_S), STEP_S)
    crossings = sum(event.crossing for event in events)
    red = np.array([[e.state(d) == "red" for e in events] for d in offsets])
    red = red.reshape(offsets.size, len(events))
    crosses = np.array([e.crossing for e in events], bool)
    agree = red != crosses
    # of equally good offsets the one nearest to none, either way round
    turn = np.minimum(offsets, cycle - offsets)
    best = int(np.lexsort((turn, -agree.sum(axis=1)))[0])
    p = _p_value(agree, [where for where, _ in found])
    red_written = _share(red[0], crosses)
    if crossings < MIN_CROSSINGS:
        verdict = OPEN[1]
    elif red_written > MAX_RED_RUNNING:
        verdict = REJECTED
    else:
        verdict = CONFIRMED if p <= MAX_P else OPEN[0]
    return PhaseCheck(
        name=name,
        recordings=len({where for where, _ in found}),
        crossings=crossings,
        right_turns=right_turns,
        stands=len(events) - crossings,
        period_s=cycle,
        red_written=red_written,
        stands_red_written=_share(red[0], ~crosses),
        best_offset_s=float(offsets[best]),
        red_best=_share(red[best], crosses),
        p=p,
        verdict=verdict,
    )


def _p_value(agree: np.ndarray, where: Sequence[str]) -> float:
    """Share of random turns, one per recording, as good as the written phase.

    `agree` [offsets, events], the first offset being the written one; `where` [events].
    """
    rng = np.random.default_rng(0)
    names = np.array(where, object)
    total = np.zeros(TURNS)
    for name in dict.fromkeys(where):
        counts = agree[:, names == name].sum(axis=1)
        total += counts[rng.integers(len(agree), size=TURNS)]
    better = np.count_nonzero(total >= agree[0].sum())
    return (1.0 + better) / (1.0 + TURNS)


def _share(values: np.ndarray, among: np.ndarray) -> float:
    return float(np.mean(values[among])) if among.any() else float("nan")


def format_phases(checks: Sequence[PhaseCheck]) -> str:
    """Return the checks as a terminal table."""

    def percent(share: float) -> str:
        return "-" if share != share else f"{100.0 * share:.0f}"

    lines = [
        f"{'signals':<34}{'files':>6}{'cross':>6}{'right':>6}{'stand':>6}{'red,%':>7}"
        f"{'st.red,%':>9}{'best,s':>7}{'red,%':>7}{'p':>6}  verdict"
    ]
    lines += [
        f"{check.name[-33:]:<34}{check.recordings:>6}{check.crossings:>6}"
        f"{check.right_turns:>6}{check.stands:>6}{percent(check.red_written):>7}"
        f"{percent(check.stands_red_written):>9}{check.best_offset_s:>7.0f}"
        f"{percent(check.red_best):>7}{check.p:>6.2f}  {check.verdict}"
        for check in checks
    ]
    return "\n".join(lines)
