"""A nuPlan log database and its city's map, with the public tables and columns.

maps/us-nv-las-vegas-strip/9.15.1915/map.gpkg and a log under
nuplan-v1.1/splits/mini. Tokens are 8-byte BLOBs, times microseconds; the columns
that are pickles in the public files are here as well.
"""

import json
import pickle
import sqlite3
import struct

import numpy as np

from rcirl_jax.types import Kind
from tests.data.importers.formats import Fixture
from tests.data.importers.formats.drives import arc, samples, straight

T = 0.05 * np.arange(161)
# the lidar's clock jitters by some milliseconds
STAMPS = T + np.where(T > 0.0, 0.002 * np.sin(np.arange(161)), 0.0)
START_US = 1623707853550000
# m, in UTM zone 11; a multiple of a kilometre: the local origin
CENTRE = np.array([664000.0, 3997000.0])
NAME = "2021.06.14.21.57.33_veh-38_00017_00025"
CITY = "us-nv-las-vegas-strip"
AHEAD = 1.461  # m, from the rear axle to the centre of a Pacifica
GREEN_FROM = 90  # lidar_pc from which on the light is green
CATEGORIES = (
    *("vehicle", "bicycle", "pedestrian", "traffic_cone"),
    *("barrier", "czone_sign", "generic_object"),
)
CATEGORY = {
    Kind.VEHICLE: "vehicle",
    Kind.CYCLIST: "bicycle",
    Kind.PEDESTRIAN: "pedestrian",
    Kind.STATIC: "traffic_cone",
}
TABLES = """
CREATE TABLE log (token BLOB NOT NULL, vehicle_name VARCHAR(64), date VARCHAR(64),
  timestamp INTEGER, logfile VARCHAR(64), location VARCHAR(64),
  map_version VARCHAR(64), PRIMARY KEY (token));
CREATE TABLE ego_pose (token BLOB NOT NULL, timestamp INTEGER, x FLOAT, y FLOAT,
  z FLOAT, qw FLOAT, qx FLOAT, qy FLOAT, qz FLOAT, vx FLOAT, vy FLOAT, vz FLOAT,
  acceleration_x FLOAT, acceleration_y FLOAT, acceleration_z FLOAT,
  angular_rate_x FLOAT, angular_rate_y FLOAT, angular_rate_z FLOAT, epsg INTEGER,
  log_token BLOB NOT NULL, PRIMARY KEY (token));
CREATE TABLE lidar (token BLOB NOT NULL, log_token BLOB NOT NULL,
  channel VARCHAR(64), model VARCHAR(64), translation BLOB, rotation BLOB,
  PRIMARY KEY (token));
CREATE TABLE lidar_pc (token BLOB NOT NULL, next_token BLOB, prev_token BLOB,
  ego_pose_token BLOB NOT NULL, lidar_token BLOB NOT NULL, scene_token BLOB,
  filename VARCHAR(128), timestamp INTEGER, PRIMARY KEY (token));
CREATE TABLE category (token BLOB NOT NULL, name VARCHAR(64), description TEXT,
  PRIMARY KEY (token));
CREATE TABLE track (token BLOB NOT NULL, category_token BLOB NOT NULL, width FLOAT,
  length FLOAT, height FLOAT, PRIMARY KEY (token));
CREATE TABLE lidar_box (token BLOB NOT NULL, lidar_pc_token BLOB NOT NULL,
  track_token BLOB NOT NULL, next_token BLOB, prev_token BLOB, x FLOAT, y FLOAT,
  z FLOAT, width FLOAT, length FLOAT, height FLOAT, vx FLOAT, vy FLOAT, vz FLOAT,
  yaw FLOAT, confidence FLOAT, PRIMARY KEY (token));
CREATE TABLE scene (token BLOB NOT NULL, log_token BLOB NOT NULL, name TEXT,
  goal_ego_pose_token BLOB, roadblock_ids TEXT, PRIMARY KEY (token));
CREATE TABLE scenario_tag (token BLOB NOT NULL, lidar_pc_token BLOB NOT NULL,
  type TEXT, agent_track_token BLOB, PRIMARY KEY (token));
CREATE TABLE traffic_light_status (token BLOB NOT NULL,
  lidar_pc_token BLOB NOT NULL, lane_connector_id INTEGER, status VARCHAR(8),
  PRIMARY KEY (token));
CREATE INDEX ix_lidar_pc_timestamp ON lidar_pc (timestamp);
CREATE INDEX ix_lidar_box_lidar_pc_token ON lidar_box (lidar_pc_token);
"""


def token(number):
    """Eight bytes; the last is sometimes zero."""
    return struct.pack(">Q", number * 0x9E3779B97F4A7C00 % 2**64)


def road_users():
    """Label -> motion in metres about CENTRE."""
    return {
        "ego": straight(STAMPS, (0.0, 0.0), 0.0, 8.0, size=(5.176, 2.297)),
        "car": straight(STAMPS, (25.0, 0.0), 0.0, 8.0),
        "left": arc(STAMPS, (60.0, 0.0), 0.0, 7.0, 25.0, size=(5.2, 2.0)),
        "part": straight(STAMPS, (-30.0, 3.5), 0.0, 11.0),
        "gap": straight(STAMPS, (-10.0, 3.5), 0.0, 9.0, size=(11.0, 2.6)),
        "walker": straight(
            STAMPS,
            (50.0, -6.0),
            np.pi / 2,
            1.3,
            kind=Kind.PEDESTRIAN,
            size=(0.6, 0.6),
        ),
        "bike": straight(
            STAMPS, (0.0, -2.0), 0.0, 5.0, kind=Kind.CYCLIST, size=(1.7, 0.6)
        ),
        "cone": straight(
            STAMPS, (40.0, -3.0), 0.0, 0.0, kind=Kind.STATIC, size=(0.4, 0.4)
        ),
    }


LABELS = tuple(name for name in road_users() if name != "ego")
TRACK = {name: token(1000 + k) for k, name in enumerate(LABELS)}
GAP = slice(60, 100)  # frames in which "gap" is hidden
ROWS = {name: np.arange(161) for name in LABELS}
ROWS["part"] = np.arange(50, 140)
ROWS["gap"] = np.delete(np.arange(161), GAP)


def insert(database, table, rows):
    marks = ",".join("?" * len(rows[0]))
    database.executemany(f"INSERT INTO {table} VALUES ({marks})", rows)


def boxes(users):
    """lidar_box rows."""
    rows = []
    for name in LABELS:
        user = users[name]
        for frame in ROWS[name].tolist():
            number = 10_000_000 + len(rows)
            vx = user.speed[frame] * np.cos(user.heading[frame])
            vy = user.speed[frame] * np.sin(user.heading[frame])
            x, y = user.x[frame] + CENTRE[0], user.y[frame] + CENTRE[1]
            size = (user.width, user.length, 1.6)
            motion = (float(vx), float(vy), 0.0, float(user.heading[frame]))
            links = (token(5000 + frame), TRACK[name], None, None)
            row = (token(number), *links, float(x), float(y), 600.0)
            rows.append((*row, *size, *motion, 0.9))
    return rows


def write_log(path, *, before=TABLES):
    """The database of one log."""
    users = road_users()
    ego = users["ego"]
    path.parent.mkdir(parents=True, exist_ok=True)
    database = sqlite3.connect(path)
    database.executescript(before)
    log = (token(1), "veh-38", "2021-06-14", START_US, NAME, "las_vegas", CITY)
    insert(database, "log", [log])
    # 3 ms before the point cloud's time; the rear axle, where the car was then
    early = 0.003
    pose, cloud = [], []
    for k, t in enumerate(STAMPS.tolist()):
        stamp = START_US + round(t * 1e6)
        at = (ego.x[k] - AHEAD - 8.0 * early + CENTRE[0], ego.y[k] + CENTRE[1], 600.0)
        turned = (1.0, 0.0, 0.0, 0.0)
        speed = (8.0, 0.0, 0.0)
        rest = (*[0.0] * 6, 32611, token(1))
        place = (token(3000 + k), stamp - 3000, *map(float, at))
        pose.append((*place, *turned, *speed, *rest))
        links = (None, None, token(3000 + k), token(2), token(4))
        cloud.append((token(5000 + k), *links, f"{k}.pcd", stamp))
    insert(database, "ego_pose", pose)
    # poses of images, which no point cloud refers to
    insert(
        database,
        "ego_pose",
        [(token(9000), START_US + 11, *[0.0] * 16, 32611, token(1))],
    )
    insert(database, "lidar_pc", cloud)
    pickled = pickle.dumps([0.0, 0.0, 1.8])
    lidar = (token(2), token(1), "MergedPointCloud", "M", pickled, pickled)
    insert(database, "lidar", [lidar])
    insert(
        database,
        "category",
        [(token(100 + k), name, name) for k, name in enumerate(CATEGORIES)],
    )
    tracks = []
    for name in LABELS:
        kind = CATEGORIES.index(CATEGORY[users[name].kind])
        size = (users[name].width, users[name].length, 1.6)
        tracks.append((TRACK[name], token(100 + kind), *size))
    insert(database, "track", tracks)
    insert(database, "lidar_box", boxes(users))
    insert(database, "scene", [(token(4), token(1), "scene-001", token(3160), "7 8")])
    insert(database, "scenario_tag", [(token(6), token(5000), "on_intersection", None)])
    lights = []
    for k in range(161):
        state = "green" if k >= GREEN_FROM else "red"
        lights.append((token(20000 + k), token(5000 + k), 71, state))
        lights.append((token(30000 + k), token(5000 + k), 72, "unknown"))
    insert(database, "traffic_light_status", lights)
    database.commit()
    database.close()
    return path


# ------------------------------------------------------------------------ map


def degrees(points):
    """Longitude, latitude [n, 2] of UTM zone 11 positions: Newton on the series."""
    target = np.asarray(points, np.float64) + CENTRE
    place = np.tile([-115.17, 36.11], (len(target), 1))
    for _ in range(8):
        off = target - transverse_mercator(place)
        scale = np.array(
            [111320.0 * np.cos(np.deg2rad(36.11)), 110950.0]
        )  # m per degree
        place = place + off / scale
    return place


def transverse_mercator(place):
    """Snyder (1987), equations 8-9 and 8-10: not the series of the importer."""
    a, e2, k0 = 6378137.0, 0.00669437999014, 0.9996
    lon, lat = np.deg2rad(place).T
    lon0 = np.deg2rad(-117.0)
    ep2 = e2 / (1.0 - e2)
    n = a / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    t, c = np.tan(lat) ** 2, ep2 * np.cos(lat) ** 2
    z = (lon - lon0) * np.cos(lat)
    m = a * (
        (1 - e2 / 4 - 3 * e2**2 / 64 - 5 * e2**3 / 256) * lat
        - (3 * e2 / 8 + 3 * e2**2 / 32 + 45 * e2**3 / 1024) * np.sin(2 * lat)
        + (15 * e2**2 / 256 + 45 * e2**3 / 1024) * np.sin(4 * lat)
        - (35 * e2**3 / 3072) * np.sin(6 * lat)
    )
    x = (
        k0
        * n
        * (
            z
            + (1 - t + c) * z**3 / 6
            + (5 - 18 * t + t**2 + 72 * c - 58 * ep2) * z**5 / 120
        )
    )
    y = k0 * (
        m
        + n
        * np.tan(lat)
        * (
            z**2 / 2
            + (5 - t + 9 * c + 4 * c**2) * z**4 / 24
            + (61 - 58 * t + t**2 + 600 * c - 330 * ep2) * z**6 / 720
        )
    )
    return np.stack([x + 500000.0, y], axis=1)


def geometry(kind, points, *, srs=4326, to=degrees):
    """A GeoPackage blob: head with an envelope, then WKB (2 line, 3 polygon)."""
    place = to(points)
    low, high = place.min(axis=0), place.max(axis=0)
    envelope = struct.pack("<4d", low[0], high[0], low[1], high[1])
    head = b"GP" + bytes([0, 0b00000011]) + struct.pack("<i", srs) + envelope
    count = struct.pack("<I", 1) if kind == 3 else b""
    body = struct.pack("<I", len(place)) + place.astype("<f8").tobytes()
    return head + b"\x01" + struct.pack("<I", kind) + count + body


MAP_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL,
  description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY,
  data_type TEXT NOT NULL, identifier TEXT UNIQUE, description TEXT DEFAULT '',
  last_change DATETIME NOT NULL, min_x DOUBLE, min_y DOUBLE, max_x DOUBLE,
  max_y DOUBLE, srs_id INTEGER);
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL,
  column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL);
CREATE TABLE meta (fid INTEGER PRIMARY KEY, key TEXT, value TEXT);
CREATE TABLE boundaries (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
  geom LINESTRING, boundary_segment_fids TEXT(256), has_reflectors BOOLEAN,
  boundary_type_fid INTEGER, creator_id TEXT(256));
CREATE TABLE baseline_paths (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
  geom LINESTRING, path_type_fid INTEGER, creator_id TEXT(256), lane_fid INTEGER,
  lane_connector_fid INTEGER, dubins_node_fids TEXT(256));
CREATE TABLE lanes_polygons (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
  geom POLYGON, lane_group_fid INTEGER, lane_fid INTEGER, lane_index MEDIUMINT,
  creator_id TEXT(256), speed_limit_mps REAL, left_boundary_fid INTEGER,
  right_boundary_fid INTEGER, from_edge_fid INTEGER, to_edge_fid INTEGER);
CREATE TABLE lane_connectors (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
  geom LINESTRING, exit_lane_group_fid INTEGER, exit_lane_fid INTEGER,
  entry_lane_group_fid INTEGER, lane_group_connector_fid INTEGER,
  entry_lane_fid INTEGER, intersection_fid INTEGER, turn_type_fid INTEGER,
  bulb_fids TEXT(256), traffic_light_stop_line_fids TEXT(256), overlap MEDIUMINT,
  creator_id TEXT(256), speed_limit_mps REAL);
CREATE TABLE gen_lane_connectors_scaled_width_polygons (fid INTEGER PRIMARY KEY
  AUTOINCREMENT NOT NULL, geom POLYGON, baseline_path_fid INTEGER,
  lane_connector_fid INTEGER, from_edge_fid INTEGER, to_edge_fid INTEGER,
  left_boundary_fid INTEGER, right_boundary_fid INTEGER);
CREATE TABLE stop_polygons (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
  geom POLYGON, stop_polygon_type_fid INTEGER, lane_group_fid INTEGER,
  lane_fids TEXT(256), lane_connector_fids TEXT(256), traffic_light_fids TEXT(256),
  creator_id TEXT(256));
"""
LAYERS = ("boundaries", "baseline_paths", "lanes_polygons", "lane_connectors")
LAYERS += ("gen_lane_connectors_scaled_width_polygons", "stop_polygons")


def line(start, stop, y):
    x = np.linspace(start, stop, 12)
    return np.stack([x, np.full(12, y)], axis=1)


def box(x0, x1, y0, y1):
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])


def left_turn(radius):
    angle = np.linspace(0.0, 2.3, 20)
    return np.array([60.0, 25.0]) + radius * np.stack(
        [np.sin(angle), -np.cos(angle)], axis=1
    )


def write_map(path, *, to=degrees, srs=4326, zone="epsg:32611"):
    """Lanes 61 (y = 0), 62 (y = 3.5), 63; connectors 71 (left), 72 (straight)."""

    def geom(kind, points):
        return geometry(kind, points, srs=srs, to=to)

    path.parent.mkdir(parents=True, exist_ok=True)
    database = sqlite3.connect(path)
    database.execute("PRAGMA application_id = 0x47504B47")
    database.executescript(MAP_TABLES)
    for layer in LAYERS:
        insert(
            database, "gpkg_geometry_columns", [(layer, "geom", "GEOMETRY", srs, 0, 0)]
        )
    insert(database, "meta", [(1, "projectedCoordSystem", zone)])
    insert(database, "meta", [(2, "geographicCoordSystem", "epsg:4326")])
    edges = {11: line(-60, 60, -1.75), 12: line(-60, 60, 1.75), 13: line(-60, 60, 5.25)}
    edges |= {14: left_turn(23.25), 15: left_turn(26.75)}
    insert(
        database,
        "boundaries",
        [(fid, geom(2, points), "1", 0, 1, "") for fid, points in edges.items()],
    )
    straight_on = line(60, 90, 0.0)
    centres = [
        (1, geom(2, line(-60, 60, 0.0)), 0, "", 61, None, ""),
        (2, geom(2, line(-60, 60, 3.5)), 0, "", 62, None, ""),
        (3, geom(2, line(90, 150, 0.0)), 0, "", 63, None, ""),
        (4, geom(2, left_turn(25.0)), 2, "", None, 71, ""),
        (5, geom(2, straight_on), 2, "", None, 72, ""),
    ]
    insert(database, "baseline_paths", centres)
    area = geom(3, box(-60, 60, -1.75, 1.75))
    lanes = [
        (61, area, 8, 61, 1, "", 11.176, 12, 11, None, None),
        (62, area, 8, 62, 0, "", 11.176, 13, 12, None, None),
        (63, area, 9, 63, 0, "", None, None, None, None, None),
    ]
    insert(database, "lanes_polygons", lanes)
    connectors = [
        (71, geom(2, left_turn(25.0)), 8, 61, 9, 5, 64, 3, 0, "", "31", 0, "", None),
        (72, geom(2, straight_on), 8, 61, 9, 6, 63, 3, 2, "", "31", 0, "", 8.9),
    ]
    insert(database, "lane_connectors", connectors)
    insert(
        database,
        "gen_lane_connectors_scaled_width_polygons",
        [(1, area, 4, 71, None, None, 14, 15)],
    )
    stops = [
        (31, geom(3, box(61.5, 62.5, -1.75, 5.25)), 2, 8, "", "71,72", "1", ""),
        (32, geom(3, box(148, 149, -1.75, 1.75)), 1, 9, "63", "", "", ""),
    ]
    insert(database, "stop_polygons", stops)
    database.commit()
    database.close()
    return path


def write(folder):
    log = write_log(folder / "nuplan-v1.1" / "splits" / "mini" / f"{NAME}.db")
    road = write_map(folder / "maps" / CITY / "9.15.1915" / "map.gpkg")
    versions = {CITY: {"version": "9.15.1915", "layers": {}}}
    (folder / "maps" / "nuplan-maps-v1.0.json").write_text(json.dumps(versions))
    users = road_users()
    found = {"ego": users["ego"]}
    for name in LABELS:
        rows = slice(0, GAP.start) if name == "gap" else ROWS[name]
        found[TRACK[name].hex()] = samples(users[name], rows)
    found[TRACK["gap"].hex() + "#2"] = samples(users["gap"], slice(GAP.stop, None))
    return Fixture(
        input=log.parent,
        rate_hz=20.0,
        tracks=found,
        num_lanes=5,
        num_signals=2,
        files=(log, road),
    )
