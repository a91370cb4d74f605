"""Lanes and lights from beside a bag, which holds no map.

Lanes come from a Lanelet2 map or a table of lines that the source TOML names, else
from the paths that were driven. Lights stop the lanes nearest to their places.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.lanelet2.map import read_lanelet2
from rcirl_jax.data.formats.lanes import lane_file_of, lanes_of_toml
from rcirl_jax.data.formats.options import path_option, section
from rcirl_jax.data.formats.perception import held_states, signal_of
from rcirl_jax.data.formats.projection import utm, utm_zone
from rcirl_jax.data.formats.shapes import Roads, distance_to_line, line_across
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane, Signal

SQUARE_M = 1e5  # m, of MGRS, to whose corner Autoware's maps are relative
MARGIN_M = 200.0  # m around the tracks in which lanes are kept
HOLD_S = 1.0  # s, a light unseen keeps its state this long
STAMP_S = 1e-6  # s, to which stamps are exact
NEAR_M = 3.0  # m from a lane's centre line to a place on its stop line


def given_lanes(path: Path, spec: dict) -> tuple[Sequence[Lane], list[str]] | None:
    """Reads the lanes of the option `map` or of [lanes] in the TOML, with notes.

    In the frame of the bag's map; None where the TOML has neither. A table of lines
    lies beside the bag, or beside its folder.
    """
    place = path_option(spec, "map")
    if place and lane_file_of(spec):
        raise InputError(f"source TOML: map: {place}: and lanes.file: expected one")
    if place:
        if not Path(place).is_file():
            raise InputError(
                f"source TOML: map: {place}: missing: expected a Lanelet2 map"
            )
        return read_lanelet2(Path(place), _on_square)
    if not spec.get("lanes"):
        return None
    return lanes_of_toml(path, spec), []


def _on_square(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    """[n, 2] m from the corner of the map's 100 km square of MGRS.

    Autoware's frame `map` begins there; maps with tags local_x, local_y say so.
    """
    zone = utm_zone(float(np.median(longitude)))
    places = utm(latitude, longitude, zone, south=bool(np.median(latitude) < 0.0))
    return places - np.floor(np.median(places, axis=0) / SQUARE_M) * SQUARE_M


def lanes_near(
    lanes: Sequence[Lane], x: np.ndarray, y: np.ndarray, origin: np.ndarray
) -> tuple[Lane, ...]:
    """Returns the lanes around positions [n] m of the bag, less the origin [2] m."""
    roads = Roads([lane.centre for lane in lanes], lanes.__getitem__)
    near = roads.around(x, y, origin, MARGIN_M)
    if not near:
        raise InputError(
            f"source TOML: map: no lane within {MARGIN_M:g} m of the tracks around "
            f"x = {np.median(x):.0f} m, y = {np.median(y):.0f} m: expected a map in "
            "the bag's own frame"
        )
    return near


def light_places(spec: Mapping) -> dict[str, np.ndarray]:
    """Reads [lights] of the source TOML: group -> places [n, 2] m on its stop lines."""
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


def signals_of(
    t: np.ndarray, table: np.ndarray, names: Sequence[str], clock: np.ndarray
) -> tuple[Signal, ...]:
    """Makes one Signal for each group that was seen.

    Args:
      t: [n] s, whenever a group was seen.
      table: [n, 2] its number and state (of `perception.STATES`).
      names: of the groups that are wanted.
      clock: [m > 0] s, of the recording.
    """
    found = []
    for name in names:
        mine = np.flatnonzero(table[:, 0] == float(name))
        if mine.size:
            mine = mine[np.argsort(t[mine], kind="stable")]
            hold, states = HOLD_S + 2.0 * STAMP_S, table[mine, 1].astype(np.int64)
            shown = held_states(clock + STAMP_S, t[mine], states, hold)
            found.append(signal_of(name, clock, shown))
    return tuple(found)


def with_stop_lines(
    lanes: Sequence[Lane], places: Mapping[str, np.ndarray]
) -> tuple[tuple[Lane, ...], list[str]]:
    """Stops the lanes nearest to a light's places by it, with notes.

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
