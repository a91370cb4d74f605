"""How a message of each type becomes rows of numbers.

A new type of message of the ego, of lights or of the driver is a function in `TYPES`;
those of obstacles stand in `objects`. Fields are found by name, as the definition in
the file has them; covariances are not read.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping

from rcirl_jax.data.formats.ros2 import objects
from rcirl_jax.data.formats.ros2.bag_file import Message
from rcirl_jax.data.formats.ros2.poses import Pose, pose_of
from rcirl_jax.data.formats.signals import STATES
from rcirl_jax.errors import InputError

NAN = math.nan
# role -> its columns; t is the header's stamp, s
COLUMNS = {
    "ego": ("t", "x", "y", "heading", "speed"),
    "velocity": ("t", "speed"),
    "obstacles": ("t", *objects.COLUMNS),
    "lights": ("t", "group", "state"),
    "driver": ("t", "is_manual"),
}
# autoware_vehicle_msgs/ControlModeReport, and autoware_auto_vehicle_msgs of before
MANUAL = 4
# colour and status of TrafficLightElement: those of autoware_perception_msgs, and of
# autoware_auto_perception_msgs and its first versions, which have no number twice
COLOURS = {1: "red", 2: "yellow", 3: "green"}
OFF = (1, 13)  # SOLID_OFF
CIRCLES = (1, 5)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Context:
    """What a message is read with."""

    where: str  # file, topic and number of the message, for errors
    map_frame: str
    base_frame: str
    kinds: Mapping[str, str]  # [kinds] of the TOML
    names: dict[str, int]  # name of an obstacle -> its number in the drive

    def check_frame(self, frame: str) -> bool:
        """Whether a frame is the ego's own; only the map's is allowed besides.

        A frame that is not named is the map's.
        """
        found = frame.lstrip("/")
        if found not in ("", self.map_frame, self.base_frame):
            raise InputError(
                f"{self.where}: header.frame_id: {found!a:.80}: expected "
                f"{self.map_frame} or {self.base_frame} ([frames] of the source TOML)"
            )
        return found == self.base_frame


Row = tuple[float, ...]
Reader = Callable[[Message, Context], Iterator[Row]]


def _odometry(message: Message, context: Context) -> Iterator[Row]:
    """nav_msgs/Odometry: the twist is in child_frame_id, its length in no frame."""
    yield _ego(message.header, message.pose.pose, _speed(message.twist.twist), context)


def _pose(message: Message, context: Context) -> Iterator[Row]:
    yield _ego(message.header, message.pose, NAN, context)


def _pose_with_covariance(message: Message, context: Context) -> Iterator[Row]:
    yield _ego(message.header, message.pose.pose, NAN, context)


def _transforms(message: Message, context: Context) -> Iterator[Row]:
    """tf2_msgs/TFMessage: where the base is on the map; others are passed over."""
    for one in message.transforms:
        frames = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
        if frames == (context.map_frame, context.base_frame):
            place = one.transform
            pose = pose_of(context.where, place.translation, place.rotation)
            yield (stamp_of(one.header.stamp), *_on_map(pose, context), NAN)


def _ego(header: Message, pose: Message, speed: float, context: Context) -> Row:
    if context.check_frame(header.frame_id):
        raise InputError(
            f"{context.where}: header.frame_id: {context.base_frame}: expected the "
            f"ego's place on the map, in {context.map_frame} ([frames] of the source "
            "TOML)"
        )
    found = pose_of(context.where, pose.position, pose.orientation)
    return (stamp_of(header.stamp), *_on_map(found, context), speed)


def _on_map(pose: Pose, context: Context) -> Row:
    if math.isnan(pose.heading):
        raise InputError(
            f"{context.where}: orientation: all zero: expected the ego's quaternion"
        )
    return pose.x, pose.y, pose.heading


def _twist(message: Message, context: Context) -> Iterator[Row]:
    yield stamp_of(message.header.stamp), _speed(message.twist)


def _twist_with_covariance(message: Message, context: Context) -> Iterator[Row]:
    yield stamp_of(message.header.stamp), _speed(message.twist.twist)


def _control_mode(message: Message, context: Context) -> Iterator[Row]:
    yield stamp_of(message.stamp), float(message.mode == MANUAL)


def _light_groups(message: Message, context: Context) -> Iterator[Row]:
    t = stamp_of(message.stamp)
    for one in message.traffic_light_groups:
        yield t, float(one.traffic_light_group_id), _state(one.elements)


def _light_signals(message: Message, context: Context) -> Iterator[Row]:
    """autoware_perception_msgs/TrafficSignalArray, the name before."""
    t = stamp_of(message.stamp)
    for one in message.signals:
        yield t, float(one.traffic_signal_id), _state(one.elements)


def _map_lights(message: Message, context: Context) -> Iterator[Row]:
    """autoware_auto_perception_msgs/TrafficSignalArray."""
    t = stamp_of(message.header.stamp)
    for one in message.signals:
        yield t, float(one.map_primitive_id), _state(one.lights)


def _state(elements: list) -> float:
    """Place in STATES of the surest round light, else of the surest one; lit ones."""
    lit = [e for e in elements if e.color in COLOURS and e.status not in OFF]
    best = max(lit, key=lambda e: (e.shape in CIRCLES, e.confidence), default=None)
    return float(0 if best is None else STATES.index(COLOURS[best.color]))


def _obstacles(read: objects.Reader) -> Reader:
    """Rows of a message of obstacles: of all of them the header's time and frame."""

    def rows(message: Message, context: Context) -> Iterator[Row]:
        t = stamp_of(message.header.stamp)
        in_base = float(context.check_frame(message.header.frame_id))
        for found in read(message, context.where, context.kinds):
            number = context.names.setdefault(found.name, len(context.names))
            yield (t, *found.row(number, in_base))

    return rows


# role -> type of message -> how it is read
TYPES: dict[str, dict[str, Reader]] = {
    "ego": {
        "nav_msgs/msg/Odometry": _odometry,
        "geometry_msgs/msg/PoseStamped": _pose,
        "geometry_msgs/msg/PoseWithCovarianceStamped": _pose_with_covariance,
        "tf2_msgs/msg/TFMessage": _transforms,
    },
    "velocity": {
        "geometry_msgs/msg/TwistStamped": _twist,
        "geometry_msgs/msg/TwistWithCovarianceStamped": _twist_with_covariance,
    },
    "obstacles": {k: _obstacles(read) for k, read in objects.TYPES.items()},
    "lights": {
        "autoware_perception_msgs/msg/TrafficLightGroupArray": _light_groups,
        "autoware_perception_msgs/msg/TrafficSignalArray": _light_signals,
        "autoware_auto_perception_msgs/msg/TrafficSignalArray": _map_lights,
    },
    "driver": {
        "autoware_vehicle_msgs/msg/ControlModeReport": _control_mode,
        "autoware_auto_vehicle_msgs/msg/ControlModeReport": _control_mode,
    },
}


def stamp_of(stamp: Message) -> float:
    """A builtin_interfaces/Time in s, to about 1e-7 s."""
    return stamp.sec + 1e-9 * stamp.nanosec


def _speed(twist: Message) -> float:
    return math.hypot(twist.linear.x, twist.linear.y)
