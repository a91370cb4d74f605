"""Rows of a table -> tracks: who is one road user, where it heads, for how long."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.readers.tables.rows import is_far
from rcirl_jax.errors import InputError
from rcirl_jax.types import Track

HEADING_WINDOW_S = 1.0  # s, heading is the direction of travel over this window
MAX_DOUBLED = 0.01  # share of rows that repeat an id at one time; more is an error
MAX_NAMESAKES = 0.1  # share of tracks with the id of another, likewise
MIN_TRAVEL_M = 0.5  # m in that window; below it the heading is held


def split_tracks(
    path: Path,
    ids: np.ndarray,
    t: np.ndarray,
    max_gap: float,
    reuse: float = np.inf,
    places: np.ndarray | None = None,
) -> list[tuple[str, np.ndarray]]:
    """Returns the rows of each track: one road user without a gap.

    A gap longer than `max_gap` starts another track of the same id, named
    "id#2", "id#3", ... A step back by more than `reuse` is a number given to
    somebody else at another time; by less it is an error.

    Args:
      path: named in errors.
      ids: [n] of each row, text or numbers.
      t: [n] in any unit.
      max_gap: in the unit of t.
      reuse: in the unit of t.
      places: [n, 2] m; where nobody gets to in time (t in s), another track starts.

    Returns:
      (name, row numbers in the order of time) per track.

    Raises:
      InputError: time goes backwards, or is met twice, inside an id, or most
        steps are gaps.
    """
    _, codes = np.unique(ids, return_inverse=True)
    order = np.argsort(codes, kind="stable")
    step, same = np.diff(t[order]), np.diff(codes[order]) == 0
    wrong = np.flatnonzero(same & (step < 0.0) & (step >= -reuse))
    if wrong.size:
        row = order[wrong[0] + 1]
        raise InputError(
            f"{path}: id {ids[row]}: t: {t[row]:.12g} after {t[order[wrong[0]]]:.12g}: "
            "goes backwards; expected increasing times"
        )
    order = np.lexsort((t, codes))
    step, same = np.diff(t[order]), np.diff(codes[order]) == 0
    twice = np.flatnonzero(same & (step == 0.0))
    if twice.size:
        row = order[twice[0]]
        raise InputError(
            f"{path}: id {ids[row]}: t: {t[row]:.12g}: met twice: expected once"
        )
    if same.any() and np.median(step[same]) > max_gap:
        raise InputError(
            f"{path}: t: median step {np.median(step[same]):g}: "
            f"expected at most {max_gap:g}; wrong unit of time or rate?"
        )
    ends = ~same | (step > max_gap)
    if places is not None:
        ends |= is_far(step, np.hypot(*np.diff(places[order], axis=0).T))
    pieces = np.split(order, np.flatnonzero(ends) + 1)
    parts: dict[str, int] = {}
    tracks = []
    for rows in pieces:
        name = str(ids[rows[0]])
        parts[name] = parts.get(name, 0) + 1
        tracks.append((name if parts[name] == 1 else f"{name}#{parts[name]}", rows))
    return tracks


def once_each(ids: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Returns rows [n] of which each id has one at a time, and a note on the others.

    The first of several counts. All rows where too many are doubled: then the file is
    wrong, and `split_tracks` says so.
    """
    order = np.lexsort((t, ids))  # stable: the file's order inside
    same = (np.diff(ids[order]) == 0) & (np.diff(t[order]) == 0.0)
    doubled = order[1:][same]
    if not 0 < doubled.size <= max(MAX_DOUBLED * t.size, 1.0):
        return np.arange(t.size), []
    kept = np.delete(np.arange(t.size), doubled)
    what = "states of a road user met twice at one time, one used"
    return kept, [f"{doubled.size} {what}"]


def of_one_name(tracks: Sequence[Track]) -> tuple[list[Track], list[str]]:
    """Returns tracks of which each has a name of its own, and a note on the others.

    The longest of several of one name counts. All of them where more than a tenth, and
    more than one, are too many: then the file is wrong, and validation says so.
    """
    longest: dict[str, Track] = {}
    for track in tracks:
        known = longest.get(track.id)
        if known is None or track.t.size > known.t.size:
            longest[track.id] = track
    lost = len(tracks) - len(longest)
    if not 0 < lost <= max(MAX_NAMESAKES * len(tracks), 1.0):
        return [*tracks], []
    kept = [track for track in tracks if longest[track.id] is track]
    return kept, [f"{lost} tracks with the id of another left out"]


def spans_of(t: np.ndarray, holds: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Returns (begin, end) of each run of samples [n] that hold, to the next one.

    The last run has no end. t [n] s in any order.
    """
    order = np.argsort(t, kind="stable")
    flips = np.flatnonzero(np.diff(np.concatenate([[False], holds[order]])))
    ends = [*t[order][flips].tolist(), np.inf]
    return tuple(zip(ends[:-1:2], ends[1::2], strict=False))


def travel_heading(
    t: np.ndarray, x: np.ndarray, y: np.ndarray, standing: float = 0.0
) -> np.ndarray:
    """Returns the direction of travel [n] rad, over a second around each sample.

    Held from the last moving sample (before the first: from it) where the car covers
    less than half a metre; `standing` [rad] for one that never moves.
    """
    half = 0.5 * HEADING_WINDOW_S
    dx, dy = (np.interp(t + half, t, v) - np.interp(t - half, t, v) for v in (x, y))
    moving = np.flatnonzero(np.hypot(dx, dy) > MIN_TRAVEL_M)
    if moving.size == 0:
        return np.full(t.shape, standing)
    held = np.searchsorted(moving, np.arange(t.size), side="right") - 1
    return np.arctan2(dy, dx)[moving[np.maximum(held, 0)]]
