"""Traffic lights of a bag: their states, and the stop lines that they govern."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from rcirl_jax.data.formats.options import section
from rcirl_jax.data.formats.shapes import distance_to_line, line_across
from rcirl_jax.data.formats.signals import held, signal_of
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane

HOLD_S = 1.0  # s, a light unseen keeps its state this long
STAMP_S = 1e-6  # s, to which stamps are exact
NEAR_M = 3.0  # m from a lane's centre line to a place on its stop line


def light_places(spec: Mapping) -> dict[str, np.ndarray]:
    """[lights] of the source TOML: group -> places [n, 2] m on its stop lines."""
    places = {}
    for name, given in section(spec, "lights").items():
        try:
            found = np.array(given, np.float64)
        except (TypeError, ValueError):
            found = np.zeros(0)
        is_number = name.removeprefix("-").isdecimal() and len(name) < 20
        shaped = found.ndim == 2 and found.shape[1:] == (2,) and len(found) > 0
        if not (is_number and shaped and np.isfinite(found).all()):
            raise InputError(
                f"source TOML: lights.{name}: {str(given)[:80]}: expected the number "
                "of a group with places [[x, y], ...] in m, one for each lane"
            )
        places[name] = found
    return places


def signals_of(table: np.ndarray, names: Sequence[str], clock: np.ndarray) -> tuple:
    """One Signal for each group that was seen.

    Args:
      table: [n, 3] t [s], group and state (by `signals.STATES`) whenever it was seen.
      names: of the groups that are wanted.
      clock: [m > 0] s, of the recording.
    """
    found = []
    for name in names:
        mine = table[table[:, 1] == float(name)]
        if len(mine):
            t, _, state = mine[np.argsort(mine[:, 0], kind="stable")].T
            hold = HOLD_S + 2.0 * STAMP_S
            states = held(clock + STAMP_S, t, state.astype(np.int64), hold)
            found.append(signal_of(name, clock, states))
    return tuple(found)


def with_stop_lines(
    lanes: Sequence[Lane], places: Mapping[str, np.ndarray]
) -> tuple[tuple[Lane, ...], list[str]]:
    """The lanes, those nearest to a light's places stopped by it, and notes.

    Args:
      lanes: of one recording.
      places: group -> [n, 2] m in the recording's frame.
    """
    changed, notes = list(lanes), []
    for name, points in places.items():
        for point in points:
            gaps = [float(distance_to_line(point[None], n.centre)[0]) for n in changed]
            nearest = int(np.argmin(gaps)) if gaps else -1
            if nearest < 0 or gaps[nearest] > NEAR_M:
                notes.append(f"light {name}: no lane within {NEAR_M:g} m of its place")
                continue
            lane = changed[nearest]
            line = line_across(lane.centre, lane.left_width, lane.right_width, point)
            ids = tuple(dict.fromkeys((*lane.signal_ids, name)))
            changed[nearest] = dataclasses.replace(lane, stop_line=line, signal_ids=ids)
    return tuple(changed), notes
