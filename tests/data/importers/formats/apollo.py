"""A drive as two Apollo cyber records, with the descriptors of its messages.

Message and field numbers are those of Apollo's common_msgs. Localization comes at
100 Hz, perception at about 10 Hz and 80 ms late, both irregular; the second part
of the drive is in a file of its own.
"""

import struct

import numpy as np
from google.protobuf import descriptor_pb2

from rcirl_jax.types import Kind
from tests.data.importers.formats import Fixture
from tests.data.importers.formats.drives import samples, seen_by_a_car
from tests.data.importers.formats.waymo import Single, message

START_S = 1627031535.25  # s, of the first localization
CENTRE = np.array([587000.0, 4141000.0])  # m, UTM zone 10; the local origin
AHEAD = 1.4235  # m, from the rear axle to the centre of an MKZ
DURATION_S = 8.0
GRID = 0.1 * np.arange(81)
LATE_S = 0.08  # s, from the measurement of perception to its message
GAP = (3.0, 5.0)  # s, in which obstacle 19 is hidden
SEEN = {"17": (2.0, 6.5)}  # s, others: the whole drive
TYPE = {Kind.VEHICLE: 5, Kind.CYCLIST: 4, Kind.PEDESTRIAN: 3, Kind.STATIC: 2}


def road_users(t):
    """Id -> motion in metres about CENTRE at times t [s]."""
    return seen_by_a_car(t, (4.933, 2.11))


# ---------------------------------------------------------------- descriptors

# package -> its messages, a field as "name number type", a type of messages with a
# dot before it, a list with a star behind it; enums of a message are "Message/Enum"
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
 custom_command 7 .google.protobuf.Any
""",
}


def file_of(package, text):
    """FileDescriptorProto of messages as in PACKAGES."""
    file = descriptor_pb2.FileDescriptorProto(name=f"{package}.proto", package=package)
    messages = {}
    for line in text.strip().splitlines():
        name, _, entries = line.partition(":")
        name, _, enum = name.partition("/")
        entries = [entry.split() for entry in entries.split(",") if entry.strip()]
        if enum:
            values = messages[name].enum_type.add(name=enum).value
            for label, number in entries:
                values.add(name=label, number=int(number))
        else:
            messages[name] = file.message_type.add(name=name)
            for entry in entries:
                _add_field(messages[name].field.add(), *entry)
    return file.SerializeToString()


def _add_field(field, name, number, kind):
    field.name, field.number = name, int(number)
    is_list, kind = kind.endswith("*"), kind.rstrip("*")
    field.label = field.LABEL_REPEATED if is_list else field.LABEL_OPTIONAL
    named = {".": field.TYPE_MESSAGE, "/": field.TYPE_ENUM}
    if kind[0] in named:
        field.type, field.type_name = named[kind[0]], f".{kind[1:]}"
    else:
        field.type = field.Type.Value(f"TYPE_{kind.upper()}")


def proto_desc(main, *needs):
    """ProtoDesc: a file and those it imports, each once per importer."""
    return message([(1, main), *[(2, other) for other in needs]])


_COMMON = proto_desc(file_of("apollo.common", PACKAGES["apollo.common"]))


def described(package, *needs, text=None):
    """ProtoDesc of a package, of those that it imports, and of the common one."""
    text = PACKAGES[package] if text is None else text
    return proto_desc(file_of(package, text), *map(described, needs), _COMMON)


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
    return [(1, float(START_S + t)), (2, "test")]


def point(x, y):
    return [(1, float(x)), (2, float(y)), (3, 0.0)]


def localization(t, *, heading=True, velocity=True):
    """The rear axle's pose; the quaternion turns (right, forward, up)."""
    ego = road_users(np.array([t]))["ego"]
    yaw = float(ego.heading[0])
    x = ego.x[0] - AHEAD * np.cos(yaw) + CENTRE[0]
    y = ego.y[0] - AHEAD * np.sin(yaw) + CENTRE[1]
    half = 0.5 * (yaw - 0.5 * np.pi)
    turned = [(1, 0.0), (2, 0.0), (3, float(np.sin(half))), (4, float(np.cos(half)))]
    pose = [(1, point(x, y)), (2, turned)]
    pose += [(3, point(8.0 * np.cos(yaw), 8.0 * np.sin(yaw)))] if velocity else []
    pose += [(6, yaw)] if heading else []
    return message([(1, stamped(t + 0.004)), (2, pose), (4, float(START_S + t))])


def chassis(t, *, manual=True):
    return message([(5, Single(8.0)), (21, 0 if manual else 1), (25, stamped(t))])


def obstacle(name, user, t):
    heading, speed = float(user.heading[0]), float(user.speed[0])
    velocity = point(speed * np.cos(heading), speed * np.sin(heading))
    return [
        (1, int(name)),
        (2, point(user.x[0] + CENTRE[0], user.y[0] + CENTRE[1])),
        (3, heading),
        (4, velocity),
        (5, float(user.length)),
        (6, float(user.width)),
        (7, 1.5),
        (10, TYPE[user.kind]),
        (11, float(START_S + t)),
    ]


def is_seen(name, t):
    first, last = SEEN.get(name, (0.0, DURATION_S))
    return first <= t <= last and not (name == "19" and GAP[0] < t < GAP[1])


def seen_at(t):
    users = road_users(np.array([t]))
    return [
        obstacle(name, user, t)
        for name, user in users.items()
        if name != "ego" and is_seen(name, t)
    ]


def perception(t):
    return message([*[(1, item) for item in seen_at(t)], (2, stamped(t + LATE_S))])


def prediction(t):
    items = [(2, [(1, item), (2, float(START_S + t))]) for item in seen_at(t)]
    return message([(1, stamped(t + LATE_S)), *items])


def routing(x, y):
    points = [(2, [(3, point(CENTRE[0], CENTRE[1]))]), (2, [(3, point(x, y))])]
    return message([(1, stamped(0.0)), (4, points)])


def command(x, y):
    """Since Apollo 9: the routing inside what planning is told to do."""
    points = [(2, [(3, point(CENTRE[0], CENTRE[1]))]), (2, [(3, point(x, y))])]
    follow = [(1, stamped(0.0)), (4, points)]
    return message([(1, stamped(0.0)), (2, 7), (3, follow)])


def parking():
    return message([(1, stamped(0.0)), (2, 8), (6, [(2, "451089045")])])


def perception_times():
    """Irregular, 0.08 to 0.12 s apart; the first and last fall on the clock."""
    t = GRID + 0.01 * np.sin(7.0 * np.arange(GRID.size))
    t[[0, -1]] = GRID[[0, -1]]
    for edge in (*GAP, *SEEN["17"]):
        t[np.argmin(np.abs(GRID - edge))] = edge
    return t


def drive(*, obstacles=OBSTACLES):
    """(channel, s since START_S, content) of the whole drive, by time."""
    found = [
        ("/apollo/routing_response", 0.0, routing(CENTRE[0] + 300.0, CENTRE[1] + 1.0))
    ]
    for k in range(801):
        t = 0.01 * k + (0.002 * np.sin(k) if 0 < k < 800 else 0.0)
        found.append(("/apollo/localization/pose", t, localization(t)))
        found.append(("/apollo/canbus/chassis", t, chassis(t)))
    for t in perception_times().tolist():
        made = {OBSTACLES: perception, "/apollo/prediction": prediction}
        found.append((obstacles, t + LATE_S, made[obstacles](t)))
    found.append(("/apollo/sensor/camera/front_6mm/image", 1.0, bytes(5000)))
    return sorted(found, key=lambda item: item[1])


# --------------------------------------------------------------------- record


def section(kind, content):
    return struct.pack("<i4xq", kind, len(content)) + content


def header(*, compress=0, complete=True):
    content = message([(1, 1), (2, 0), (3, compress), (13, complete)])
    return section(0, content) + bytes(2048 - len(content))


def record(messages, *, channels=None, chunk=200, **options):
    """A record file: header, channels, chunks of messages, index."""
    parts = [header(**options)]
    for name, (kind, desc) in (CHANNELS if channels is None else channels).items():
        parts.append(section(4, message([(1, name), (2, kind), (3, desc)])))
    for start in range(0, len(messages), chunk):
        singles = []
        for name, t, content in messages[start : start + chunk]:
            time = round((START_S + t) * 1e9)
            singles.append((1, [(1, name), (2, time), (3, content)]))
        parts.append(section(1, message([(1, 1), (3, len(singles))])))
        parts.append(section(2, message(singles)))
    parts.append(section(3, message([(1, [(1, 4), (2, 2064)])])))
    return b"".join(parts)


def expected():
    """Tracks on the clock of 10 Hz."""
    users = road_users(GRID)
    found = {}
    for name, user in users.items():
        times = [t for t in perception_times() if name == "ego" or is_seen(name, t)]
        if name == "19":
            early = [t for t in times if t <= GAP[0]]
            found["19#2"] = on_clock(user, [t for t in times if t > GAP[0]])
            found["19"] = on_clock(user, early)
        else:
            found[name] = on_clock(user, times)
    return found


def on_clock(user, times):
    first, last = round(10.0 * min(times)), round(10.0 * max(times))
    return samples(user, slice(first, last + 1))


def write(folder):
    messages = drive()
    half = len(messages) // 2
    first = folder / "20210723091215.record.00000"
    second = folder / "20210723091215.record.00001"
    first.write_bytes(record(messages[:half]))
    second.write_bytes(record(messages[half:]))
    return Fixture(
        input=folder,
        rate_hz=10.0,
        tracks=expected(),
        num_lanes=1,
        files=(first, second),
    )
