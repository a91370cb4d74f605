"""Signals from the colours of lights at the times at which they were seen."""

import numpy as np

from rcirl_jax.types import Signal

STATES = ("off", "red", "yellow", "green")  # by their numbers


def held(
    clock: np.ndarray, seen: np.ndarray, states: np.ndarray, hold: float
) -> np.ndarray:
    """State [T] at each time: the last one seen, off after `hold` without any.

    Args:
      clock: [T] times, increasing.
      seen: [n] times, increasing, in the same unit.
      states: [n] numbers of STATES.
      hold: in the same unit.
    """
    last = np.searchsorted(seen, clock, side="right") - 1
    fresh = (last >= 0) & (clock - seen[np.maximum(last, 0)] <= hold)
    return np.where(fresh, states[np.maximum(last, 0)], 0)


def signal_of(name: str, t: np.ndarray, states: np.ndarray) -> Signal:
    """A light as intervals, by its state (a number of STATES) at each time [T] s."""
    first = np.flatnonzero(np.diff(states, prepend=-1))
    return Signal(
        id=name, start=t[first], state=tuple(STATES[state] for state in states[first])
    )
