"""nuPlan logs and maps: SQLite of others, geometry blobs, windows, lights."""

import functools
import shutil

import numpy as np
import pytest
import shapely

from rcirl_jax.data.formats import nuplan
from tests.data.formats.fixtures import has_note
from tests.data.formats.fixtures import nuplan as fixture
from tests.data.formats.fixtures.nuplan import edit
from tests.helpers import logs
from tests.helpers.logs import lanes_of, tracks_of

DRIVE = "2021.06.14.21.57.33_veh-38"
only = functools.partial(logs.only, "nuplan")


LOGS = "nuplan-v1.1/splits/mini"


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nuplan")
    fixture.write(folder)
    return folder


@pytest.fixture
def folder(original, tmp_path):
    """Logs with their map."""
    return shutil.copytree(original, tmp_path / "nuplan") / LOGS


@pytest.fixture
def city(folder):
    """The file of the map."""
    return folder.parents[2] / "maps" / fixture.CITY / "9.15.1915" / "map.gpkg"


@pytest.fixture
def log(original, tmp_path):
    """A log without a map."""
    name = f"{fixture.NAME}.db"
    return shutil.copy(original / LOGS / name, tmp_path / name)


@pytest.fixture(scope="module")
def whole(original):
    """The recording of the log, with its map."""
    return only(original / LOGS)


def test_ego_is_the_box_at_the_clouds_time(whole, log):
    """Rear axle, 3 ms early -> centre, at the time of the point cloud."""
    assert (whole.name, whole.group) == (fixture.NAME, DRIVE)
    assert has_note(whole, "x = 664000 m, y = 3997000 m")
    ego = whole.tracks[0]
    np.testing.assert_allclose(ego.x, fixture.road_users()["ego"].x, atol=2e-3)
    np.testing.assert_allclose(ego.t, fixture.STAMPS, atol=1e-6)
    edit(log, f"UPDATE ego_pose SET qw = {np.cos(0.35)}, qz = {np.sin(0.35)}")
    np.testing.assert_allclose(only(log).tracks[0].heading, 0.7)


@pytest.mark.parametrize(
    ("name", "drive"),
    [
        ("2021.06.14.21.57.33_veh-08_01008_01518", "2021.06.14.21.57.33_veh-08"),
        (f"{DRIVE}_00017", f"{DRIVE}_00017"),
    ],
)
def test_logs_of_one_drive_are_one_group(name, drive):
    assert nuplan.drive_of(name) == drive


def test_lanes_of_the_map(whole):
    lanes = lanes_of(whole)
    assert set(lanes) == {"61", "62", "63", "connector-71", "connector-72"}
    lane, right, last = lanes["61"], lanes["62"], lanes["63"]
    np.testing.assert_allclose(lane.centre[[0, -1]], [[-60, 0], [60, 0]], atol=5e-3)
    for width in (lane.left_width, lane.right_width):
        np.testing.assert_allclose(width, 1.75, atol=5e-3)
    assert lane.speed_limit == pytest.approx(11.176)
    assert (lane.left, lane.right, right.right) == ("62", None, "61")
    assert lane.successors == ("connector-71", "connector-72")
    assert lanes["connector-72"].successors == ("63",)
    assert lanes["connector-72"].speed_limit == pytest.approx(8.9)
    assert last.speed_limit is None
    # no bounds in the map
    np.testing.assert_array_equal(last.left_width, 1.75)


def test_stop_lines_signs_and_lights(whole):
    lanes = lanes_of(whole)
    line, sign = lanes["connector-72"].stop_line, lanes["63"].stop_line
    np.testing.assert_allclose(line, [[62.0, 1.75], [62.0, -1.75]], atol=0.02)
    assert sign[0, 0] == pytest.approx(148.5, abs=0.02)
    assert lanes["connector-71"].signal_ids == ("71",)
    assert {name for name, lane in lanes.items() if lane.stop_sign} == {"63"}
    assert lanes["61"].stop_line is None
    signals = {signal.id: signal for signal in whole.signals}
    assert signals["71"].state == ("red", "green")
    green = fixture.STAMPS[fixture.GREEN_FROM]
    np.testing.assert_allclose(signals["71"].start, [0.0, green], atol=1e-6)
    assert signals["72"].state == ("off",)


@pytest.mark.parametrize(
    ("version", "location", "is_found"),
    [
        ("us-nv-las-vegas-strip.gpkg", "x", True),
        (None, "las_vegas", True),
        # what leaves the folder, or could be several maps
        *[(name, "/etc", False) for name in ("../maps/us-nv-las-vegas-strip", "us-")],
    ],
)
def test_map_is_found_by_name(folder, version, location, is_found):
    sql = "UPDATE log SET map_version = ?, location = ?"
    edit(folder / f"{fixture.NAME}.db", sql, values=(version, location))
    (folder.parents[2] / "maps" / "us-ma-boston").mkdir()
    name = only(folder).lanes[0].id.partition(".")[0]
    assert name == ("61" if is_found else "lane-0")


def test_latest_version_of_a_map_as_the_archive_unpacks_it(folder, city):
    """nuplan-maps-v1.1.zip holds a folder nuplan-maps-v1.0."""
    latest = city.parents[1] / "9.17.0000" / "map.gpkg"
    fixture.write_map(latest)
    edit(latest, "DELETE FROM lane_connectors")
    maps = folder.parents[2] / "maps"
    (maps / "nuplan-maps-v1.0.json").write_text("{}")
    maps.rename(maps.with_name("nuplan-maps-v1.0"))
    assert set(lanes_of(only(folder))) == {"61", "62", "63"}


def in_utm(points):
    return np.asarray(points) + fixture.CENTRE


@pytest.mark.parametrize(
    ("srs", "to", "zone"),
    [
        (32611, in_utm, "epsg:32611"),
        (26911, in_utm, "epsg:32611"),
        (4326, fixture.degrees, "26911"),
    ],
)
def test_systems_of_coordinates(folder, city, srs, to, zone):
    city.unlink()
    fixture.write_map(city, to=to, srs=srs, zone=zone)
    centre = lanes_of(only(folder))["61"].centre
    np.testing.assert_allclose(centre[0], [-60.0, 0.0], atol=5e-3)


def test_optional_layers_and_columns(folder, city):
    edit(city, "DELETE FROM stop_polygons")
    assert not any(lane.stop_sign for lane in only(folder).lanes)
    edit(
        city,
        "DROP TABLE boundaries; DROP TABLE stop_polygons; DROP TABLE "
        "gen_lane_connectors_scaled_width_polygons; DROP TABLE gpkg_geometry_columns;"
        "ALTER TABLE lanes_polygons DROP COLUMN left_boundary_fid;"
        "ALTER TABLE lane_connectors DROP COLUMN traffic_light_stop_line_fids;"
        "UPDATE lanes_polygons SET lane_index = NULL, speed_limit_mps = 'x';"
        "UPDATE lane_connectors SET exit_lane_fid = '61', entry_lane_fid = 63.0;",
    )
    lanes = lanes_of(only(folder))
    assert (lanes["61"].left, lanes["61"].speed_limit) == (None, None)
    assert lanes["61"].successors == ("connector-71", "connector-72")
    assert lanes["connector-72"].successors == ("63",)
    assert lanes["connector-72"].stop_line is None


def blob(shape, order=1, **dimensions):
    """A GeoPackage blob without an envelope, as shapely writes well-known binary."""
    made = shapely.to_wkb(shape, byte_order=order, **dimensions)
    return b"GP\x00\x01" + bytes(4) + made


LINE = np.array([[1.0, 2.0], [3.0, 4.0]])
RING = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 0.0]])
HOLE = np.array([[2.0, 0.5], [3.0, 0.5], [3.0, 1.0], [2.0, 0.5]])
SHORT = shapely.LineString([[7.0, 7.0], [7.0, 8.0]])
TALL = shapely.force_3d(shapely.LineString(LINE), 9.0)
LONG = shapely.LineString(RING)
GEOMETRIES = [
    *[(blob(shapely.LineString(LINE), order=order), LINE) for order in (0, 1)],
    *[(blob(TALL, flavor=flavor), LINE) for flavor in ("iso", "extended")],
    (blob(shapely.Polygon(RING, [HOLE])), RING),
    (blob(shapely.MultiLineString([SHORT, LONG])), RING),
    (blob(shapely.MultiPolygon([shapely.Polygon(RING)])), RING),
    (b"GP\x00\x11" + blob(SHORT)[4:], np.zeros((0, 2))),  # said to be empty
]


@pytest.mark.parametrize(("content", "points"), GEOMETRIES)
def test_geometries(content, points):
    np.testing.assert_array_equal(nuplan.points_of(content), points)


MALFORMED = [
    *(None, b"XX" + bytes(20), blob(shapely.Point(1.0, 2.0)), blob(LONG)[:30]),
    blob(LONG)[:13] + b"\xff" * 4,  # more points than there are bytes
]


@pytest.mark.parametrize("content", MALFORMED)
def test_malformed_geometries(content):
    with pytest.raises(ValueError, match=r"\w"):
        nuplan.points_of(content)


def test_missing_velocity_comes_from_positions(log):
    edit(log, "UPDATE lidar_box SET vx = NULL", "UPDATE ego_pose SET vy = NULL")
    tracks = tracks_of(only(log))
    for name in ("ego", fixture.TRACK["12"].hex()):
        np.testing.assert_allclose(tracks[name].speed, 8.0, atol=0.1)
