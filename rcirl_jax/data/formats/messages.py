"""Drives as messages in the order of recording, in windows: bags and cyber records.

A format's subclass of `Drive` turns messages into rows of numbers by role. They are
held until the windows that need them are made, and then forgotten, so that the memory
that a drive takes does not grow with its length. The same rows become the ego's track,
the spans in which nobody drove by hand, and the tracks of the others.
"""

import abc
import array
import copy
import dataclasses
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from rcirl_jax.data.formats.options import number, positive, recording_car, section
from rcirl_jax.data.formats.perception import (
    Boxes,
    ego_boxes,
    fitted_lanes,
    on_clock,
    placed,
    tracks_of,
)
from rcirl_jax.data.formats.shapes import check_coordinates, origin_notes
from rcirl_jax.data.formats.tracks import spans_of, travel_heading
from rcirl_jax.data.readers import long_logs
from rcirl_jax.data.recording import MAX_RATE_HZ, validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording, Track

MAX_GAP_S = 0.55  # s without a message inside one track
MIN_WINDOW_S = 1.0  # s that it may be; each window costs as much as its surroundings
PIECE_S = 60.0  # s of recording after which rows are looked at
LATE_S = 2.0  # s, messages of one time are recorded within it
MAX_SILENCE_S = 1.0  # s without a message on who drives, after which nobody knows
MAX_DURATION_S = 86400.0  # s, of one drive
MAX_ROWS = 5_000_000  # obstacle states held at once

Row = tuple[float, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Window:
    """The surroundings that a window's lanes and lights are made for."""

    tracks: Sequence[Track]  # around the origin
    within: tuple[float, float]  # s, when scenes begin
    # x, y [n] m of all samples, and the origin [2] m
    places: tuple[np.ndarray, np.ndarray, np.ndarray]


class Drive(abc.ABC):
    """One drive: rows by role while windows still need them, and its recordings.

    Column 0 of a row is its time [s] by the message's stamp. Besides it has a row of
    role "ego": x, y [m], heading [rad], speed [m/s], NaN where it is not known; of
    "velocity": speed [m/s]; of "driver": 1 where a human drives; of obstacles: number,
    x, y [m], heading [rad], speed [m/s], length, width [m], kind. More columns may
    follow, and other roles. Windows of one drive are one vehicle-disjoint group.
    """

    widths: ClassVar[Mapping[str, int]]  # role -> number of columns
    obstacles: ClassVar[Sequence[str]] = ("obstacles",)  # the first with rows counts
    stamp_field = "header.stamp"  # named in errors
    by_hand = "driven by hand"  # named in notes
    has_no_map = "no map given"

    def __init__(self, path: Path, spec: dict, name: str, group: str = "") -> None:
        self.path, self.spec, self.name = path, spec, name
        self.group = group or name
        self.tables = {role: np.zeros((0, n)) for role, n in self.widths.items()}
        self.notes: list[str] = []  # of what was read since the last window
        self.progress = 0.0  # share of the drive that is read
        self.end = -math.inf  # s, of the last place
        self.start = math.nan  # s, the stamp of the first place; NaN: none yet
        self._since = -math.inf  # s, rows from before it were forgotten
        self._new = {role: array.array("d") for role in self.widths}

    # ---------------------------------------------------------- what formats say

    @abc.abstractmethod
    def rows(self) -> Iterator[tuple[str, float, float, Row]]:
        """Yields (role, s of recording, share of the drive that is read, row)."""

    def stamps(self, role: str) -> np.ndarray:
        """Returns the time [n] s of each row of a role, on the drive's one clock."""
        return self.tables[role][:, 0]

    def settle(self) -> None:
        """Chooses where the clock starts; called while all rows are held."""
        stamps = np.concatenate([self.stamps(role) for role in self.in_use])
        self.start = float(stamps.min()) if stamps.size else math.nan
        self.end = -math.inf

    @property
    def now(self) -> float:
        """Returns the time [s] that the drive is read up to."""
        return self.end

    def name_of(self, number: int) -> str:
        """Returns the name of the obstacle with a number."""
        return str(number)

    def selected(self, table: np.ndarray) -> tuple[np.ndarray, list[str]]:
        """Returns the obstacles [n, columns] that become tracks, times by `clock`."""
        return table, []

    def surroundings(self, window: "Window") -> tuple[dict[str, Any], list[str]]:
        """Makes fields of the recording besides its tracks, with notes."""
        lanes, note = fitted_lanes(window.tracks, self.spec)
        return {"lanes": lanes}, [f"{self.has_no_map}; {note}"]

    # --------------------------------------------------------------- rows, clock

    @property
    def in_use(self) -> tuple[str, str]:
        """Roles whose rows become tracks: the ego's, that of the obstacles."""
        met = [role for role in self.obstacles if len(self.tables[role])]
        return "ego", [*met, self.obstacles[-1]][0]

    def clock(self, role: str) -> np.ndarray:
        """Returns the time [n] s of each row since the drive's start."""
        return self.stamps(role) - self.start

    def _pieces(self) -> Iterator[None]:
        """Takes rows in, a minute at a time, and tells when one is over."""
        began = None
        for role, recorded, share, row in self.rows():
            began = recorded if began is None else began
            if abs(recorded - began) > PIECE_S:
                self._take_in()
                yield
                began = recorded
            self.progress = share
            values = self._new[role]
            values.extend(row)
            if len(values) > MAX_ROWS * len(row):
                break  # that they are too many is said as they are taken in
        self._take_in()
        yield

    def _take_in(self) -> None:
        """Appends the rows that are new."""
        for role, values in self._new.items():
            rows = np.array(values).reshape(-1, self.widths[role])
            self.tables[role] = np.concatenate([self.tables[role], rows])
            self._new[role] = array.array("d")
        if any(len(self.tables[role]) > MAX_ROWS for role in self.tables):
            raise InputError(
                f"{self.path}: more than {MAX_ROWS} obstacle states in a few minutes: "
                "expected one drive"
            )
        if self._since == -math.inf:
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

    def _tables(self, low: float, high: float) -> dict[str, np.ndarray]:
        """Rows by role between two times [s]."""
        return {
            role: table[self.between(role, low, high)]
            for role, table in self.tables.items()
        }

    def between(self, role: str, low: float, high: float) -> np.ndarray:
        """Returns which rows [n] of a role count between two times [s]."""
        clock = self.clock(role)
        kept = (clock >= low) & (clock < high)
        if role == "driver" and (clock < low).any():  # the mode then in force
            kept[np.argmax(np.where(clock < low, clock, -np.inf))] = True
        return kept

    # ------------------------------------------------------------------- windows

    def recordings(self) -> Iterator[Recording]:
        """Yields the drive's recording, or each window's once what it needs is read."""
        found = False
        for made in self._windows():
            found = True
            yield validate_recording(made, self.path)
        if not found:
            what = f"tracks: none on a clock of {clock_rate(self.spec):g} Hz"
            expected = "a longer drive"
            if math.isnan(self.start):
                what, expected = "no places of the ego, nor obstacles", "one of them"
            raise InputError(f"{self.path}: {what}: expected {expected}")

    def _windows(self) -> Iterator[Recording]:
        number, window = 0, longest_window(self.spec)
        needed = long_logs.AFTER_S + LATE_S  # s of what comes after a window
        windows = Windows(self.name, self.group)

        def take(high: float) -> Iterator[Recording]:
            """The window up to a time [s], if anybody is there."""
            within = (number * window, high)
            if (made := self._recording(within, around(within))) is not None:
                yield windows.recording(made, number, within, self.progress)

        def following(last: float) -> int:
            """The next window near a place, or else the one at a time [s]."""
            places = ("ego", *self.obstacles)
            clock = np.concatenate([self.clock(role) for role in places])
            since = (number + 1) * window - MAX_GAP_S
            near = float(np.min(clock, where=clock >= since, initial=math.inf))
            near = min(near - MAX_GAP_S, last)
            return max(number + 1, math.floor(near / window))

        for _ in self._pieces():
            while self.now > (number + 1) * window + needed:
                yield from take((number + 1) * window)
                number = following(self.now - needed)
                self._since = around((number * window, 0.0))[0]
                self.tables = self._tables(self._since, math.inf)
        if number == 0 and self.end <= window:
            made = self._recording(*[(-math.inf, math.inf)] * 2)
            yield from [] if made is None else [made]
            return
        while number * window < self.end:
            high = (number + 1) * window
            yield from take(self.end + 1.0 if self.end <= high else high)
            number = following(self.end)

    def _recording(
        self, within: tuple[float, float], held: tuple[float, float]
    ) -> Recording | None:
        """The recording of the rows held; None: nobody is there. Times in s."""
        view, self.notes = copy.copy(self), []
        view.tables = self._tables(*held)
        return view.recording(within)

    def recording(self, within: tuple[float, float]) -> Recording | None:
        """Makes the recording of all rows; its scenes begin within two times [s]."""
        spec, (others, notes) = self.spec, self._others()
        tracks = [*self._ego(), *others]
        if not any(t.t[0] < within[1] and t.t[-1] >= within[0] for t in tracks):
            return None
        x, y, origin, tracks = placed(tracks)
        window = Window(tracks=tracks, within=within, places=(x, y, origin))
        fields, more = self.surroundings(window)
        clock, by_hand = self.clock("driver"), self.tables["driver"][:, 1]
        inside = by_hand[(clock >= within[0]) & (clock < within[1])]
        if inside.size and not inside.all():
            share = f"{1.0 - float(np.mean(inside)):.0%} of the time"
            notes = [f"{share} not {self.by_hand}: the ego is no human there", *notes]
        if not len(self.tables[self.in_use[1]]):
            notes = ["no obstacles recorded; the ego is alone", *notes]
        if not len(self.tables["ego"]):
            notes = ["no places of the ego recorded; no ego track", *notes]
        return Recording(
            name=self.name,
            source=spec["source"],
            licence=spec["licence"],
            rate_hz=clock_rate(spec),
            start_s=self.start,
            origin=(float(origin[0]), float(origin[1])),
            default_speed_limit=positive(spec, "speed_limit"),
            notes=(*self.notes, *notes, *origin_notes(origin), *more),
            **{"tracks": tuple(tracks), **fields},
        )

    # ------------------------------------------------------- rows become tracks

    def _ego(self) -> list[Track]:
        """The recording car's track, moved from its rear axle to its centre."""
        t, (x, y, heading, speed) = self.clock("ego"), self.tables["ego"][:, 1:5].T
        poses = np.stack([x, y, heading], axis=1)
        check_coordinates(self.path, "ego", ("x", "y", "heading"), poses)
        clock, measured = self.clock("velocity"), self.tables["velocity"][:, 1]
        lost, known = ~np.isfinite(speed), np.isfinite(measured)
        if lost.any() and np.count_nonzero(known) > 1:  # measured apart from the poses
            order = np.flatnonzero(known)[np.argsort(clock[known], kind="stable")]
            measured = np.interp(t, clock[order], measured[order])
            speed = np.where(lost, measured, speed)
        boxes = ego_boxes(self.spec, t, x, y, heading, speed)
        return self._tracks(boxes, self._driver_spans())[0]

    def _driver_spans(self) -> tuple[tuple[float, float], ...]:
        """Returns the intervals without manual driving, or of unknown mode.

        The first mode was in force before; without any the source TOML says who drove.
        """
        clock, by_hand = self.clock("driver"), self.tables["driver"][:, 1]
        if not clock.size:
            return recording_car(self.spec)
        order = np.argsort(clock, kind="stable")
        clock, other = clock[order], by_hand[order] == 0.0
        silent = np.diff(clock, append=np.inf) > MAX_SILENCE_S
        return spans_of(
            np.concatenate([[-np.inf], clock, clock[silent] + MAX_SILENCE_S]),
            np.concatenate([other[:1], other, np.ones(np.count_nonzero(silent), bool)]),
        )

    def _others(self) -> tuple[list[Track], list[str]]:
        """Tracks of the obstacles, and notes on what was left out.

        A heading that is not known is the direction of travel.
        """
        role = self.in_use[1]
        table = self.tables[role].copy()
        table[:, 0] = self.clock(role)
        table, notes = self.selected(table)
        check_coordinates(self.path, "obstacles", ("x", "y"), table[:, 2:4])
        numbers, ids = np.unique(table[:, 1].astype(np.int64), return_inverse=True)
        t, _, x, y, heading, speed, length, width, kind = table[:, :9].T
        for user in np.unique(ids[np.isnan(heading)]):
            mine = np.flatnonzero(ids == user)
            mine = mine[np.argsort(t[mine], kind="stable")]
            travel = travel_heading(t[mine], x[mine], y[mine])
            heading[mine] = np.where(np.isnan(heading[mine]), travel, heading[mine])
        names, kinds = [self.name_of(n) for n in numbers.tolist()], kind.astype(int)
        boxes = Boxes(ids, names, t, x, y, heading, speed, length, width, kinds)
        tracks, left_out = self._tracks(boxes)
        return tracks, [*notes, *left_out]

    def _tracks(
        self, boxes: Boxes, automated: tuple[tuple[float, float], ...] = ()
    ) -> tuple[list[Track], list[str]]:
        """Tracks of boxes on the recording's clock, with notes."""
        boxes = on_clock(boxes, clock_rate(self.spec), MAX_GAP_S)
        return tracks_of(self.path, boxes, MAX_GAP_S, self.spec["unknown"], automated)


def longest_window(spec: Mapping) -> float:
    """Returns the option `window_s` of a source TOML, s."""
    window = number(spec, "window_s")
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
    """Windows of one long drive: each road user has one name in all of them."""

    def __init__(self, drive: str, group: str) -> None:
        self.drive, self.group = drive, group
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
            if first - self._last.get(user, -np.inf) > MAX_GAP_S:
                self._starts.setdefault(user, []).append(first)
            self._last[user] = max(self._last.get(user, -np.inf), float(track.t[-1]))
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


def topics_of(spec: Mapping, known: Collection[str]) -> dict[str, list[str]]:
    """Returns role -> names of topics of the option `topics`.

    Raises:
      InputError: a role that is not known, or no list of names.
    """
    found = {}
    for role, given in section(spec, "topics").items():
        every = [given] if isinstance(given, str) else given
        if role not in known:
            raise InputError(
                f"source TOML: topics.{role}: unknown: expected {', '.join(known)}"
            )
        if not isinstance(every, list | tuple) or not {*map(type, every)} <= {str}:
            raise InputError(
                f"source TOML: topics.{role}: {given}: expected a topic or a list"
            )
        found[role] = [*every]
    return found


def clock_rate(spec: Mapping) -> float:
    """Returns the option `rate_hz` [1/s] of recordings that are put onto a clock."""
    rate = positive(spec, "rate_hz")
    if rate > MAX_RATE_HZ:
        raise InputError(
            f"source TOML: rate_hz: {rate:g}: expected at most {MAX_RATE_HZ:g}"
        )
    return rate
