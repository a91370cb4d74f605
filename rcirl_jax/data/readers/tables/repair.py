"""Repair rows that put a road user in two places at once, or far from its track."""

from collections.abc import Callable, Container, Mapping, Sequence
from typing import Any

import numpy as np

from rcirl_jax.data.readers.tables.ledger import LINE, Ledger

FASTEST_MPS = 100.0  # m/s; nobody covers a distance faster
FAR_M = 25.0  # m; nearer than this positions may just be inaccurate
SPIKE_ROWS = 3  # of one road user far from all its others: no place, but an error
MOST_FAR = 0.5  # share of far steps; of more the unit is wrong, which is found later


def once(
    rows: dict[str, np.ndarray],
    ledger: Ledger,
    t: str = "t",
    user: str | None = "id",
    **options: Any,  # noqa: ANN401
) -> dict[str, np.ndarray]:
    """The rows of a table in which each road user is met once in a frame.

    Args:
      rows: columns [n] of `table.read`.
      ledger: of the file.
      t: name of the clock's column.
      user: name of that of the road users; None: a row is of all of them.
      **options: of `single_rows`.
    """
    users = np.zeros(rows[t].size) if user is None else rows[user]
    kept = single_rows(rows, rows[t], users, ledger, **options)
    return rows if kept.all() else {name: rows[name][kept] for name in rows}


def single_rows(
    values: Mapping[str, np.ndarray],
    t: np.ndarray,
    codes: np.ndarray,
    ledger: Ledger,
    places: Sequence[str] = ("x", "y"),
    apart: Container[str] = (),
    name_of: Callable[[Any], str] = str,
) -> np.ndarray:
    """Which rows [n] are kept, so that each road user is met once in a frame.

    Of rows that are equal in everything that was read the first is kept. Of others
    with one id and time, that which continues the track: the nearest to where the
    road user was before (else: is after). Both are counted in the ledger.

    Args:
      values: columns [n] that were read, `line` among them.
      t: [n] clock.
      codes: [n] ids, text or numbers.
      ledger: of the file.
      places: names of the positions; one that is not there is 0.
      apart: names of columns in which rows that repeat each other may differ.
      name_of: an id as the file has it.

    Raises:
      InputError: more rows than the ledger allows.
    """
    ids = codes

    def named(row: int) -> str:
        return f"{ledger.unit} {values[LINE][row]:.0f}: id {name_of(ids[row])}"

    if codes.dtype.kind != "f":
        codes = np.unique(codes, return_inverse=True)[1]
    kept = np.ones(t.size, bool)
    order = np.lexsort((t, codes))  # stable: the file's order inside
    same = (np.diff(codes[order]) == 0) & (np.diff(t[order]) == 0.0)
    if not same.any():
        return kept
    shared = order[np.concatenate([same, [False]]) | np.concatenate([[False], same])]
    columns = [
        np.unique(values[name][shared], return_inverse=True)[1]
        for name in values
        if name != LINE and name not in apart
    ]
    columns += [t[shared], codes[shared]]
    inner = np.lexsort((shared, *columns))
    equal = np.all([np.diff(column[inner]) == 0 for column in columns], axis=0)
    repeats = shared[inner[1:][equal]]
    kept[repeats] = False
    if repeats.size:
        who = named(repeats.min())
        ledger.drop("repeated", f"{who}: the same row again", repeats.size)
    order = order[kept[order]]
    same = (np.diff(codes[order]) == 0) & (np.diff(t[order]) == 0.0)
    if same.any():
        first = order[1:][same].min()
        who = named(first)
        ledger.drop("doubled", f"{who}: met twice in one frame", int(same.sum()))
    ledger.check()
    none = np.zeros(t.size)
    where = np.stack([values.get(name, none) for name in places])
    starts = np.flatnonzero(np.concatenate([[True], ~same]))
    ends = np.append(starts[1:], order.size)
    several = ends - starts > 1
    for low, high in zip(starts[several], ends[several], strict=True):
        kept[order[low:high]] = False
        kept[_continuing(where, codes, order, low, high, kept)] = True
    return kept


Distance = Callable[[np.ndarray, np.ndarray], np.ndarray]  # dx, dy -> m, [n] each


def is_far(dt: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Whether one road user cannot cover a distance [m] in a time [s], [n] each."""
    return distance > np.maximum(FAR_M, FASTEST_MPS * dt)


def reachable_rows(
    values: Mapping[str, np.ndarray],
    ledger: Ledger,
    distance: Distance,
    name_of: Callable[[Any], str] = str,
) -> np.ndarray:
    """Which rows [n] are kept, so that no road user is far away for a moment.

    A cell of 9999 among others is such a place: up to `SPIKE_ROWS` rows that nobody
    reaches from the rows before, or leaves to those after. They count as unreadable.

    Args:
      values: columns [n] that were read: t [s], id, x, y and `line`.
      ledger: of the file.
      distance: of differences in x and y.
      name_of: an id as the file has it.

    Raises:
      InputError: more rows than the ledger allows.
    """
    codes = np.unique(values["id"], return_inverse=True)[1]
    order = np.lexsort((values["t"], codes))
    t, x, y = (values[name][order] for name in ("t", "x", "y"))
    kept = _without_spikes(codes[order], t, x, y, distance)
    dropped = order[~kept]
    if dropped.size:
        row = dropped[np.argmin(values[LINE][dropped])]
        user = f"{ledger.unit} {values[LINE][row]:.0f}: id {name_of(values['id'][row])}"
        place = f"{values['x'][row]:.9g}, {values['y'][row]:.9g}"
        why = f"{user}: x, y: {place}: expected a place near its rows before and after"
        ledger.drop("unreadable", why, dropped.size)
        ledger.check()
    return kept[np.argsort(order)]


def _without_spikes(
    codes: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray, distance: Distance
) -> np.ndarray:
    """Which rows [n], in the order of road users and times, are no spikes.

    Those amid a track go first: a row behind one may then be near the others.
    """
    kept = np.ones(t.size, bool)
    for amid in (True, False):
        rows = np.flatnonzero(kept)
        same = np.diff(codes[rows]) == 0
        way = distance(np.diff(x[rows]), np.diff(y[rows]))
        far = same & is_far(np.diff(t[rows]), way)
        if not far.any() or far.sum() > MOST_FAR * same.sum():
            break
        starts = np.flatnonzero(np.concatenate([[True], ~same | far]))
        ends = np.append(starts[1:], rows.size)
        cut = np.concatenate([[False], far, [False]])  # far from the row before
        alone = np.stack([cut[starts], cut[ends]])
        spikes = (ends - starts <= SPIKE_ROWS) & (
            alone.all(axis=0) if amid else alone.any(axis=0)
        )
        for low, high in zip(starts[spikes], ends[spikes], strict=True):
            kept[rows[low:high]] = False
    return kept


def _continuing(
    where: np.ndarray,
    codes: np.ndarray,
    order: np.ndarray,
    low: int,
    high: int,
    kept: np.ndarray,
) -> int:
    """Of rows order[low:high] of one road user and time, that nearest to its track."""
    rows = order[low:high]
    before = low - 1
    while before >= 0 and not kept[order[before]]:
        before -= 1
    near = None
    if before >= 0 and codes[order[before]] == codes[rows[0]]:
        near = order[before]
    elif high < order.size and codes[order[high]] == codes[rows[0]]:
        near = order[high]
    if near is None:
        return int(rows[0])
    apart = np.hypot(*(where[:, rows] - where[:, [near]]))
    return int(rows[np.argmin(apart)])
