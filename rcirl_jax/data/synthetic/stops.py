"""What drivers stop for on the road itself: lights, signs, their destination."""

import numpy as np

from rcirl_jax.data.synthetic.drivers import line_acceleration
from rcirl_jax.data.synthetic.state import RoadTable, State

LOOK_AHEAD_M = 300.0  # m, lines and destinations farther ahead do not matter yet
AT_LINE_M = 4.0  # m, standing closer than this counts as standing at the line
STANDING_MPS = 0.1  # m/s
REVOKE_MPS2 = 1.5  # m/s^2, a light run is given up if this braking is enough
ARRIVED_M = 1.5  # m, standing closer than this to the destination is arriving
GREEN, YELLOW, RED = 0, 1, 2
COLOURS = ("green", "yellow", "red")


def signal_phase(table: RoadTable, offset: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """GREEN, YELLOW or RED at times `clock` [R, N] s.

    Args:
      table: gives the cycle.
      offset: [R, N] s, how far into its cycle the light is at time 0.
      clock: [R, N] s.
    """
    into = np.mod(clock + offset, table.cycle)
    after_green = into >= table.green
    return after_green.astype(int) + (into >= table.green + table.yellow)


def schedule(
    cycle: tuple[float, float, float], offset: float, end: float
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Starts [s] and colours of a light's intervals that cover 0 .. end s."""
    starts, colours = [], []
    start = -offset
    while start <= end:
        for colour, seconds in zip(COLOURS, cycle, strict=True):
            if start + seconds > 0.0 and start <= end:
                starts.append(max(start, 0.0))
                colours.append(colour)
            start += seconds
    return np.array(starts), tuple(colours)


def stop_acceleration(
    state: State, table: RoadTable, offsets: np.ndarray, clock: float, dt: float
) -> np.ndarray:
    """Bound [m/s^2] from stop lines and destinations; inf where nothing demands.

    A light that is not green is seen after the reaction time. The driver then
    decides once: brake, unless more than `dilemma` would be needed. At a stop
    sign the driver stands `sign_wait` at the line, then goes.

    Args:
      state: `next_stop`, `decided`, `committed`, `stood` are updated.
      table: the roads.
      offsets: [R, S + 1] s, of the lights.
      clock: s.
      dt: s.
    """
    rows = np.arange(len(state.s))[:, None]
    half = 0.5 * state.driver["length"]
    gap = table.stop_s[rows, state.next_stop] - state.s - half
    passed = gap < 0.0
    state.next_stop += passed
    for flags in (state.decided, state.committed):
        flags &= ~passed
    gap = table.stop_s[rows, state.next_stop] - state.s - half
    sign = table.stop_is_sign[rows, state.next_stop]
    seen = clock - state.driver["delay"]
    colour = signal_phase(table, offsets[rows, state.next_stop], seen)
    demand = np.isfinite(gap) & (sign | (colour != GREEN))
    _decide(state, gap, demand & ~sign, colour)
    _wait(state, gap, demand & sign, dt)
    demand &= ~state.committed & (gap < LOOK_AHEAD_M)
    near = np.where(demand, gap, 1.0)
    bound = np.where(demand, line_acceleration(state.v, near, state.driver), np.inf)
    return np.minimum(bound, _destination(state))


def _decide(state: State, gap: np.ndarray, lit: np.ndarray, colour: np.ndarray) -> None:
    """Yellow and red lights: brake or drive on."""
    needed = state.v**2 / (2.0 * np.maximum(gap - 0.5, 0.1))
    first = lit & ~state.decided
    state.committed |= first & (needed > state.driver["dilemma"])
    state.committed &= lit & ~((colour == RED) & (needed < REVOKE_MPS2))
    state.decided = lit.copy()


def _wait(state: State, gap: np.ndarray, sign: np.ndarray, dt: float) -> None:
    """Stop signs: count the time at the line; after `sign_wait` it is done."""
    at_line = sign & (gap < AT_LINE_M) & (state.v < STANDING_MPS) & state.alive
    state.stood = np.where(at_line, state.stood + dt, 0.0)
    done = at_line & (state.stood >= state.driver["sign_wait"])
    state.next_stop += done


def _destination(state: State) -> np.ndarray:
    """Bound [m/s^2] that brings the car to stand at its destination."""
    left = state.driver["destination"] - state.s
    near = state.alive & (left < LOOK_AHEAD_M)
    state.parked |= near & (np.abs(left) < ARRIVED_M) & (state.v < STANDING_MPS)
    # the line is placed so that the gap left to it is used up at the destination
    gap = np.where(near, left + state.driver["line_gap"], 1.0)
    bound = line_acceleration(state.v, np.maximum(gap, 0.05), state.driver)
    return np.where(near, bound, np.inf)
