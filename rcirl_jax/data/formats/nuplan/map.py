"""nuPlan maps: lanes and lane connectors of a city's `map.gpkg`.

Layers read: baseline_paths (centre lines), lanes_polygons (limits, neighbours,
bounds), lane_connectors (paths across junctions), boundaries,
gen_lane_connectors_scaled_width_polygons (bounds of connectors), stop_polygons,
meta (the UTM zone). Geometries are WGS84 degrees, logs are in that UTM zone.

A connector leaves its "exit lane" and enters its "entry lane". Lanes of a group
are numbered from left to right.
"""

import dataclasses
import functools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.files import MAP_FOLDERS
from rcirl_jax.data.formats.nuplan.geopackage import MAX_ROWS, Layers, zone_of
from rcirl_jax.data.formats.options import path_option
from rcirl_jax.data.formats.shapes import (
    MIN_HALF_WIDTH_M,
    Roads,
    distance_to_line,
    line_across,
    moves,
)
from rcirl_jax.data.readers.sqlite import Database
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane

HALF_WIDTH_M = 1.75  # m, where a lane's bounds are not in the map
MAX_HALF_WIDTH_M = 6.0  # m; a bound farther off is another lane's
MAX_LIMIT_MPS = 60.0  # m/s; faster "limits" are none
STOP_SIGN = 1  # stop_polygon_type_fid
NONE = -1  # no feature's number
FOLDERS_UP = 6  # folders above a log in which those of maps are looked for
SAFE_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}")
CENTRES = ("lane_fid", "lane_connector_fid")
LANES = ("lane_fid", "lane_group_fid", "lane_index", "speed_limit_mps")
CONNECTORS = ("fid", "exit_lane_fid", "entry_lane_fid", "speed_limit_mps")
BOUNDS = ("left_boundary_fid", "right_boundary_fid")
STOPS = ("fid", "stop_polygon_type_fid")
CONNECTOR_BOUNDS = "gen_lane_connectors_scaled_width_polygons"


def find_map(file: Path, names: Sequence[str], spec: Mapping) -> Path | None:
    """map.gpkg of a log: MAP_FOLDERS/NAME/VERSION/ above it, or as in the TOML.

    Args:
      file: the log.
      names: under which its map may be filed, e.g. "us-nv-las-vegas-strip" or the
        location "las_vegas".
      spec: `maps` names the folder of the maps; relative to a folder above the log.
    """
    given = path_option(spec, "maps")
    above = list(file.resolve().parents)[:FOLDERS_UP]
    kept = [given] if given else MAP_FOLDERS
    roots = [folder / name for folder in above for name in kept]
    for root in [Path(given), *roots] if given else roots:
        for name in names:
            found = _versions(root, name)
            if found:
                return found[-1]
    if given:
        raise InputError(
            f"source TOML: maps: {given}: no map of {' or '.join(names)[:80]}: "
            "expected NAME/VERSION/map.gpkg in it"
        )
    return None


def _versions(root: Path, name: str) -> list[Path]:
    """All versions of a map; a location names the folder that contains it."""
    if not (root.is_dir() and SAFE_NAME.fullmatch(name)):
        return []
    part = name.replace("_", "-").lower()
    folders = [f for f in sorted(root.iterdir()) if part in f.name.lower()]
    exact = [folder for folder in folders if folder.name == name]
    chosen = exact or folders
    return sorted(chosen[0].glob("*/map.gpkg")) if len(chosen) == 1 else []


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Row:
    """A lane or connector as the map's tables have it."""

    id: str
    limit: float | None
    bounds: tuple[int, int]  # fids of left, right
    successors: tuple[str, ...]
    left: str | None = None
    right: str | None = None
    signal: str | None = None
    stops: tuple[int, ...] = ()  # fids of stop polygons
    has_sign: bool = False


class NuplanMap:
    """One city; lanes are made when they are first asked for."""

    def __init__(self, file: Path) -> None:
        """Reads all tables; geometries of lanes' bounds stay blobs."""
        with Database(file) as database:
            self._layers = layers = Layers(database, *_zone(database))
            self._stops = _stops(layers)
            rows = {**self._connectors(database), **self._lanes(database)}
            self._bounds: dict[int, object] = {}
            centres = _centres(layers)
            if database.columns("boundaries"):
                table = layers.blobs("boundaries", ("fid",))
                self._bounds = {_fid(fid): blob for blob, fid in table}
        self._centres = {name: centres[name] for name in centres if name in rows}
        self._rows = [rows[name] for name in self._centres]
        self.roads = Roads([*self._centres.values()], functools.cache(self._make))

    def _make(self, index: int) -> Lane:
        row = self._rows[index]
        centre = self._centres[row.id]
        found = [self._half_width(fid, centre) for fid in row.bounds]
        usual = np.full(len(centre), HALF_WIDTH_M)
        left, right = (usual if half is None else half for half in found)
        stop = None
        if row.signal is not None or row.has_sign:
            places = [self._stops[fid][1] for fid in row.stops if fid in self._stops]
            start = centre[0]
            near = min(places, key=lambda p: np.hypot(*(p - start)), default=start)
            stop = line_across(centre, left, right, near)
        return Lane(
            id=row.id,
            centre=centre,
            left_width=left,
            right_width=right,
            speed_limit=row.limit,
            successors=row.successors,
            left=row.left,
            right=row.right,
            stop_line=stop,
            signal_ids=() if row.signal is None else (row.signal,),
            stop_sign=row.has_sign,
            width_assumed=any(half is None for half in found),
        )

    def _half_width(self, fid: int, centre: np.ndarray) -> np.ndarray | None:
        """Distance [n] m of a bound from the centre line's points; None of no bound."""
        line = np.zeros((0, 2))
        if fid in self._bounds:
            (line,) = self._layers.lines("boundaries", [self._bounds[fid]])
        if not len(line):
            return None
        apart = distance_to_line(centre, line)
        return np.clip(apart, MIN_HALF_WIDTH_M, MAX_HALF_WIDTH_M)

    def _signs(self, *, connectors: bool) -> dict[int, int]:
        """Stop polygon of a stop sign, by the lane or connector that it governs."""
        return {
            user: fid
            for fid, (kind, _, lanes, ways) in self._stops.items()
            if kind == STOP_SIGN and (connectors or not ways)
            for user in (ways if connectors else lanes)
        }

    def _lanes(self, database: Database) -> dict[str, _Row]:
        bounds = BOUNDS
        if not set(BOUNDS) <= set(database.columns("lanes_polygons")):
            bounds = ("", "")
        table = [
            (*map(_fid, row[:3]), _limit(row[3]), (_fid(row[4]), _fid(row[5])))
            for row in database.table("lanes_polygons", LANES, MAX_ROWS, bounds)
        ]
        place = {
            (group, index): str(fid)
            for fid, group, index, *_ in table
            if NONE not in (group, index)
        }
        signs = self._signs(connectors=False)
        found = {}
        for fid, group, index, limit, beside in table:
            is_placed = index != NONE
            found[str(fid)] = _Row(
                id=str(fid),
                limit=limit,
                bounds=beside,
                successors=tuple(self._leaving.get(fid, ())),
                left=place.get((group, index - 1)) if is_placed else None,
                right=place.get((group, index + 1)) if is_placed else None,
                stops=(signs[fid],) if fid in signs else (),
                has_sign=fid in signs,
            )
        return found

    def _connectors(self, database: Database) -> dict[str, _Row]:
        bounds = {}
        names = ("lane_connector_fid", *BOUNDS)
        if set(names) <= set(database.columns(CONNECTOR_BOUNDS)):
            for row in database.table(CONNECTOR_BOUNDS, names, MAX_ROWS):
                fid, left, right = map(_fid, row)
                bounds[fid] = left, right
        signs = self._signs(connectors=True)
        self._leaving: dict[int, list[str]] = {}  # connectors of a lane
        found = {}
        lights = ("traffic_light_stop_line_fids",)
        for number, leaves, enters, limit, stops in database.table(
            "lane_connectors", CONNECTORS, MAX_ROWS, lights
        ):
            fid, lines = _fid(number), _fids(stops)
            name = f"connector-{fid}"
            self._leaving.setdefault(_fid(leaves), []).append(name)
            found[name] = _Row(
                id=name,
                limit=_limit(limit),
                bounds=bounds.get(fid, (NONE, NONE)),
                successors=(str(_fid(enters)),),
                signal=str(fid) if lines else None,
                stops=lines or ((signs[fid],) if fid in signs else ()),
                has_sign=fid in signs and not lines,
            )
        return found


def _centres(layers: Layers) -> dict[str, np.ndarray]:
    """Centre lines [n >= 2, 2] m by the id of their lane or connector."""
    found = {}
    for line, lane, connector in layers.rows("baseline_paths", CENTRES):
        fid = _fid(lane)
        name = f"connector-{_fid(connector)}" if fid == NONE else str(fid)
        line = line[moves(line)] if len(line) else line
        if len(line) >= 2:
            found[name] = line
    return found


def _stops(layers: Layers) -> dict[int, tuple]:
    """Stop polygons: type, middle [2] m, fids of lanes and of connectors."""
    if not layers.database.columns("stop_polygons"):
        return {}
    users = ("lane_fids", "lane_connector_fids")
    found = {}
    for ring, fid, kind, *lists in layers.rows("stop_polygons", STOPS, users):
        if len(ring):
            middle = ring[:-1].mean(axis=0) if len(ring) > 1 else ring[0]
            found[_fid(fid)] = (_fid(kind), middle, *map(_fids, lists))
    return found


def _zone(database: Database) -> tuple[int, bool]:
    """The UTM zone of a city, from the table meta."""
    value: object = "missing"
    if database.columns("meta"):
        found = dict(database.table("meta", ("key", "value"), MAX_ROWS))
        value = found.get("projectedCoordSystem", value)
    zone = zone_of(value)
    if zone is None:
        raise database.error(
            "meta: projectedCoordSystem", str(value), "a UTM zone such as epsg:32611"
        )
    return zone


def _fid(value: object) -> int:
    """A feature's number, which some tables keep as real or text; NONE if none."""
    try:
        number = float(value) if isinstance(value, int | float | str) else float("nan")
    except ValueError:
        number = float("nan")
    return int(number) if np.isfinite(number) else NONE


def _fids(value: object) -> tuple[int, ...]:
    """Numbers separated by commas."""
    parts = value.split(",") if isinstance(value, str) else [value]
    found = [_fid(part) for part in parts]
    return tuple(fid for fid in found if fid != NONE)


def _limit(value: object) -> float | None:
    if isinstance(value, int | float) and 0.0 < value <= MAX_LIMIT_MPS:
        return float(value)
    return None
