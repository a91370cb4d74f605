"""ROS 2 bags: messages, lights, lanes, storages, and files that are refused."""

import functools
import math

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import Writer as PlainWriter

from rcirl_jax.types import Kind
from tests.data.formats.fixtures import has_note, osm
from tests.data.formats.fixtures import ros2 as fixture
from tests.data.formats.fixtures.drives import DURATION_S
from tests.data.formats.fixtures.ros2 import (
    OBJECTS,
    ODOMETRY,
    TRACKED,
    ego,
    seen,
    times,
    tracked_objects,
)
from tests.helpers import logs
from tests.helpers.logs import refused, tracks_of

read = functools.partial(logs.read, "ros2")
PERCEPTION = "autoware_perception_msgs"
ALONE = {"topics": {"ego": [ODOMETRY], "obstacles": []}}


def only(path, messages=None, **options):
    """The one recording of a bag, or of messages written into a folder."""
    if messages is not None:
        path = fixture.mcap(path / "a.mcap", messages)
    (recording,) = read(path, **options) if options else read(path)
    return recording


def line_of(path, messages=None, **options):
    return refused(only, path, messages, **options)


def label(name):
    return fixture.uuid(name).hex()


def obstacle(folder, name, change=lambda found, user: None, kind=TRACKED):
    """The track of an obstacle of a short drive, each of its messages changed."""
    messages = seen(tracked_objects(change, [name]), kind)
    return tracks_of(only(folder, [*ego(), *messages]))[label(name)]


def assert_as_driven(track, name):
    """The track is that of the fixture's road user, whatever messages said it."""
    user = fixture.road_users(track.t)[name]
    np.testing.assert_allclose(track.x, user.x, atol=5e-3)
    np.testing.assert_allclose(track.y, user.y, atol=5e-3)
    np.testing.assert_allclose(track.speed, user.speed, atol=0.1)
    turn = np.angle(np.exp(1j * (track.heading - user.heading)))
    np.testing.assert_allclose(turn, 0.0, atol=5e-3)
    assert track.length == pytest.approx(user.length)
    assert track.width == pytest.approx(user.width)
    assert track.kind == user.kind


def test_a_bag_of_two_files(tmp_path):
    made = only(fixture.write(tmp_path).input)
    assert (made.name, made.group) == ("drive", None)
    assert set(tracks_of(made)) == set(fixture.expected())
    assert tracks_of(made)["ego"].is_human(0.0, DURATION_S)
    assert has_note(made, "x = 81000 m, y = 50000 m")
    assert has_note(made, "no map given")


def test_headings_of_a_car_on_a_slope_by_quaternions_of_any_length(tmp_path):
    """Yaw, then pitch, then roll, by matrices: where the x axis points."""
    yaw, pitch, roll = 2.5, 0.3, -0.4

    def half(angle):
        return math.cos(0.5 * angle), math.sin(0.5 * angle)

    (cy, sy), (cp, sp), (cr, sr) = half(yaw), half(pitch), half(roll)
    q = {
        "w": 3.0 * (cr * cp * cy + sr * sp * sy),
        "x": 3.0 * (sr * cp * cy - cr * sp * sy),
        "y": 3.0 * (cr * sp * cy + sr * cp * sy),
        "z": 3.0 * (cr * cp * sy - sr * sp * cy),
    }

    def turn(message):
        message["pose"]["pose"]["orientation"] = q

    (track,) = only(tmp_path, ego(change=turn), **ALONE).tracks
    np.testing.assert_allclose(track.heading, yaw, atol=1e-9)


def test_the_ego_by_poses_and_speeds(tmp_path):
    """Poses without a speed: that of the topic of velocities, else of the places."""
    poses, speeds = [], []
    for t in times():
        place, _ = fixture.rear_axle(t)
        message = {"header": fixture.header(t), "pose": place}
        poses.append(("/pose", "geometry_msgs/PoseStamped", t, message))
        twist = {"header": fixture.header(t), "twist": fixture.velocity(3.0, 4.0)}
        speeds.append(("/twist", "geometry_msgs/TwistStamped", t, twist))
    topics = {"ego": "/pose", "velocity": "/twist", "obstacles": []}
    (track,) = only(tmp_path, poses, topics=topics).tracks
    assert_as_driven(track, "ego")
    both = sorted([*poses, *speeds], key=lambda item: item[2])
    (track,) = only(tmp_path, both, topics=topics).tracks
    np.testing.assert_allclose(track.speed, 5.0)


def test_the_ego_by_tf(tmp_path):
    """Other transforms are passed over; frames may begin with a slash."""
    messages = []
    for t in times():
        place, _ = fixture.rear_axle(t)
        way = {"translation": place["position"], "rotation": place["orientation"]}
        frames = (("/map", "base_link"), ("base_link", "camera"))
        transforms = [
            {"header": fixture.header(t, on), "child_frame_id": of, "transform": way}
            for on, of in frames
        ]
        messages.append(("/tf", "tf2_msgs/TFMessage", t, {"transforms": transforms}))
    topics = {"ego": [ODOMETRY, "/tf"], "obstacles": []}
    (track,) = only(tmp_path, messages, topics=topics).tracks
    assert_as_driven(track, "ego")
    frames = {"map": "map", "base": "rear_axle"}
    line = line_of(tmp_path / "a.mcap", topics=topics, frames=frames)
    assert "a.mcap: ego: no message says where rear_axle is in map: expected" in line


def test_who_drives(tmp_path):
    """Manual for a second, then not, then silent."""
    messages = [
        (fixture.MODE, fixture.CONTROL_MODE, t, fixture.control_mode(t, mode=mode))
        for t, mode in ((t, 4 if t < 1.0 else 1) for t in times(2.0))
    ]
    topics = {**ALONE["topics"], "driver": fixture.MODE}
    both = sorted([*ego(6.0), *messages], key=lambda item: item[2])
    made = only(tmp_path, both, topics=topics)
    (track,) = made.tracks
    assert track.automated == (pytest.approx((1.0, math.inf), abs=1e-6),)
    assert has_note(made, "51% of the time not driven by hand")
    (track,) = only(tmp_path, ego(), **ALONE, recording_car="automated").tracks
    assert track.automated == ((-math.inf, math.inf),)


def test_the_older_package_and_predicted_objects(tmp_path):
    auto = TRACKED.replace("autoware_p", "autoware_auto_p")
    assert_as_driven(obstacle(tmp_path, "12", kind=auto), "12")

    def predicted(found, user):
        how = found["kinematics"]
        found["kinematics"] = {
            "initial_pose_with_covariance": how["pose_with_covariance"],
            "initial_twist_with_covariance": how["twist_with_covariance"],
            "predicted_paths": [{"path": [fixture.pose(1.0, 2.0, 0.0)] * 3}],
        }

    kind = f"{PERCEPTION}/PredictedObjects"
    assert_as_driven(obstacle(tmp_path, "12", predicted, kind), "12")


def test_shapes(tmp_path):
    """A cylinder's diameter, a polygon's box about its own middle, none measured."""

    def shaped(name, **shape):
        return obstacle(tmp_path, name, lambda found, _: found.update(shape=shape))

    track = shaped("12", type=1, dimensions={"x": 0.7, "y": 0.0, "z": 1.0})
    assert (track.length, track.width) == pytest.approx((0.7, 0.7))
    corners = ((-1.0, -1.0), (5.0, -1.0), (5.0, 1.0), (2.0, 2.0), (-1.0, 1.0))
    outline = {"points": [fixture.point(*corner) for corner in corners]}
    # 15 turns left: its box is 2 m ahead and 0.5 m to the left of its place
    track = shaped("15", type=2, footprint=outline, dimensions={"z": 1.0})
    assert (track.length, track.width) == pytest.approx((6.0, 3.0))
    user = fixture.road_users(track.t)["15"]
    cos, sin = np.cos(user.heading), np.sin(user.heading)
    np.testing.assert_allclose(track.x, user.x + 2.0 * cos - 0.5 * sin, atol=5e-3)
    np.testing.assert_allclose(track.y, user.y + 2.0 * sin + 0.5 * cos, atol=5e-3)
    track = shaped("27", type=0)
    assert (track.length, track.width) == pytest.approx((1.8, 0.6))


@pytest.mark.parametrize("availability", [0, 1])
def test_headings_that_are_not_known(tmp_path, availability):
    """None: the direction of travel. No sign: the twist says which end is ahead."""

    def change(found, user):
        how = found["kinematics"]
        how["orientation_availability"] = availability
        heading = user.heading[0] + math.pi if availability else 1.0
        place = how["pose_with_covariance"]["pose"]
        place["orientation"] = fixture.turned(heading)
        how["twist_with_covariance"] = {"twist": fixture.velocity(-user.speed[0], 0.0)}

    assert_as_driven(obstacle(tmp_path, "23", change), "23")


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        *[(number, Kind.VEHICLE) for number in (2, 5, 0, 99)],
        *[(6, Kind.CYCLIST), (8, Kind.PEDESTRIAN), (9, Kind.STATIC), (10, None)],
    ],
)
def test_classes_of_autoware(tmp_path, number, kind):
    """Unknown ones move here; what may be driven over is no obstacle."""

    def change(found, user):
        found["classification"] = [{"label": number, "probability": 0.9}]

    made = only(tmp_path, [*ego(), *seen(tracked_objects(change))])
    found = tracks_of(made).get(label("12"))
    assert (found and found.kind) == kind
    note = "41 states of what is driven over or under left out"
    assert has_note(made, note) == (found is None)


def carla(t):
    """An ObjectArray as CARLA's bridge sends it: twists on the map, itself as well."""
    found = []
    for name, number in (("15", 6), ("23", 4), ("31", 11), ("ego", 6)):
        user = fixture.road_users(np.array([t]))[name]
        x, y, heading = fixture.at(user)
        speed = float(user.speed[0])
        shape = {"type": 1, "dimensions": [user.length, user.width, 1.5]}
        if name == "23":  # a cylinder: height, radius
            shape = {"type": 3, "dimensions": [1.8, 0.3]}
        twist = fixture.velocity(speed * math.cos(heading), speed * math.sin(heading))
        about = {"header": fixture.header(t), "pose": fixture.pose(x, y, heading)}
        about["id"] = 200 if name == "ego" else int(name)
        about |= {"twist": twist, "shape": shape, "classification": number}
        found.append(about)
    return {"header": fixture.header(t), "objects": found}


def test_derived_objects(tmp_path):
    messages = seen(carla, "derived_object_msgs/ObjectArray")
    made = only(tmp_path, [*ego(), *messages], ego_id="200")
    assert set(tracks_of(made)) == {"ego", "15", "23", "31"}
    for name in ("15", "23", "31"):
        assert_as_driven(tracks_of(made)[name], name)
    assert "200" in tracks_of(only(tmp_path / "a.mcap"))


def detections(t):
    """A car 30 m ahead of the ego, 5 m to its left; detections have no speed."""
    user = fixture.road_users(np.array([t]))["15"]
    sure = [{"class_id": "bicycle", "score": 0.1}, {"class_id": "car", "score": 0.8}]
    results = [{"hypothesis": one} for one in sure]
    box = {"center": fixture.pose(30.0, 5.0, 0.25), "size": fixture.size_of(user)}
    found = [{"results": results, "bbox": box, "id": "15"}]
    return {"header": fixture.header(t, "base_link"), "detections": found}


def test_detections_seen_by_an_ego_that_turned(tmp_path):
    """The ego at (10, 20) looks north: 30 m ahead, 5 m to the left is (5, 50)."""

    def stand(message):
        place = fixture.pose(*np.add(fixture.CENTRE, (10.0, 20.0)), 0.5 * math.pi)
        message["pose"]["pose"] = place
        message["twist"]["twist"] = fixture.velocity(0.0, 0.0)

    # the last second has no ego
    messages = seen(detections, "vision_msgs/Detection3DArray", 3.0)
    made = only(tmp_path, [*ego(change=stand), *messages])
    track = tracks_of(made)["15"]
    np.testing.assert_allclose(track.x, 5.0, atol=1e-6)
    np.testing.assert_allclose(track.y, 50.0, atol=1e-6)
    np.testing.assert_allclose(track.heading, 0.5 * math.pi + 0.25, atol=1e-6)
    assert has_note(made, "9 obstacle states left out, while the ego's place was")


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


def test_lanes_of_a_lanelet2_map(tmp_path):
    """In metres of the bag's frame, the eastbound lane below the ego."""
    shift = np.add(fixture.CENTRE, (0.0, -osm.EAST_Y))
    # in zone 54, from the corner of a square of 100 km
    utm = osm.in_degrees(54, (300_000.0, 3_900_000.0))
    first, again = (
        only(tmp_path, ego(), **ALONE, map=str(osm.lanelet_map(place, project, shift)))
        for place, project in (
            (tmp_path / "map.osm", osm.in_metres),
            (tmp_path / "utm.osm", utm),
        )
    )
    for one, same in zip(first.lanes, again.lanes, strict=True):
        np.testing.assert_allclose(one.centre, same.centre, atol=1e-3)
    lane = logs.lanes_of(first)["30001"]
    np.testing.assert_allclose(lane.centre[[0, -1]], [[0.0, 0.0], [80.0, 0.0]])
    assert lane.successors
    far = osm.lanelet_map(tmp_path / "far.osm", osm.in_metres, shift + 5000.0)
    line = line_of(tmp_path, ego(), **ALONE, map=str(far))
    assert "map: no lane within 200 m of the tracks around x = 81008 m" in line
    line = line_of(tmp_path, ego(), **ALONE, map="nowhere.osm")
    assert line == ("source TOML: map: nowhere.osm: missing: expected a Lanelet2 map")


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
