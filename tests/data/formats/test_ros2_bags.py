"""ROS 2 bags: lights, lanes, storages, windows, and files that are refused."""

import contextlib
import math
import sqlite3
import sys

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as PlainWriter

from tests.data.formats.fixtures import osm
from tests.data.formats.fixtures import ros2 as fixture
from tests.data.formats.fixtures.ros2 import (
    OBJECTS,
    ODOMETRY,
    ego,
)
from tests.data.formats.test_ros2 import (
    ALONE,
    PERCEPTION,
    has_note,
    line_of,
    only,
)
from tests.helpers import logs

# -------------------------------------------------------------- lights and lanes


def of_light(tmp_path, make, kind=fixture.LIGHT_GROUPS):
    """The only signal of the ego's drive with a light, and the recording."""
    place = fixture.CENTRE + fixture.LIGHT
    messages = [(fixture.LIGHTS, kind, t, make(t)) for t in fixture.times(7.9, 0.1)]
    both = sorted([*ego(8.0), *messages], key=lambda item: item[2])
    made = only(
        tmp_path,
        both,
        topics={**ALONE["topics"], "lights": fixture.LIGHTS},
        lights={"1034": [place.tolist()], "7": [[0.0, 0.0]]},
    )
    (signal,) = made.signals
    return signal, made


def test_lights_govern_the_lane_at_their_place(tmp_path):
    """The round light counts, not the surer arrow."""
    signal, made = of_light(tmp_path, fixture.lights)
    assert (signal.id, signal.state) == ("1034", ("red", "green"))
    np.testing.assert_allclose(signal.start, [0.0, fixture.RED_UNTIL_S], atol=1e-6)
    (lane,) = [lane for lane in made.lanes if lane.signal_ids]
    assert lane.signal_ids == ("1034",)
    np.testing.assert_allclose(lane.stop_line, [[60.0, 1.75], [60.0, -1.75]], atol=0.01)
    assert has_note(made, "light 7: no lane within 3 m")


@pytest.mark.parametrize("given", ["north", [[1.0]], [[1.0, float("nan")]], [], {}])
def test_places_of_lights_that_are_none(tmp_path, given):
    for lights in ({"1034": given}, {"north": [[1.0, 2.0]]}):
        line = line_of(tmp_path, ego(), **ALONE, lights=lights)
        assert line.startswith(f"source TOML: lights.{next(iter(lights))}: ")


def test_lanes_of_a_lanelet2_map(tmp_path):
    """In metres of the bag's frame."""
    # the eastbound lane below the ego
    shift = np.add(fixture.CENTRE, (0.0, -osm.EAST_Y))
    place = osm.lanelet_map(tmp_path / "map.osm", osm.in_metres, shift)
    made = only(tmp_path, ego(), **ALONE, map=str(place))
    # in zone 54, from the corner of a square of 100 km
    utm = osm.in_degrees(54, (300_000.0, 3_900_000.0))
    other = osm.lanelet_map(tmp_path / "utm.osm", utm, shift)
    again = only(tmp_path / "a.mcap", **ALONE, map=str(other))
    for one, same in zip(made.lanes, again.lanes, strict=True):
        np.testing.assert_allclose(one.centre, same.centre, atol=1e-3)
    lane = logs.lanes_of(made)["30001"]
    np.testing.assert_allclose(lane.centre[[0, -1]], [[0.0, 0.0], [80.0, 0.0]])
    assert lane.successors
    far = osm.lanelet_map(tmp_path / "far.osm", osm.in_metres, shift + 5000.0)
    line = line_of(tmp_path, ego(), **ALONE, map=str(far))
    assert "map: no lane within 200 m of the tracks around x = 81008 m" in line
    line = line_of(tmp_path, ego(), **ALONE, map="nowhere.osm")
    assert line == ("source TOML: map: nowhere.osm: missing: expected a Lanelet2 map")


# -------------------------------------------------------------- bags and windows


def test_sqlite_storage_is_the_same(tmp_path):
    bag = fixture.write(tmp_path).input / "drive"
    whole = only(bag / "drive_0.mcap")
    other = tmp_path / "other"
    other.mkdir()
    fixture.sqlite(other / "drive_0.db3", bag / "drive_0.mcap")
    fixture.metadata(other, ["drive_0.db3"])
    ego_topics = {"ego": [f"{ODOMETRY}/silent", ODOMETRY], "obstacles": OBJECTS}
    made = only(other, topics=ego_topics)
    assert made.name == "other"
    for one, same in zip(whole.tracks, made.tracks, strict=True):
        np.testing.assert_array_equal(one.x, same.x)
    old = fixture.sqlite(tmp_path / "old.db3", bag / "drive_0.mcap", definitions=False)
    line = line_of(old)
    assert f"{old}: {ODOMETRY} (nav_msgs/msg/Odometry): schema encoding: ''" in line


@pytest.mark.parametrize("pack", [bytes, zstandard.compress])
def test_a_file_without_chunks_and_messages_packed_one_by_one(tmp_path, pack):
    """As rosbag2 writes them: no index, one message a record."""
    sound, path = fixture.mcap(tmp_path / "a.mcap", ego()), tmp_path / "b.mcap"
    with sound.open("rb") as source:
        messages = [*make_reader(source).iter_messages()]
    schema = messages[0][0]
    sent = [(message.log_time, pack(message.data)) for *_, message in messages]
    plain(path, "cdr", schema.encoding, schema.data, sent, use_chunking=False)
    np.testing.assert_array_equal(
        only(path, **ALONE).tracks[0].x, only(sound, **ALONE).tracks[0].x
    )
    content = zstandard.compress(bytes(2**24 + 1))
    plain(path, "cdr", schema.encoding, schema.data, [(0, content)])
    line = line_of(path, **ALONE)
    assert "message 0: ValueError: 16777217 bytes of at most 16777216" in line


# -------------------------------------------------------------------- refusals


def test_topics_that_are_missing_or_of_no_known_type(tmp_path):
    renamed = [("/odom", *rest) for _, *rest in ego()]
    line = line_of(tmp_path, renamed)
    assert line.startswith(
        f"{tmp_path / 'a.mcap'}: ego: no messages on {ODOMETRY}, /tf"
    )
    assert "(in this bag: /odom), or [] for none" in line
    line = line_of(tmp_path, ego())
    assert f"obstacles: no messages on {OBJECTS}, " in line
    assert "none of a type that is read" in line
    image = {"header": fixture.header(0.0), "data": b"0"}
    messages = [*ego(), ("/camera", "sensor_msgs/Image", 0.0, image)]
    topics = {"ego": ODOMETRY, "obstacles": "/camera"}
    line = line_of(tmp_path, messages, topics=topics)
    assert "a.mcap: /camera: type 'sensor_msgs/msg/Image': expected for " in line
    assert f"topics.obstacles one of {PERCEPTION}/msg/TrackedObjects, " in line
    line = line_of(tmp_path, ego(), topics={"egos": ODOMETRY})
    assert line == (
        "source TOML: topics.egos: unknown: expected ego, velocity, obstacles, "
        "lights, driver"
    )
    line = line_of(tmp_path, ego(), topics={"ego": 7})
    assert line == "source TOML: topics.ego: 7: expected a topic or a list"


def plain(path, encoding, schema_encoding, text, sent=((0, b"{}"),), **options):
    """An MCAP file of messages on the ego's topic, whatever they say."""
    with path.open("wb") as file:
        writer = PlainWriter(file, **options)
        writer.start()
        name = "nav_msgs/msg/Odometry"
        schema = writer.register_schema(name, schema_encoding, text)
        channel = writer.register_channel(ODOMETRY, encoding, schema)
        for logged, data in sent:
            writer.add_message(channel, logged, data, 0)
        writer.finish()
    return path


def test_other_encodings_and_definitions(tmp_path, capsys):
    file, sound = tmp_path / "a.mcap", fixture.definition("nav_msgs/Odometry").encode()
    where, typed = f"{ODOMETRY}: message 0", f"{ODOMETRY} (nav_msgs/msg/Odometry): "
    cut = ((0, b"\0\1\0\0\1\2"),)
    for words, *content in (
        (f"{typed}message_encoding: 'json': expected cdr", "json", "jsonschema", b"{}"),
        (f"{typed}schema encoding: 'ros2idl': expected ros2msg", "cdr", "ros2idl", b""),
        # the library prints such a line
        ("expected a message definition of ROS 2", "cdr", "ros2msg", b"float64"),
        (f"{where}: ", "cdr", "ros2msg", sound, cut),
        (f"{where}: header: missing in the", "cdr", "ros2msg", b"uint8 level", cut),
    ):
        line = line_of(plain(file, *content), **ALONE)
        assert line.startswith(f"{file}: {ODOMETRY}")
        assert words in line
    assert line.endswith("expected a nav_msgs/msg/Odometry with it")
    assert capsys.readouterr() == ("", "")


def test_files_that_were_never_closed(tmp_path):
    file = fixture.mcap(tmp_path / "a.mcap", ego())
    content = file.read_bytes()
    for size in (len(content) - 1, len(content) // 2, 12, 8):
        file.write_bytes(content[:size])
        line = line_of(file, **ALONE)
        assert line.startswith(f"{file}: no end after {size} bytes: expected a whole")
        assert "`mcap recover FILE -o NEW`" in line
    file.write_bytes(b"MCAP")
    assert line_of(file, **ALONE).startswith(f"{file}: begins with b'MCAP': expected")


def test_a_chunk_with_a_wrong_byte(tmp_path):
    file = fixture.mcap(tmp_path / "a.mcap", ego(), compression=CompressionType.NONE)
    content = bytearray(file.read_bytes())
    content[content.index(b"base_link", 2000)] ^= 1
    file.write_bytes(content)
    line = line_of(file, **ALONE)
    assert line.startswith(f"{file}: CRCValidationError: ")
    assert "`mcap doctor FILE` says what is wrong" in line


def test_without_the_extra(tmp_path, monkeypatch):
    file = fixture.mcap(tmp_path / "a.mcap", ego())
    monkeypatch.setitem(sys.modules, "mcap.reader", None)
    line = line_of(file, **ALONE)
    assert line.startswith("mcap.reader: not installed ")
    assert line.endswith("expected pip install 'rcirl-jax[ros2]'")


def test_values_of_messages(tmp_path):
    """The line names file, topic, message and field."""
    where = f"{tmp_path / 'a.mcap'}: {ODOMETRY}: message 0: "

    def line(**fields):
        def change(message):
            message["pose"]["pose"] |= fields

        return line_of(tmp_path, ego(change=change), **ALONE)

    assert line(position=fixture.point(math.nan, 0.0)) == (
        f"{where}position.x: nan: expected a finite number"
    )
    zero = dict.fromkeys("xyzw", 0.0)
    assert line(orientation=zero) == (
        f"{where}orientation: all zero: expected the ego's quaternion"
    )

    def elsewhere(message):
        message["header"]["frame_id"] = "odom"

    found = line_of(tmp_path, ego(change=elsewhere), **ALONE)
    assert found == (
        f"{where}header.frame_id: 'odom': expected map or base_link ([frames] of the "
        "source TOML)"
    )
    frames = {"map": "odom", "base": "base_link"}
    assert only(tmp_path / "a.mcap", **ALONE, frames=frames).tracks


def test_lights_of_the_older_package(tmp_path):
    """SOLID_OFF is 13 there, amber 2."""

    def make(t):
        status = 13 if t > 3.95 else 14
        light = {"color": 2, "shape": 5, "status": status, "confidence": 1.0}
        signals = [{"map_primitive_id": 1034, "lights": [light]}]
        return {"header": fixture.header(t), "signals": signals}

    kind = "autoware_auto_perception_msgs/TrafficSignalArray"
    signal, _ = of_light(tmp_path, make, kind)
    assert signal.state == ("yellow", "off")
    np.testing.assert_allclose(signal.start, [0.0, 4.0], atol=1e-6)


def test_lanes_of_a_table_beside_the_bag(tmp_path):
    x, y = fixture.CENTRE
    rows = [f"a,{x + k},{y},4.0" for k in (-10.0, 100.0)]
    (tmp_path / "lanes.csv").write_text("\n".join(["id,x,y,width", *rows]) + "\n")
    made = only(tmp_path, ego(), **ALONE, lanes={"file": "lanes.csv"})
    (lane,) = made.lanes
    np.testing.assert_allclose(lane.centre, [[-10.0, 0.0], [100.0, 0.0]])
    np.testing.assert_allclose(lane.left_width, 2.0)
    line = line_of(tmp_path, ego(), **ALONE, lanes={"file": "other.csv"})
    assert "lanes.file: other.csv: expected this CSV beside the log" in line


def test_a_topic_without_a_definition_is_noted(tmp_path):
    """Where it need not be there; what says who drove is missed in words."""
    bag = fixture.write(tmp_path).input / "drive" / "drive_0.mcap"
    file = fixture.sqlite(tmp_path / "other.db3", bag)
    with contextlib.closing(sqlite3.connect(file)) as database, database:
        database.execute(
            "DELETE FROM message_definitions WHERE topic_type LIKE '%ControlMode%'"
        )
    made = only(file)
    assert {track.id for track in made.tracks} >= {"ego"}
    (note,) = [note for note in made.notes if "not read" in note]
    assert note.startswith("/vehicle/status/control_mode (autoware_vehicle_msgs/msg/")
    assert note.endswith("who drove is not known")


def test_metadata(tmp_path):
    bag = fixture.write(tmp_path).input / "drive"
    (bag / "drive_1.mcap").unlink()
    (bag / "drive_0.mcap.zstd").write_bytes(b"packed")
    for names, words in (
        (
            ["drive_0.mcap", "drive_1.mcap"],
            "relative_file_paths: drive_1.mcap: missing",
        ),
        ([], "relative_file_paths: none: expected"),
        (["drive_0.mcap.zstd"], "drive_0.mcap.zstd: compressed as a whole: expected"),
    ):
        fixture.metadata(bag, names)
        assert words in line_of(tmp_path)
