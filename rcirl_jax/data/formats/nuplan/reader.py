"""nuPlan logs: one SQLite database (`*.db`) per log, and the maps' GeoPackages.

Layout: docs/nuplan_schema.md of motional/nuplan-devkit (v1.0, v1.1). Tokens are
BLOBs, times microseconds, positions UTM metres, 20 Hz. Boxes come from the table
lidar_box, the ego from the pose of each lidar_pc. Long logs are read in windows
of time that overlap; each is a Recording. The logs of one drive are one group.

Traps: ego_pose is the rear axle's centre; its time is not the lidar_pc's, even
when linked; velocities of boxes are a network's guess; the columns translation,
rotation and intrinsic of lidar and camera are pickles and are never read;
traffic lights belong to lane connectors and are inferred from the traffic.
"""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.files import files_below, log_name
from rcirl_jax.data.formats.messages import (
    MAX_DURATION_S,
    MAX_GAP_S,
    Windows,
    around,
    longest_window,
)
from rcirl_jax.data.formats.nuplan.map import NuplanMap, find_map
from rcirl_jax.data.formats.options import one_pattern, positive
from rcirl_jax.data.formats.perception import (
    Boxes,
    ego_boxes,
    fitted_lanes,
    held_states,
    placed,
    signal_of,
    tracks_of,
)
from rcirl_jax.data.formats.shapes import (
    check_coordinates,
    origin_notes,
)
from rcirl_jax.data.readers.sqlite import Database
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, Recording, Signal, Track

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
KIND_NAMES = {
    "vehicle": Kind.VEHICLE,
    "bicycle": Kind.CYCLIST,
    "pedestrian": Kind.PEDESTRIAN,
    "traffic_cone": Kind.STATIC,
    "barrier": Kind.STATIC,
    "czone_sign": Kind.STATIC,
    "generic_object": Kind.STATIC,
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
RATE_HZ = 20.0  # 1/s
HOLD_S = 1.0  # s, a light without status keeps its state this long
MAX_STAMP_GAP_S = 0.2  # s, between a lidar_pc and the pose linked to it
LIMIT_MPS = 15.65  # m/s, 35 mph
# Chrysler Pacifica: 4.049 m before, 1.127 m behind the rear axle
EGO = {"length": 5.176, "width": 2.297, "rear_axle_to_centre": 1.461}  # m


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Log:
    """What is known of a log before its boxes are read."""

    database: Database
    name: str
    group: str  # the drive; logs of one name may be copies of each other
    poses: np.ndarray  # [n, 10] as POSE, in the order of time
    users: dict[int, tuple[bytes, int]]  # row of a track -> its token, Kind
    road: NuplanMap | None
    spec: dict


def parts(path: Path, spec: dict) -> list[Path]:
    """Lists the databases: each can be read without the others."""
    return files_below(path, one_pattern(spec, "*.db"))


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
            log = _Log(
                database=database,
                name=log_name(file, spec, own_name(file)),
                group=drive_of(own_name(file)),
                poses=_poses(database),
                users=_users(database),
                road=roads[map_file] if map_file is not None else None,
                spec=spec,
            )
            for recording in _windows(log):
                yield validate_recording(recording, file)


def _poses(database: Database) -> np.ndarray:
    """Ego poses [n, 10] by time; all but the velocity are needed."""
    poses = database.numbers(POSE_SQL, POSE, MAX_FRAMES)
    if not len(poses):
        raise database.error("lidar_pc", "no row with an ego pose", "at least one")
    for place, name in enumerate(POSE[:8]):
        if not np.isfinite(poses[:, place]).all():
            raise database.error(name, "NULL", "a number")
    check_coordinates(database.path, "ego_pose", ("x", "y"), poses[:, 2:4])
    span = np.ptp(poses[:, :2])
    if not (span <= MAX_DURATION_S * 1e6 and np.all(np.abs(poses[:, :2]) < 2.0**53)):
        raise database.error(
            "timestamp", f"{span:g} us from first to last", f"{MAX_DURATION_S:g} s"
        )
    return poses[np.argsort(poses[:, 0], kind="stable")]


def _users(database: Database) -> dict[int, tuple[bytes, int]]:
    sql = """SELECT t.rowid, t.token, c.name FROM track AS t
      JOIN category AS c ON t.category_token = c.token"""
    users = {}
    for rows in database.chunks(sql, ("track",), MAX_TRACKS):
        for row, token, name in rows:
            if name not in KIND_NAMES:
                raise database.error(
                    "category.name", repr(name)[:40], f"one of {', '.join(KIND_NAMES)}"
                )
            if not isinstance(token, bytes):
                raise database.error("track.token", repr(token)[:40], "a BLOB")
            users[row] = token, int(KIND_NAMES[name])
    return users


def _windows(log: _Log) -> Iterator[Recording]:
    """The whole log, or windows of equal length, none longer than allowed."""
    clock = (log.poses[:, 0] - log.poses[0, 0]) * 1e-6  # s
    count = max(int(np.ceil(clock[-1] / longest_window(log.spec))), 1)
    if count == 1:
        yield dataclasses.replace(_recording(log, log.poses), progress=1.0)
        return
    edges = np.linspace(0.0, clock[-1], count + 1)
    edges[-1] += 1.0  # the last pose is in the last window
    windows = Windows(log.name, log.group)
    for index in np.unique(np.searchsorted(edges, clock, side="right") - 1).tolist():
        within = (float(edges[index]), float(edges[index + 1]))
        low, high = around(within)
        made = _recording(log, log.poses[(clock >= low) & (clock < high)])
        yield windows.recording(made, index, within, (index + 1) / count)


def _recording(log: _Log, poses: np.ndarray) -> Recording:
    """Everything at the times of some poses, in seconds of the log."""
    spec, path, start = log.spec, log.database.path, log.poses[0, 0]
    tracks = _ego(path, poses, start, spec)
    others, notes = _others(log, poses[0, 0], poses[-1, 0])
    tracks += others
    x, y, origin, tracks = placed(tracks)
    lanes: tuple[Lane, ...] = ()
    if log.road is not None:
        lanes = log.road.roads.around(x, y, origin)
    if not lanes:
        lanes, note = fitted_lanes(tracks, spec)
        notes.append(f"no map here; {note}")
    return Recording(
        name=log.name,
        group=log.group,
        source=str(spec.get("source", "nuPlan")),
        licence=str(spec.get("licence", "unknown")),
        rate_hz=positive(spec, "rate_hz", RATE_HZ),
        tracks=tuple(tracks),
        lanes=lanes,
        signals=_signals(log.database, poses[:, 0], start),
        default_speed_limit=positive(spec, "speed_limit", LIMIT_MPS),
        notes=(*notes, *origin_notes(origin)),
    )


def _ego(path: Path, poses: np.ndarray, start: float, spec: dict) -> list[Track]:
    """The ego's box at the times of the point clouds, in s since `start` [us].

    Poses were taken a little earlier or later: x(t) = x_p + dx/dt (t - t_p).
    """
    t, stamp = (poses[:, :2] - start).T * 1e-6
    x, y, qw, qx, qy, qz, vx, vy = poses[:, 2:].T
    heading = np.arctan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
    norm = np.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    bad = np.flatnonzero(~(np.abs(norm - 1.0) < 0.01))
    if bad.size:
        raise InputError(
            f"{path}: ego_pose.qw, qx, qy, qz: norm {norm[bad[0]]:g}: expected 1"
        )
    boxes = ego_boxes(spec, EGO, t, x, y, heading, np.hypot(vx, vy))
    rising = t.size > 1 and bool(np.all(np.diff(stamp) > 0.0))
    if rising and np.max(np.abs(t - stamp)) <= MAX_STAMP_GAP_S:
        moved = {
            name: place + np.gradient(place, stamp) * (t - stamp)
            for name, place in (("x", boxes.x), ("y", boxes.y))
        }
        boxes = dataclasses.replace(boxes, **moved)
    return tracks_of(path, boxes, MAX_GAP_S)[0]


def _others(log: _Log, first: float, last: float) -> tuple[list[Track], list[str]]:
    """Tracks of the boxes between two times [us]."""
    database = log.database
    bounds = (int(first), int(last))
    table = database.numbers(BOX_SQL, BOX, MAX_BOXES, bounds)
    if not len(table):
        return [], ["no boxes recorded; the ego is alone"]
    table = table[np.argsort(table[:, 1], kind="stable")]  # they come in any order
    row, t, x, y, yaw, vx, vy, length, width = table.T.copy()
    check_coordinates(database.path, "lidar_box", ("x", "y"), table[:, 2:4])
    found, ids = np.unique(row, return_inverse=True)
    if not set(found.tolist()) <= log.users.keys():
        where = "lidar_box.track_token"
        raise database.error(where, "of no track", "a track with a category")
    users = [log.users[int(one)] for one in found]
    order = sorted(range(len(users)), key=lambda one: users[one])
    names = [users[one][0].hex() for one in order]
    kinds = np.array([kind for _, kind in users])[ids]
    t, ids = (t - log.poses[0, 0]) * 1e-6, np.argsort(order)[ids]
    speed = np.hypot(vx, vy)
    boxes = Boxes(ids, names, t, x, y, yaw, speed, length, width, kinds)
    return tracks_of(database.path, boxes, MAX_GAP_S)


def _signals(database: Database, clock: np.ndarray, start: float) -> tuple[Signal, ...]:
    """Lights of the lane connectors at some times [us], in s since `start` [us].

    Off where there is no status for a second, and where it is "unknown".
    """
    if not database.columns("traffic_light_status"):
        return ()
    database.need("traffic_light_status", LIGHTS)
    bounds = (int(clock[0]), int(clock[-1]))
    table = database.numbers(LIGHT_SQL, LIGHT, MAX_BOXES, bounds)
    table = table[np.argsort(table[:, 0], kind="stable")]
    found = []
    for connector in np.unique(table[np.isfinite(table[:, 1]), 1]):
        seen, _, states = table[table[:, 1] == connector].T
        shown = held_states(clock, seen, states.astype(np.int64), HOLD_S * 1e6)
        found.append(signal_of(str(int(connector)), (clock - start) * 1e-6, shown))
    return tuple(found)
