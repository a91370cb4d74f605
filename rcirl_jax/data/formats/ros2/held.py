"""Rows of a drive while its bag is read: what windows still need of them.

Times are those of the headers' stamps, in s since the drive's first place of the ego
or of an obstacle.
"""

import copy
import math
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.messages import between, check_held, check_span
from rcirl_jax.data.formats.ros2.messages import Rows
from rcirl_jax.data.formats.ros2.readings import COLUMNS

PLACES = ("ego", "obstacles")  # roles that say where somebody is


class Held:
    """Rows of a drive by role, t in column 0."""

    def __init__(self, path: Path) -> None:
        """Holds nothing; `path` is named in errors."""
        self.path = path
        self.tables = {role: np.zeros((0, len(COLUMNS[role]))) for role in COLUMNS}
        self.names: dict[str, int] = {}  # of obstacles, with their numbers
        self.notes: list[str] = []
        self.progress = 0.0  # share of the bag's bytes that is read
        self.end = -math.inf  # s, of the last place
        self.has_ego = False  # whether any of them is the ego's
        self._start: float | None = None  # s, the stamp that is 0 here
        self._since = -math.inf  # s, rows from before it were forgotten

    @property
    def now(self) -> float:
        """Time [s] that the bag is read up to."""
        return self.end

    def next_place(self, since: float) -> float:
        """Time [s] of the first place held from a time on; inf without one."""
        clock = np.concatenate([self.tables[role][:, 0] for role in PLACES])
        return float(np.min(clock, where=clock >= since, initial=math.inf))

    def add(self, rows: Rows) -> None:
        """Rows that follow.

        Raises:
          InputError: too many, too long a drive, or rows of windows long taken.
        """
        new = {role: rows.table(role) for role in COLUMNS}
        clock = np.concatenate([new[role][:, 0] for role in PLACES])
        if self._start is None and clock.size:
            self._start = float(clock.min())
            for role, table in self.tables.items():  # of before the first place
                self.tables[role] = self._shifted(table)
        for role, table in new.items():
            table = table if self._start is None else self._shifted(table)
            self.tables[role] = np.concatenate([self.tables[role], table])
        self.names, self.progress = rows.names, rows.progress
        self.notes += rows.notes
        self.has_ego = self.has_ego or len(new["ego"]) > 0
        check_held(str(self.path), len(self.tables["obstacles"]))
        if clock.size and self._start is not None:
            first, last = clock.min() - self._start, clock.max() - self._start
            self.end = max(self.end, last)
            check_span(f"{self.path}: header.stamp", first, self.end, self._since)

    def _shifted(self, table: np.ndarray) -> np.ndarray:
        return table - np.array([self._start, *[0.0] * (table.shape[1] - 1)])

    def view(self, low: float, high: float) -> "Held":
        """Rows from one time [s] to before another, and the notes since the last."""
        view = copy.copy(self)
        self.notes = []
        view.tables = {role: self._rows(role, low, high) for role in self.tables}
        return view

    def forget(self, before: float) -> None:
        """Drop rows from before a time [s]."""
        self.tables = {role: self._rows(role, before) for role in self.tables}
        self._since = before

    def _rows(self, role: str, low: float, high: float = math.inf) -> np.ndarray:
        """Rows between two times [s]; who drove at the first is known from before."""
        table = self.tables[role]
        return table[between(table[:, 0], low, high, is_state=role == "driver")]
