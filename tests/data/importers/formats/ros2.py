"""A drive as a ROS 2 bag of two MCAP files, with the definitions of its messages.

Fields are those of the packages' .msg files. Localization comes at 20 Hz, tracked
objects at about 10 Hz, irregular, stamped when they were measured and recorded later.
Written by the libraries' own writers.
"""

import math
import sqlite3

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer

from rcirl_jax.types import Kind
from tests.data.importers.formats import Fixture
from tests.data.importers.formats.drives import (
    GRID,
    is_seen,
    perception_times,
    seen_by_a_car,
    seen_on_clock,
)
from tests.data.importers.formats.ros2_definitions import definition

START_NS = 1_700_000_000_250_000_000  # ns, stamp of the first localization
CENTRE = np.array([81000.0, 50000.0])  # m on the map; the local origin
AHEAD = 1.345  # m, from the rear axle to the centre
EGO_SIZE = (4.89, 1.896)  # m
LATE_S = 0.12  # s, from the measurement of objects to their recording
LABELS = {Kind.VEHICLE: 1, Kind.CYCLIST: 6, Kind.PEDESTRIAN: 7, Kind.STATIC: 0}
LIGHT = (60.0, 0.0)  # m from CENTRE, where lane of the ego meets a light's stop line
RED_UNTIL_S = 4.0
ODOMETRY = "/localization/kinematic_state"
OBJECTS = "/perception/object_recognition/tracking/objects"
TRACKED = "autoware_perception_msgs/TrackedObjects"
LIGHTS = "/perception/traffic_light_recognition/traffic_signals"
MODE = "/vehicle/status/control_mode"


# ------------------------------------------------------------------- messages


def road_users(t):
    """Id -> motion in metres about CENTRE at times t [s]."""
    return seen_by_a_car(t, EGO_SIZE)


def stamp(t):
    ns = START_NS + round(t * 1e9)
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}


def header(t, frame="map"):
    return {"stamp": stamp(t), "frame_id": frame}


def point(x, y):
    return {"x": float(x), "y": float(y), "z": 0.0}


def turned(heading):
    half = 0.5 * heading
    return {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)}


def pose(x, y, heading):
    return {"position": point(x, y), "orientation": turned(heading)}


def velocity(x, y):
    return {"linear": point(x, y), "angular": point(0.0, 0.0)}


def at(user):
    """Place on the map and heading of a road user at its first sample."""
    heading = float(user.heading[0])
    return user.x[0] + CENTRE[0], user.y[0] + CENTRE[1], heading


def rear_axle(t):
    ego = road_users(np.array([t]))["ego"]
    x, y, heading = at(ego)
    x, y = x - AHEAD * math.cos(heading), y - AHEAD * math.sin(heading)
    return pose(x, y, heading), float(ego.speed[0])


def odometry(t):
    place, speed = rear_axle(t)
    return {
        "header": header(t),
        "child_frame_id": "base_link",
        "pose": {"pose": place},
        "twist": {"twist": velocity(speed, 0.0)},
    }


def uuid(name):
    """Bytes of an id; the importer's name is their hexadecimal form."""
    return int(name).to_bytes(16, "big")


def tracked(name, user, **kinematics):
    """A TrackedObject; its twist is in its own frame."""
    return {
        "object_id": {"uuid": uuid(name)},
        "existence_probability": 1.0,
        "classification": [
            {"label": 3, "probability": 0.2},
            {"label": LABELS[user.kind], "probability": 0.8},
        ],
        "kinematics": {
            "pose_with_covariance": {"pose": pose(*at(user))},
            "twist_with_covariance": {"twist": velocity(user.speed[0], 0.0)},
            "orientation_availability": 2,
            **kinematics,
        },
        "shape": {
            "type": 0,
            "dimensions": {"x": user.length, "y": user.width, "z": 1.5},
        },
    }


def others(t):
    """Id -> road user at a time, those seen."""
    users = road_users(np.array([t])).items()
    return {n: user for n, user in users if n != "ego" and is_seen(n, t)}


def objects(t):
    found = [tracked(name, user) for name, user in others(t).items()]
    return {"header": header(t), "objects": found}


def lights(t, *, group=1034):
    """A group with a round light, and an arrow that is surer of itself."""
    colour = 1 if t < RED_UNTIL_S else 3
    elements = [
        {"color": 3, "shape": 2, "status": 2, "confidence": 1.0},
        {"color": colour, "shape": 1, "status": 2, "confidence": 0.9},
    ]
    groups = [{"traffic_light_group_id": group, "elements": elements}]
    return {"stamp": stamp(t), "traffic_light_groups": groups}


def control_mode(t, *, mode=4):
    return {"stamp": stamp(t), "mode": mode}


def drive():
    """(topic, type, s of recording, message) of the whole drive, by time."""
    found = []
    for k in range(161):
        t = 0.05 * k
        found.append((ODOMETRY, "nav_msgs/Odometry", t, odometry(t)))
    for t in perception_times():
        found.append((OBJECTS, TRACKED, t + LATE_S, objects(t)))
        kind = "autoware_perception_msgs/TrafficLightGroupArray"
        found.append((LIGHTS, kind, t + LATE_S, lights(t)))
        kind = "autoware_vehicle_msgs/ControlModeReport"
        found.append((MODE, kind, t, control_mode(t)))
    image = {"header": header(1.0, "camera"), "data": bytes(5000)}
    found.append(("/camera/image", "sensor_msgs/Image", 1.0, image))
    return sorted(found, key=lambda item: item[2])


# ------------------------------------------------- messages of short drives


def times(seconds=2.0, step=0.05):
    return (step * np.arange(round(seconds / step) + 1)).tolist()


def ego(seconds=2.0, change=lambda message: None, step=0.05):
    """The ego's odometry, each message changed."""
    found = []
    for t in times(seconds, step):
        message = odometry(t)
        change(message)
        found.append((ODOMETRY, "nav_msgs/Odometry", t, message))
    return found


def seen(make, kind=TRACKED, seconds=2.0, step=0.05):
    """Messages of obstacles, each made for a time."""
    return [(OBJECTS, kind, t, make(t)) for t in times(seconds, step)]


def tracked_objects(change=lambda found, user: None, names=("12",)):
    """A message of tracked objects, each changed, as a function of time."""

    def make(t):
        found = []
        for name in names:
            user = road_users(np.array([t]))[name]
            found.append(tracked(name, user))
            change(found[-1], user)
        return {"header": header(t), "objects": found}

    return make


# ------------------------------------------------------------------------ bags


def mcap(path, messages, *, compression=CompressionType.ZSTD, crcs=True):
    """An MCAP file of (topic, type, s, message)."""
    with path.open("wb") as file:
        writer = Writer(file, 100_000, compression, enable_crcs=crcs)
        schemas = {}
        for topic, kind, t, message in messages:
            if kind not in schemas:
                name = kind.replace("/", "/msg/")
                schemas[kind] = writer.register_msgdef(name, definition(kind))
            ns = START_NS + round(t * 1e9)
            writer.write_message(topic, schemas[kind], message, ns)
        writer.finish()
    return path


def metadata(folder, names, storage="mcap", **other):
    """metadata.yaml of a bag, the lines that say which files it has."""
    lines = ["rosbag2_bagfile_information:", "  version: 8"]
    lines += [f"  storage_identifier: {storage}", "  relative_file_paths:"]
    lines += [f"    - {name}" for name in names]
    lines += ["  duration:", "    nanoseconds: 8000000000"]
    lines += [f"  {key}: {value}" for key, value in other.items()]
    (folder / "metadata.yaml").write_text("\n".join(lines) + "\n")


def sqlite(path, mcap_file, *, definitions=True):
    """The messages of an MCAP file in rosbag2's SQLite storage."""
    database = sqlite3.connect(path)
    database.executescript("""
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT,
 serialization_format TEXT, offered_qos_profiles TEXT, type_description_hash TEXT);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,
 data BLOB);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
""")
    if definitions:
        database.execute("""CREATE TABLE message_definitions(id INTEGER PRIMARY KEY,
 topic_type TEXT, encoding TEXT, encoded_message_definition TEXT, hash TEXT)""")
    # a topic without messages, as rosbag2 lists all that it was asked for
    silent = (7, ODOMETRY + "/silent", "nav_msgs/msg/Odometry", "cdr", "", "")
    database.execute("INSERT INTO topics VALUES (?,?,?,?,?,?)", silent)
    topics = {}
    with mcap_file.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.topic not in topics:
                topics[channel.topic] = len(topics) + 1
                row = (topics[channel.topic], channel.topic, schema.name, "cdr", "", "")
                database.execute("INSERT INTO topics VALUES (?,?,?,?,?,?)", row)
                if definitions:
                    row = (None, schema.name, "ros2msg", schema.data.decode(), "")
                    database.execute(
                        "INSERT INTO message_definitions VALUES (?,?,?,?,?)", row
                    )
            row = (None, topics[channel.topic], message.log_time, message.data)
            database.execute("INSERT INTO messages VALUES (?,?,?,?)", row)
    database.commit()
    database.close()
    return path


def expected():
    """Tracks on the clock of 10 Hz."""
    return seen_on_clock(road_users(GRID), lambda name: uuid(name).hex())


def write(folder):
    messages = drive()
    half = len(messages) // 2
    names = ("drive_0.mcap", "drive_1.mcap")
    bag = folder / "drive"
    bag.mkdir()
    first = mcap(bag / names[0], messages[:half])
    second = mcap(bag / names[1], messages[half:])
    metadata(bag, names)
    return Fixture(
        input=folder,
        assumed=(4, 4, 1),  # fitted lanes; the ego
        rate_hz=10.0,
        tracks=expected(),
        num_lanes=1,
        files=(first, second),
    )
