"""Counts a table's rows, and drops those that cannot be true.

A row is dropped if it cannot be read, repeats another, or puts a road user in two
places at once or far from its track. `RowStats` counts them, and refuses a file of too
many.
"""

import collections
import dataclasses
from collections.abc import Callable, Container, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording, RowCounts

Rows = dict[str, np.ndarray]  # field -> [n]
Distance = Callable[[np.ndarray, np.ndarray], np.ndarray]  # dx, dy -> m, [n] each
LINE = "line"  # column: of each row in the file; the number of the row in Parquet
NOTES = {
    "unreadable": "unreadable rows dropped; first: {first}",
    "repeated": "rows met twice, used once",  # wherever they stand
    "doubled": "rows of a road user twice in one frame, one used; first: {first}",
}
MAX_BAD_ROWS = 0.01  # share of rows that may be dropped; the option of this name
FASTEST_MPS = 100.0  # m/s; nobody covers a distance faster
FAR_M = 25.0  # m; nearer than this positions may just be inaccurate
SPIKE_ROWS = 3  # of one road user far from all its others: no place, but an error
MOST_FAR = 0.5  # share of far steps; of more the unit is wrong, which is found later
DAY_S = 86400.0  # s
NEAR_S = 60.0  # s; a recording over midnight has rows this near to it on both sides


class NoRowsError(InputError):
    """A table has a header and no rows: of a log, nobody drove."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path}: rows: none: expected rows below the header")
        self.path = path


@dataclasses.dataclass
class RowStats:
    """Counts of the rows of one file: read, and dropped for which reason."""

    path: Path
    unit: str = "line"  # what rows are counted by
    allowed: float = MAX_BAD_ROWS  # share of bad rows
    # whether rows that repeat another are bad; a release is known for them
    repeats_are_bad: bool = True
    read: int = 0
    unreadable: int = 0  # a cell that cannot be read, or a needed one that is empty
    repeated: int = 0  # equal to another in everything that is read
    doubled: int = 0  # a road user that is met twice in one frame
    first: str = ""  # what is wrong with the first bad row
    firsts: dict[str, str] = dataclasses.field(default_factory=dict)  # of `news`
    reported: dict[str, int] = dataclasses.field(default_factory=dict)

    def drop(self, why: str, first: str, count: int = 1) -> None:
        """Counts dropped rows; `first` says what is wrong with the first of them."""
        self.firsts.setdefault(why, first)
        if why != "repeated" or self.repeats_are_bad:
            self.first = self.first or first
        setattr(self, why, getattr(self, why) + count)

    def check(self) -> None:
        """Raises: InputError: no rows, or more bad ones than are allowed."""
        bad = self.unreadable + self.doubled + self.repeated * self.repeats_are_bad
        if self.read == 0:
            raise NoRowsError(self.path)
        if bad > self.allowed * self.read or bad == self.read:
            raise InputError(
                f"{self.path}: {self.first}; {bad} of {self.read} rows are bad: "
                f"expected up to {100.0 * self.allowed:g} % (max_bad_rows of the TOML)"
            )

    def news(self) -> tuple[collections.Counter[str], list[str]]:
        """Returns what was counted since the last call, also as notes."""
        counts = {name: getattr(self, name) for name in ("read", *NOTES)}
        since = collections.Counter(counts)
        since.subtract(self.reported)
        self.reported = counts
        notes = [
            f"{since[why]} {what.format(first=self.firsts.pop(why))}"
            for why, what in NOTES.items()
            if since[why]
        ]
        return since, notes


def attach_row_stats(made: Recording, *files: RowStats) -> Recording:
    """Adds to a recording what became of its files' rows since the one before it."""
    counts, notes = collections.Counter[str](), [*made.notes]
    for stats in files:
        since, dropped = stats.news()
        counts.update(since)
        notes += dropped
    return dataclasses.replace(made, rows=RowCounts(**counts), notes=tuple(notes))


def allowed_share(spec: Mapping) -> float:
    """Returns the option `max_bad_rows` of a source TOML."""
    value = float(spec.get("max_bad_rows", MAX_BAD_ROWS))
    if not 0.0 <= value < 1.0:
        raise InputError(
            f"source TOML: max_bad_rows: {value:g}: expected a share from 0 to below 1"
        )
    return value


def drop_duplicates(
    rows: Rows,
    stats: RowStats,
    *,
    t: str = "t",
    user: str | None = "id",
    places: Sequence[str] = ("x", "y"),
    may_differ: Container[str] = (),
    name_of: Callable[[Any], str] = str,
) -> Rows:
    """Returns the rows of a table in which each road user is met once in a frame.

    Of rows that are equal in everything that was read the first is kept. Of others
    with one id and time, that which continues the track: the nearest to where the
    road user was before (else: is after). Both are counted.

    Args:
      rows: columns [n] that were read, `line` among them.
      stats: of the file.
      t: name of the clock's column.
      user: name of that of the road users; None: a row is of all of them.
      places: names of the positions; one that is not there is 0.
      may_differ: columns in which rows that repeat each other may differ.
      name_of: an id as the file has it.

    Raises:
      InputError: more rows than are allowed.
    """
    clock = rows[t]
    ids = np.zeros(clock.size) if user is None else rows[user]
    codes = ids if ids.dtype.kind == "f" else np.unique(ids, return_inverse=True)[1]

    def is_again(order: np.ndarray) -> np.ndarray:
        """True for each later row of the user and frame of the one before."""
        return (np.diff(codes[order]) == 0) & (np.diff(clock[order]) == 0.0)

    def drop(why: str, found: np.ndarray, what: str) -> None:
        if found.size:
            row = found.min()
            line = f"{stats.unit} {rows[LINE][row]:.0f}: id {name_of(ids[row])}"
            stats.drop(why, f"{line}: {what}", found.size)

    kept = np.ones(clock.size, bool)
    order = np.lexsort((clock, codes))  # stable: the file's order inside
    same = is_again(order)
    if not same.any():
        return rows
    shared = order[np.append(same, False) | np.append(False, same)]
    columns = [
        np.unique(rows[name][shared], return_inverse=True)[1]
        for name in rows
        if name != LINE and name not in may_differ
    ]
    columns += [clock[shared], codes[shared]]
    inner = np.lexsort((shared, *columns))
    equal = np.all([np.diff(column[inner]) == 0 for column in columns], axis=0)
    repeats = shared[inner[1:][equal]]
    kept[repeats] = False
    drop("repeated", repeats, "the same row again")
    order = order[kept[order]]
    same = is_again(order)
    drop("doubled", order[1:][same], "met twice in one frame")
    stats.check()
    none = np.zeros(clock.size)
    where = np.stack([rows.get(name, none) for name in places])
    starts = np.flatnonzero(np.append(True, ~same))
    ends = np.append(starts[1:], order.size)
    several = ends - starts > 1
    for low, high in zip(starts[several], ends[several], strict=True):
        doubles, chosen = order[low:high], 0
        kept[doubles] = False
        before = low
        while before and not kept[order[before - 1]]:
            before -= 1
        beside = order[max(before - 1, 0) : before], order[high : high + 1]
        for near in np.concatenate(beside):
            if codes[near] == codes[doubles[0]]:
                chosen = np.argmin(np.hypot(*(where[:, doubles] - where[:, [near]])))
                break
        kept[doubles[chosen]] = True
    return {name: column[kept] for name, column in rows.items()}


def is_far(dt: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """True where one road user cannot cover a distance [m] in a time [s], [n] each."""
    return distance > np.maximum(FAR_M, FASTEST_MPS * dt)


def drop_position_outliers(
    rows: Rows, stats: RowStats, distance: Distance, name_of: Callable[[Any], str] = str
) -> Rows:
    """Returns the rows in which no road user is far away for a moment.

    A cell of 9999 among others is such a place: up to `SPIKE_ROWS` rows that nobody
    reaches from the rows before, or leaves to those after. They count as unreadable.
    Those amid a track go first: a row behind one may then be near the others.

    Args:
      rows: columns [n] that were read: t [s], id, x, y and `line`.
      stats: of the file.
      distance: of differences in x and y.
      name_of: an id as the file has it.

    Raises:
      InputError: more rows than are allowed.
    """
    codes = np.unique(rows["id"], return_inverse=True)[1]
    order = np.lexsort((rows["t"], codes))
    codes, t, x, y = codes[order], *(rows[name][order] for name in ("t", "x", "y"))
    kept = np.ones(t.size, bool)  # in the order of road users and times
    for is_amid in (True, False):
        at = np.flatnonzero(kept)
        same = np.diff(codes[at]) == 0
        far = same & is_far(np.diff(t[at]), distance(np.diff(x[at]), np.diff(y[at])))
        if not far.any() or far.sum() > MOST_FAR * same.sum():
            break
        starts = np.flatnonzero(np.append(True, ~same | far))
        ends = np.append(starts[1:], at.size)
        cut = np.concatenate([[False], far, [False]])  # far from the row before
        alone = cut[starts] & cut[ends] if is_amid else cut[starts] | cut[ends]
        sizes = ends - starts
        kept[at] &= ~np.repeat(alone & (sizes <= SPIKE_ROWS), sizes)
    dropped = order[~kept]
    if not dropped.size:
        return rows
    row = dropped[np.argmin(rows[LINE][dropped])]
    user = f"{stats.unit} {rows[LINE][row]:.0f}: id {name_of(rows['id'][row])}"
    place = f"{rows['x'][row]:.9g}, {rows['y'][row]:.9g}"
    why = f"{user}: x, y: {place}: expected a place near its rows before and after"
    stats.drop("unreadable", why, dropped.size)
    stats.check()
    kept = kept[np.argsort(order)]
    return {name: column[kept] for name, column in rows.items()}


def after_turn(t: np.ndarray, turn_s: float = DAY_S) -> np.ndarray:
    """Returns times [n] s of a clock without a date, those after midnight a day later.

    A recording goes over midnight if it has rows just before and just after; it then
    begins after the longest time without rows. One that fills the day stays as it is,
    and so do times of a date, which are of a later day than the first.

    Args:
      t: [n] s.
      turn_s: s after which the clock begins anew: a day, or an hour.
    """
    times = np.unique(t)
    if times.size < 2:
        return t
    begin = np.floor(times[0] / turn_s) * turn_s
    early, late = times[0] - begin, begin + turn_s - times[-1]
    pauses = np.diff(times)
    longest = int(np.argmax(pauses))
    if begin > 0.0 or late < 0.0 or max(early, late) > NEAR_S:
        return t
    if pauses[longest] <= NEAR_S:
        return t
    return np.where(t <= times[longest], t + turn_s, t)
