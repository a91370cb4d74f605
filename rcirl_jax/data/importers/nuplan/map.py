"""nuPlan maps: lanes and lane connectors of a city's `map.gpkg`.

Layers read: baseline_paths (centre lines), lanes_polygons (limits, neighbours,
bounds), lane_connectors (paths across junctions), boundaries,
gen_lane_connectors_scaled_width_polygons (bounds of connectors), stop_polygons,
meta (the UTM zone). Geometries are WGS84 degrees, logs are in that UTM zone.

A connector leaves its "exit lane" and enters its "entry lane". Lanes of a group
are numbered from left to right.
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.importers.files import MAP_FOLDERS
from rcirl_jax.data.importers.nuplan.geopackage import Layers, zone_of
from rcirl_jax.data.importers.options import path_option
from rcirl_jax.data.importers.shapes import (
    MIN_HALF_WIDTH_M,
    distance_to_line,
    line_across,
    moves,
)
from rcirl_jax.data.readers.sqlite import Database
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane

MAX_ROWS = 2_000_000  # rows of one layer; a city has some 1e4
MARGIN_M = 150.0  # m of map around the tracks
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
GEOMETRY = "geom"  # column of a layer's geometries where the file names none
MAX_NAME = 100  # characters of a column's name
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
            self._layers = Layers(database, *_zone(database))
            self._geometry = _geometry_columns(database)
            self._stops = self._read_stops(database)
            rows = {**self._connectors(database), **self._lanes_of(database)}
            self._rows, self._centres = self._read_centres(database, rows)
            self._bounds: dict[int, object] = {}
            if database.columns("boundaries"):
                columns = ("fid", self._column("boundaries"))
                table = _table(database, "boundaries", columns)
                self._bounds = {_fid(fid): blob for fid, blob in table}
        self._made: dict[int, Lane] = {}
        self._boxes = np.array(
            [[line.min(axis=0), line.max(axis=0)] for line in self._centres]
        ).reshape(-1, 2, 2)

    def lanes(
        self, x: np.ndarray, y: np.ndarray, origin: np.ndarray
    ) -> tuple[Lane, ...]:
        """Lanes around positions [m], less the origin."""
        low = np.array([x.min(), y.min()]) - MARGIN_M
        high = np.array([x.max(), y.max()]) + MARGIN_M
        near = (self._boxes[:, 1] >= low).all(1) & (self._boxes[:, 0] <= high).all(1)
        found = []
        for index in np.flatnonzero(near).tolist():
            if index not in self._made:
                self._made[index] = self._make(index)
            lane = self._made[index]
            stop = None if lane.stop_line is None else lane.stop_line - origin
            found.append(
                dataclasses.replace(lane, centre=lane.centre - origin, stop_line=stop)
            )
        return tuple(found)

    def _column(self, layer: str) -> str:
        """Name of a layer's column of geometries."""
        return self._geometry.get(layer, GEOMETRY)

    def _lines(self, layer: str, blobs: Sequence[object]) -> list[np.ndarray]:
        """[n, 2] m of each geometry of a layer."""
        return self._layers.lines(layer, self._column(layer), blobs)

    def _make(self, index: int) -> Lane:
        row, centre = self._rows[index], self._centres[index]
        left, right = (self._half_width(fid, centre) for fid in row.bounds)
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
        )

    def _half_width(self, fid: int, centre: np.ndarray) -> np.ndarray:
        """Distance [n] m of a bound from the centre line's points."""
        default = np.full(len(centre), HALF_WIDTH_M)
        if fid not in self._bounds:
            return default
        (line,) = self._lines("boundaries", [self._bounds[fid]])
        if not len(line):
            return default
        apart = distance_to_line(centre, line)
        return np.clip(apart, MIN_HALF_WIDTH_M, MAX_HALF_WIDTH_M)

    def _read_centres(
        self, database: Database, rows: Mapping[str, _Row]
    ) -> tuple[list[_Row], list[np.ndarray]]:
        """Rows that have a centre line, and those lines [n >= 2, 2] m."""
        columns = (self._column("baseline_paths"), *CENTRES)
        table = _table(database, "baseline_paths", columns)
        lines = self._lines("baseline_paths", [row[0] for row in table])
        found: dict[str, np.ndarray] = {}
        for (_, lane, connector), line in zip(table, lines, strict=True):
            fid = _fid(lane)
            name = _connector_id(_fid(connector)) if fid == NONE else str(fid)
            line = line[moves(line)] if len(line) else line
            if name in rows and len(line) >= 2:
                found[name] = line
        return [rows[name] for name in found], list(found.values())

    def _lanes_of(self, database: Database) -> dict[str, _Row]:
        columns = database.columns("lanes_polygons")
        bounds = BOUNDS if set(BOUNDS) <= set(columns) else ("NULL", "NULL")
        table = _table(database, "lanes_polygons", (*LANES, *bounds))
        place = {}
        for lane, group, index, *_ in table:
            if NONE not in (_fid(group), _fid(index)):
                place[_fid(group), _fid(index)] = str(_fid(lane))
        signs = {
            lane: fid
            for fid, (kind, _, lanes, connectors) in self._stops.items()
            if kind == STOP_SIGN and not connectors
            for lane in lanes
        }
        found = {}
        for lane, group, index, limit, left, right in table:
            fid, number = _fid(lane), _fid(index)
            beside: list[str | None] = [None, None]
            if number != NONE:
                beside = [place.get((_fid(group), number + k)) for k in (-1, 1)]
            found[str(fid)] = _Row(
                id=str(fid),
                limit=_limit(limit),
                bounds=(_fid(left), _fid(right)),
                successors=tuple(self._leaving.get(fid, ())),
                left=beside[0],
                right=beside[1],
                stops=(signs[fid],) if fid in signs else (),
                has_sign=fid in signs,
            )
        return found

    def _connectors(self, database: Database) -> dict[str, _Row]:
        columns = database.columns("lane_connectors")
        lights = "traffic_light_stop_line_fids"
        wanted = (*CONNECTORS, lights if lights in columns else "NULL")
        bounds = _connector_bounds(database)
        signs = {
            connector: fid
            for fid, (kind, _, _, connectors) in self._stops.items()
            if kind == STOP_SIGN
            for connector in connectors
        }
        self._leaving: dict[int, list[str]] = {}  # connectors of a lane
        found = {}
        for number, leaves, enters, limit, stops in _table(
            database, "lane_connectors", wanted
        ):
            fid, lines = _fid(number), _fids(stops)
            name = _connector_id(fid)
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

    def _read_stops(self, database: Database) -> dict[int, tuple]:
        """Stop polygons: type, middle [2] m, fids of lanes and of connectors."""
        columns = database.columns("stop_polygons")
        if not columns:
            return {}
        lists = [
            name if name in columns else "NULL"
            for name in ("lane_fids", "lane_connector_fids")
        ]
        wanted = (self._column("stop_polygons"), *STOPS, *lists)
        table = _table(database, "stop_polygons", wanted)
        rings = self._lines("stop_polygons", [row[0] for row in table])
        found = {}
        for (_, fid, kind, *users), ring in zip(table, rings, strict=True):
            if len(ring):
                middle = ring[:-1].mean(axis=0) if len(ring) > 1 else ring[0]
                found[_fid(fid)] = (_fid(kind), middle, *map(_fids, users))
        return found


def _table(database: Database, table: str, columns: Sequence[str]) -> list[tuple]:
    """All rows of a layer's columns; "NULL" stands for one that is missing."""
    database.need(table, [name for name in columns if name != "NULL"])
    chosen = [name if name == "NULL" else _quoted(name) for name in columns]
    sql = f'SELECT {", ".join(chosen)} FROM "{table}"'
    chunks = database.chunks(sql, (table,), MAX_ROWS)
    return [row for rows in chunks for row in rows]


def _quoted(name: str) -> str:
    """A column's name in SQL; the file may have chosen it."""
    return '"' + name.replace('"', '""') + '"'


def _geometry_columns(database: Database) -> dict[str, str]:
    """Layer -> its column of geometries; a short name, of one line for errors."""
    table = "gpkg_geometry_columns"
    if not database.columns(table):
        return {}
    rows = _table(database, table, ("table_name", "column_name"))
    return {str(layer): " ".join(str(name).split())[:MAX_NAME] for layer, name in rows}


def _zone(database: Database) -> tuple[int, bool]:
    """The UTM zone of a city, from the table meta."""
    value: object = "missing"
    if database.columns("meta"):
        found = {str(key): v for key, v in _table(database, "meta", ("key", "value"))}
        value = found.get("projectedCoordSystem", value)
    zone = zone_of(value)
    if zone is None:
        raise database.error(
            "meta: projectedCoordSystem", str(value), "a UTM zone such as epsg:32611"
        )
    return zone


def _connector_bounds(database: Database) -> dict[int, tuple]:
    columns = database.columns(CONNECTOR_BOUNDS)
    if not {"lane_connector_fid", *BOUNDS} <= set(columns):
        return {}
    table = _table(database, CONNECTOR_BOUNDS, ("lane_connector_fid", *BOUNDS))
    return {_fid(fid): (_fid(left), _fid(right)) for fid, left, right in table}


def _connector_id(fid: int) -> str:
    return f"connector-{fid}"


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
