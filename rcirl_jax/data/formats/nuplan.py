"""nuPlan logs: one SQLite database (`*.db`) per log, and the maps' GeoPackages.

Layout: docs/nuplan_schema.md of motional/nuplan-devkit (v1.0, v1.1). Tokens are
BLOBs, times microseconds, positions UTM metres, 20 Hz. Boxes come from the table
lidar_box, the ego from the pose of each lidar_pc. Long logs are read in windows
of time that overlap; each is a Recording. The logs of one drive are one group.

Traps: ego_pose is the rear axle's centre; its time is not the lidar_pc's, even
when linked; velocities of boxes are a network's guess; the columns translation,
rotation and intrinsic of lidar and camera are pickles and are never read;
traffic lights belong to lane connectors and are inferred from the traffic.

A city's `map.gpkg` is SQLite with blobs (www.geopackage.org/spec, clause 2.1.3): a
head "GP", version, flags, srs_id and an optional envelope, then well-known binary.
Geometries are WGS84 degrees, logs are in the UTM zone that the layer `meta` names.

A connector leaves its "exit lane" and enters its "entry lane". Lanes of a group
are numbered from left to right.
"""

import dataclasses
import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.formats.files import MAP_FOLDERS, files_below, log_name
from rcirl_jax.data.formats.messages import (
    MAX_DURATION_S,
    MAX_GAP_S,
    Windows,
    around,
    longest_window,
)
from rcirl_jax.data.formats.options import one_pattern, path_option, positive
from rcirl_jax.data.formats.perception import (
    Boxes,
    ego_boxes,
    fitted_lanes,
    held_states,
    placed,
    signal_of,
    tracks_of,
)
from rcirl_jax.data.formats.projection import utm
from rcirl_jax.data.formats.shapes import (
    MAX_COORDINATE_M,
    MIN_HALF_WIDTH_M,
    Roads,
    check_coordinates,
    distance_to_line,
    limit_of,
    line_across,
    moves,
    origin_notes,
)
from rcirl_jax.data.readers.sqlite import Database
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError, extra_module
from rcirl_jax.types import Kind, Lane, Recording, Signal, Track

HALF_WIDTH_M = 1.75  # m, where a lane's bounds are not in the map
MAX_HALF_WIDTH_M = 6.0  # m; a bound farther off is another lane's
STOP_SIGN = 1  # stop_polygon_type_fid
NONE = -1  # no feature's number
FOLDERS_UP = 6  # folders above a log in which those of maps are looked for
SAFE_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}")
MAX_ROWS = 2_000_000  # rows of one layer; a city has some 1e4
MAX_NAME = 100  # characters of a column's name
MAX_POINTS = 20_000  # of one line; a city's longest has some 1e3
ENVELOPE_BYTES = (0, 32, 48, 48, 64)  # by the flags' envelope code
SHAPES = ("LineString", "Polygon", "MultiLineString", "MultiPolygon")
GEOGRAPHIC = 4326  # WGS84 longitude and latitude in degrees
EPSG = re.compile(r"(?:epsg:)?(\d{4,6})", re.IGNORECASE)
NEEDED = ("baseline_paths", "lane_connectors", "lanes_polygons")  # layers
BOUNDS = ("left_boundary_fid", "right_boundary_fid")
CONNECTOR_BOUNDS = "gen_lane_connectors_scaled_width_polygons"


def find_map(file: Path, names: Sequence[str], spec: Mapping) -> Path | None:
    """Finds map.gpkg of a log: MAP_FOLDERS/NAME/VERSION/ above it, or as in the TOML.

    Args:
      file: the log.
      names: under which its map may be filed, e.g. "us-nv-las-vegas-strip" or the
        location "las_vegas", which names the folder that contains it.
      spec: `maps` names the folder of the maps; relative to a folder above the log.
    """
    given, above = path_option(spec, "maps"), file.resolve().parents[:FOLDERS_UP]
    roots = [folder / name for folder in above for name in MAP_FOLDERS]
    if given:
        roots = [folder / given for folder in (Path(), *above)]
    for root in filter(Path.is_dir, roots):
        for name in filter(SAFE_NAME.fullmatch, names):
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
      ValueError: no GeoPackage blob, or another geometry.
    """
    shapely = extra_module("shapely")
    if not isinstance(blob, bytes) or blob[:2] != b"GP" or len(blob) < 8:
        raise ValueError("no GeoPackage geometry")
    if blob[3] & 0x10:  # empty
        return np.zeros((0, 2))
    try:
        shape = shapely.from_wkb(blob[8 + ENVELOPE_BYTES[blob[3] >> 1 & 7] :])
    except (IndexError, shapely.errors.GEOSException) as error:
        raise ValueError(f"well-known binary: {error}") from error
    if shape.geom_type not in SHAPES:
        raise ValueError(f"geometry type {shape.geom_type}")
    parts = [getattr(part, "exterior", part) for part in shapely.get_parts(shape)]
    lines = map(shapely.get_coordinates, parts)
    return max(lines, key=len, default=np.zeros((0, 2)))


def zone_of(system: object) -> tuple[int, bool] | None:
    """Returns (UTM zone, southern) of an EPSG code such as 32611 or "epsg:32611"."""
    match = EPSG.fullmatch(str(system).strip())
    code = int(match[1]) if match else 0
    # WGS84 north and south; NAD83, which differs by about a metre
    for first, south in ((32600, False), (32700, True), (26900, False)):
        if first < code <= first + 60:
            return code - first, south
    return None


class _Package:
    """A GeoPackage, projected to the UTM zone that its table meta names."""

    def __init__(self, database: Database) -> None:
        self.database = database
        system = dict(self.rows("meta", ("key", "value"))).get("projectedCoordSystem")
        zone = zone_of(system)
        if zone is None:
            found = "missing" if system is None else str(system)
            expected = "a UTM zone such as epsg:32611"
            raise database.error("meta: projectedCoordSystem", found, expected)
        self.zone = zone
        columns = ("table_name", "column_name", "srs_id")
        # layer -> its geometry's column (a short name, of one line), its system
        self._geometry = {
            str(layer): (" ".join(str(column).split())[:MAX_NAME], system)
            for layer, column, system in self.rows("gpkg_geometry_columns", columns)
        }

    def geometry(self, layer: str) -> tuple[str, object]:
        """Returns the name of a layer's column of geometries, and their system."""
        return self._geometry.get(layer, ("geom", GEOGRAPHIC))

    def rows(
        self, layer: str, columns: Sequence[str], optional: Sequence[str] = ()
    ) -> list[tuple]:
        """Returns the columns of a layer, and optional ones; none without the layer."""
        if layer not in NEEDED and not self.database.columns(layer):
            return []
        return self.database.table(layer, columns, MAX_ROWS, optional)

    def shapes(
        self, layer: str, columns: Sequence[str], optional: Sequence[str] = ()
    ) -> list[tuple]:
        """Returns rows as `rows`, before each the points [n, 2] m of its geometry."""
        table = self.rows(layer, (self.geometry(layer)[0], *columns), optional)
        lines = self.lines(layer, [row[0] for row in table])
        return [(line, *row[1:]) for line, row in zip(lines, table, strict=True)]

    def lines(self, layer: str, blobs: Sequence[object]) -> list[np.ndarray]:
        """Returns [n, 2] m of each geometry of a layer."""
        if not blobs:
            return []
        column, system = self.geometry(layer)
        error, where = self.database.error, f"{layer}.{column}"
        try:
            found = [points_of(blob) for blob in blobs]
        except ValueError as fault:
            raise error(where, str(fault), "a GeoPackage geometry") from fault
        longest = max(map(len, found))
        if longest > MAX_POINTS:
            raise error(where, f"{longest} points", f"at most {MAX_POINTS}")
        every = np.concatenate(found)
        is_degrees = system == GEOGRAPHIC
        limits = np.array([180.0, 84.0]) if is_degrees else MAX_COORDINATE_M
        bad = every[~(np.abs(every) <= limits)]
        if bad.size:
            expected = "longitude, latitude in degrees" if is_degrees else "metres"
            raise error(where, f"{bad[0]:g}", expected)
        if is_degrees:
            every = utm(every[:, 1], every[:, 0], self.zone[0], south=self.zone[1])
        elif zone_of(system) != self.zone:
            expected = f"{GEOGRAPHIC} or the log's UTM zone"
            raise error(f"{layer}: srs_id", str(system), expected)
        return np.split(every, np.cumsum([len(line) for line in found])[:-1])


# ---------------------------------------------------------------------- lanes

# fids of a lane's left and right bound, fids of what stops it, other fields of the lane
_Row = tuple[Sequence[int], Sequence[int], dict[str, Any]]


class NuplanMap:
    """One city; lanes are made when they are first asked for."""

    def __init__(self, file: Path) -> None:
        """Reads all tables; geometries of lanes' bounds stay blobs."""
        with Database(file) as database:
            self._package = package = _Package(database)
            self._stops: dict[int, np.ndarray] = {}  # middle [2] m by fid
            rows = self._read_rows()
            centres: dict[str, np.ndarray] = {}
            ways = ("lane_fid", "lane_connector_fid")
            for line, lane, connector in package.shapes("baseline_paths", ways):
                fid = _fid(lane)
                name = f"connector-{_fid(connector)}" if fid == NONE else str(fid)
                line = line[moves(line)] if len(line) else line
                if len(line) >= 2 and name in rows:
                    centres[name] = line
            columns = (package.geometry("boundaries")[0], "fid")
            table = package.rows("boundaries", columns)
            self._bounds = {_fid(fid): blob for blob, fid in table}
        self._lanes = [(line, *rows[name]) for name, line in centres.items()]
        self.roads = Roads([*centres.values()], functools.cache(self._make))

    def _read_rows(self) -> dict[str, _Row]:
        """Lanes and connectors by id; middles of stop polygons are kept on the way."""
        package = self._package
        lane_signs: dict[int, int] = {}  # lane, or connector -> its stop sign's polygon
        signs: dict[int, int] = {}
        columns = ("fid", "stop_polygon_type_fid")
        users = ("lane_fids", "lane_connector_fids")
        for ring, number, kind, *governed in package.shapes(
            "stop_polygons", columns, users
        ):
            fid, (ways, across) = _fid(number), map(_fids, governed)
            if len(ring):
                self._stops[fid] = ring[:-1].mean(axis=0) if len(ring) > 1 else ring[0]
                if _fid(kind) == STOP_SIGN:
                    signs |= dict.fromkeys(across, fid)
                    lane_signs |= dict.fromkeys(() if across else ways, fid)
        table = package.rows(CONNECTOR_BOUNDS, (), ("lane_connector_fid", *BOUNDS))
        bounds = {_fid(fid): [*map(_fid, sides)] for fid, *sides in table}
        rows: dict[str, _Row] = {}
        leaving: dict[int, list[str]] = {}  # lane -> connectors
        columns = ("fid", "exit_lane_fid", "entry_lane_fid", "speed_limit_mps")
        for number, leaves, enters, limit, lights in package.rows(
            "lane_connectors", columns, ("traffic_light_stop_line_fids",)
        ):
            fid, lines = _fid(number), _fids(lights)
            name, sign = f"connector-{fid}", [signs[fid]] if fid in signs else []
            leaving.setdefault(_fid(leaves), []).append(name)
            fields = {
                "id": name,
                "speed_limit": limit_of(limit),
                "successors": (str(_fid(enters)),),
                "signal_ids": (str(fid),) if lines else (),
                "stop_sign": bool(sign and not lines),
            }
            rows[name] = bounds.get(fid, (NONE, NONE)), lines or sign, fields
        columns = ("lane_fid", "lane_group_fid", "lane_index", "speed_limit_mps")
        table = package.rows("lanes_polygons", columns, BOUNDS)
        places = [(*map(_fid, row[:3]),) for row in table]
        lane_at = {(group, index): str(fid) for fid, group, index in places}
        for (fid, group, index), row in zip(places, table, strict=True):
            *_, limit, left, right = row
            is_placed = NONE not in (group, index)
            # lane 0 is the leftmost
            beside = [lane_at.get((group, index + step)) for step in (-1, 1)]
            sign = [lane_signs[fid]] if fid in lane_signs else []
            fields = {
                "id": str(fid),
                "speed_limit": limit_of(limit),
                "successors": tuple(leaving.get(fid, ())),
                "left": beside[0] if is_placed and index else None,
                "right": beside[1] if is_placed else None,
                "stop_sign": bool(sign),
            }
            rows[str(fid)] = (_fid(left), _fid(right)), sign, fields
        return rows

    def _make(self, index: int) -> Lane:
        centre, bounds, stops, fields = self._lanes[index]
        sides, assumed = [], False
        for fid in bounds:  # distance [n] m of each from the centre line's points
            blobs = [self._bounds[fid]] if fid in self._bounds else []
            (line,) = self._package.lines("boundaries", blobs) or [np.zeros((0, 2))]
            half = np.full(len(centre), HALF_WIDTH_M)
            if len(line):
                half = distance_to_line(centre, line)
            sides.append(np.clip(half, MIN_HALF_WIDTH_M, MAX_HALF_WIDTH_M))
            assumed |= not len(line)
        line = None
        if stops:
            places = [self._stops[fid] for fid in stops if fid in self._stops]
            places.sort(key=lambda place: np.hypot(*(place - centre[0])))
            near = (places or [centre[0]])[0]
            line = line_across(centre, sides[0], sides[1], near)
        return Lane(
            centre=centre,
            left_width=sides[0],
            right_width=sides[1],
            stop_line=line,
            width_assumed=assumed,
            **fields,
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
    return tuple(fid for fid in map(_fid, parts) if fid != NONE)


TABLES = {
    "log": ("location", "map_version"),
    "lidar_pc": ("token", "timestamp", "ego_pose_token"),
    "ego_pose": ("token", "timestamp", "x", "y", "qw", "qx", "qy", "qz", "vx", "vy"),
    "lidar_box": (
        *("lidar_pc_token", "track_token", "x", "y", "yaw"),
        *("vx", "vy", "width", "length"),
    ),
    "track": ("token", "category_token"),
    "category": ("token", "name"),
}
LIGHTS = ("lidar_pc_token", "lane_connector_id", "status")
LIGHT = ("lidar_pc.timestamp", "traffic_light_status.lane_connector_id", "status")
STANDING = ("traffic_cone", "barrier", "czone_sign", "generic_object")
KIND_NAMES = {
    **{"vehicle": Kind.VEHICLE, "bicycle": Kind.CYCLIST},
    **{"pedestrian": Kind.PEDESTRIAN, **dict.fromkeys(STANDING, Kind.STATIC)},
}
POSE_SQL = """SELECT lp.timestamp, ep.timestamp, ep.x, ep.y, ep.qw, ep.qx, ep.qy,
  ep.qz, ep.vx, ep.vy FROM lidar_pc AS lp JOIN ego_pose AS ep
  ON lp.ego_pose_token = ep.token"""
POSE = ("lidar_pc.timestamp", *[f"ego_pose.{n}" for n in TABLES["ego_pose"][1:]])
BOX_SQL = """SELECT t.rowid, lp.timestamp, b.x, b.y, b.yaw, b.vx, b.vy, b.length,
  b.width FROM lidar_box AS b JOIN lidar_pc AS lp ON b.lidar_pc_token = lp.token
  LEFT JOIN track AS t ON b.track_token = t.token WHERE lp.timestamp BETWEEN ? AND ?"""
OF_BOX = ("track_token", "timestamp", "x", "y", "yaw", "vx", "vy", "length", "width")
BOX = tuple(f"lidar_box.{name}" for name in OF_BOX)
USER_SQL = """SELECT t.rowid, t.token, c.name FROM track AS t
  JOIN category AS c ON t.category_token = c.token"""
# any other status is off
LIGHT_SQL = """SELECT lp.timestamp, s.lane_connector_id, CASE s.status
  WHEN 'red' THEN 1 WHEN 'yellow' THEN 2 WHEN 'green' THEN 3 ELSE 0 END
  FROM traffic_light_status AS s JOIN lidar_pc AS lp
  ON s.lidar_pc_token = lp.token WHERE lp.timestamp BETWEEN ? AND ?"""
# of a release: DATE_veh-NN_START_END, the last two s of the drive
DRIVE = re.compile(r"(?P<drive>.+_veh-\d+)_\d+_\d+")
MAX_FRAMES = 10_000_000  # lidar_pc rows
MAX_TRACKS = 10_000_000
MAX_BOXES = 20_000_000  # boxes of one window
HOLD_S = 1.0  # s, a light without status keeps its state this long
MAX_STAMP_GAP_S = 0.2  # s, between a lidar_pc and the pose linked to it


def parts(path: Path, spec: dict) -> list[Path]:
    """Lists the databases: each can be read without the others."""
    return files_below(path, one_pattern(spec))


def own_name(file: Path) -> str:
    """Returns the name of a log, as long as no other folder has one called alike."""
    return file.stem


def drive_of(name: str) -> str:
    """Returns the drive that a log is a part of, by its name in the release."""
    match = DRIVE.fullmatch(name)
    return match["drive"] if match else name


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per log, or per window of a long one."""
    roads: dict[Path, NuplanMap] = {}
    for file in parts(path, spec):
        with Database(file) as database:
            for table, columns in TABLES.items():
                database.need(table, columns)
            # names under which the log's map may be filed
            names = database.table("log", ("map_version", "location"), 1000)
            if not names:
                raise database.error("table log", "no rows", "one")
            cells = [cell for cell in names[0] if isinstance(cell, str)]
            map_file = find_map(file, [c.removesuffix(".gpkg") for c in cells], spec)
            if map_file is not None and map_file not in roads:
                roads = {map_file: NuplanMap(map_file)}  # one city at a time
            road = roads[map_file] if map_file is not None else None
            name = log_name(file, spec, own_name(file))
            for recording in _Log(database, name, road, spec).windows():
                yield validate_recording(recording, file)


class _Log:
    """A log: its ego poses and road users, and recordings of their boxes."""

    def __init__(
        self, database: Database, name: str, road: NuplanMap | None, spec: dict
    ) -> None:
        self.database, self.name, self.road, self.spec = database, name, road, spec
        # the drive; logs of one name may be copies of each other
        self.group = drive_of(own_name(database.path))
        poses = database.numbers(POSE_SQL, POSE, MAX_FRAMES)
        if not len(poses):
            raise database.error("lidar_pc", "no row with an ego pose", "at least one")
        known = np.isfinite(poses[:, :8]).all(axis=0)  # all but the velocity
        if not known.all():
            raise database.error(POSE[int(np.argmin(known))], "NULL", "a number")
        check_coordinates(database.path, "ego_pose", ("x", "y"), poses[:, 2:4])
        span = np.ptp(poses[:, :2])
        if not (span <= MAX_DURATION_S * 1e6 and np.all(np.abs(poses[:, :2]) < 2**53)):
            found = f"{span:g} us from first to last"
            raise database.error("timestamp", found, f"{MAX_DURATION_S:g} s")
        # [n, 10] as POSE, in the order of time
        self.poses = poses[np.argsort(poses[:, 0], kind="stable")]
        self.start = self.poses[0, 0]  # us
        # row of a track -> its token, Kind
        self.users: dict[int, tuple[bytes, int]] = {}
        for rows in database.chunks(USER_SQL, ("track",), MAX_TRACKS):
            for row, token, kind in rows:
                if kind not in KIND_NAMES:
                    expected = f"one of {', '.join(KIND_NAMES)}"
                    raise database.error("category.name", repr(kind)[:40], expected)
                if not isinstance(token, bytes):
                    raise database.error("track.token", repr(token)[:40], "a BLOB")
                self.users[row] = token, int(KIND_NAMES[kind])

    def windows(self) -> Iterator[Recording]:
        """Yields the whole log, or windows of equal length, none too long."""
        clock = (self.poses[:, 0] - self.start) * 1e-6  # s
        count = max(int(np.ceil(clock[-1] / longest_window(self.spec))), 1)
        if count == 1:
            yield dataclasses.replace(self.recording(self.poses), progress=1.0)
            return
        edges = np.linspace(0.0, clock[-1], count + 1)
        edges[-1] += 1.0  # the last pose is in the last window
        windows = Windows(self.name, self.group)
        inside = np.unique(np.searchsorted(edges, clock, side="right") - 1)
        for index in inside.tolist():
            within = (float(edges[index]), float(edges[index + 1]))
            low, high = around(within)
            made = self.recording(self.poses[(clock >= low) & (clock < high)])
            yield windows.recording(made, index, within, (index + 1) / count)

    def recording(self, poses: np.ndarray) -> Recording:
        """Returns everything at the times of some poses, in seconds of the log."""
        spec = self.spec
        others, notes = self._others((int(poses[0, 0]), int(poses[-1, 0])))
        x, y, origin, tracks = placed([*self._ego(poses), *others])
        lanes: tuple[Lane, ...] = ()
        if self.road is not None:
            lanes = self.road.roads.around(x, y, origin)
        if not lanes:
            lanes, note = fitted_lanes(tracks, spec)
            notes.append(f"no map here; {note}")
        return Recording(
            name=self.name,
            group=self.group,
            source=spec["source"],
            licence=spec["licence"],
            rate_hz=positive(spec, "rate_hz"),
            start_s=float(self.start) * 1e-6,
            origin=(float(origin[0]), float(origin[1])),
            tracks=tuple(tracks),
            lanes=lanes,
            signals=self._signals(poses[:, 0]),
            default_speed_limit=positive(spec, "speed_limit"),
            notes=(*notes, *origin_notes(origin)),
        )

    def _ego(self, poses: np.ndarray) -> list[Track]:
        """The ego's box at the times of the point clouds.

        Poses were taken a little earlier or later: x(t) = x_p + dx/dt (t - t_p).
        """
        t, stamp = (poses[:, :2] - self.start).T * 1e-6
        x, y, qw, qx, qy, qz, vx, vy = poses[:, 2:].T
        heading = np.arctan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
        norm = np.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
        bad = norm[~(np.abs(norm - 1.0) < 0.01)]
        if bad.size:
            raise self.database.error(
                "ego_pose.qw, qx, qy, qz", f"norm {bad[0]:g}", "1"
            )
        boxes = ego_boxes(self.spec, t, x, y, heading, np.hypot(vx, vy))
        rising = t.size > 1 and bool(np.all(np.diff(stamp) > 0.0))
        if rising and np.max(np.abs(t - stamp)) <= MAX_STAMP_GAP_S:
            x, y = (v + np.gradient(v, stamp) * (t - stamp) for v in (boxes.x, boxes.y))
            boxes = dataclasses.replace(boxes, x=x, y=y)
        return tracks_of(self.database.path, boxes, MAX_GAP_S)[0]

    def _others(self, bounds: tuple[int, int]) -> tuple[list[Track], list[str]]:
        """Tracks of the boxes between two times [us], with notes."""
        database, where = self.database, "lidar_box.track_token"
        table = database.numbers(BOX_SQL, BOX, MAX_BOXES, bounds)
        if not len(table):
            return [], ["no boxes recorded; the ego is alone"]
        table = table[np.argsort(table[:, 1], kind="stable")]  # they come in any order
        row, t, x, y, yaw, vx, vy, length, width = table.T.copy()
        check_coordinates(database.path, "lidar_box", ("x", "y"), table[:, 2:4])
        found, ids = np.unique(row, return_inverse=True)
        if not set(found.tolist()) <= self.users.keys():
            raise database.error(where, "of no track", "a track with a category")
        users = [self.users[int(one)] for one in found]
        order = sorted(range(len(users)), key=lambda one: users[one])
        names = [users[one][0].hex() for one in order]
        kinds = np.array([kind for _, kind in users])[ids]
        t, ids, speed = (
            (t - self.start) * 1e-6,
            np.argsort(order)[ids],
            np.hypot(vx, vy),
        )
        boxes = Boxes(ids, names, t, x, y, yaw, speed, length, width, kinds)
        return tracks_of(database.path, boxes, MAX_GAP_S)

    def _signals(self, clock: np.ndarray) -> tuple[Signal, ...]:
        """Lights of the lane connectors at some times [us].

        Off where there is no status for a second, and where it is "unknown".
        """
        database = self.database
        if not database.columns("traffic_light_status"):
            return ()
        database.need("traffic_light_status", LIGHTS)
        bounds = (int(clock[0]), int(clock[-1]))
        table = database.numbers(LIGHT_SQL, LIGHT, MAX_BOXES, bounds)
        table = table[np.argsort(table[:, 0], kind="stable")]
        found, t = [], (clock - self.start) * 1e-6
        for connector in np.unique(table[np.isfinite(table[:, 1]), 1]):
            seen, _, states = table[table[:, 1] == connector].T
            shown = held_states(clock, seen, states.astype(np.int64), HOLD_S * 1e6)
            found.append(signal_of(str(int(connector)), t, shown))
        return tuple(found)
