"""CommonRoad XML: fixtures of both versions, real files, malformed files."""

import time

import numpy as np
import pytest
from defusedxml import ElementTree
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.data.importers import read_recordings
from rcirl_jax.data.importers.commonroad import extras as commonroad_extras
from rcirl_jax.data.importers.commonroad import reader as commonroad
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind
from tests.data.importers import writers as w


def read(path):
    return list(read_recordings("commonroad", path, None))


def only(path):
    (recording,) = read(path)
    return recording


@pytest.mark.parametrize("version", ["2018b", "2020a"])
def test_car_in_both_versions(tmp_path, version):
    recording = only(w.commonroad(tmp_path / "one.xml", version=version))
    (track,) = recording.tracks
    assert (recording.name, recording.rate_hz) == ("one", pytest.approx(10.0))
    assert (track.id, track.kind, track.length, track.width) == ("10", 1, 4.4, 1.8)
    steps = np.arange(40)
    np.testing.assert_allclose(track.t, 0.1 * steps)
    np.testing.assert_allclose(track.x, 1.5 * steps)
    np.testing.assert_array_equal(track.speed, 15.0)
    assert recording.group == "one"
    assert any("its own group" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("truck", Kind.VEHICLE),
        ("motorcycle", Kind.VEHICLE),
        ("bicycle", Kind.CYCLIST),
        ("pedestrian", Kind.PEDESTRIAN),
    ],
)
def test_kinds(tmp_path, kind, expected):
    body = w.lanelet() + w.car(kind=kind)
    assert only(w.commonroad(tmp_path / "a.xml", body)).tracks[0].kind == expected


@pytest.mark.parametrize("version", ["2018b", "2020a"])
def test_standing_things_last_the_whole_recording(tmp_path, version):
    parked = w.car("31", kind="parkedVehicle", version=version, count=2, y=-5)
    body = w.lanelet() + w.car(version=version) + w.standing(version=version) + parked
    tracks = only(w.commonroad(tmp_path / "a.xml", body, version=version)).tracks
    assert [track.kind for track in tracks] == [Kind.VEHICLE, Kind.STATIC, Kind.STATIC]
    for track in tracks[1:]:
        np.testing.assert_allclose(track.t, tracks[0].t)
        assert np.ptp(track.x) == 0.0
        assert not track.speed.any()


def test_samples_of_standing_things_are_limited(tmp_path, monkeypatch):
    body = w.lanelet() + w.car() + w.standing()  # 40 steps
    path = w.commonroad(tmp_path / "a.xml", body)
    monkeypatch.setattr(commonroad, "MAX_STANDING", 40)
    assert len(only(path).tracks) == 2
    monkeypatch.setattr(commonroad, "MAX_STANDING", 39)
    with pytest.raises(InputError, match="obstacles: 1 static ones over 40 steps"):
        read(path)


def test_shapes_and_their_offsets(tmp_path):
    circle = "<circle><radius>0.4</radius></circle>"
    corners = [(0, 0), (4, 0), (4, 2), (0, 2)]
    polygon = f"<polygon>{''.join(w.POINT.format(*p) for p in corners)}</polygon>"
    body = (
        w.lanelet()
        + w.car()
        + w.standing("30", shape=circle)
        + w.standing("31", shape=polygon, x=50, y=10, heading=np.pi / 2)
    )
    _, round_one, box = only(w.commonroad(tmp_path / "a.xml", body)).tracks
    assert (round_one.length, round_one.width) == (0.8, 0.8)
    assert (box.length, box.width) == (4.0, 2.0)
    # the box centre (2, 1) of the polygon, turned by 90 degrees to the left
    np.testing.assert_allclose([box.x[0], box.y[0]], [49.0, 12.0])


def test_intervals_become_midpoints(tmp_path):
    between = (
        "<velocity><intervalStart>14</intervalStart><intervalEnd>16</intervalEnd>"
        "</velocity></state>"
    )
    states = [
        w.state(k, 1.5 * k, 0, drop=("velocity",)).replace("</state>", between)
        for k in range(1, 5)
    ]
    path = w.commonroad(tmp_path / "a.xml", w.lanelet() + w.car(states=states))
    np.testing.assert_allclose(only(path).tracks[0].speed, 15.0)


def test_lane_geometry_from_unequal_bounds(tmp_path):
    (lane,) = only(w.commonroad(tmp_path / "a.xml")).lanes
    np.testing.assert_allclose(lane.centre, [[0, 0], [100, 0], [200, 0]], atol=1e-9)
    np.testing.assert_allclose(lane.left_width + lane.right_width, 3.5)


def test_lane_tapering_to_a_point_keeps_a_width(tmp_path):
    body = w.lanelet(left=[(0, 1.75), (200, -1.75)]) + w.car()
    (lane,) = only(w.commonroad(tmp_path / "a.xml", body)).lanes
    assert (lane.left_width > 0.0).all()


def test_lane_references(tmp_path):
    links = (
        '<successor ref="2"/><successor ref="77"/>'
        '<adjacentLeft ref="3" drivingDir="opposite"/>'
        '<adjacentRight ref="2" drivingDir="same"/>'
    )
    body = w.lanelet("1", extra=links) + w.lanelet("2") + w.lanelet("3") + w.car()
    lane = only(w.commonroad(tmp_path / "a.xml", body)).lanes[0]
    assert (lane.successors, lane.left, lane.right) == (("2",), None, "2")


def test_speed_limits(tmp_path):
    body = (
        w.lanelet("1", extra='<trafficSignRef ref="50"/>')
        + w.lanelet("2", extra='<trafficSignRef ref="51"/>')
        + w.lanelet("3")
        + w.car()
        + w.sign("50", "R2-1", 13.4112)
        + w.sign("51", "R2-1", 3.5763)
    )
    recording = only(w.commonroad(tmp_path / "a.xml", body))
    assert [lane.speed_limit for lane in recording.lanes] == [13.4112, None, None]
    assert recording.default_speed_limit == 13.4112
    assert any("speed limit" in note for note in recording.notes)


@pytest.mark.parametrize("kind", ["R2-1", "274", "274.1", "r301"])
def test_limit_signs_of_countries(tmp_path, kind):
    lane = w.lanelet(extra='<trafficSignRef ref="50"/>')
    path = w.commonroad(tmp_path / "a.xml", lane, w.sign("50", kind, 8.33), w.car())
    assert only(path).lanes[0].speed_limit == 8.33


@pytest.mark.parametrize("kind", ["R1-1", "206", "r2"])
def test_stop_signs_of_countries(tmp_path, kind):
    lane = w.lanelet(extra='<stopLine><trafficSignRef ref="50"/></stopLine>')
    path = w.commonroad(tmp_path / "a.xml", lane, w.sign("50", kind), w.car())
    assert only(path).lanes[0].stop_sign


def test_speed_limit_of_2018b(tmp_path):
    body = w.lanelet(extra="<speedLimit>20</speedLimit>") + w.car(version="2018b")
    path = w.commonroad(tmp_path / "a.xml", body, version="2018b")
    assert only(path).lanes[0].speed_limit == 20.0


def test_stop_lines_signs_and_lights(tmp_path):
    ends = "".join(w.POINT.format(*p) for p in [(190, 1.75), (190, -1.75)])
    body = (
        w.lanelet(
            "1",
            extra="<stopLine><trafficSignRef ref='60'/></stopLine>",
        )
        + w.lanelet("2", extra=f"<stopLine>{ends}</stopLine><trafficLightRef ref='7'/>")
        + w.car()
        + w.sign("60", "R1-1")
        + w.light("7", [("green", 10), ("red", 20)])
    )
    first, second = only(w.commonroad(tmp_path / "a.xml", body)).lanes
    assert first.stop_sign
    np.testing.assert_array_equal(first.stop_line, [[200, 1.75], [200, -1.75]])
    assert not second.stop_sign
    np.testing.assert_array_equal(second.stop_line, [[190, 1.75], [190, -1.75]])
    assert second.signal_ids == ("7",)


@given(
    durations=st.lists(st.integers(1, 400), min_size=1, max_size=4),
    offset=st.integers(0, 2000),
)
def test_signal_cycle_against_modular_arithmetic(tmp_path_factory, durations, offset):
    colours = ["green", "yellow", "redYellow", "inactive"][: len(durations)]
    shown = {"redYellow": "red", "inactive": "off"}
    phases = list(zip(colours, durations, strict=True))
    path = tmp_path_factory.mktemp("signal") / "a.xml"
    body = w.lanelet() + w.car() + w.light("7", phases, offset=offset)
    (signal,) = only(w.commonroad(path, body)).signals
    assert not signal.is_recorded
    assert signal.start[0] <= 0.0
    for step in range(40):
        left = (step - offset) % sum(durations)
        expected = next(
            colour
            for colour, end in zip(colours, np.cumsum(durations), strict=True)
            if left < end
        )
        index = np.searchsorted(signal.start, 0.1 * step + 1e-6, side="right") - 1
        assert signal.state[index] == shown.get(expected, expected)


@pytest.mark.parametrize("offset", [1.149e34, -1e300, -1e-30, 1e9 + 5])
def test_offset_of_any_size_begins_one_turn_early(tmp_path, offset):
    body = (
        w.lanelet() + w.car() + w.light("7", [("red", 7), ("green", 5)], offset=offset)
    )
    (signal,) = only(w.commonroad(tmp_path / "a.xml", body)).signals
    assert -1.21 < signal.start[0] <= 0.0
    assert signal.start[-1] >= 3.1
    np.testing.assert_allclose(np.diff(signal.start)[::2], 0.7)


def test_intervals_of_all_lights_are_limited(tmp_path, monkeypatch):
    lights = [w.light(name, [("red", 1), ("green", 1)]) for name in "78"]
    path = w.commonroad(tmp_path / "a.xml", w.lanelet(), w.car(), *lights)
    sizes = [signal.start.size for signal in only(path).signals]
    assert sizes == [42, 42]  # steps 0 to 39 and a turn before
    monkeypatch.setattr(commonroad_extras, "MAX_INTERVALS", sum(sizes) - 1)
    with pytest.raises(InputError, match="trafficLight 8: cycle: 21 turns"):
        read(path)


def test_inactive_light_is_off(tmp_path):
    body = w.lanelet() + w.car() + w.light("7", [("red", 9)], active="false")
    (signal,) = only(w.commonroad(tmp_path / "a.xml", body)).signals
    assert set(signal.state) == {"off"}


@pytest.mark.parametrize(
    ("goal", "end"),
    [
        (
            "<position><rectangle><length>2</length><width>2</width>"
            "<center><x>25</x><y>1</y></center></rectangle></position>",
            (25.0, 1.0),
        ),
        ('<position><lanelet ref="1"/></position>', (30.0, 0.0)),
        ("", (30.0, 0.0)),
    ],
)
def test_ghost_reaches_the_goal(tmp_path, goal, end):
    body = w.lanelet() + w.car() + w.problem(goal, speed=10.0)
    (ghost,) = only(w.commonroad(tmp_path / "a.xml", body)).ghosts
    assert (ghost.t0, ghost.t1, ghost.start) == (0.0, pytest.approx(3.0), (0.0, 0.0))
    np.testing.assert_allclose(ghost.end, end, atol=0.6)


def test_lanelets_of_a_goal_are_limited(tmp_path):
    ends = {"left": [(0, 2), (200000, 2)], "right": [(0, -2), (200000, -2)]}
    goal = '<position><lanelet ref="1"/></position>'
    path = w.commonroad(tmp_path / "a.xml", w.lanelet(**ends), w.car(), w.problem(goal))
    with pytest.raises(InputError, match="goalState: lanelets of 200000 m"):
        read(path)


def test_lanelet_of_a_goal_counts_once(tmp_path, monkeypatch):
    monkeypatch.setattr(commonroad_extras, "MAX_GOAL_M", 201)  # m, the lanelet has 200
    goal = "<position>" + '<lanelet ref="1"/>' * 3 + "</position>"
    path = w.commonroad(tmp_path / "a.xml", w.lanelet(), w.car(), w.problem(goal))
    np.testing.assert_allclose(only(path).ghosts[0].end, (30.0, 0.0), atol=0.6)


def test_obstacle_without_trajectory_is_noted(tmp_path):
    bare = w.car("11", count=1).replace("<trajectory></trajectory>", "")
    recording = only(w.commonroad(tmp_path / "a.xml", w.lanelet() + w.car() + bare))
    assert len(recording.tracks) == 1
    assert any("without a trajectory" in note for note in recording.notes)


def test_groups_beside_and_above_the_folder(tmp_path):
    folder = tmp_path / "xml"
    folder.mkdir()
    w.commonroad(folder / "a.xml")
    (tmp_path / "independent_groups.csv").write_text("file,group\na.xml,G1\n")
    assert only(folder).group == "G1"
    assert only(folder / "a.xml").group == "G1"


def test_provenance_follows_the_source_attribute(tmp_path):
    ngsim = only(w.commonroad(tmp_path / "a.xml"))
    assert "10.21949/1504477" in ngsim.licence
    assert "OpenStreetMap" in ngsim.licence
    other = w.commonroad(tmp_path / "b.xml")
    other.write_text(other.read_text().replace("NGSIM test", "by hand"))
    assert "NGSIM" not in only(other).licence


BOMB = (
    '<!DOCTYPE b [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">'
    '<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;">]>'
)
EXTERNAL = '<!DOCTYPE b [<!ENTITY x SYSTEM "file:///etc/hostname">]>'
BOX = "<rectangle><length>4.4</length><width>1.8</width></rectangle>"
GOOD = [w.state(1, 1.5, 0)]


@pytest.mark.parametrize(
    ("parts", "options", "field"),
    [
        ([], {"prolog": BOMB}, "entities"),
        ([], {"prolog": EXTERNAL}, "entities"),
        ([], {"version": "1999"}, "commonRoadVersion"),
        ([w.car()], {}, "lanelet"),
        ([w.lanelet()], {}, "tracks"),
        (
            [w.lanelet(), w.car(states=[w.state(1, 1.5, 0, drop=("velocity",))])],
            {},
            "state 1: velocity: missing",
        ),
        (
            [w.lanelet(), w.car(states=[w.state(1, 1.5, 0, drop=("position",))])],
            {},
            "state 1: position: missing",
        ),
        ([w.lanelet(), w.car(states=[w.state(1, "nan", 0)])], {}, "x: 'nan'"),
        ([w.lanelet(), w.car(states=[w.state(1, 1.5, "1e999")])], {}, "y: '1e999'"),
        ([w.lanelet(), w.car(), w.car(y=4)], {}, "id: 10"),
        ([w.lanelet(), w.car(states=GOOD * 2)], {}, "time: 1"),
        (
            [w.lanelet(), w.car(states=[w.state(3, 4.5, 0), w.state(2, 3, 0)])],
            {},
            "time: 2",
        ),
        ([w.lanelet(), w.car(shape="<blob/>")], {}, "shape: blob"),
        ([w.lanelet(), w.car(shape=BOX.replace("4.4", "4400"))], {}, "length: 4400"),
        ([w.lanelet(left=[(0, 1)]), w.car()], {}, "leftBound"),
        ([w.lanelet(), w.lanelet(), w.car()], {}, "lane id: 1"),
        ([w.lanelet(), w.car(), w.light("7", [("pink", 9)])], {}, "pink"),
        ([w.lanelet(), w.car(), w.light("7", [("red", -1)])], {}, "duration"),
        ([w.lanelet(), w.car(), w.light("7", [("red", 1e-9)])], {}, "red for 1e-09"),
        ([w.lanelet(), w.car(), w.light("7", [("red", 1e300)])], {}, "red for 1e+300"),
        ([w.lanelet(), w.car(version="2018b").replace("dynamic<", "odd<")], {}, "role"),
    ],
)
def test_malformed(tmp_path, parts, options, field):
    path = w.commonroad(tmp_path / "bad.xml", *parts, **options)
    with pytest.raises(InputError) as error:
        read(path)
    message = str(error.value)
    assert message.startswith(str(path))
    assert field in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("content", "field"),
    [
        (b"\x00\xff\xfe\x01garbage" * 100, "xml"),
        (b"", "xml"),
        (b"<other/>", "root: 'other'"),
        (b'<commonRoad commonRoadVersion="2020a" timeStepSize="x"/>', "timeStepSize"),
        (b'<?xml version="1.0" encoding="klingon"?><commonRoad/>', "xml"),
    ],
)
def test_not_commonroad(tmp_path, content, field):
    path = tmp_path / "bad.xml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=field) as error:
        read(path)
    assert str(error.value).startswith(str(path))


@given(share=st.floats(0.0, 0.99))
def test_truncated_anywhere(tmp_path_factory, share):
    path = w.commonroad(tmp_path_factory.mktemp("cut") / "cut.xml")
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match="well-formed"):
        read(path)


def test_too_large_a_file(tmp_path, monkeypatch):
    monkeypatch.setattr(commonroad, "MAX_FILE_BYTES", 100)
    with pytest.raises(InputError, match="size"):
        read(w.commonroad(tmp_path / "a.xml"))


def test_wrong_units_are_named(tmp_path):
    states = [w.state(k, 1.5 * k / w.FOOT, 0) for k in range(1, 40)]
    path = w.commonroad(tmp_path / "a.xml", w.lanelet() + w.car(states=states))
    with pytest.raises(InputError, match="feet taken for metres"):
        read(path)


@pytest.mark.parametrize(
    ("table", "said"),
    [("name,number\na.xml,1\n", "columns: "), ("file,group\na.xml\n", "row 1: ")],
)
def test_group_file_without_its_columns(tmp_path, table, said):
    path = w.commonroad(tmp_path / "a.xml")
    (tmp_path / "independent_groups.csv").write_text(table)
    with pytest.raises(InputError, match=rf"csv: {said}.*expected file,group"):
        read(path)


@pytest.mark.dataset
@pytest.mark.parametrize(
    ("folder", "files", "tracks", "groups"),
    [
        ("ngsim_us101_commonroad", 36, 996, 16),
        ("ngsim_urban_commonroad", 25, 1136, 6),
    ],
)
def test_recorded_files(data_dir, folder, files, tracks, groups):
    begin = time.process_time()
    found = read(data_dir / folder / "xml")
    assert time.process_time() - begin < 10.0
    assert len(found) == files
    assert sum(len(recording.tracks) for recording in found) == tracks
    assert len({recording.group for recording in found}) == groups
    for recording in found:
        assert len(recording.ghosts) == 1
        (ghost,) = recording.ghosts
        distance = np.hypot(*np.subtract(ghost.end, ghost.start))
        assert distance / (ghost.t1 - ghost.t0) < 25.0  # m/s, no car flies


@pytest.mark.dataset
def test_recorded_states_are_those_of_the_file(data_dir):
    path = data_dir / "ngsim_urban_commonroad" / "xml" / "USA_Peach-4_4_T-1.xml"
    recording, root = only(path), ElementTree.parse(path).getroot()
    for element, track in zip(
        root.iterfind("dynamicObstacle"), recording.tracks, strict=True
    ):
        x = [float(node.text) for node in element.iter("x")]
        speed = [float(node.text) for node in element.iterfind(".//velocity/exact")]
        np.testing.assert_array_equal(track.x, x)
        np.testing.assert_array_equal(track.speed, speed)
    limits = {lane.speed_limit for lane in recording.lanes}
    assert limits <= {None, 11.176, 13.4112, 15.6464}


@pytest.mark.dataset
def test_recorded_cars_stay_on_the_lanes(data_dir):
    for recording in read(data_dir / "ngsim_us101_commonroad" / "xml")[:3]:
        centres = np.concatenate([lane.centre for lane in recording.lanes])
        x = np.concatenate([track.x for track in recording.tracks])
        y = np.concatenate([track.y for track in recording.tracks])
        apart = np.hypot(x[:, None] - centres[:, 0], y[:, None] - centres[:, 1])
        assert np.mean(apart.min(axis=1) < 6.0) > 0.95


@pytest.mark.dataset
def test_reference_file_of_2018b(data_dir):
    path = data_dir / "formats" / "commonroad_2018b"
    recording = only(path)
    assert [len(track.t) for track in recording.tracks] == [61, 61]
    assert len(recording.lanes) == 6
    assert sum(lane.left is not None for lane in recording.lanes) == 5
