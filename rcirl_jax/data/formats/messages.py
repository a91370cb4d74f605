"""Drives as messages in the order of recording: bags and cyber records in windows.

Messages are held until the windows that need them are made, and then forgotten.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from rcirl_jax.data.formats.options import positive, section
from rcirl_jax.data.formats.perception import Windows, around
from rcirl_jax.data.formats.tracks import spans_of
from rcirl_jax.data.recording import MAX_RATE_HZ
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording, Track

RATE_HZ = 10.0  # 1/s, of recordings
MAX_GAP_S = 0.55  # s without a message inside one track
LATE_S = 2.0  # s, messages of one time are recorded within it
MAX_SILENCE_S = 1.0  # s without a message on who drives, after which nobody knows
MAX_DURATION_S = 86400.0  # s, of one drive
MAX_ROWS = 5_000_000  # obstacle states held at once


class Held(Protocol):
    """Rows of a drive that are read and still needed; times in s since its start."""

    end: float  # s, of the last place
    progress: float  # share of the drive that is read

    @property
    def now(self) -> float:
        """Time [s] that the drive is read up to."""
        ...

    def add(self, rows: Any) -> None:  # noqa: ANN401
        """Rows that follow."""
        ...

    def next_place(self, since: float) -> float:
        """Time [s] of the first place held from a time on; inf without one."""
        ...

    def view(self, low: float, high: float) -> Any:  # noqa: ANN401
        """Rows from one time [s] to before another."""
        ...

    def forget(self, before: float) -> None:
        """Drop rows from before a time [s]."""
        ...


def drive_windows(
    held: Held,
    batches: Iterable[Any],
    windows: Windows,
    window: float,
    make: Callable[[Any, tuple[float, float]], Recording | None],
) -> Iterator[Recording]:
    """Recordings of a drive, each made once what it needs is read.

    Args:
      held: of the drive, without rows.
      batches: rows in the order of recording, as `held.add` takes them.
      windows: names and numbers the windows of a long drive.
      window: s, the longest; a drive that is not longer is one recording.
      make: view and the times [s] that scenes begin within -> a recording; None:
        nobody is there.
    """
    number = 0

    def take(low: float, high: float) -> Iterator[Recording]:
        made = make(held.view(*around((low, high))), (low, high))
        if made is not None:
            yield windows.recording(made, number, (low, high), held.progress)

    def following(last: float) -> int:
        """The next window near a place, or else the one at a time [s]."""
        gap = windows.max_gap_s
        near = held.next_place((number + 1) * window - gap) - gap
        return max(number + 1, math.floor(min(near, last) / window))

    _, needed = around((0.0, 0.0))  # s of what comes after a window
    for rows in batches:
        held.add(rows)
        while held.now > (number + 1) * window + needed + LATE_S:
            yield from take(number * window, (number + 1) * window)
            number = following(held.now - LATE_S - needed)
            held.forget(around((number * window, 0.0))[0])
    if number == 0 and held.end <= window:
        whole = (-math.inf, math.inf)
        made = make(held.view(*whole), whole)
        yield from [] if made is None else [made]
        return
    while (low := number * window) < held.end:
        is_last = held.end <= low + window
        yield from take(low, held.end + 1.0 if is_last else low + window)
        number = following(held.end)


def between(
    clock: np.ndarray, low: float, high: float, is_state: bool = False
) -> np.ndarray:
    """[n] bool, rows between two times [s]; of a state also the one in force then."""
    kept = (clock >= low) & (clock < high)
    if is_state and (clock < low).any():
        kept[np.argmax(np.where(clock < low, clock, -np.inf))] = True
    return kept


def check_held(where: str, count: int) -> None:
    """No more obstacle states than MAX_ROWS are held."""
    if count > MAX_ROWS:
        raise InputError(
            f"{where}: more than {MAX_ROWS} obstacle states in a few minutes: "
            "expected one drive"
        )


def check_span(where: str, first: float, last: float, since: float) -> None:
    """Rows of times [s] from `first` on, in a drive read up to `last`.

    Args:
      where: file and field, for errors.
      first: s since the drive's start.
      last: s.
      since: s, rows from before it were forgotten.

    Raises:
      InputError: too long a drive, or rows of windows long taken.
    """
    span = last - min(first, 0.0)
    if not span <= MAX_DURATION_S:
        raise InputError(
            f"{where}: {span:g} s from first to last: expected at most "
            f"{MAX_DURATION_S:g} s; several clocks in one drive?"
        )
    if first < since:
        raise InputError(
            f"{where}: {first:g} s from the start after {last:g} s: goes backwards; "
            "expected one drive, its files in order"
        )


def topics_of(
    spec: dict, known: Iterable[str], usual: Mapping[str, Sequence[str]]
) -> dict[str, list[str]]:
    """Role -> names of topics: those of the option `topics`, else the usual ones."""
    names, found = ", ".join(known), {}
    for role, given in {**usual, **section(spec, "topics")}.items():
        every = [given] if isinstance(given, str) else given
        if role not in known:
            raise InputError(f"source TOML: topics.{role}: unknown: expected {names}")
        if not isinstance(every, list | tuple) or not {*map(type, every)} <= {str}:
            raise InputError(
                f"source TOML: topics.{role}: {given}: expected a topic or a list"
            )
        found[role] = [*every]
    return found


def is_anybody(tracks: Iterable[Track], within: tuple[float, float]) -> bool:
    """Whether a road user is there between two times [s]."""
    return any(t.t[0] < within[1] and t.t[-1] >= within[0] for t in tracks)


def automatic_spans(
    clock: np.ndarray, by_hand: np.ndarray
) -> tuple[tuple[float, float], ...]:
    """When nobody drove by hand, or nothing was said of it; none without messages.

    The first mode was in force before.

    Args:
      clock: [n] s, of messages that say who drives.
      by_hand: [n] 1 where a human does.
    """
    if not clock.size:
        return ()
    order = np.argsort(clock, kind="stable")
    clock, other = clock[order], by_hand[order] == 0.0
    silent = np.diff(clock, append=np.inf) > MAX_SILENCE_S
    return spans_of(
        np.concatenate([[-np.inf], clock, clock[silent] + MAX_SILENCE_S]),
        np.concatenate([other[:1], other, np.ones(np.count_nonzero(silent), bool)]),
    )


def automatic_notes(
    clock: np.ndarray, by_hand: np.ndarray, within: tuple[float, float], mode: str
) -> list[str]:
    """A note on how much of the time between two [s] is not driven in a mode."""
    inside = by_hand[(clock >= within[0]) & (clock < within[1])]
    share = 1.0 - float(np.mean(inside)) if inside.size else 0.0
    words = f"{share:.0%} of the time not {mode}: the ego is no human there"
    return [words] if share > 0.0 else []


def speed_at(t: np.ndarray, clock: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Speed [m/s] at times t between those measured; NaN where there are none."""
    known = np.isfinite(speed)
    if np.count_nonzero(known) < 2:
        return np.full(t.shape, np.nan)
    order = np.argsort(clock[known], kind="stable")
    return np.interp(t, clock[known][order], speed[known][order])


def no_tracks(first: Path, spec: dict) -> InputError:
    """What is wrong with a drive of which no window has a track."""
    return InputError(
        f"{first}: tracks: none on a clock of {clock_rate(spec):g} Hz: expected a "
        "longer drive"
    )


def clock_rate(spec: dict) -> float:
    """The option `rate_hz` of recordings that are put onto a clock."""
    rate = positive(spec, "rate_hz", RATE_HZ)
    if rate > MAX_RATE_HZ:
        raise InputError(
            f"source TOML: rate_hz: {rate:g}: expected at most {MAX_RATE_HZ:g}"
        )
    return rate
