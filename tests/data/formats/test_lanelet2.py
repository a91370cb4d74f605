"""Lanelet2 maps: geometry, links, rules, positions; hostile and broken files."""

import copy
from xml.etree import ElementTree

import numpy as np
import pytest

from rcirl_jax.data.formats.lanelet2 import read_lanelet2
from rcirl_jax.data.formats.projection import utm
from tests.data.formats.fixtures import osm

UTM_ORIGIN = np.array([297631.3187, 5629917.34465])


def project(latitude, longitude):
    return utm(latitude, longitude, 32) - UTM_ORIGIN


def read(path):
    lanes, notes = read_lanelet2(path, project)
    return {lane.id: lane for lane in lanes}, notes


def metres(folder, **options):
    return osm.lanelet_map(folder / "m.osm_xy", osm.in_metres, **options)


@pytest.fixture
def lanes(tmp_path):
    return read(metres(tmp_path))[0]


def test_geometry_and_direction(lanes):
    """Bounds in two ways, or drawn backwards, give the lane as it is driven."""
    east = lanes["30001"]
    np.testing.assert_allclose(east.centre[[0, -1]], [[0.0, -1.75], [80.0, -1.75]])
    np.testing.assert_allclose(east.left_width + east.right_width, 3.5)
    assert np.all(np.diff(east.centre[:, 0]) > 0.0)
    west = lanes["30005"]
    np.testing.assert_allclose(west.centre[[0, -1]], [[160.0, 1.75], [0.0, 1.75]])
    turn = lanes["30003"].centre
    radii = np.hypot(turn[:, 0] - 80.0, turn[:, 1] + 1.75 + osm.RADIUS)
    np.testing.assert_allclose(radii, osm.RADIUS, atol=0.05)
    assert np.hypot(*np.diff(turn, axis=0).T).min() > 0.2


def test_links(lanes):
    assert lanes["30001"].successors == ("30002", "30003")
    assert lanes["30003"].successors == ("30004",)
    assert lanes["30004"].successors == ()
    # the opposite lane shares a bound, but is no neighbour of the same direction
    assert lanes["30001"].left is None
    assert lanes["30005"].left is None


def test_neighbours_of_the_same_direction(tmp_path):
    one = (["path_north"], ["path_south"], osm.ROAD, [])
    other = (["path_south"], ["middle_3"], osm.ROAD, [])
    lanes, _ = read(metres(tmp_path, lanelets={"1": one, "2": other}))
    assert (lanes["1"].left, lanes["1"].right) == (None, "2")
    assert (lanes["2"].left, lanes["2"].right) == ("1", None)


def test_two_way_lanes_and_those_of_others(lanes):
    assert set(lanes) == {*(f"3000{i}" for i in (1, 2, 3, 4, 5, 7)), "30007-back"}
    there, back = lanes["30007"], lanes["30007-back"]
    np.testing.assert_allclose(there.centre, back.centre[::-1])
    assert back.id not in there.successors


@pytest.mark.parametrize(
    ("tags", "kept"),
    [
        ({"subtype": "bicycle_lane"}, False),
        ({"subtype": "walkway", "participant:vehicle": "yes"}, True),
        ({"subtype": "road", "participant:pedestrian": "yes"}, False),
        ({"subtype": "bus_lane", "participant:vehicle:bus": "yes"}, True),
        ({}, True),
    ],
)
def test_participants(tmp_path, tags, kept):
    both = {
        "1": (["path_north"], ["path_south"], {"type": "lanelet", **tags}, []),
        "2": (["middle_3"], ["border_3"], osm.ROAD, []),
    }
    assert ("1" in read(metres(tmp_path, lanelets=both))[0]) == kept


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("50 km/h", 50 / 3.6),
        ("40mph", 40 * 0.44704),
        ("de274-60", 60 / 3.6),
        ("fast", None),
        ("900 km/h", None),
        # minutes, if the time were the square of the spaces
        (f"50{300_000 * ' '}!", None),
    ],
)
def test_speed_limits(tmp_path, monkeypatch, text, expected):
    rule = ({"subtype": "speed_limit", "sign_type": text}, [])
    monkeypatch.setitem(osm.RULES, "50000", rule)
    lanes, _ = read(metres(tmp_path))
    if expected is None:
        assert lanes["30001"].speed_limit is None
    else:
        assert lanes["30001"].speed_limit == pytest.approx(expected)
    assert lanes["30007"].speed_limit is None


def test_stop_sign_and_its_line(lanes):
    lane = lanes["30004"]
    assert lane.stop_sign
    np.testing.assert_allclose(lane.stop_line, [[93.25, -78.0], [96.75, -78.0]])
    assert lanes["30002"].stop_line is None


@pytest.mark.parametrize(
    ("rule", "line", "sign"),
    [
        (({"subtype": "traffic_light"}, []), "end", False),
        (({"subtype": "all_way_stop"}, [("relation", "30004", "yield")]), "end", True),
        (({"subtype": "right_of_way"}, [("relation", "30002", "yield")]), None, False),
        (({"subtype": "right_of_way"}, [("relation", "30004", "yield")]), None, False),
        (({"subtype": "traffic_sign"}, [("way", "sign", "refers")]), "end", True),
        (({"subtype": "traffic_sign", "sign_type": "de205"}, []), None, False),
    ],
)
def test_rules_about_stopping(tmp_path, monkeypatch, rule, line, sign):
    monkeypatch.setitem(osm.RULES, "50001", rule)
    lane = read(metres(tmp_path))[0]["30004"]
    assert lane.stop_sign == sign
    if line is None:
        assert lane.stop_line is None
    else:
        np.testing.assert_allclose(lane.stop_line, [[96.75, -80.0], [93.25, -80.0]])


def test_positions_in_degrees_and_in_local_tags(tmp_path, lanes):
    place = osm.in_degrees(32, UTM_ORIGIN)
    degrees, _ = read(osm.lanelet_map(tmp_path / "m.osm", place))
    path = osm.lanelet_map(tmp_path / "local.osm", osm.in_metres)
    text = path.read_text()
    for x, y in {tuple(p) for points in osm.WAYS.values() for p in points}:
        old = f"x='{x:.4f}' y='{y:.4f}' />"
        tags = f"<tag k='local_x' v='{x:.4f}'/><tag k='local_y' v='{y:.4f}'/></node>"
        text = text.replace(old, f"lat='0' lon='0'>{tags}")
    path.write_text(text)
    tagged, _ = read(path)
    for name, lane in lanes.items():
        np.testing.assert_allclose(degrees[name].centre, lane.centre, atol=1e-3)
        np.testing.assert_allclose(tagged[name].centre, lane.centre, atol=1e-9)


def test_ways_of_a_bound_meet_in_two_nodes_at_one_place(tmp_path, lanes):
    """Every way with nodes of its own: the same lanes."""
    file = metres(tmp_path / "twins")
    tree = ElementTree.parse(file)
    root, number = tree.getroot(), 900_000
    nodes = {node.get("id"): node for node in root.iter("node")}
    for way in root.findall("way"):
        for ref in way.findall("nd"):
            number += 1
            twin = copy.deepcopy(nodes[ref.get("ref")])
            twin.set("id", str(number))
            ref.set("ref", str(number))
            root.insert(0, twin)
    tree.write(file)
    found, _ = read(file)
    assert found.keys() == lanes.keys()
    for name, lane in lanes.items():
        np.testing.assert_allclose(found[name].centre, lane.centre, atol=1e-9)
        assert found[name].successors == lane.successors
