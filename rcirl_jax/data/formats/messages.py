"""Drives as messages in the order of recording, in windows: bags and cyber records.

A format turns messages into rows of numbers by role (`Rows`). `Drive` holds them until
the windows that need them are made, and then forgets them, so that the memory that a
drive takes does not grow with its length. The same rows become the ego's track, the
spans in which nobody drove by hand, and the boxes of the others.
"""

import copy
import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Self, TypeVar

import numpy as np

from rcirl_jax.data.formats.options import number, positive, section
from rcirl_jax.data.formats.perception import Boxes, ego_boxes, on_clock, tracks_of
from rcirl_jax.data.formats.tracks import spans_of
from rcirl_jax.data.readers import long_logs
from rcirl_jax.data.recording import MAX_RATE_HZ
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording, Track

RATE_HZ = 10.0  # 1/s, of recordings
MAX_GAP_S = 0.55  # s without a message inside one track
WINDOW_S = 300.0  # s, longest window of a drive
MIN_WINDOW_S = 1.0  # s that it may be; each window costs as much as its surroundings
PIECE_S = 60.0  # s of recording after which rows are handed on
LATE_S = 2.0  # s, messages of one time are recorded within it
MAX_SILENCE_S = 1.0  # s without a message on who drives, after which nobody knows
MAX_DURATION_S = 86400.0  # s, of one drive
MAX_ROWS = 5_000_000  # obstacle states held at once


@dataclasses.dataclass(kw_only=True)
class Rows:
    """A piece of a drive: rows [n, columns] by role, in the order of recording."""

    tables: Mapping[str, np.ndarray]
    notes: list[str] = dataclasses.field(default_factory=list)
    progress: float = 1.0  # share of the drive that is read with them


class Drive:
    """Rows of a drive while it is read: what windows still need of them.

    Times are s since the first place of a road user. A format whose messages are
    stamped by several clocks overrides `stamps`.

    Args:
      path: named in errors.
      widths: role -> number of columns; t [s] is column 0.
      places: roles that say where somebody is, the ego's first.
    """

    stamp_field = "header.stamp"  # named in errors
    driver_role = "driver"  # its last message before a window is in force there

    def __init__(
        self, path: Path, widths: Mapping[str, int], places: Sequence[str]
    ) -> None:
        self.path, self.places = path, places
        self.tables = {role: np.zeros((0, width)) for role, width in widths.items()}
        self.notes: list[str] = []
        self.progress = 0.0  # share of the drive that is read
        self.end = -math.inf  # s, of the last place
        self.start = math.nan  # s, the stamp of the first place; NaN: none yet
        self._since = -math.inf  # s, rows from before it were forgotten

    def stamps(self, role: str) -> np.ndarray:
        """Returns the time [n] s of each row of a role, on the drive's one clock."""
        return self.tables[role][:, 0]

    def clock(self, role: str) -> np.ndarray:
        """Returns the time [n] s of each row since the drive's start."""
        return self.stamps(role) - self.start

    @property
    def in_use(self) -> Sequence[str]:
        """Roles of `places` whose rows become tracks."""
        return self.places

    @property
    def is_cut(self) -> bool:
        """True once rows were forgotten: the clock is settled from then on."""
        return self._since > -math.inf

    @property
    def now(self) -> float:
        """Returns the time [s] that the drive is read up to."""
        return self.end

    def settle(self) -> None:
        """Chooses where the clock starts; called while all rows are held."""
        stamps = np.concatenate([self.stamps(role) for role in self.in_use])
        self.start = float(stamps.min()) if stamps.size else math.nan
        self.end = -math.inf

    def add(self, rows: Rows) -> None:
        """Appends rows that follow.

        Raises:
          InputError: too many, too long a drive, or rows of windows long taken.
        """
        self.tables = {
            role: np.concatenate([table, rows.tables[role]])
            for role, table in self.tables.items()
        }
        self.notes, self.progress = [*self.notes, *rows.notes], rows.progress
        seen = sum(len(self.tables[role]) for role in self.places[1:])
        check_held(str(self.path), seen)
        if not self.is_cut:
            self.settle()
        clock = np.concatenate([self.clock(role) for role in self.in_use])
        if not clock.size:
            return
        first, self.end = float(clock.min()), max(self.end, float(clock.max()))
        last, where = max(self.end, self.now), f"{self.path}: {self.stamp_field}"
        span = last - min(first, 0.0)
        if not span <= MAX_DURATION_S:
            raise InputError(
                f"{where}: {span:g} s from first to last: expected at most "
                f"{MAX_DURATION_S:g} s; several clocks in one drive?"
            )
        if first < self._since:
            raise InputError(
                f"{where}: {first:g} s from the start after {last:g} s: goes "
                "backwards; expected one drive, its files in order"
            )

    def next_place(self, since: float) -> float:
        """Returns the time [s] of the first place from a time on; inf without one."""
        clock = np.concatenate([self.clock(role) for role in self.places])
        return float(np.min(clock, where=clock >= since, initial=math.inf))

    def view(self, low: float, high: float) -> Self:
        """Returns rows from one time [s] to before another, notes since the last."""
        view, self.notes = copy.copy(self), []
        view.tables = {role: self._rows(role, low, high) for role in self.tables}
        return view

    def forget(self, before: float) -> None:
        """Drops rows from before a time [s]."""
        self.tables = {role: self._rows(role, before) for role in self.tables}
        self._since = before

    def _rows(self, role: str, low: float, high: float = math.inf) -> np.ndarray:
        """Rows between two times [s]; a state that was in force at the first, too."""
        table, clock = self.tables[role], self.clock(role)
        kept = (clock >= low) & (clock < high)
        if role == self.driver_role and (clock < low).any():
            kept[np.argmax(np.where(clock < low, clock, -np.inf))] = True
        return table[kept]

    # ------------------------------------------------------- rows become tracks

    def driver_spans(self) -> tuple[tuple[float, float], ...]:
        """Returns when nobody drove by hand, or nothing was said of it.

        The first mode was in force before; () without any message. A row of the role
        "driver" ends with 1 where a human drives.
        """
        clock, by_hand = (
            self.clock(self.driver_role),
            self.tables[self.driver_role][:, -1],
        )
        if not clock.size:
            return ()
        order = np.argsort(clock, kind="stable")
        clock, other = clock[order], by_hand[order] == 0.0
        silent = np.diff(clock, append=np.inf) > MAX_SILENCE_S
        return spans_of(
            np.concatenate([[-np.inf], clock, clock[silent] + MAX_SILENCE_S]),
            np.concatenate([other[:1], other, np.ones(np.count_nonzero(silent), bool)]),
        )

    def driver_notes(self, within: tuple[float, float], mode: str) -> list[str]:
        """Notes how much of the time between two [s] is not driven in a mode."""
        clock, by_hand = (
            self.clock(self.driver_role),
            self.tables[self.driver_role][:, -1],
        )
        inside = by_hand[(clock >= within[0]) & (clock < within[1])]
        share = 1.0 - float(np.mean(inside)) if inside.size else 0.0
        words = f"{share:.0%} of the time not {mode}: the ego is no human there"
        return [words] if share > 0.0 else []

    def ego_tracks(
        self,
        spec: Mapping,
        car: Mapping[str, float],
        poses: np.ndarray,
        velocity: tuple[np.ndarray, np.ndarray],
        automated: tuple[tuple[float, float], ...],
    ) -> list[Track]:
        """Makes the recording car's track, moved from its rear axle to its centre.

        Args:
          spec: source TOML.
          car: its usual measures, see `ego_boxes`.
          poses: [n, 4] x, y, heading, speed at `clock` of the first role.
          velocity: times [m] s and speeds [m] m/s that were measured apart from poses.
          automated: of the track.
        """
        t, (x, y, heading, speed) = self.clock(self.places[0]), poses.T
        lost, known = ~np.isfinite(speed), np.isfinite(velocity[1])
        if lost.any() and np.count_nonzero(known) > 1:
            clock, measured = velocity[0][known], velocity[1][known]
            order = np.argsort(clock, kind="stable")
            measured = np.interp(t, clock[order], measured[order])
            speed = np.where(lost, measured, speed)
        boxes = ego_boxes(spec, car, t, x, y, heading, speed)
        return self.tracks(boxes, spec, automated)[0]

    def tracks(
        self,
        boxes: Boxes,
        spec: Mapping,
        automated: tuple[tuple[float, float], ...] = (),
    ) -> tuple[list[Track], list[str]]:
        """Puts boxes onto the recording's clock; returns their tracks, with notes."""
        boxes = on_clock(boxes, clock_rate(spec), MAX_GAP_S)
        unknown = str(spec.get("unknown", "auto"))
        return tracks_of(self.path, boxes, MAX_GAP_S, unknown, automated)


SomeDrive = TypeVar("SomeDrive", bound=Drive)


def drive_windows(
    drive: SomeDrive,
    batches: Iterable[Rows],
    windows: "Windows",
    window: float,
    make: Callable[[SomeDrive, tuple[float, float]], Recording | None],
) -> Iterator[Recording]:
    """Makes recordings of a drive, each once what it needs is read.

    Args:
      drive: without rows.
      batches: rows in the order of recording.
      windows: names and numbers the windows of a long drive.
      window: s, the longest; a drive that is not longer is one recording.
      make: view and the times [s] that scenes begin within -> a recording; None:
        nobody is there.
    """
    number = 0

    def take(low: float, high: float) -> Iterator[Recording]:
        made = make(drive.view(*around((low, high))), (low, high))
        if made is not None:
            yield windows.recording(made, number, (low, high), drive.progress)

    def following(last: float) -> int:
        """Returns the next window near a place, or else the one at a time [s]."""
        gap = windows.max_gap_s
        near = drive.next_place((number + 1) * window - gap) - gap
        return max(number + 1, math.floor(min(near, last) / window))

    _, needed = around((0.0, 0.0))  # s of what comes after a window
    for rows in batches:
        drive.add(rows)
        while drive.now > (number + 1) * window + needed + LATE_S:
            yield from take(number * window, (number + 1) * window)
            number = following(drive.now - LATE_S - needed)
            drive.forget(around((number * window, 0.0))[0])
    if number == 0 and drive.end <= window:
        whole = (-math.inf, math.inf)
        made = make(drive.view(*whole), whole)
        yield from [] if made is None else [made]
        return
    while (low := number * window) < drive.end:
        is_last = drive.end <= low + window
        yield from take(low, drive.end + 1.0 if is_last else low + window)
        number = following(drive.end)


def longest_window(spec: Mapping) -> float:
    """Returns the option `window_s` of a source TOML, s."""
    window = number(spec, "window_s", WINDOW_S)
    if window < MIN_WINDOW_S:
        raise InputError(
            f"source TOML: window_s: {window:g}: expected at least {MIN_WINDOW_S:g} s"
        )
    return window


def around(within: tuple[float, float]) -> tuple[float, float]:
    """Returns the times [s] that a window's scenes need: with history and future."""
    low, high = within
    return low - long_logs.BEFORE_S, high + long_logs.AFTER_S


class Windows:
    """Windows of one long drive: each road user has one name in all of them.

    Args:
      drive: its name.
      group: vehicle-disjoint group of all its windows.
      max_gap_s: a road user unseen for longer is another track.
    """

    def __init__(self, drive: str, group: str, max_gap_s: float = MAX_GAP_S) -> None:
        self.drive, self.group, self.max_gap_s = drive, group, max_gap_s
        self._starts: dict[str, list[float]] = {}  # s, first seen, and after gaps
        self._last: dict[str, float] = {}  # s

    def recording(
        self, made: Recording, number: int, within: tuple[float, float], progress: float
    ) -> Recording:
        """Makes a window a part of the drive; windows come in the order of time.

        Args:
          made: with `around(within)`, in seconds of the drive.
          number: of the window.
          within: s, when its scenes begin.
          progress: share of the input read with it.
        """
        for track in made.tracks:
            user, first = track.id.partition("#")[0], float(track.t[0])
            last = self._last.get(user, -np.inf)
            if first - last > self.max_gap_s:
                self._starts.setdefault(user, []).append(first)
            self._last[user] = max(last, float(track.t[-1]))
        part = long_logs.TimeSlice(
            number=number,
            values={},
            within=within,
            fragments=self._starts,
            progress=progress,
        )
        name = f"{self.drive}-{number:03d}"
        made = dataclasses.replace(made, name=name, group=self.group)
        return part.of_log(self.drive, made)


def check_held(where: str, count: int) -> None:
    """Checks that no more obstacle states than MAX_ROWS are held."""
    if count > MAX_ROWS:
        raise InputError(
            f"{where}: more than {MAX_ROWS} obstacle states in a few minutes: "
            "expected one drive"
        )


def topics_of(
    spec: Mapping, usual: Mapping[str, Sequence[str]]
) -> dict[str, list[str]]:
    """Returns role -> names of topics: those of the option `topics`, else usual ones.

    Raises:
      InputError: a role that is not among the usual ones, or no list of names.
    """
    found = {}
    for role, given in {**usual, **section(spec, "topics")}.items():
        every = [given] if isinstance(given, str) else given
        if role not in usual:
            raise InputError(
                f"source TOML: topics.{role}: unknown: expected {', '.join(usual)}"
            )
        if not isinstance(every, list | tuple) or not {*map(type, every)} <= {str}:
            raise InputError(
                f"source TOML: topics.{role}: {given}: expected a topic or a list"
            )
        found[role] = [*every]
    return found


def is_anybody(tracks: Iterable[Track], within: tuple[float, float]) -> bool:
    """True if a road user is there between two times [s]."""
    return any(t.t[0] < within[1] and t.t[-1] >= within[0] for t in tracks)


def no_tracks(first: Path, spec: Mapping) -> InputError:
    """Makes the error of a drive of which no window has a track."""
    return InputError(
        f"{first}: tracks: none on a clock of {clock_rate(spec):g} Hz: expected a "
        "longer drive"
    )


def clock_rate(spec: Mapping) -> float:
    """Returns the option `rate_hz` [1/s] of recordings that are put onto a clock."""
    rate = positive(spec, "rate_hz", RATE_HZ)
    if rate > MAX_RATE_HZ:
        raise InputError(
            f"source TOML: rate_hz: {rate:g}: expected at most {MAX_RATE_HZ:g}"
        )
    return rate
