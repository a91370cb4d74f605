"""GeoPackage layers (SQLite with geometry blobs): lines and polygons in metres.

Specification: www.geopackage.org/spec, clause 2.1.3: a blob is a head "GP",
version, flags, srs_id and an optional envelope, then well-known binary. Numbers
of points are checked against the blob's length before anything is read. By hand,
because shapely's reader is no faster, and 80 kB of nested lines crash it.
"""

import re
import struct
from collections.abc import Sequence

import numpy as np

from rcirl_jax.data.formats.projection import utm
from rcirl_jax.data.formats.shapes import MAX_COORDINATE_M
from rcirl_jax.data.readers.sqlite import Database

ENVELOPE_BYTES = (0, 32, 48, 48, 64)  # by the flags' envelope code
LINE, POLYGON, MULTI_LINE, MULTI_POLYGON = 2, 3, 5, 6
MAX_ROWS = 2_000_000  # rows of one layer; a city has some 1e4
MAX_NAME = 100  # characters of a column's name
MAX_POINTS = 20_000  # of one line; a city's longest has some 1e3
EWKB_Z, EWKB_M = 0x80000000, 0x40000000
GEOGRAPHIC = 4326  # WGS84 longitude and latitude in degrees
EPSG = re.compile(r"(?:epsg:)?(\d{4,6})", re.IGNORECASE)


def points_of(blob: object) -> np.ndarray:
    """Points [n, 2] of a geometry: a line, a polygon's outer ring, or the longest.

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
    parts, _ = _well_known(blob, 8 + ENVELOPE_BYTES[code], 0)
    return max(parts, key=len, default=np.zeros((0, 2)))


def _well_known(blob: bytes, at: int, depth: int) -> tuple[list[np.ndarray], int]:
    """(lines or outer rings, place behind them) of well-known binary."""
    if len(blob) < at + 9 or blob[at] > 1 or depth > 1:
        raise ValueError("well-known binary cut short")
    order = "<" if blob[at] else ">"
    kind, count = struct.unpack_from(order + "II", blob, at + 1)
    size = 2 + bool(kind & EWKB_Z) + bool(kind & EWKB_M)
    flat = kind & 0x0FFFFFFF
    size += (0, 1, 1, 2)[flat // 1000] if flat < 4000 else 0
    kind, at = flat % 1000, at + 9
    if kind == LINE:
        points, at = _points(blob, at, count, size, order)
        return [points], at
    if kind == POLYGON:  # the outer ring is the first; inner ones are stepped over
        rings = []
        for _ in range(min(count, len(blob))):
            if len(blob) < at + 4:
                raise ValueError("well-known binary cut short")
            (number,) = struct.unpack_from(order + "I", blob, at)
            points, at = _points(blob, at + 4, number, size, order)
            rings.append(points)
        return rings[:1], at
    if kind in (MULTI_LINE, MULTI_POLYGON):
        found = []
        for _ in range(min(count, len(blob))):
            parts, at = _well_known(blob, at, depth + 1)
            found += parts
        return found, at
    raise ValueError(f"geometry type {kind}")


def _points(
    blob: bytes, at: int, count: int, size: int, order: str
) -> tuple[np.ndarray, int]:
    end = at + 8 * size * count
    if end > len(blob):
        raise ValueError(f"{count} points in {len(blob) - at} bytes")
    values = np.frombuffer(blob, order + "f8", size * count, at)
    return values.reshape(count, size)[:, :2].astype(np.float64), end


class Layers:
    """Layers of one GeoPackage, projected to one UTM zone.

    Args:
      database: the opened file.
      zone: number of the zone.
      south: whether it is a southern one.
    """

    def __init__(self, database: Database, zone: int, south: bool) -> None:
        self.database, self.zone, self.south = database, zone, south
        about = "gpkg_geometry_columns"
        names = ("table_name", "column_name", "srs_id")
        found = (
            database.table(about, names, MAX_ROWS) if database.columns(about) else ()
        )
        # a short name, of one line for errors
        self._about = {
            str(layer): (" ".join(str(column).split())[:MAX_NAME], srs)
            for layer, column, srs in found
        }

    def blobs(
        self, layer: str, columns: Sequence[str], optional: Sequence[str] = ()
    ) -> list[tuple]:
        """Rows of a layer: geometry, the columns, those that may be missing."""
        geometry = self._about.get(layer, ("geom", GEOGRAPHIC))[0]
        return self.database.table(layer, (geometry, *columns), MAX_ROWS, optional)

    def rows(
        self, layer: str, columns: Sequence[str], optional: Sequence[str] = ()
    ) -> list[tuple]:
        """As `blobs`, with the points [n, 2] m of each geometry."""
        table = self.blobs(layer, columns, optional)
        lines = self.lines(layer, [row[0] for row in table])
        return [(line, *row[1:]) for line, row in zip(lines, table, strict=True)]

    def lines(self, layer: str, blobs: Sequence[object]) -> list[np.ndarray]:
        """[n, 2] m of each geometry of a layer.

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
        bad = np.argwhere(~(np.abs(every) <= limits))
        if bad.size:
            value = every[bad[0][0], bad[0][1]]
            expected = "longitude, latitude in degrees" if is_degrees else "metres"
            raise database.error(where, f"{value:g}", expected)
        if is_degrees:
            every = utm(every[:, 1], every[:, 0], self.zone, south=self.south)
        elif zone_of(system) != (self.zone, self.south):
            raise database.error(
                f"{layer}: srs_id", str(system), f"{GEOGRAPHIC} or the log's UTM zone"
            )
        return np.split(every, np.cumsum([len(line) for line in found])[:-1])


def zone_of(system: object) -> tuple[int, bool] | None:
    """(UTM zone, southern) of an EPSG code such as 32611 or "epsg:32611"."""
    match = EPSG.fullmatch(str(system).strip())
    code = int(match[1]) if match else 0
    # WGS84 north and south; NAD83, which differs by about a metre
    for first, south in ((32600, False), (32700, True), (26900, False)):
        if first < code <= first + 60:
            return code - first, south
    return None
