"""A drive as two Apollo cyber records, with the descriptors of its messages.

Message and field numbers are those of Apollo's common_msgs. Localization comes at
100 Hz, perception at about 10 Hz and 80 ms late, both irregular; the second part
of the drive is in a file of its own.
"""

import struct

import numpy as np

from rcirl_jax.types import Kind
from tests.data.importers.formats import Fixture
from tests.data.importers.formats.drives import (
    GRID,
    is_seen,
    perception_times,
    seen_by_a_car,
    seen_on_clock,
)
from tests.data.importers.formats.proto import classes, file_of, written

START_S = 1627031535.25  # s, of the first localization
CENTRE = np.array([587000.0, 4141000.0])  # m, UTM zone 10; the local origin
AHEAD = 1.4235  # m, from the rear axle to the centre of an MKZ
LATE_S = 0.08  # s, from the measurement of perception to its message
TYPE = {Kind.VEHICLE: 5, Kind.CYCLIST: 4, Kind.PEDESTRIAN: 3, Kind.STATIC: 2}


def road_users(t):
    """Id -> motion in metres about CENTRE at times t [s]."""
    return seen_by_a_car(t, (4.933, 2.11))


# ---------------------------------------------------------------- descriptors

PACKAGES = {
    "apollo.common": """
Header: timestamp_sec 1 double, module_name 2 string, sequence_num 3 uint32
PointENU: x 1 double, y 2 double, z 3 double
Point3D: x 1 double, y 2 double, z 3 double
Quaternion: qx 1 double, qy 2 double, qz 3 double, qw 4 double
""",
    "apollo.localization": """
Pose: position 1 .apollo.common.PointENU, orientation 2 .apollo.common.Quaternion,\
 linear_velocity 3 .apollo.common.Point3D, heading 6 double
LocalizationEstimate: header 1 .apollo.common.Header,\
 pose 2 .apollo.localization.Pose, measurement_time 4 double
""",
    "apollo.canbus": """
Chassis: engine_started 3 bool, speed_mps 5 float,\
 driving_mode 21 /apollo.canbus.Chassis.DrivingMode, header 25 .apollo.common.Header
Chassis/DrivingMode: COMPLETE_MANUAL 0, COMPLETE_AUTO_DRIVE 1
""",
    "apollo.perception": """
PerceptionObstacle: id 1 int32, position 2 .apollo.common.Point3D, theta 3 double,\
 velocity 4 .apollo.common.Point3D, length 5 double, width 6 double, height 7 double,\
 type 10 /apollo.perception.PerceptionObstacle.Type, timestamp 11 double
PerceptionObstacle/Type: UNKNOWN 0, UNKNOWN_MOVABLE 1, UNKNOWN_UNMOVABLE 2,\
 PEDESTRIAN 3, BICYCLE 4, VEHICLE 5
PerceptionObstacles: perception_obstacle 1 .apollo.perception.PerceptionObstacle*,\
 header 2 .apollo.common.Header
""",
    "apollo.prediction": """
PredictionObstacle: perception_obstacle 1 .apollo.perception.PerceptionObstacle,\
 timestamp 2 double
PredictionObstacles: header 1 .apollo.common.Header,\
 prediction_obstacle 2 .apollo.prediction.PredictionObstacle*
""",
    "apollo.routing": """
LaneWaypoint: pose 3 .apollo.common.PointENU
RoutingRequest: waypoint 2 .apollo.routing.LaneWaypoint*
RoutingResponse: header 1 .apollo.common.Header,\
 routing_request 4 .apollo.routing.RoutingRequest
""",
    "apollo.planning": """
ParkingCommand: parking_spot_id 2 string
PlanningCommand: header 1 .apollo.common.Header, command_id 2 int64,\
 lane_follow_command 3 .apollo.routing.RoutingResponse,\
 parking_command 6 .apollo.planning.ParkingCommand,\
 custom_command 7 .apollo.planning.ParkingCommand
""",
}


# of Cyber RT itself
CYBER = """
ProtoDesc: desc 1 bytes, dependencies 2 .ProtoDesc*
Header: major_version 1 uint32, minor_version 2 uint32, compress 3 int32,\
 is_complete 13 bool
Channel: name 1 string, message_type 2 string, proto_desc 3 bytes
ChunkHeader: begin_time 1 uint64, message_number 3 uint64
SingleMessage: channel_name 1 string, time 2 uint64, content 3 bytes
ChunkBody: messages 1 .SingleMessage*
SingleIndex: type 1 int32, position 2 uint64
Index: indexes 1 .SingleIndex*
"""
MESSAGES = classes({**PACKAGES, "cyber": CYBER})


def _described(package, *needs, text=None):
    """ProtoDesc: a file and those it imports, each once per importer."""
    content = file_of(package, text or PACKAGES[package]).SerializeToString()
    needs = needs if package == "apollo.common" else (*needs, "apollo.common")
    return MESSAGES.ProtoDesc(desc=content, dependencies=map(_described, needs))


def described(package, *needs, text=None):
    """Bytes of the ProtoDesc of a package, of those it imports, and the common one."""
    return _described(package, *needs, text=text).SerializeToString()


COMMANDS = ("apollo.planning.PlanningCommand",)
COMMANDS += (described("apollo.planning", "apollo.routing"),)
OBSTACLES = "/apollo/perception/obstacles"
CHANNELS = {
    "/apollo/localization/pose": (
        "apollo.localization.LocalizationEstimate",
        described("apollo.localization"),
    ),
    "/apollo/canbus/chassis": ("apollo.canbus.Chassis", described("apollo.canbus")),
    OBSTACLES: (
        "apollo.perception.PerceptionObstacles",
        described("apollo.perception"),
    ),
    "/apollo/prediction": (
        "apollo.prediction.PredictionObstacles",
        described("apollo.prediction", "apollo.perception"),
    ),
    "/apollo/routing_response": (
        "apollo.routing.RoutingResponse",
        described("apollo.routing"),
    ),
    "/apollo/sensor/camera/front_6mm/image": ("apollo.drivers.Image", b""),
}


# ------------------------------------------------------------------- messages


def stamped(t):
    return {"timestamp_sec": START_S + t, "module_name": "test"}


def point(x, y):
    return {"x": x, "y": y, "z": 0.0}


def localization(t, *, later=0.0, heading=True, velocity=True, **changes):
    """The rear axle's pose; the quaternion turns (right, forward, up)."""
    ego = road_users(np.array([t]))["ego"]
    yaw = float(ego.heading[0])
    x = ego.x[0] - AHEAD * np.cos(yaw) + CENTRE[0]
    y = ego.y[0] - AHEAD * np.sin(yaw) + CENTRE[1]
    half = 0.5 * (yaw - 0.5 * np.pi)
    turned = {"qx": 0.0, "qy": 0.0, "qz": np.sin(half), "qw": np.cos(half)}
    pose = {"position": point(x, y), "orientation": turned}
    if velocity:
        pose["linear_velocity"] = point(8.0 * np.cos(yaw), 8.0 * np.sin(yaw))
    if heading:
        pose["heading"] = yaw
    fields = {
        "header": stamped(t + 0.004 + later),
        "pose": pose,
        "measurement_time": START_S + t + later,
    }
    return written(MESSAGES.LocalizationEstimate, **{**fields, **changes})


def chassis(t, *, manual=True, speed=8.0):
    fields = {"speed_mps": speed, "driving_mode": 0 if manual else 1}
    return written(MESSAGES.Chassis, **fields, header=stamped(t))


def obstacle(name, user, t):
    heading, speed = float(user.heading[0]), float(user.speed[0])
    return {
        "id": int(name),
        "position": point(user.x[0] + CENTRE[0], user.y[0] + CENTRE[1]),
        "theta": heading,
        "velocity": point(speed * np.cos(heading), speed * np.sin(heading)),
        **{"length": user.length, "width": user.width, "height": 1.5},
        **{"type": TYPE[user.kind], "timestamp": START_S + t},
    }


def seen_at(t):
    users = road_users(np.array([t]))
    return [
        obstacle(name, user, t)
        for name, user in users.items()
        if name != "ego" and is_seen(name, t)
    ]


def perceived(t, obstacles, late=LATE_S):
    """A message of perception, published late."""
    stamp = stamped(t + late)
    kind = MESSAGES.PerceptionObstacles
    return written(kind, perception_obstacle=obstacles, header=stamp)


def perception(t):
    return perceived(t, seen_at(t))


def prediction(t):
    seen = [
        {"perception_obstacle": item, "timestamp": START_S + t} for item in seen_at(t)
    ]
    kind = MESSAGES.PredictionObstacles
    return written(kind, header=stamped(t + LATE_S), prediction_obstacle=seen)


def _route(x, y):
    points = [{"pose": point(*CENTRE)}, {"pose": point(x, y)}]
    return {"header": stamped(0.0), "routing_request": {"waypoint": points}}


def routing(x, y):
    return written(MESSAGES.RoutingResponse, **_route(x, y))


def command(x, y):
    """Since Apollo 9: the routing inside what planning is told to do."""
    follow = {"command_id": 7, "lane_follow_command": _route(x, y)}
    return written(MESSAGES.PlanningCommand, header=stamped(0.0), **follow)


def parking():
    spot = {"command_id": 8, "parking_command": {"parking_spot_id": "451089045"}}
    return written(MESSAGES.PlanningCommand, header=stamped(0.0), **spot)


def drive(*, obstacles=OBSTACLES):
    """(channel, s since START_S, content) of the whole drive, by time."""
    found = [
        ("/apollo/routing_response", 0.0, routing(CENTRE[0] + 300.0, CENTRE[1] + 1.0))
    ]
    for k in range(801):
        t = 0.01 * k + (0.002 * np.sin(k) if 0 < k < 800 else 0.0)
        found.append(("/apollo/localization/pose", t, localization(t)))
        found.append(("/apollo/canbus/chassis", t, chassis(t)))
    for t in perception_times():
        made = {OBSTACLES: perception, "/apollo/prediction": prediction}
        found.append((obstacles, t + LATE_S, made[obstacles](t)))
    found.append(("/apollo/sensor/camera/front_6mm/image", 1.0, bytes(5000)))
    return sorted(found, key=lambda item: item[1])


# --------------------------------------------------------------------- record


def section(kind, content):
    return struct.pack("<i4xq", kind, len(content)) + content


def header(*, compress=0, complete=True):
    version = {"major_version": 1, "minor_version": 0}
    made = {**version, "compress": compress, "is_complete": complete}
    content = written(MESSAGES.Header, **made)
    return section(0, content) + bytes(2048 - len(content))


def _channel(name, kind, desc):
    about = {"name": name, "message_type": kind, "proto_desc": desc}
    return section(4, written(MESSAGES.Channel, **about))


INDEX = section(3, written(MESSAGES.Index, indexes=[{"type": 4, "position": 2064}]))


def record(messages, *, channels=None, chunk=200, **options):
    """A record file: header, channels, chunks of messages, index."""
    channels = CHANNELS if channels is None else channels
    parts = [header(**options)]
    parts += [_channel(name, *found) for name, found in channels.items()]
    for start in range(0, len(messages), chunk):
        singles = [
            {
                "channel_name": name,
                "time": round((START_S + t) * 1e9),
                "content": content,
            }
            for name, t, content in messages[start : start + chunk]
        ]
        head = {"begin_time": 1, "message_number": len(singles)}
        parts.append(section(1, written(MESSAGES.ChunkHeader, **head)))
        parts.append(section(2, written(MESSAGES.ChunkBody, messages=singles)))
    return b"".join([*parts, INDEX])


def expected():
    """Tracks on the clock of 10 Hz."""
    return seen_on_clock(road_users(GRID))


def write(folder):
    messages = drive()
    half = len(messages) // 2
    first = folder / "20210723091215.record.00000"
    second = folder / "20210723091215.record.00001"
    first.write_bytes(record(messages[:half]))
    second.write_bytes(record(messages[half:]))
    return Fixture(
        input=folder,
        assumed=(4, 4, 1),  # fitted lanes; the ego
        rate_hz=10.0,
        tracks=expected(),
        num_lanes=1,
        files=(first, second),
    )


# ---------------------------------------------------------------------- harms


def rewritten(made=None, *, name="/apollo/localization/pose", content=None):
    """What puts other messages of a channel, or bytes, in the place of a drive."""

    def harm(fixture):
        messages = [
            (channel, t, made(t) if made and channel == name else message)
            for channel, t, message in drive()[:200]
        ]
        whole = record(messages) if content is None else content
        fixture.files[0].write_bytes(whole)
        fixture.files[1].unlink()

    return harm


def posed(**pose):
    pose = {"position": point(*CENTRE), "heading": 0.0, **pose}
    return rewritten(lambda t: localization(t, pose=pose))


def seen(**changes):
    def made(t):
        first, *others = seen_at(t)
        return perceived(t, [{**first, **changes}, *others])

    return rewritten(made, name=OBSTACLES)


NAN = float("nan")
# what is done to the files, and what the line says
HARMS = {
    "pose: x: nan": posed(position=point(NAN, 0.0)),
    "s from first to last": rewritten(
        lambda t: localization(t, later=1e9 * (0.5 < t < 0.515))
    ),
    "expected an Apollo message": rewritten(lambda t: b"\xff\xff"),
    "x: 1e+300": seen(position=point(1e300, 0.0)),
    "length: -2 m: expected 0 to": seen(length=-2.0),
    "no messages, nor obstacles": rewritten(content=record([])),
    "compress: 2: expected 0, none": rewritten(content=header(compress=2)),
    "expected a whole record; truncated?": rewritten(
        content=header() + struct.pack("<i4xq", 2, 2**62)
    ),
    "varint: no end": rewritten(content=header() + section(2, b"\xff" * 11)),
    "Error parsing": rewritten(content=header() + section(4, b"\x0a\x05")),
}
# options of values that are none
OPTIONS = [
    *[{"rate_hz": rate} for rate in (0, 1e9)],
    *[{"window_s": window} for window in (0, 1e-320, 0.99)],
    *[{"topics": bad} for bad in (3, {"pose": "/x"}, {"routing": [3]})],
    *[{"ego": 1}, {"unknown": "x"}],
]
