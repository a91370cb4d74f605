"""Drives as messages in the order of recording: bags and cyber records in windows.

Messages are held until the windows that need them are made, and then forgotten.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol

import numpy as np

from rcirl_jax.data.importers.options import positive
from rcirl_jax.data.importers.perception import Windows, around
from rcirl_jax.data.recording import MAX_RATE_HZ
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording

LATE_S = 2.0  # s, messages of one time are recorded within it


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


def clock_rate(spec: dict, usual: float) -> float:
    """The option `rate_hz` of recordings that are put onto a clock."""
    rate = positive(spec, "rate_hz", usual)
    if rate > MAX_RATE_HZ:
        raise InputError(
            f"source TOML: rate_hz: {rate:g}: expected at most {MAX_RATE_HZ:g}"
        )
    return rate
