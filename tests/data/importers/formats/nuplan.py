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
import shapely

from rcirl_jax.types import Kind
from tests.data.importers.formats import Fixture, osm
from tests.data.importers.formats.drives import samples, seen_by_a_car

T = 0.05 * np.arange(161)
# the lidar's clock jitters by some milliseconds
STAMPS = T + np.where(T > 0.0, 0.002 * np.sin(np.arange(161)), 0.0)
START_US = 1623707853550000
ZONE = 11
# m, in the UTM zone; a multiple of a kilometre: the local origin
CENTRE = np.array([664000.0, 3997000.0])
NAME = "2021.06.14.21.57.33_veh-38_00017_00025"
CITY = "us-nv-las-vegas-strip"
AHEAD = 1.461  # m, from the rear axle to the centre of a Pacifica
EARLY_S = 0.003  # s, of a pose before the time of its point cloud
GREEN_FROM = 90  # lidar_pc from which on the light is green
CATEGORIES = ("vehicle", "bicycle", "pedestrian", "traffic_cone", "barrier")
CATEGORY = {
    **{Kind.VEHICLE: "vehicle", Kind.CYCLIST: "bicycle"},
    **{Kind.PEDESTRIAN: "pedestrian", Kind.STATIC: "traffic_cone"},
}
TABLES = """
CREATE TABLE log (token BLOB PRIMARY KEY, vehicle_name TEXT, date TEXT,
  timestamp INTEGER, logfile TEXT, location TEXT, map_version TEXT);
CREATE TABLE ego_pose (token BLOB PRIMARY KEY, timestamp INTEGER, x FLOAT, y FLOAT,
  z FLOAT, qw FLOAT, qx FLOAT, qy FLOAT, qz FLOAT, vx FLOAT, vy FLOAT, vz FLOAT,
  epsg INTEGER, log_token BLOB);
CREATE TABLE lidar (token BLOB PRIMARY KEY, log_token BLOB, channel TEXT,
  translation BLOB, rotation BLOB);
CREATE TABLE lidar_pc (token BLOB PRIMARY KEY, next_token BLOB, prev_token BLOB,
  ego_pose_token BLOB, lidar_token BLOB, scene_token BLOB, filename TEXT,
  timestamp INTEGER);
CREATE TABLE category (token BLOB PRIMARY KEY, name TEXT, description TEXT);
CREATE TABLE track (token BLOB PRIMARY KEY, category_token BLOB, width FLOAT,
  length FLOAT, height FLOAT);
CREATE TABLE lidar_box (token BLOB PRIMARY KEY, lidar_pc_token BLOB,
  track_token BLOB, next_token BLOB, prev_token BLOB, x FLOAT, y FLOAT,
  z FLOAT, width FLOAT, length FLOAT, height FLOAT, vx FLOAT, vy FLOAT, vz FLOAT,
  yaw FLOAT, confidence FLOAT);
CREATE TABLE traffic_light_status (token BLOB PRIMARY KEY, lidar_pc_token BLOB,
  lane_connector_id INTEGER, status TEXT);
CREATE INDEX ix_lidar_pc_timestamp ON lidar_pc (timestamp);
CREATE INDEX ix_lidar_box_lidar_pc_token ON lidar_box (lidar_pc_token);
"""


def token(number):
    """Eight bytes; the last is sometimes zero."""
    return struct.pack(">Q", number * 0x9E3779B97F4A7C00 % 2**64)


def road_users():
    """Label -> motion in metres about CENTRE."""
    return seen_by_a_car(STAMPS, (5.176, 2.297))


LABELS = tuple(name for name in road_users() if name != "ego")
TRACK = {name: token(1000 + k) for k, name in enumerate(LABELS)}
GAP = slice(60, 100)  # frames in which 19 is hidden
ROWS = {name: np.arange(161) for name in LABELS}
ROWS["17"] = np.arange(50, 140)
ROWS["19"] = np.delete(np.arange(161), GAP)


def made(path, tables, rows):
    """A database of tables, each with its rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    database = sqlite3.connect(path)
    database.executescript(tables)
    for table, content in rows.items():
        marks = ",".join("?" * len(content[0]))
        database.executemany(f"INSERT INTO {table} VALUES ({marks})", content)
    database.commit()
    database.close()
    return path


def boxes(users):
    """lidar_box rows."""
    rows = []
    for name in LABELS:
        user = users[name]
        for frame in ROWS[name].tolist():
            vx = user.speed[frame] * np.cos(user.heading[frame])
            vy = user.speed[frame] * np.sin(user.heading[frame])
            x, y = user.x[frame] + CENTRE[0], user.y[frame] + CENTRE[1]
            size = (user.width, user.length, 1.6)
            motion = (float(vx), float(vy), 0.0, float(user.heading[frame]))
            links = (token(5000 + frame), TRACK[name], None, None)
            row = (token(10_000_000 + len(rows)), *links, float(x), float(y), 600.0)
            rows.append((*row, *size, *motion, 0.9))
    return rows


def write_log(path):
    """The database of one log."""
    users = road_users()
    # the rear axle, where the car was before the time of the point cloud
    x = users["ego"].x - AHEAD - 8.0 * EARLY_S + CENTRE[0]
    y = users["ego"].y + CENTRE[1]
    stamps = [START_US + round(t * 1e6) for t in STAMPS.tolist()]
    rest = (1.0, *[0.0] * 3, 8.0, 0.0, 0.0, 32611, token(1))  # turned, speed, log
    early = [stamp - round(EARLY_S * 1e6) for stamp in stamps]
    pose = [
        (token(3000 + k), early[k], float(x[k]), float(y[k]), 600.0, *rest)
        for k in range(161)
    ]
    # of an image, which no point cloud refers to
    pose.append((token(9000), START_US + 11, *[0.0] * 10, 32611, token(1)))
    links = [(None, None, token(3000 + k), token(2), token(4)) for k in range(161)]
    cloud = [
        (token(5000 + k), *links[k], f"{k}.pcd", stamp)
        for k, stamp in enumerate(stamps)
    ]
    tracks = []
    for name in LABELS:
        kind = token(100 + CATEGORIES.index(CATEGORY[users[name].kind]))
        tracks.append((TRACK[name], kind, users[name].width, users[name].length, 1.6))
    lights = []
    for k in range(161):
        state = "green" if k >= GREEN_FROM else "red"
        lights.append((token(20000 + k), token(5000 + k), 71, state))
        lights.append((token(30000 + k), token(5000 + k), 72, "unknown"))
    pickled = pickle.dumps([0.0, 0.0, 1.8])
    rows = {
        "log": [
            (token(1), "veh-38", "2021-06-14", START_US, NAME, "las_vegas", CITY),
        ],
        "ego_pose": pose,
        "lidar": [(token(2), token(1), "MergedPointCloud", pickled, pickled)],
        "lidar_pc": cloud,
        "category": [(token(100 + k), n, n) for k, n in enumerate(CATEGORIES)],
        "track": tracks,
        "lidar_box": boxes(users),
        "traffic_light_status": lights,
    }
    return made(path, TABLES, rows)


# ------------------------------------------------------------------------ map


def degrees(points):
    """Longitude, latitude [n, 2] of positions about CENTRE."""
    return osm.degrees(points, ZONE, CENTRE)[:, ::-1]


def geometry(shape, points, *, srs=4326, to=degrees):
    """A GeoPackage blob: head with an envelope, then the WKB of a shape of shapely."""
    made = shape(to(points))
    low_x, low_y, high_x, high_y = made.bounds
    envelope = struct.pack("<4d", low_x, high_x, low_y, high_y)
    head = b"GP" + bytes([0, 0b00000011]) + struct.pack("<i", srs) + envelope
    return head + shapely.to_wkb(made, byte_order=1)


MAP_TABLES = """
PRAGMA application_id = 0x47504B47;
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL,
  column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL);
CREATE TABLE meta (fid INTEGER PRIMARY KEY, key TEXT, value TEXT);
CREATE TABLE boundaries (fid INTEGER PRIMARY KEY, geom LINESTRING,
  boundary_segment_fids TEXT, boundary_type_fid INTEGER);
CREATE TABLE baseline_paths (fid INTEGER PRIMARY KEY, geom LINESTRING,
  path_type_fid INTEGER, lane_fid INTEGER, lane_connector_fid INTEGER);
CREATE TABLE lanes_polygons (fid INTEGER PRIMARY KEY, geom POLYGON,
  lane_group_fid INTEGER, lane_fid INTEGER, lane_index MEDIUMINT,
  speed_limit_mps REAL, left_boundary_fid INTEGER, right_boundary_fid INTEGER);
CREATE TABLE lane_connectors (fid INTEGER PRIMARY KEY, geom LINESTRING,
  exit_lane_group_fid INTEGER, exit_lane_fid INTEGER, entry_lane_group_fid INTEGER,
  entry_lane_fid INTEGER, traffic_light_stop_line_fids TEXT, speed_limit_mps REAL);
CREATE TABLE gen_lane_connectors_scaled_width_polygons (fid INTEGER PRIMARY KEY,
  geom POLYGON, lane_connector_fid INTEGER, left_boundary_fid INTEGER,
  right_boundary_fid INTEGER);
CREATE TABLE stop_polygons (fid INTEGER PRIMARY KEY, geom POLYGON,
  stop_polygon_type_fid INTEGER, lane_group_fid INTEGER, lane_fids TEXT,
  lane_connector_fids TEXT, traffic_light_fids TEXT);
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

    def geom(shape, points):
        return geometry(shape, points, srs=srs, to=to)

    edges = {11: line(-60, 60, -1.75), 12: line(-60, 60, 1.75), 13: line(-60, 60, 5.25)}
    edges |= {14: left_turn(23.25), 15: left_turn(26.75)}
    straight_on, turn = (
        geom(shapely.LineString, line(60, 90, 0.0)),
        geom(shapely.LineString, left_turn(25.0)),
    )
    area = geom(shapely.Polygon, box(-60, 60, -1.75, 1.75))
    rows = {
        "gpkg_geometry_columns": [
            (layer, "geom", "GEOMETRY", srs, 0, 0) for layer in LAYERS
        ],
        "meta": [
            (1, "projectedCoordSystem", zone),
            (2, "geographicCoordSystem", "epsg:4326"),
        ],
        "boundaries": [
            (fid, geom(shapely.LineString, p), "1", 0) for fid, p in edges.items()
        ],
        "baseline_paths": [
            (1, geom(shapely.LineString, line(-60, 60, 0.0)), 0, 61, None),
            (2, geom(shapely.LineString, line(-60, 60, 3.5)), 0, 62, None),
            (3, geom(shapely.LineString, line(90, 150, 0.0)), 0, 63, None),
            (4, turn, 2, None, 71),
            (5, straight_on, 2, None, 72),
        ],
        "lanes_polygons": [
            (61, area, 8, 61, 1, 11.176, 12, 11),
            (62, area, 8, 62, 0, 11.176, 13, 12),
            (63, area, 9, 63, 0, None, None, None),
        ],
        "lane_connectors": [
            (71, turn, 8, 61, 9, 64, "31", None),
            (72, straight_on, 8, 61, 9, 63, "31", 8.9),
        ],
        "gen_lane_connectors_scaled_width_polygons": [(1, area, 71, 14, 15)],
        "stop_polygons": [
            (
                31,
                geom(shapely.Polygon, box(61.5, 62.5, -1.75, 5.25)),
                2,
                8,
                "",
                "71,72",
                "1",
            ),
            (32, geom(shapely.Polygon, box(148, 149, -1.75, 1.75)), 1, 9, "63", "", ""),
        ],
    }
    return made(path, MAP_TABLES, rows)


def write(folder):
    log = write_log(folder / "nuplan-v1.1" / "splits" / "mini" / f"{NAME}.db")
    road = write_map(folder / "maps" / CITY / "9.15.1915" / "map.gpkg")
    versions = {CITY: {"version": "9.15.1915", "layers": {}}}
    (folder / "maps" / "nuplan-maps-v1.0.json").write_text(json.dumps(versions))
    users = road_users()
    found = {"ego": users["ego"]}
    for name in LABELS:
        rows = slice(0, GAP.start) if name == "19" else ROWS[name]
        found[TRACK[name].hex()] = samples(users[name], rows)
    found[TRACK["19"].hex() + "#2"] = samples(users["19"], slice(GAP.stop, None))
    return Fixture(
        input=log.parent,
        assumed=(2, 2, 1),  # the ego
        rate_hz=20.0,
        tracks=found,
        num_lanes=5,
        num_signals=2,
        files=(log, road),
    )


# ---------------------------------------------------------------------- harms


def edit(path, *statements, values=None):
    """Change a database by SQL: scripts, or statements with values."""
    database = sqlite3.connect(path)
    for statement in statements:
        if values is None:
            database.executescript(statement)
        else:
            database.execute(statement, values)
    database.commit()
    database.close()


def sql(place, *statements, values=None):
    """What changes the log (0) or the map (1)."""
    return lambda fixture: edit(fixture.files[place], *statements, values=values)


def set_to(table, column, value):
    return sql(0, f"UPDATE {table} SET {column} = {value}")


ENDLESS = """WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n)
  SELECT x AS lidar_pc_token, x AS track_token, x AS x, x AS y, x AS yaw, x AS vx,
  x AS vy, x AS width, x AS length FROM n"""
VIRTUAL = "fts4(lidar_pc_token, track_token, x, y, yaw, vx, vy, width, length)"
GENERATED = """CREATE TABLE category (token BLOB, other TEXT,
  name TEXT GENERATED ALWAYS AS (hex(zeroblob(20000000))) VIRTUAL);
  INSERT INTO category (token, other) SELECT category_token, 1 FROM track"""
SCHEMA = "PRAGMA writable_schema = ON; UPDATE sqlite_master SET"
NO_BOX = "DROP TABLE lidar_box;"
LAST = "UPDATE lidar_pc SET timestamp = 9223372036854775807 WHERE filename = '1.pcd'"
WILD = geometry(shapely.LineString, [[500.0, 95.0], [0.0, 0.0]], to=np.asarray)
GEOM_OF = "UPDATE gpkg_geometry_columns SET"
# what is done to the log or the map, and what the line says
HARMS = {
    "lidar_box: a view": sql(0, f"{NO_BOX} CREATE VIEW lidar_box AS {ENDLESS}"),
    "lidar_box: a virtual table: expected a table": sql(
        0, f"{NO_BOX} CREATE VIRTUAL TABLE lidar_box USING {VIRTUAL}"
    ),
    "a readable SQLite file": sql(0, f"DROP TABLE category; {GENERATED}"),
    "database: malformed": sql(0, f"{SCHEMA} sql = 'nonsense' WHERE name = 'track'"),
    "table lidar_box: missing": sql(0, NO_BOX),
    "table log: no rows": sql(0, "DELETE FROM log"),
    "lidar_pc: no row with an ego pose": sql(0, "DELETE FROM ego_pose"),
    "lidar_box.yaw: missing": sql(0, "ALTER TABLE lidar_box DROP COLUMN yaw"),
    "lidar_box.x: '1.5 m': expected a number": set_to("lidar_box", "x", "'1.5 m'"),
    "lidar_box: x: nan": set_to("lidar_box", "x", "NULL"),
    "length: -1 m: expected 0 to": set_to("lidar_box", "length", "-1"),
    "track_token: of no track: expected a track": set_to(
        "lidar_box", "track_token", "'abc'"
    ),
    "track_token: ": sql(0, "DELETE FROM track"),
    "category.name: 'alien': expected one": set_to("category", "name", "'alien'"),
    "ego_pose.x: NULL: expected a number": set_to("ego_pose", "x", "NULL"),
    "qw, qx, qy, qz: norm 0: expected 1": set_to("ego_pose", "qw", "0"),
    "us from first to last": sql(0, LAST),
    "connector_id: 'x'": set_to("traffic_light_status", "lane_connector_id", "'x'"),
    "projectedCoordSystem: missing: expected a UTM zone": sql(1, "DELETE FROM meta"),
    "srs_id: 3857: expected 4326": sql(1, f"{GEOM_OF} srs_id = 3857"),
    "stop_polygons.two x: missing": sql(
        1, f"{GEOM_OF} column_name = 'two' || char(10) || 'x'"
    ),
    "baseline_paths.geom: no GeoPackage": sql(
        1, "UPDATE baseline_paths SET geom = x'00'"
    ),
    "baseline_paths.geom: 500: expected longitude": sql(
        1, "UPDATE baseline_paths SET geom = ?", values=(WILD,)
    ),
}
OPTIONS = [{"window_s": 0}, {"window_s": 1e-9}, {"ego": 1}, {"maps": "gone"}]
