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
from rcirl_jax.data.formats.shapes import check_coordinates, origin_notes
from rcirl_jax.data.readers.sqlite import Database
from rcirl_jax.data.recording import validate_recording
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
