"""nuPlan maps: lanes and lane connectors of a city's `map.gpkg`.

A GeoPackage is SQLite with geometry blobs (www.geopackage.org/spec, clause 2.1.3): a
head "GP", version, flags, srs_id and an optional envelope, then well-known binary.
It is read by hand, with numbers of points checked against the blob's length, because
shapely's reader is no faster, and 80 kB of nested lines crash it.

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
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.formats.files import MAP_FOLDERS
from rcirl_jax.data.formats.options import path_option
from rcirl_jax.data.formats.projection import utm
from rcirl_jax.data.formats.shapes import (
    MAX_COORDINATE_M,
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
MAX_ROWS = 2_000_000  # rows of one layer; a city has some 1e4
MAX_NAME = 100  # characters of a column's name
MAX_POINTS = 20_000  # of one line; a city's longest has some 1e3
ENVELOPE_BYTES = (0, 32, 48, 48, 64)  # by the flags' envelope code
LINE, POLYGON, MULTI_LINE, MULTI_POLYGON = 2, 3, 5, 6
EWKB_Z, EWKB_M = 0x80000000, 0x40000000
GEOGRAPHIC = 4326  # WGS84 longitude and latitude in degrees
EPSG = re.compile(r"(?:epsg:)?(\d{4,6})", re.IGNORECASE)
GEOMETRIES = ("table_name", "column_name", "srs_id")
CENTRES = ("lane_fid", "lane_connector_fid")
LANES = ("lane_fid", "lane_group_fid", "lane_index", "speed_limit_mps")
CONNECTORS = ("fid", "exit_lane_fid", "entry_lane_fid", "speed_limit_mps")
LIGHTS = ("traffic_light_stop_line_fids",)
BOUNDS = ("left_boundary_fid", "right_boundary_fid")
CONNECTOR_BOUNDS = "gen_lane_connectors_scaled_width_polygons"
STOPS = ("fid", "stop_polygon_type_fid")
STOP_USERS = ("lane_fids", "lane_connector_fids")


def find_map(file: Path, names: Sequence[str], spec: Mapping) -> Path | None:
    """Finds map.gpkg of a log: MAP_FOLDERS/NAME/VERSION/ above it, or as in the TOML.

    Args:
      file: the log.
      names: under which its map may be filed, e.g. "us-nv-las-vegas-strip" or the
        location "las_vegas", which names the folder that contains it.
      spec: `maps` names the folder of the maps; relative to a folder above the log.
    """
    given = path_option(spec, "maps")
    above = list(file.resolve().parents)[:FOLDERS_UP]
    roots = [
        folder / n for folder in above for n in ([given] if given else MAP_FOLDERS)
    ]
    for root in [Path(given), *roots] if given else roots:
        for name in names:
            if not (root.is_dir() and SAFE_NAME.fullmatch(name)):
                continue
            part = name.replace("_", "-").lower()
            folders = [f for f in sorted(root.iterdir()) if part in f.name.lower()]
            chosen = [folder for folder in folders if folder.name == name] or folders
            found = sorted(chosen[0].glob("*/map.gpkg")) if len(chosen) == 1 else []
            if found:
                return found[-1]  # the latest version
    if given:
        raise InputError(
            f"source TOML: maps: {given}: no map of {' or '.join(names)[:80]}: "
            "expected NAME/VERSION/map.gpkg in it"
        )
    return None


# ----------------------------------------------------------------- geometries


def points_of(blob: object) -> np.ndarray:
    """Returns points [n, 2] of a line, of a polygon's outer ring, or of the longest.

    Raises:
      ValueError: no GeoPackage blob, another geometry, or a count beyond it.
    """
    if not isinstance(blob, bytes) or len(blob) < 8 or blob[:2] != b"GP":
        raise ValueError("no GeoPackage geometry")
    code = blob[3] >> 1 & 7
    if code >= len(ENVELOPE_BYTES):
        raise ValueError(f"envelope {code}")
    if blob[3] & 0x10:  # empty
        return np.zeros((0, 2))
    try:
        parts, _ = _well_known(blob, 8 + ENVELOPE_BYTES[code], 0)
    except (struct.error, IndexError) as error:
        raise ValueError("well-known binary cut short") from error
    return max(parts, key=len, default=np.zeros((0, 2)))


def _well_known(blob: bytes, at: int, depth: int) -> tuple[list[np.ndarray], int]:
    """(lines or outer rings, place behind them) of well-known binary."""
    if blob[at] > 1 or depth > 1:
        raise ValueError("well-known binary cut short")
    order = "<" if blob[at] else ">"
    kind, count = struct.unpack_from(order + "II", blob, at + 1)
    size = 2 + bool(kind & EWKB_Z) + bool(kind & EWKB_M)
    flat = kind & 0x0FFFFFFF
    size += (0, 1, 1, 2)[flat // 1000] if flat < 4000 else 0
    kind, at = flat % 1000, at + 9

    def points(at: int, count: int) -> tuple[np.ndarray, int]:
        end = at + 8 * size * count
        if end > len(blob):
            raise ValueError(f"{count} points in {len(blob) - at} bytes")
        values = np.frombuffer(blob, order + "f8", size * count, at)
        return values.reshape(count, size)[:, :2].astype(np.float64), end

    found = []
    if kind == LINE:
        line, at = points(at, count)
        return [line], at
    if kind == POLYGON:  # the outer ring is the first; inner ones are stepped over
        for _ in range(min(count, len(blob))):
            (number,) = struct.unpack_from(order + "I", blob, at)
            ring, at = points(at + 4, number)
            found.append(ring)
        return found[:1], at
    if kind not in (MULTI_LINE, MULTI_POLYGON):
        raise ValueError(f"geometry type {kind}")
    for _ in range(min(count, len(blob))):
        parts, at = _well_known(blob, at, depth + 1)
        found += parts
    return found, at


def zone_of(system: object) -> tuple[int, bool] | None:
    """Returns (UTM zone, southern) of an EPSG code such as 32611 or "epsg:32611"."""
    match = EPSG.fullmatch(str(system).strip())
    code = int(match[1]) if match else 0
    # WGS84 north and south; NAD83, which differs by about a metre
    for first, south in ((32600, False), (32700, True), (26900, False)):
        if first < code <= first + 60:
            return code - first, south
    return None


class _Layers:
    """Layers of one GeoPackage, projected to the UTM zone that its table meta names."""

    def __init__(self, database: Database) -> None:
        self.database, value = database, "missing"
        if database.columns("meta"):
            found = dict(database.table("meta", ("key", "value"), MAX_ROWS))
            value = found.get("projectedCoordSystem", value)
        if (zone := zone_of(value)) is None:
            field, expected = (
                "meta: projectedCoordSystem",
                "a UTM zone such as epsg:32611",
            )
            raise database.error(field, str(value), expected)
        self.zone = zone
        about = "gpkg_geometry_columns"
        has_about = database.columns(about)
        rows = database.table(about, GEOMETRIES, MAX_ROWS) if has_about else ()
        # a short name, of one line for errors
        self._about = {
            str(layer): (" ".join(str(column).split())[:MAX_NAME], srs)
            for layer, column, srs in rows
        }

    def rows(
        self, layer: str, columns: Sequence[str], optional: Sequence[str] = ()
    ) -> list[tuple]:
        """Returns rows of a layer: the geometry's blob, columns, those optional."""
        geometry = self._about.get(layer, ("geom", GEOGRAPHIC))[0]
        return self.database.table(layer, (geometry, *columns), MAX_ROWS, optional)

    def lines(self, layer: str, blobs: Sequence[object]) -> list[np.ndarray]:
        """Returns [n, 2] m of each geometry of a layer.

        Raises:
          InputError: a blob that is no geometry, an unknown system, or a place
            outside of it.
        """
        if not blobs:
            return []
        column, system = self._about.get(layer, ("geom", GEOGRAPHIC))
        database, where = self.database, f"{layer}.{column}"
        try:
            found = [points_of(blob) for blob in blobs]
        except ValueError as error:
            raise database.error(where, str(error), "a GeoPackage geometry") from error
        longest = max(map(len, found), default=0)
        if longest > MAX_POINTS:
            raise database.error(where, f"{longest} points", f"at most {MAX_POINTS}")
        every = np.concatenate([np.zeros((0, 2)), *found])
        is_degrees = system == GEOGRAPHIC
        limits = np.array([180.0, 84.0]) if is_degrees else MAX_COORDINATE_M
        bad = every[~(np.abs(every) <= limits)]
        if bad.size:
            expected = "longitude, latitude in degrees" if is_degrees else "metres"
            raise database.error(where, f"{bad[0]:g}", expected)
        if is_degrees:
            every = utm(every[:, 1], every[:, 0], self.zone[0], south=self.zone[1])
        elif zone_of(system) != self.zone:
            raise database.error(
                f"{layer}: srs_id", str(system), f"{GEOGRAPHIC} or the log's UTM zone"
            )
        return np.split(every, np.cumsum([len(line) for line in found])[:-1])


# ---------------------------------------------------------------------- lanes


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Row:
    """A lane or connector as the map's tables have it."""

    id: str
    limit: Any  # m/s, if it is a number
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
            self._layers = layers = _Layers(database)
            self._stops: dict[int, np.ndarray] = {}  # middle [2] m by fid
            lane_signs, connector_signs = self._read_stops()
            rows, leaving = self._connectors(connector_signs)
            rows |= self._lanes(lane_signs, leaving)
            table = layers.rows("baseline_paths", CENTRES)
            lines = layers.lines("baseline_paths", [row[0] for row in table])
            self._centres: dict[str, np.ndarray] = {}
            for line, (_, lane, connector) in zip(lines, table, strict=True):
                fid = _fid(lane)
                name = f"connector-{_fid(connector)}" if fid == NONE else str(fid)
                line = line[moves(line)] if len(line) else line
                if len(line) >= 2 and name in rows:
                    self._centres[name] = line
            self._bounds: dict[int, object] = {}
            if database.columns("boundaries"):
                table = layers.rows("boundaries", ("fid",))
                self._bounds = {_fid(fid): blob for blob, fid in table}
        self._rows = [rows[name] for name in self._centres]
        self.roads = Roads([*self._centres.values()], functools.cache(self._make))

    def _read_stops(self) -> tuple[dict[int, int], dict[int, int]]:
        """Stop signs' polygons by the lane, and by the connector, that they govern."""
        lanes, connectors = {}, {}
        if self._layers.database.columns("stop_polygons"):
            table = self._layers.rows("stop_polygons", STOPS, STOP_USERS)
            rings = self._layers.lines("stop_polygons", [row[0] for row in table])
            kinds = {}
            for ring, (_, number, kind, *users) in zip(rings, table, strict=True):
                if len(ring):
                    middle = ring[:-1].mean(axis=0) if len(ring) > 1 else ring[0]
                    self._stops[_fid(number)] = middle
                    kinds[_fid(number)] = _fid(kind), *map(_fids, users)
            for fid, (kind, ways, across) in kinds.items():
                if kind == STOP_SIGN:
                    connectors |= dict.fromkeys(across, fid)
                    lanes |= dict.fromkeys(() if across else ways, fid)
        return lanes, connectors

    def _connectors(
        self, signs: Mapping[int, int]
    ) -> tuple[dict[str, _Row], dict[int, list[str]]]:
        """Connectors by id, and ids of those that leave a lane."""
        database, bounds = self._layers.database, {}
        names = ("lane_connector_fid", *BOUNDS)
        if set(names) <= set(database.columns(CONNECTOR_BOUNDS)):
            for row in database.table(CONNECTOR_BOUNDS, names, MAX_ROWS):
                fid, left, right = map(_fid, row)
                bounds[fid] = left, right
        found, leaving = {}, {}
        for number, leaves, enters, limit, stops in database.table(
            "lane_connectors", CONNECTORS, MAX_ROWS, LIGHTS
        ):
            fid, lines = _fid(number), _fids(stops)
            name = f"connector-{fid}"
            leaving.setdefault(_fid(leaves), []).append(name)
            found[name] = _Row(
                id=name,
                limit=limit,
                bounds=bounds.get(fid, (NONE, NONE)),
                successors=(str(_fid(enters)),),
                signal=str(fid) if lines else None,
                stops=lines or ((signs[fid],) if fid in signs else ()),
                has_sign=fid in signs and not lines,
            )
        return found, leaving

    def _lanes(
        self, signs: Mapping[int, int], leaving: Mapping[int, Sequence[str]]
    ) -> dict[str, _Row]:
        database = self._layers.database
        has_bounds = set(BOUNDS) <= set(database.columns("lanes_polygons"))
        bounds = BOUNDS if has_bounds else ("", "")
        table = [
            (*map(_fid, row[:3]), row[3], (_fid(row[4]), _fid(row[5])))
            for row in database.table("lanes_polygons", LANES, MAX_ROWS, bounds)
        ]
        place = {
            (group, index): str(fid)
            for fid, group, index, *_ in table
            if NONE not in (group, index)
        }
        found = {}
        for fid, group, index, limit, beside in table:
            is_placed = index != NONE
            found[str(fid)] = _Row(
                id=str(fid),
                limit=limit,
                bounds=beside,
                successors=tuple(leaving.get(fid, ())),
                left=place.get((group, index - 1)) if is_placed else None,
                right=place.get((group, index + 1)) if is_placed else None,
                stops=(signs[fid],) if fid in signs else (),
                has_sign=fid in signs,
            )
        return found

    def _make(self, index: int) -> Lane:
        row = self._rows[index]
        centre = self._centres[row.id]
        sides, assumed = [], False
        for fid in row.bounds:  # distance [n] m of each from the centre line's points
            line = np.zeros((0, 2))
            if fid in self._bounds:
                (line,) = self._layers.lines("boundaries", [self._bounds[fid]])
            half = np.full(len(centre), HALF_WIDTH_M)
            if len(line):
                half = distance_to_line(centre, line)
            sides.append(np.clip(half, MIN_HALF_WIDTH_M, MAX_HALF_WIDTH_M))
            assumed |= not len(line)
        stop, limit = None, row.limit
        if row.signal is not None or row.has_sign:
            places = [self._stops[fid] for fid in row.stops if fid in self._stops]
            start = centre[0]
            near = min(places, key=lambda p: np.hypot(*(p - start)), default=start)
            stop = line_across(centre, sides[0], sides[1], near)
        known = isinstance(limit, int | float) and 0.0 < limit <= MAX_LIMIT_MPS
        speed_limit = float(limit) if known else None
        return Lane(
            id=row.id,
            centre=centre,
            left_width=sides[0],
            right_width=sides[1],
            speed_limit=speed_limit,
            successors=row.successors,
            left=row.left,
            right=row.right,
            stop_line=stop,
            signal_ids=() if row.signal is None else (row.signal,),
            stop_sign=row.has_sign,
            width_assumed=assumed,
        )


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
