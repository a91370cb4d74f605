"""A drive as two Apollo cyber records, with the descriptors of its messages.

Message and field numbers are those of Apollo's common_msgs. Localization comes at
100 Hz, perception at about 10 Hz and 80 ms late, both irregular; the second part
of the drive is in a file of its own.
"""

import struct

import numpy as np

from rcirl_jax.types import Kind
from tests.data.importers.formats import Fixture
from tests.data.importers.formats.drives import arc, samples, straight
from tests.data.importers.formats.waymo import Single, message

START_S = 1627031535.25  # s, of the first localization
CENTRE = np.array([587000.0, 4141000.0])  # m, UTM zone 10; the local origin
AHEAD = 1.4235  # m, from the rear axle to the centre of an MKZ
DURATION_S = 8.0
GRID = 0.1 * np.arange(81)
LATE_S = 0.08  # s, from the measurement of perception to its message
GAP = (3.0, 5.0)  # s, in which obstacle 19 is hidden
SEEN = {"17": (2.0, 6.5)}  # s, others: the whole drive
DOUBLE, FLOAT, INT32, BOOL, STRING, MESSAGE, ENUM = 1, 2, 5, 8, 9, 11, 14
TYPE = {Kind.VEHICLE: 5, Kind.CYCLIST: 4, Kind.PEDESTRIAN: 3, Kind.STATIC: 2}


def road_users(t):
    """Id -> motion in metres about CENTRE at times t [s]."""
    return {
        "ego": straight(t, (0.0, 0.0), 0.0, 8.0, size=(4.933, 2.11)),
        "12": straight(t, (25.0, 0.0), 0.0, 8.0),
        "15": arc(t, (60.0, 0.0), 0.0, 7.0, 25.0, size=(5.2, 2.0)),
        "17": straight(t, (-30.0, 3.5), 0.0, 11.0),
        "19": straight(t, (-10.0, 3.5), 0.0, 9.0, size=(11.0, 2.6)),
        "23": straight(
            t, (50.0, -6.0), np.pi / 2, 1.3, kind=Kind.PEDESTRIAN, size=(0.6, 0.6)
        ),
        "27": straight(t, (0.0, -2.0), 0.0, 5.0, kind=Kind.CYCLIST, size=(1.7, 0.6)),
        "31": straight(t, (40.0, -3.0), 0.0, 0.0, kind=Kind.STATIC, size=(0.4, 0.4)),
    }


# ---------------------------------------------------------------- descriptors


def field_of(name, number, kind, *, type_name="", repeated=False):
    """FieldDescriptorProto."""
    parts = [(1, name), (3, number), (4, 3 if repeated else 1), (5, kind)]
    return message([*parts, *([(6, type_name)] if type_name else [])])


def type_of(name, fields, *, enums=()):
    """DescriptorProto."""
    parts = [(1, name), *[(2, item) for item in fields]]
    return message([*parts, *[(4, item) for item in enums]])


def enum_of(name, values):
    """EnumDescriptorProto."""
    items = [message([(1, label), (2, number)]) for label, number in values]
    return message([(1, name), *[(2, item) for item in items]])


def file_of(name, package, types, needs=()):
    """FileDescriptorProto."""
    parts = [(1, name), (2, package), *[(3, other) for other in needs]]
    return message([*parts, *[(4, item) for item in types]])


def xyz(name):
    return type_of(name, [field_of(n, k + 1, DOUBLE) for k, n in enumerate("xyz")])


QUATERNION = type_of(
    "Quaternion",
    [field_of(n, k + 1, DOUBLE) for k, n in enumerate(("qx", "qy", "qz", "qw"))],
)
HEADER = file_of(
    "modules/common_msgs/basic_msgs/header.proto",
    "apollo.common",
    [
        type_of(
            "Header",
            [
                field_of("timestamp_sec", 1, DOUBLE),
                field_of("module_name", 2, STRING),
                field_of("sequence_num", 3, 13),
            ],
        )
    ],
)
GEOMETRY = file_of(
    "modules/common_msgs/basic_msgs/geometry.proto",
    "apollo.common",
    [xyz("PointENU"), xyz("Point3D"), QUATERNION],
)


def header_field(number):
    return field_of("header", number, MESSAGE, type_name=".apollo.common.Header")


def common(name, number, kind):
    return field_of(name, number, MESSAGE, type_name=f".apollo.common.{kind}")


POSE = file_of(
    "modules/common_msgs/localization_msgs/pose.proto",
    "apollo.localization",
    [
        type_of(
            "Pose",
            [
                common("position", 1, "PointENU"),
                common("orientation", 2, "Quaternion"),
                common("linear_velocity", 3, "Point3D"),
                field_of("heading", 6, DOUBLE),
            ],
        )
    ],
)
LOCALIZATION = file_of(
    "modules/common_msgs/localization_msgs/localization.proto",
    "apollo.localization",
    [
        type_of(
            "LocalizationEstimate",
            [
                header_field(1),
                field_of("pose", 2, MESSAGE, type_name=".apollo.localization.Pose"),
                field_of("measurement_time", 4, DOUBLE),
            ],
        )
    ],
)
MODES = enum_of("DrivingMode", [("COMPLETE_MANUAL", 0), ("COMPLETE_AUTO_DRIVE", 1)])
CHASSIS = file_of(
    "modules/common_msgs/chassis_msgs/chassis.proto",
    "apollo.canbus",
    [
        type_of(
            "Chassis",
            [
                field_of("engine_started", 3, BOOL),
                field_of("speed_mps", 5, FLOAT),
                field_of(
                    "driving_mode",
                    21,
                    ENUM,
                    type_name=".apollo.canbus.Chassis.DrivingMode",
                ),
                header_field(25),
            ],
            enums=[MODES],
        )
    ],
)
TYPES = enum_of(
    "Type",
    [
        ("UNKNOWN", 0),
        ("UNKNOWN_MOVABLE", 1),
        ("UNKNOWN_UNMOVABLE", 2),
        ("PEDESTRIAN", 3),
        ("BICYCLE", 4),
        ("VEHICLE", 5),
    ],
)
OBSTACLE = "apollo.perception.PerceptionObstacle"
PERCEPTION = file_of(
    "modules/common_msgs/perception_msgs/perception_obstacle.proto",
    "apollo.perception",
    [
        type_of(
            "PerceptionObstacle",
            [
                field_of("id", 1, INT32),
                common("position", 2, "Point3D"),
                field_of("theta", 3, DOUBLE),
                common("velocity", 4, "Point3D"),
                field_of("length", 5, DOUBLE),
                field_of("width", 6, DOUBLE),
                field_of("height", 7, DOUBLE),
                field_of("type", 10, ENUM, type_name=f".{OBSTACLE}.Type"),
                field_of("timestamp", 11, DOUBLE),
            ],
            enums=[TYPES],
        ),
        type_of(
            "PerceptionObstacles",
            [
                field_of(
                    "perception_obstacle",
                    1,
                    MESSAGE,
                    type_name=f".{OBSTACLE}",
                    repeated=True,
                ),
                header_field(2),
            ],
        ),
    ],
)
PREDICTION = file_of(
    "modules/common_msgs/prediction_msgs/prediction_obstacle.proto",
    "apollo.prediction",
    [
        type_of(
            "PredictionObstacle",
            [
                field_of("perception_obstacle", 1, MESSAGE, type_name=f".{OBSTACLE}"),
                field_of("timestamp", 2, DOUBLE),
            ],
        ),
        type_of(
            "PredictionObstacles",
            [
                header_field(1),
                field_of(
                    "prediction_obstacle",
                    2,
                    MESSAGE,
                    type_name=".apollo.prediction.PredictionObstacle",
                    repeated=True,
                ),
            ],
        ),
    ],
)
ROUTING = file_of(
    "modules/common_msgs/routing_msgs/routing.proto",
    "apollo.routing",
    [
        type_of("LaneWaypoint", [common("pose", 3, "PointENU")]),
        type_of(
            "RoutingRequest",
            [
                field_of(
                    "waypoint",
                    2,
                    MESSAGE,
                    type_name=".apollo.routing.LaneWaypoint",
                    repeated=True,
                )
            ],
        ),
        type_of(
            "RoutingResponse",
            [
                header_field(1),
                field_of(
                    "routing_request",
                    4,
                    MESSAGE,
                    type_name=".apollo.routing.RoutingRequest",
                ),
            ],
        ),
    ],
)
COMMAND = file_of(
    "modules/common_msgs/planning_msgs/planning_command.proto",
    "apollo.planning",
    [
        type_of("ParkingCommand", [field_of("parking_spot_id", 2, STRING)]),
        type_of(
            "PlanningCommand",
            [
                header_field(1),
                field_of("command_id", 2, 3),
                field_of(
                    "lane_follow_command",
                    3,
                    MESSAGE,
                    type_name=".apollo.routing.RoutingResponse",
                ),
                field_of(
                    "parking_command",
                    6,
                    MESSAGE,
                    type_name=".apollo.planning.ParkingCommand",
                ),
                field_of(
                    "custom_command", 7, MESSAGE, type_name=".google.protobuf.Any"
                ),
            ],
        ),
    ],
)


def proto_desc(main, *needs):
    """ProtoDesc: a file and those it imports, each once per importer."""
    return message([(1, main), *[(2, other) for other in needs]])


_HEADER, _GEOMETRY = proto_desc(HEADER), proto_desc(GEOMETRY)
COMMANDS = (
    "apollo.planning.PlanningCommand",
    proto_desc(COMMAND, _HEADER, proto_desc(ROUTING, _HEADER, _GEOMETRY)),
)
CHANNELS = {
    "/apollo/localization/pose": (
        "apollo.localization.LocalizationEstimate",
        proto_desc(LOCALIZATION, _HEADER, proto_desc(POSE, _GEOMETRY)),
    ),
    "/apollo/canbus/chassis": (
        "apollo.canbus.Chassis",
        proto_desc(CHASSIS, _HEADER),
    ),
    "/apollo/perception/obstacles": (
        "apollo.perception.PerceptionObstacles",
        proto_desc(PERCEPTION, _HEADER, _GEOMETRY),
    ),
    "/apollo/prediction": (
        "apollo.prediction.PredictionObstacles",
        proto_desc(PREDICTION, _HEADER, proto_desc(PERCEPTION, _HEADER, _GEOMETRY)),
    ),
    "/apollo/routing_response": (
        "apollo.routing.RoutingResponse",
        proto_desc(ROUTING, _HEADER, _GEOMETRY),
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


def drive(*, obstacles="perception"):
    """(channel, s since START_S, content) of the whole drive, by time."""
    found = [
        ("/apollo/routing_response", 0.0, routing(CENTRE[0] + 300.0, CENTRE[1] + 1.0))
    ]
    for k in range(801):
        t = 0.01 * k + (0.002 * np.sin(k) if 0 < k < 800 else 0.0)
        found.append(("/apollo/localization/pose", t, localization(t)))
        found.append(("/apollo/canbus/chassis", t, chassis(t)))
    for t in perception_times().tolist():
        make = perception if obstacles == "perception" else prediction
        name = "/apollo/perception/obstacles"
        name = name if obstacles == "perception" else "/apollo/prediction"
        found.append((name, t + LATE_S, make(t)))
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
