"""Rows of an Apollo drive while its parts are read: what windows still need of them.

All times here are of one clock: of measurement, or of recording where topics are
stamped on different clocks; s since the drive's first position.
"""

import copy
import math
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.apollo.messages import OBSTACLES, TOPICS, Rows
from rcirl_jax.data.formats.messages import between, check_held, check_span

CLOCK_TOLERANCE_S = 1.0  # s, two topics' clocks differ by more: not one clock
REPEAT_S = 1.5  # s; Apollo sends the routing in force again every second
# topics whose rows are held; the others are routings
HELD = ("localization", "chassis", *OBSTACLES)

Leg = tuple[float, tuple[float, float] | None]  # s, from when on; destination, m


class Held:
    """Rows of a drive, put onto one clock."""

    def __init__(self, path: Path) -> None:
        """Holds nothing; `path` is named in errors."""
        self.path = path
        self.tables = {name: np.zeros((0, TOPICS[name].width)) for name in HELD}
        self.notes: list[str] = []
        self.progress = 0.0  # share of the drive's bytes that is read
        self.is_empty = True  # no position until now
        self.end = -math.inf  # s, last position
        self._routing: list[tuple[float, float, float]] = []
        self._since = -math.inf  # s, rows from before it were forgotten
        self._start = 0.0  # s, what the clock shows at the first position
        self._offset = 0.0  # s, what it shows less the time of recording
        self._is_one_clock = True

    @property
    def key(self) -> str:
        """The topic of the obstacles."""
        return "perception" if len(self.tables["perception"]) else "prediction"

    @property
    def now(self) -> float:
        """Time [s] at which the last position was recorded; -inf without any held."""
        tables = [self.tables[name] for name in ("localization", self.key)]
        recorded = [table[-1, 1] for table in tables if len(table)]
        return max(recorded, default=-math.inf) + self._offset - self._start

    def next_place(self, since: float) -> float:
        """Time [s] of the first position held from a time on; inf without one."""
        clocks = [self.clock(name) for name in HELD if name != "chassis"]
        clock = np.concatenate(clocks)
        return float(np.min(clock, where=clock >= since, initial=math.inf))

    def add(self, rows: Rows) -> None:
        """Rows that follow.

        Raises:
          InputError: too many, too long a drive, or rows of windows long taken.
        """
        for topic, table in rows.tables:
            if topic in HELD:
                self.tables[topic] = np.concatenate([self.tables[topic], table])
                continue
            for time, x, y in table.tolist():
                if not self._routing or (x, y) != self._routing[-1][1:]:
                    self._routing.append((time, x, y))
        check_held(str(self.path), sum(len(self.tables[name]) for name in OBSTACLES))
        self.notes += rows.notes
        self.progress = rows.progress
        if self._since == -math.inf:
            self._settle()
        clock = np.concatenate([self.clock(n) for n in ("localization", self.key)])
        if clock.size:
            self.end = max(self.end, float(clock.max()))
            last = max(self.end, self.now)
            where = f"{self.path}: timestamp_sec"
            check_span(where, float(clock.min()), last, self._since)

    def _settle(self) -> None:
        """Choose the clock, and where it starts."""
        self.end = -math.inf  # all rows are held still
        names = ("localization", self.key)
        tables = [self.tables[name] for name in (*names, "chassis")]
        offsets = [float(np.median(t[:, 0] - t[:, 1])) for t in tables if len(t)]
        if offsets:
            apart = max(offsets) - min(offsets)
            self._is_one_clock = apart <= CLOCK_TOLERANCE_S
        clock = np.concatenate([self._shown(name) for name in names])
        recorded = np.concatenate([self.tables[name][:, 1] for name in names])
        if clock.size:
            self.is_empty = False
            self._start = float(clock.min())
            self._offset = float(np.median(clock - recorded))

    def _shown(self, name: str) -> np.ndarray:
        """What the clock shows [s] at each row of a topic."""
        table = self.tables[name]
        if not self._is_one_clock:
            return table[:, 1]
        own = table[:, 0 if name == "chassis" else 2]
        near = np.abs(own - table[:, 0]) <= CLOCK_TOLERANCE_S
        return np.where(near, own, table[:, 0])

    def clock(self, name: str) -> np.ndarray:
        """Time [s] of each row of a topic."""
        return self._shown(name) - self._start

    def view(self, low: float, high: float) -> "Held":
        """Rows from one time [s] to before another, and the notes since the last."""
        view = copy.copy(self)
        view.tables = {name: self._rows(name, low, high) for name in self.tables}
        self.notes = []
        if self._since == -math.inf and not self._is_one_clock:
            note = "topics stamped on different clocks; times of recording used"
            view.notes = [*view.notes, note]
        return view

    def forget(self, before: float) -> None:
        """Drop rows from before a time [s]; the clock is settled from then on."""
        self.tables = {name: self._rows(name, before) for name in self.tables}
        self._since = before

    def _rows(self, name: str, low: float, high: float = math.inf) -> np.ndarray:
        """Rows between two times [s], the chassis' in force at the first included."""
        kept = between(self.clock(name), low, high, is_state=name == "chassis")
        return self.tables[name][kept]

    def legs(self) -> list[Leg]:
        """Destinations in the order of time, the first valid from the beginning.

        A routing that came within REPEAT_S of the start was in force before.
        """
        legs: list[Leg] = [(-math.inf, None)]
        for time, x, y in sorted(self._routing):
            if (x, y) != legs[-1][1]:
                legs.append((time + self._offset - self._start, (x, y)))
        while len(legs) > 1 and legs[1][0] <= (REPEAT_S if legs[0][1] is None else 0.0):
            legs[:2] = [(-math.inf, legs[1][1])]
        return legs
