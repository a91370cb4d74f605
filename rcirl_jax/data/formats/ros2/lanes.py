"""Lanes for a bag, which holds none: a Lanelet2 map, a table of lines, or paths."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.csv.map import LogTable, lane_file_of, lanes_of
from rcirl_jax.data.formats.lanelet2.map import read_lanelet2
from rcirl_jax.data.formats.options import path_option
from rcirl_jax.data.formats.perception import fitted_lanes
from rcirl_jax.data.formats.projection import utm, utm_zone
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane, Track

LIMIT_MPS = 13.41  # m/s, 30 mph, where nothing better is known
SQUARE_M = 1e5  # m, of MGRS, to whose corner Autoware's maps are relative
MARGIN_M = 200.0  # m around the tracks in which lanes are kept


@dataclasses.dataclass(frozen=True, kw_only=True)
class Given:
    """Lanes that the source TOML names, in the frame of the bag's map."""

    lanes: tuple[Lane, ...]
    notes: tuple[str, ...]

    def near(self, x: np.ndarray, y: np.ndarray, origin: np.ndarray) -> tuple:
        """Lanes around positions [n] m of the bag, less the origin [2] m."""
        low = np.array([x.min(), y.min()]) - MARGIN_M
        high = np.array([x.max(), y.max()]) + MARGIN_M
        return tuple(
            dataclasses.replace(
                lane,
                centre=lane.centre - origin,
                stop_line=None if lane.stop_line is None else lane.stop_line - origin,
            )
            for lane in self.lanes
            if (lane.centre.max(axis=0) >= low).all()
            and (lane.centre.min(axis=0) <= high).all()
        )


def given_lanes(path: Path, spec: dict) -> Given | None:
    """Lanes of the option `map` or of [lanes] in the TOML; None where it has neither.

    Args:
      path: file of the bag; a table of lines lies beside it, or beside its folder.
      spec: source TOML.
    """
    place = path_option(spec, "map")
    if place and lane_file_of(spec):
        raise InputError(f"source TOML: map: {place}: and lanes.file: expected one")
    if place:
        if not Path(place).is_file():
            raise InputError(
                f"source TOML: map: {place}: missing: expected a Lanelet2 map"
            )
        lanes, notes = read_lanelet2(Path(place), _on_square)
        return Given(lanes=lanes, notes=tuple(notes))
    if not spec.get("lanes"):
        return None
    table = LogTable(path=path, values={}, rate_hz=0.0, origin=np.zeros(2), notes=())
    lanes, notes = lanes_of(table, spec, ())
    return Given(lanes=lanes, notes=tuple(notes))


def _on_square(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    """[n, 2] m from the corner of the map's 100 km square of MGRS.

    Autoware's frame `map` begins there; maps with tags local_x, local_y say so.
    """
    zone = utm_zone(float(np.median(longitude)))
    places = utm(latitude, longitude, zone, south=bool(np.median(latitude) < 0.0))
    return places - np.floor(np.median(places, axis=0) / SQUARE_M) * SQUARE_M


def lanes_for(
    given: Given | None,
    tracks: Sequence[Track],
    places: tuple[np.ndarray, np.ndarray, np.ndarray],
    spec: Mapping,
) -> tuple[tuple[Lane, ...], list[str]]:
    """Lanes of a recording and notes: the given ones near it, else fitted ones.

    Args:
      given: by `given_lanes`.
      tracks: of the recording, less its origin.
      places: x, y [n] m of all samples with the origin, and the origin [2] m.
      spec: source TOML.

    Raises:
      InputError: none of the given lanes is near.
    """
    if given is None:
        lanes, note = fitted_lanes(tracks, spec)
        return lanes, [f"no map given; {note}"]
    lanes = given.near(*places)
    if not lanes:
        x, y = (float(np.median(values)) for values in places[:2])
        raise InputError(
            f"source TOML: map: no lane within {MARGIN_M:g} m of the tracks around "
            f"x = {x:.0f} m, y = {y:.0f} m: expected a map in the bag's own frame"
        )
    return lanes, list(given.notes)
