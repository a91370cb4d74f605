"""nuPlan logs and maps: SQLite of others, geometry blobs, windows, lights."""

import collections
import hashlib
import os
import pickle
import shutil
import sqlite3
import struct
import time

import numpy as np
import pytest

from rcirl_jax.data.cut import cut
from rcirl_jax.data.importers import parts, read_recordings
from rcirl_jax.data.importers.nuplan import geopackage
from rcirl_jax.data.importers.nuplan import map as nuplan_map
from rcirl_jax.data.importers.nuplan import reader as nuplan
from rcirl_jax.data.readers import long_logs
from rcirl_jax.data.readers import sqlite as sqlite_ro
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.types import Kind
from tests.data.importers.formats import nuplan as fixture

DRIVE = "2021.06.14.21.57.33_veh-38"


def read(path, **options):
    spec = load_toml(spec_root() / "sources" / "nuplan.toml")
    return list(nuplan.recordings(path, {**spec, **options}))


def only(path, **options):
    (recording,) = read(path, **options)
    return recording


def lanes_of(recording):
    return {lane.id: lane for lane in recording.lanes}


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nuplan")
    return folder, fixture.write(folder).input.relative_to(folder)


@pytest.fixture
def folder(original, tmp_path):
    """Logs with their map."""
    shutil.copytree(original[0], tmp_path / "nuplan")
    return tmp_path / "nuplan" / original[1]


@pytest.fixture
def log(original, tmp_path):
    """A log without a map."""
    name = f"{fixture.NAME}.db"
    return shutil.copy(original[0] / original[1] / name, tmp_path / name)


def edit(path, *statements):
    database = sqlite3.connect(path)
    for statement in statements:
        database.executescript(statement)
    database.commit()
    database.close()


# ---------------------------------------------------------------- well-formed


def test_log_becomes_a_recording(folder):
    recording = only(folder)
    assert recording.name == fixture.NAME
    assert (recording.rate_hz, recording.group) == (20.0, DRIVE)
    assert any("x = 664000 m, y = 3997000 m" in note for note in recording.notes)
    kinds = {track.id: track.kind for track in recording.tracks}
    assert kinds["ego"] == Kind.VEHICLE
    assert kinds[fixture.TRACK["walker"].hex()] == Kind.PEDESTRIAN
    assert kinds[fixture.TRACK["bike"].hex()] == Kind.CYCLIST
    assert kinds[fixture.TRACK["cone"].hex()] == Kind.STATIC


def test_ego_is_the_box_at_the_clouds_time(folder):
    """Rear axle, 3 ms early -> centre, at the time of the point cloud."""
    ego = only(folder).tracks[0]
    np.testing.assert_allclose(ego.x, fixture.road_users()["ego"].x, atol=2e-3)
    np.testing.assert_allclose(ego.t, fixture.STAMPS, atol=1e-6)
    turned = only(
        folder, ego={"rear_axle_to_centre": 0.0, "length": 4.0, "width": 1.7}
    ).tracks[0]
    assert turned.x[0] == pytest.approx(-fixture.AHEAD, abs=2e-3)
    assert (turned.length, turned.width) == (4.0, 1.7)


@pytest.mark.parametrize("indexed", [True, False])
def test_rows_in_any_order(folder, log, indexed):
    """A database has no order of rows: here that of the tokens, as of a key."""
    for table in ("lidar_box", "lidar_pc", "ego_pose", "traffic_light_status"):
        edit(
            log,
            f"CREATE TABLE kept AS SELECT * FROM {table}; DELETE FROM {table};"
            f"INSERT INTO {table} SELECT * FROM kept ORDER BY substr(hex(token), 5);"
            "DROP TABLE kept;",
        )
    if not indexed:
        edit(log, "DROP INDEX ix_lidar_pc_timestamp")
        edit(log, "DROP INDEX ix_lidar_box_lidar_pc_token")
    found, expected = only(log), only(folder)
    assert [track.id for track in found.tracks] == [t.id for t in expected.tracks]
    for one, other in zip(found.tracks, expected.tracks, strict=True):
        np.testing.assert_array_equal(one.t, other.t)
        np.testing.assert_array_equal(one.x, other.x)
    assert [s.state for s in found.signals] == [s.state for s in expected.signals]


def test_heading_from_the_quaternion(log):
    half = 0.35
    edit(log, f"UPDATE ego_pose SET qw = {np.cos(half)}, qz = {np.sin(half)}")
    np.testing.assert_allclose(only(log).tracks[0].heading, 2.0 * half)


@pytest.mark.parametrize(
    ("name", "drive"),
    [
        (fixture.NAME, DRIVE),
        ("2021.06.14.21.57.33_veh-38_01008_01518", DRIVE),
        ("2021.06.14.21.57.33_veh-08_01008_01518", "2021.06.14.21.57.33_veh-08"),
        ("my_log_00001_00002", "my_log_00001_00002"),
        (f"{DRIVE}_00017", f"{DRIVE}_00017"),
    ],
)
def test_logs_of_one_drive_are_one_group(name, drive):
    assert nuplan.drive_of(name) == drive


def test_windows_hold_the_scenes_of_the_log(folder, monkeypatch):
    """Surroundings are shortened to those of a log of 8 s."""
    monkeypatch.setattr(long_logs, "BEFORE_S", 1.0)
    monkeypatch.setattr(long_logs, "AFTER_S", 2.5)
    found = read(folder, window_s=3.0)
    assert [r.name for r in found] == [f"{fixture.NAME}-{k:03d}" for k in range(3)]
    assert {(r.group, r.piece_of) for r in found} == {(DRIVE, fixture.NAME)}
    egos = [recording.tracks[0] for recording in found]
    np.testing.assert_allclose(
        [(ego.t[0], ego.t[-1]) for ego in egos],
        [(0.0, 5.15), (1.7, 7.8), (4.35, 8.0)],
        atol=0.051,
    )
    assert {ego.first_seen_s for ego in egos} == {0.0}
    for recording, ego in zip(found, egos, strict=True):
        assert all(signal.start[0] == ego.t[0] for signal in recording.signals)
    config = CollectConfig(
        min_future_s=1.5, require_obstacles=False, require_speed_change=False
    )
    whole, apart = (
        collections.Counter(
            (name, int(frame))
            for made in (cut(recording, config) for recording in recordings)
            for name, frame in zip(made.vehicles, made.scenes.frame, strict=True)
        )
        for recordings in ([only(folder)], found)
    )
    assert max(apart.values()) == 1
    assert whole.total() > 40
    assert apart == whole


def test_parts_are_logs(folder):
    shutil.copy(folder / f"{fixture.NAME}.db", folder / "b.db")
    found, _ = parts("nuplan", folder)
    assert [part.name for part in found] == [f"{fixture.NAME}.db", "b.db"]
    assert [r.name for r in read_recordings("nuplan", folder)] == [fixture.NAME, "b"]


def test_file_is_left_as_it_is(log):
    before = hashlib.sha256(log.read_bytes()).hexdigest()
    only(log)
    assert hashlib.sha256(log.read_bytes()).hexdigest() == before
    assert [path.name for path in log.parent.iterdir()] == [log.name]


def test_odd_names_of_files(tmp_path):
    """A URI must not take ? and # in a name for its own."""
    path = fixture.write_log(tmp_path / "a?mode=rwc#%41 b.db")
    assert only(path).name == "a?mode=rwc#%41 b"


def test_pickles_in_the_file_are_not_loaded(log, tmp_path):
    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "executed"),)

    database = sqlite3.connect(log)
    bomb = pickle.dumps(Bomb())
    database.execute("UPDATE lidar SET translation = ?, rotation = ?", (bomb, bomb))
    database.commit()
    database.close()
    only(log)
    assert not (tmp_path / "executed").exists()


def test_missing_velocity_comes_from_positions(log):
    edit(log, "UPDATE lidar_box SET vx = NULL", "UPDATE ego_pose SET vy = NULL")
    tracks = {track.id: track for track in only(log).tracks}
    np.testing.assert_allclose(tracks["ego"].speed, 8.0, atol=0.1)
    car = tracks[fixture.TRACK["car"].hex()]
    np.testing.assert_allclose(car.speed, 8.0, atol=0.1)


def test_ego_alone(log):
    edit(log, "DELETE FROM lidar_box")
    recording = only(log)
    assert [track.id for track in recording.tracks] == ["ego"]
    assert any("alone" in note for note in recording.notes)


# ------------------------------------------------------------------------ map


def test_lanes_of_the_map(folder):
    lanes = lanes_of(only(folder))
    assert set(lanes) == {"61", "62", "63", "connector-71", "connector-72"}
    lane = lanes["61"]
    np.testing.assert_allclose(
        lane.centre[[0, -1]], [[-60.0, 0.0], [60.0, 0.0]], atol=5e-3
    )
    np.testing.assert_allclose(lane.left_width, 1.75, atol=5e-3)
    np.testing.assert_allclose(lane.right_width, 1.75, atol=5e-3)
    assert lane.speed_limit == pytest.approx(11.176)
    assert (lane.left, lane.right) == ("62", None)
    assert lanes["62"].right == "61"
    assert lane.successors == ("connector-71", "connector-72")
    assert lanes["connector-72"].successors == ("63",)
    assert lanes["connector-72"].speed_limit == pytest.approx(8.9)
    assert lanes["63"].speed_limit is None
    # no bounds in the map
    np.testing.assert_array_equal(lanes["63"].left_width, 1.75)


def test_stop_lines_and_signs(folder):
    lanes = lanes_of(only(folder))
    line, sign = lanes["connector-72"].stop_line, lanes["63"].stop_line
    assert line is not None
    assert sign is not None
    np.testing.assert_allclose(line, [[62.0, 1.75], [62.0, -1.75]], atol=0.02)
    assert lanes["connector-71"].signal_ids == ("71",)
    assert not lanes["connector-71"].stop_sign
    assert lanes["63"].stop_sign
    assert sign[0, 0] == pytest.approx(148.5, abs=0.02)
    assert lanes["61"].stop_line is None


def test_lights(folder):
    signals = {signal.id: signal for signal in only(folder).signals}
    assert signals["71"].state == ("red", "green")
    green = fixture.STAMPS[fixture.GREEN_FROM]
    np.testing.assert_allclose(signals["71"].start, [0.0, green], atol=1e-6)
    assert signals["72"].state == ("off",)


def test_light_without_status_for_a_second_is_off(log):
    first = fixture.START_US + 2_000_000
    edit(
        log,
        "DELETE FROM traffic_light_status WHERE lidar_pc_token IN (SELECT token "
        f"FROM lidar_pc WHERE timestamp BETWEEN {first} AND {first + 2_000_000})",
    )
    signals = {signal.id: signal for signal in only(log).signals}
    assert signals["71"].state == ("red", "off", "red", "green")
    assert signals["71"].start[1] == pytest.approx(2.95, abs=0.06)


def test_without_lights(log):
    edit(log, "DROP TABLE traffic_light_status")
    assert only(log).signals == ()


def test_without_a_map_lanes_are_paths(log):
    recording = only(log)
    assert recording.lanes[0].id == "path-0"
    assert any("no map here" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("version", "location"),
    [
        ("us-nv-las-vegas-strip", "x"),
        ("us-nv-las-vegas-strip.gpkg", "x"),
        (None, "las_vegas"),
        ("nuplan-maps-v1.0", "us-nv-las-vegas-strip"),
    ],
)
def test_map_is_found_by_name(folder, version, location):
    path = folder / f"{fixture.NAME}.db"
    value = "NULL" if version is None else f"'{version}'"
    edit(path, f"UPDATE log SET map_version = {value}, location = '{location}'")
    assert "61" in lanes_of(only(folder))


@pytest.mark.parametrize("name", ["../maps/us-nv-las-vegas-strip", "..", "", "us-"])
def test_map_names_cannot_leave_the_folder(folder, name):
    path = folder / f"{fixture.NAME}.db"
    edit(path, f"UPDATE log SET map_version = '{name}', location = '/etc'")
    (folder.parents[2] / "maps" / "us-ma-boston").mkdir()
    assert only(folder).lanes[0].id == "path-0"


def test_maps_as_the_archive_unpacks_them(folder):
    """nuplan-maps-v1.1.zip holds a folder nuplan-maps-v1.0."""
    maps = folder.parents[2] / "maps"
    (maps / "nuplan-maps-v1.0.json").write_text("{}")
    maps.rename(maps.with_name("nuplan-maps-v1.0"))
    assert "61" in lanes_of(only(folder))


def test_latest_version_of_a_map(folder):
    city = folder.parents[2] / "maps" / fixture.CITY
    fixture.write_map(city / "9.17.0000" / "map.gpkg")
    edit(city / "9.17.0000" / "map.gpkg", "DELETE FROM lane_connectors")
    assert set(lanes_of(only(folder))) == {"61", "62", "63"}


def test_maps_option(folder, tmp_path):
    shutil.move(folder.parents[2] / "maps", tmp_path / "elsewhere")
    assert only(folder).lanes[0].id == "path-0"
    for place in ("../elsewhere", str(tmp_path / "elsewhere")):
        assert "61" in lanes_of(only(folder, maps=place))
    with pytest.raises(InputError, match=r"source TOML: maps: gone: no map of"):
        only(folder, maps="gone")


def in_utm(points):
    return np.asarray(points) + fixture.CENTRE


@pytest.mark.parametrize(
    ("srs", "to", "zone"),
    [
        (32611, in_utm, "epsg:32611"),
        (32611, in_utm, "EPSG:32611"),
        (26911, in_utm, "epsg:32611"),
        (4326, fixture.degrees, "26911"),
    ],
)
def test_systems_of_coordinates(folder, srs, to, zone):
    path = folder.parents[2] / "maps" / fixture.CITY / "9.15.1915" / "map.gpkg"
    path.unlink()
    fixture.write_map(path, to=to, srs=srs, zone=zone)
    centre = lanes_of(only(folder))["61"].centre
    np.testing.assert_allclose(centre[0], [-60.0, 0.0], atol=5e-3)


def test_optional_layers_and_columns(folder):
    path = folder.parents[2] / "maps" / fixture.CITY / "9.15.1915" / "map.gpkg"
    edit(
        path,
        "DROP TABLE boundaries; DROP TABLE stop_polygons; DROP TABLE "
        "gen_lane_connectors_scaled_width_polygons; DROP TABLE gpkg_geometry_columns;"
        "ALTER TABLE lanes_polygons DROP COLUMN left_boundary_fid;"
        "ALTER TABLE lane_connectors DROP COLUMN traffic_light_stop_line_fids;"
        "UPDATE lanes_polygons SET lane_index = NULL, speed_limit_mps = 'x';"
        "UPDATE lane_connectors SET exit_lane_fid = '61', entry_lane_fid = 63.0;",
    )
    lanes = lanes_of(only(folder))
    assert lanes["61"].left is None
    assert lanes["61"].speed_limit is None
    assert lanes["61"].successors == ("connector-71", "connector-72")
    assert lanes["connector-72"].successors == ("63",)
    assert lanes["connector-72"].stop_line is None


@pytest.mark.parametrize("column", ["geometry", 'the "shape", or 1'])
def test_names_of_geometry_columns(folder, column):
    """A GeoPackage says of each layer which column holds its geometries."""
    whole = lanes_of(only(folder))
    path = folder.parents[2] / "maps" / fixture.CITY / "9.15.1915" / "map.gpkg"
    quoted = column.replace('"', '""')
    for layer in ("baseline_paths", "boundaries", "stop_polygons"):
        edit(
            path,
            f'ALTER TABLE {layer} RENAME COLUMN geom TO "{quoted}"',
            f"UPDATE gpkg_geometry_columns SET column_name = '{column}' "
            f"WHERE table_name = '{layer}'",
        )
    found = lanes_of(only(folder))
    assert list(found) == list(whole)
    for name, lane in whole.items():
        np.testing.assert_array_equal(found[name].centre, lane.centre)
        np.testing.assert_array_equal(found[name].left_width, lane.left_width)
        np.testing.assert_equal(found[name].stop_line, lane.stop_line)


def blob(kind, body, *, order="<", flags=1):
    mark = b"\x01" if order == "<" else b"\x00"
    head = b"GP" + bytes([0, flags]) + struct.pack("<i", 4326)
    return head + mark + struct.pack(order + "I", kind) + body


def points(values, order="<"):
    values = np.asarray(values, np.float64)
    return struct.pack(order + "I", len(values)) + values.astype(order + "f8").tobytes()


LINE = [[1.0, 2.0], [3.0, 4.0]]
LINE_Z = [[1.0, 2.0, 9.0], [3.0, 4.0, 9.0]]
LINE_ZM = [[1.0, 2.0, 9.0, 8.0], [3.0, 4.0, 9.0, 8.0]]


@pytest.mark.parametrize(
    "content",
    [
        blob(2, points(LINE)),
        blob(2, points(LINE, ">"), order=">"),
        blob(1002, points(LINE_Z)),
        blob(2002, points(LINE_Z)),
        blob(3002, points(LINE_ZM)),
        blob(0x80000002, points(LINE_Z)),
        blob(0xC0000002, points(LINE_ZM)),
        blob(3, struct.pack("<I", 2) + points(LINE) + points(LINE[:1])),
        blob(
            5,
            struct.pack("<I", 2)
            + blob(2, points(LINE[:1]))[8:]
            + blob(2, points(LINE))[8:],
        ),
        blob(
            6,
            struct.pack("<I", 1) + blob(3, struct.pack("<I", 1) + points(LINE))[8:],
        ),
    ],
)
def test_geometries(content):
    np.testing.assert_array_equal(geopackage.points_of(content), LINE)


@pytest.mark.parametrize(
    "content",
    [
        None,
        "GP",
        b"",
        b"XX" + bytes(20),
        b"GP\x00\x0f" + bytes(40),  # no such envelope
        blob(2, b""),
        blob(2, struct.pack("<I", 2**32 - 1)),
        blob(2, struct.pack("<I", 3) + bytes(32)),
        blob(1, points(LINE)),  # a point
        blob(3, struct.pack("<I", 2**32 - 1)),
        blob(5, struct.pack("<I", 2**32 - 1)),
        blob(5, struct.pack("<I", 1) + blob(5, struct.pack("<I", 1))[8:] * 50),
        blob(9999, points(LINE)),
        b"GP\x00\x01" + bytes(4) + b"\x07" + bytes(20),
    ],
)
def test_malformed_geometries(content):
    with pytest.raises(ValueError, match=r"\w"):
        geopackage.points_of(content)


def test_empty_geometry():
    assert geopackage.points_of(blob(2, points(LINE), flags=0x11)).shape == (0, 2)


@pytest.mark.parametrize(
    ("statement", "expected"),
    [
        ("DELETE FROM meta", "projectedCoordSystem: missing: expected a UTM zone"),
        ("DROP TABLE meta", "projectedCoordSystem: missing: expected a UTM zone"),
        ("UPDATE meta SET value = 'epsg:3857'", "epsg:3857: expected a UTM zone"),
        ("UPDATE meta SET value = 7.5", "projectedCoordSystem: 7.5"),
        (
            "UPDATE gpkg_geometry_columns SET srs_id = 3857",
            "srs_id: 3857: expected 4326",
        ),
        (
            "UPDATE gpkg_geometry_columns SET column_name = 'shape'",
            "stop_polygons.shape: missing",
        ),
        (
            "UPDATE gpkg_geometry_columns SET column_name = 'two' || char(10) || 'x'",
            "stop_polygons.two x: missing",
        ),
        (
            "ALTER TABLE gpkg_geometry_columns DROP COLUMN column_name",
            "gpkg_geometry_columns.column_name: missing",
        ),
        (
            "UPDATE baseline_paths SET geom = x'00'",
            "baseline_paths.geom: no GeoPackage",
        ),
        ("UPDATE boundaries SET geom = 'x'", "boundaries.geom: no GeoPackage"),
        ("DROP TABLE baseline_paths", "table baseline_paths: missing"),
        ("DROP TABLE lanes_polygons", "table lanes_polygons: missing"),
        (
            "ALTER TABLE lanes_polygons DROP COLUMN lane_fid",
            "lanes_polygons.lane_fid: missing",
        ),
        (
            "DROP TABLE lane_connectors; CREATE VIEW lane_connectors AS SELECT 1",
            "lane_connectors: a view: expected a table",
        ),
    ],
)
def test_malformed_map(folder, statement, expected):
    path = folder.parents[2] / "maps" / fixture.CITY / "9.15.1915" / "map.gpkg"
    edit(path, statement)
    with pytest.raises(InputError) as error:
        only(folder)
    assert expected in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_lines_are_limited(folder, monkeypatch):
    monkeypatch.setattr(geopackage, "MAX_POINTS", 11)
    with pytest.raises(InputError, match=r"geom: \d+ points: expected at most 11"):
        only(folder)


def test_map_off_the_earth(folder):
    path = folder.parents[2] / "maps" / fixture.CITY / "9.15.1915" / "map.gpkg"
    wild = fixture.geometry(2, [[500.0, 95.0], [0.0, 0.0]], to=np.asarray)
    database = sqlite3.connect(path)
    database.execute("UPDATE baseline_paths SET geom = ? WHERE fid = 1", (wild,))
    database.commit()
    database.close()
    with pytest.raises(InputError, match=r"baseline_paths\.geom: 500: expected longit"):
        only(folder)


# -------------------------------------------------------------------- hostile

ENDLESS = """WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n)
  SELECT CAST(x AS BLOB) AS token, CAST(x AS BLOB) AS lidar_pc_token,
  CAST(x AS BLOB) AS track_token, x AS x, x AS y, x AS yaw, x AS vx, x AS vy,
  x AS width, x AS length FROM n"""


@pytest.mark.parametrize(
    ("statement", "expected"),
    [
        (
            f"DROP TABLE lidar_box; CREATE VIEW lidar_box AS {ENDLESS}",
            "lidar_box: a view: expected a table",
        ),
        (
            "DROP TABLE lidar_box; CREATE VIRTUAL TABLE lidar_box USING "
            "fts4(lidar_pc_token, track_token, x, y, yaw, vx, vy, width, length)",
            "lidar_box: a virtual table: expected a table",
        ),
        (
            "DROP TABLE category; CREATE TABLE category (token BLOB, other TEXT, "
            "name TEXT GENERATED ALWAYS AS (hex(zeroblob(20000000))) VIRTUAL);"
            "INSERT INTO category (token, other) SELECT category_token, 1 FROM track",
            "expected a readable SQLite file",
        ),
        ("DROP TABLE lidar_box", "table lidar_box: missing"),
        ("DROP TABLE log", "table log: missing"),
        ("DELETE FROM log", "table log: no rows"),
        ("DELETE FROM lidar_pc", "lidar_pc: no row with an ego pose"),
        ("DELETE FROM ego_pose", "lidar_pc: no row with an ego pose"),
        ("ALTER TABLE lidar_box DROP COLUMN yaw", "lidar_box.yaw: missing"),
        ("UPDATE lidar_box SET x = 'far'", "lidar_box.x: 'far': expected a number"),
        ("UPDATE lidar_box SET x = '1.5 m'", "lidar_box.x: '1.5 m': expected a number"),
        ("UPDATE lidar_box SET x = x'31'", "lidar_box.x: b'1': expected a number"),
        ("UPDATE lidar_box SET x = 9e999", "lidar_box: x: inf"),
        ("UPDATE lidar_box SET x = NULL", "lidar_box: x: nan"),
        ("UPDATE lidar_box SET yaw = NULL", "heading: nan: expected a finite number"),
        ("UPDATE lidar_box SET length = -1", "length: -1 m: expected 0 to"),
        ("UPDATE lidar_box SET width = 1e9", "width: 1e+09 m: expected 0 to"),
        ("UPDATE lidar_box SET vx = 300", "speed: 300"),
        ("UPDATE lidar_box SET track_token = 'abc'", "track_token: 'abc': expected a"),
        (
            "UPDATE lidar_box SET track_token = zeroblob(99)",
            "track_token: b'",
        ),
        ("DELETE FROM track", "track_token: "),
        ("UPDATE category SET name = 'alien'", "category.name: 'alien': expected one"),
        ("UPDATE category SET name = x'ff'", "category.name: b'"),
        ("UPDATE category SET name = NULL", "category.name: None: expected one"),
        ("UPDATE ego_pose SET x = NULL", "ego_pose.x: NULL: expected a number"),
        ("UPDATE ego_pose SET x = 1e300", "ego_pose: x: 1e+300"),
        ("UPDATE ego_pose SET qw = 0", "ego_pose.qw, qx, qy, qz: norm 0: expected 1"),
        ("UPDATE lidar_pc SET timestamp = NULL", "lidar_pc.timestamp: NULL"),
        ("UPDATE lidar_pc SET timestamp = 'now'", "lidar_pc.timestamp: 'now'"),
        ("UPDATE lidar_pc SET timestamp = 5", "timestamp: "),
        ("UPDATE lidar_pc SET timestamp = timestamp / 1000", "timestamp: "),
        (
            "UPDATE lidar_pc SET timestamp = 9223372036854775807 WHERE filename "
            "= '1.pcd'",
            "timestamp: ",
        ),
        (
            "UPDATE traffic_light_status SET lane_connector_id = 'x'",
            "connector_id: 'x'",
        ),
        (
            "PRAGMA writable_schema = ON; UPDATE sqlite_master SET sql = 'nonsense' "
            "WHERE name = 'lidar_box'",
            "expected a readable SQLite file",
        ),
        (
            "PRAGMA writable_schema = ON; UPDATE sqlite_master SET rootpage = 999999 "
            "WHERE name = 'lidar_box'",
            "expected a",
        ),
    ],
)
def test_malformed_log(log, statement, expected):
    edit(log, statement)
    start = time.monotonic()
    with pytest.raises(InputError) as error:
        read(log)
    assert expected in str(error.value)
    assert str(error.value).startswith(str(log))
    assert "\n" not in str(error.value)
    assert time.monotonic() - start < 20.0


def test_triggers_do_not_run(log):
    edit(
        log,
        "CREATE TRIGGER t BEFORE INSERT ON log BEGIN SELECT load_extension('x'); END",
    )
    assert only(log).tracks


def test_work_is_bounded(log, monkeypatch):
    """A join without end stops after steps in proportion to the file."""
    monkeypatch.setattr(sqlite_ro, "MIN_STEPS", 1_000_000)
    monkeypatch.setattr(sqlite_ro, "STEPS_PER_BYTE", 0)
    with sqlite_ro.Database(log) as database:
        sql = "SELECT a.x FROM lidar_box AS a, lidar_box AS b, lidar_box AS c"
        with pytest.raises(InputError, match="too much work for the file's size"):
            database.numbers(sql, ("x",), 10**12)


def test_only_select_is_authorised(log):
    with sqlite_ro.Database(log) as database:
        for sql in (
            "DELETE FROM log",
            "ATTACH DATABASE ':memory:' AS other",
            "SELECT load_extension('x')",
            "PRAGMA writable_schema = ON",
            "WITH RECURSIVE n(x) AS (SELECT 1 UNION SELECT x FROM n) SELECT x FROM n",
        ):
            with pytest.raises(InputError, match="database: "):
                database.numbers(sql, ("x",), 10)


def test_rows_are_limited(log, monkeypatch):
    monkeypatch.setattr(nuplan, "MAX_BOXES", 100)
    with pytest.raises(InputError, match=r"lidar_box\.track_token: more than 100 rows"):
        read(log)


def test_extra_wal_file_is_not_read(log):
    """immutable=1: a planted journal changes nothing."""
    for suffix in ("-wal", "-journal", "-shm"):
        (log.parent / (log.name + suffix)).write_bytes(os.urandom(4096))
    assert only(log).tracks


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "database: b'': expected a SQLite file"),
        (b"SQLite format 3\x00", "expected a SQLite file"),
        (b"SQLite format 3\x00" + bytes(5000), "expected"),
        (b"SQLite format 3\x00" + b"\xff" * 5000, "expected"),
    ],
)
def test_not_a_database(tmp_path, content, expected):
    path = tmp_path / "a.db"
    path.write_bytes(content)
    with pytest.raises(InputError, match=expected):
        read(tmp_path)


def test_truncated(log):
    log.write_bytes(log.read_bytes()[:50000])
    with pytest.raises(
        InputError, match=r"size: 50000 bytes: expected \d+ bytes; trunc"
    ):
        read(log)


@pytest.mark.parametrize("seed", range(4))
def test_flipped_bytes_are_one_line(log, seed):
    content = log.read_bytes()
    rng = np.random.default_rng(seed)
    for _ in range(12):
        damaged = bytearray(content)
        for place in rng.integers(0, len(content), 30):
            damaged[place] = rng.integers(0, 256)
        damaged[: 4 * 4096] = content[: 4 * 4096] if seed % 2 else damaged[: 4 * 4096]
        log.write_bytes(damaged)
        try:
            read(log)
        except InputError as error:
            line = str(error)
            assert "\n" not in line


@pytest.mark.parametrize(
    "options", [{"window_s": 0}, {"window_s": 1e-9}, {"ego": 1}, {"rate_hz": "x"}]
)
def test_options_are_checked(log, options):
    with pytest.raises(InputError, match="source TOML"):
        read(log, **options)


def test_wrong_rate(log):
    with pytest.raises(InputError, match=r"t: median step .*: expected 0\.1 s"):
        read(log, rate_hz=10.0)


def test_zone_of():
    assert geopackage.zone_of("epsg:32648") == (48, False)
    assert geopackage.zone_of(32719) == (19, True)
    for bad in ("epsg:4326", None, "32661", "x32611"):
        assert geopackage.zone_of(bad) is None
    assert nuplan_map._fid("61") == 61
    assert nuplan_map._fids("31, 32,x") == (31, 32)
