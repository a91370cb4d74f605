"""Converts messages of each type to rows of numbers, by the role of the topic.

A new type of message is a function in `TYPES`. Fields are found by name, as the
definition in the file has them. Numbers of classes, shapes and availabilities are those
of the packages' .msg files. Names of classes in vision_msgs are whatever the detector
calls them, so [kinds] of the source TOML says what they are.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from operator import attrgetter

from rcirl_jax.data.formats.messages import Row
from rcirl_jax.data.formats.options import kind_of
from rcirl_jax.data.formats.perception import STATES, UNKNOWN
from rcirl_jax.data.formats.ros2.bag import Message
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind

NAN = math.nan
# role -> columns of its rows, as `Drive` has them; of lights t [s], group, state; of
# obstacles there is another: 1 in the ego's frame
WIDTHS = {"ego": 5, "velocity": 2, "obstacles": 10, "lights": 3, "driver": 2}
# autoware_vehicle_msgs/ControlModeReport, and autoware_auto_vehicle_msgs of before
MANUAL = 4
# colour and status of TrafficLightElement: those of autoware_perception_msgs, and of
# autoware_auto_perception_msgs and its first versions, which have no number twice
COLOURS = {1: "red", 2: "yellow", 3: "green"}
OFF = (1, 13)  # SOLID_OFF
CIRCLES = (1, 5)
LEFT_OUT = -2  # kind of what a car drives over or under
# ObjectClassification.label: CAR, TRUCK, BUS, TRAILER, MOTORCYCLE; BICYCLE;
# PEDESTRIAN, ANIMAL; HAZARD; OVER_DRIVABLE, UNDER_DRIVABLE; 0 is UNKNOWN
LABELS = {
    **dict.fromkeys((1, 2, 3, 4, 5), Kind.VEHICLE),
    **{6: Kind.CYCLIST, 7: Kind.PEDESTRIAN, 8: Kind.PEDESTRIAN, 9: Kind.STATIC},
    **dict.fromkeys((10, 11), LEFT_OUT),
}
# Object.classification: PEDESTRIAN; BIKE; CAR, TRUCK, MOTORCYCLE, OTHER_VEHICLE;
# BARRIER, SIGN; 0 to 3 are UNKNOWN of several sizes
CLASSES = {
    **{4: Kind.PEDESTRIAN, 5: Kind.CYCLIST, 10: Kind.STATIC, 11: Kind.STATIC},
    **dict.fromkeys((6, 7, 8, 9), Kind.VEHICLE),
}
CYLINDER, POLYGON = 1, 2  # Shape.type
BOX, SPHERE, CONE = 1, 2, 4  # SolidPrimitive.type; 3 is CYLINDER
HAS_NO_HEADING, HAS_NO_SIGN = 0, 1  # TrackedObjectKinematics.orientation_availability

Reader = Callable[[Message, "Context"], Iterator[Row]]
Pose = tuple[float, float, float]  # x, y [m], heading [rad]; NaN: quaternion not set


@dataclasses.dataclass(kw_only=True)
class Context:
    """The context that a message is read in."""

    where: str = ""  # file, topic and number of the message, for errors
    map_frame: str
    base_frame: str
    kinds: Mapping[str, str]  # [kinds] of the TOML
    # name of an obstacle -> its number in the drive
    names: dict[str, int] = dataclasses.field(default_factory=dict)

    def check_frame(self, frame: str) -> bool:
        """Returns whether a frame is the ego's own; only the map's is allowed besides.

        A frame that is not named is the map's.
        """
        found = frame.lstrip("/")
        if found not in ("", self.map_frame, self.base_frame):
            raise InputError(
                f"{self.where}: header.frame_id: {found!a:.80}: expected "
                f"{self.map_frame} or {self.base_frame} ([frames] of the source TOML)"
            )
        return found == self.base_frame

    def pose(
        self, position: Message, orientation: Message, *, is_ego: bool = False
    ) -> Pose:
        """Returns a place from a point and a quaternion of any length.

            heading = atan2(2 (w z + x y), w^2 + x^2 - y^2 - z^2)

        Raises:
          InputError: a number that is not finite, or a heading of the ego not set.
        """
        x, y, q = position.x, position.y, orientation
        for name, value in {"x": x, "y": y, "w": q.w, "z": q.z}.items():
            if not math.isfinite(value):
                field = "position" if name in "xy" else "orientation"
                raise InputError(
                    f"{self.where}: {field}.{name}: {value}: expected a finite number"
                )
        if not any((q.x, q.y, q.z, q.w)):
            if is_ego:
                found = "all zero: expected the ego's quaternion"
                raise InputError(f"{self.where}: orientation: {found}")
            return x, y, NAN
        ahead = q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z
        return x, y, math.atan2(2.0 * (q.w * q.z + q.x * q.y), ahead)


def _stamp(stamp: Message) -> float:
    """A builtin_interfaces/Time in s, to about 1e-7 s."""
    return stamp.sec + 1e-9 * stamp.nanosec


def _length(vector: Message) -> float:
    return math.hypot(vector.x, vector.y)


# ------------------------------------------------------------ the ego, lights


def _ego(pose: str, speed: str = "") -> Reader:
    """Messages of one pose; `speed` leads to a velocity whose length is the speed."""
    pose_of, velocity_of = attrgetter(pose), attrgetter(speed or "header")

    def rows(message: Message, context: Context) -> Iterator[Row]:
        if context.check_frame(message.header.frame_id):
            raise InputError(
                f"{context.where}: header.frame_id: {context.base_frame}: expected the "
                f"ego's place on the map, in {context.map_frame} ([frames] of the "
                "source TOML)"
            )
        place = pose_of(message)
        known = _length(velocity_of(message)) if speed else NAN
        found = context.pose(place.position, place.orientation, is_ego=True)
        yield _stamp(message.header.stamp), *found, known

    return rows


def _transforms(message: Message, context: Context) -> Iterator[Row]:
    """tf2_msgs/TFMessage: where the base is on the map; others are passed over."""
    for one in message.transforms:
        frames = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
        if frames == (context.map_frame, context.base_frame):
            place = one.transform
            found = context.pose(place.translation, place.rotation, is_ego=True)
            yield _stamp(one.header.stamp), *found, NAN


def _velocity(velocity: str) -> Reader:
    velocity_of = attrgetter(velocity)
    return lambda message, _: iter(
        [(_stamp(message.header.stamp), _length(velocity_of(message)))]
    )


def _control_mode(message: Message, _: Context) -> Iterator[Row]:
    yield _stamp(message.stamp), float(message.mode == MANUAL)


def _lights(stamp: str, groups: str, name: str, elements: str) -> Reader:
    """Messages of lights: places of the time, the groups, and of each id and lamps.

    The state is the place in STATES of the surest round light, else of the surest one.
    """
    stamp_of, parts = attrgetter(stamp), attrgetter(name, elements)

    def rows(message: Message, _: Context) -> Iterator[Row]:
        t = _stamp(stamp_of(message))
        for number, lamps in map(parts, getattr(message, groups)):
            lit = [e for e in lamps if e.color in COLOURS and e.status not in OFF]
            lit.sort(key=lambda e: (e.shape in CIRCLES, e.confidence), reverse=True)
            colour = COLOURS[lit[0].color] if lit else "off"
            yield t, float(number), float(STATES.index(colour))

    return rows


# ------------------------------------------------------------------ obstacles


def _obstacle(
    message: Message,
    context: Context,
    name: str,
    pose: Pose,
    speed: float,
    size: tuple[float, float],
    kind: int,
) -> Row:
    """A row of an obstacle: of all in a message the header's time and frame.

    Place and size [m] are the box's; NaN: a heading by the direction of travel, a speed
    from the positions; size 0: not known; kind: `Kind`, UNKNOWN or LEFT_OUT.
    """
    in_base = float(context.check_frame(message.header.frame_id))
    number = context.names.setdefault(name, len(context.names))
    length, width = (one or NAN for one in size)
    t = _stamp(message.header.stamp)
    return (t, float(number), *pose, speed, length, width, float(kind), in_base)


def _autoware(pose: str, twist: str) -> Reader:
    """TrackedObjects and PredictedObjects of Autoware; paths are not read.

    Args:
      pose: leads from an object's kinematics to its pose.
      twist: to its velocity in its own frame.
    """
    pose_of, twist_of = attrgetter(pose), attrgetter(twist)

    def rows(message: Message, context: Context) -> Iterator[Row]:
        for one in message.objects:
            how, shape = one.kinematics, one.shape
            place, velocity = pose_of(how), twist_of(how)
            x, y, heading = context.pose(place.position, place.orientation)
            known = getattr(how, "orientation_availability", None)
            if known == HAS_NO_HEADING:
                heading = NAN
            elif known == HAS_NO_SIGN and velocity.x < 0.0:
                heading += math.pi
            best = max(one.classification, key=lambda c: c.probability, default=None)
            kind = UNKNOWN if best is None else LABELS.get(best.label, UNKNOWN)
            size = shape.dimensions.x, shape.dimensions.y
            if shape.type == CYLINDER:
                size = (shape.dimensions.x, shape.dimensions.x)
            elif shape.type == POLYGON and shape.footprint.points:
                # in the object's frame; its place need not be in its box's middle
                ahead = [point.x for point in shape.footprint.points]
                left = [point.y for point in shape.footprint.points]
                size = (max(ahead) - min(ahead), max(left) - min(left))
                u, v = 0.5 * (max(ahead) + min(ahead)), 0.5 * (max(left) + min(left))
                turn = 0.0 if math.isnan(heading) else heading
                cos, sin = math.cos(turn), math.sin(turn)
                x, y = x + cos * u - sin * v, y + sin * u + cos * v
            name, pose = bytes(one.object_id.uuid).hex(), (x, y, heading)
            speed = _length(velocity)
            yield _obstacle(message, context, name, pose, speed, size, kind)

    return rows


def _derived(message: Message, context: Context) -> Iterator[Row]:
    """derived_object_msgs/ObjectArray, as CARLA's bridge publishes it."""
    for one in message.objects:
        pose = context.pose(one.pose.position, one.pose.orientation)
        shape, sizes, size = one.shape.type, list(one.shape.dimensions), (0.0, 0.0)
        # radius: the only number of a sphere, behind the height of the others
        place = 0 if shape == SPHERE else 1
        if shape == BOX and len(sizes) > 1:
            size = sizes[0], sizes[1]
        elif BOX < shape <= CONE and len(sizes) > place:
            size = (2.0 * sizes[place],) * 2
        kind, name = CLASSES.get(one.classification, UNKNOWN), str(one.id)
        speed = _length(one.twist.linear)
        yield _obstacle(message, context, name, pose, speed, size, kind)


def _detections(message: Message, context: Context) -> Iterator[Row]:
    """vision_msgs/Detection3DArray; the speed comes from the positions.

    The id is `id`, before ROS 2 Humble `tracking_id`; a class is `hypothesis.class_id`,
    before Galactic `id`.
    """
    for place, one in enumerate(message.detections):
        where = f"{context.where}: detections[{place}]"
        name = one.id if hasattr(one, "id") else one.tracking_id
        if not name:
            raise InputError(
                f"{where}.id: '': expected one that stays with a road user; name the "
                "topic of a tracker in topics.obstacles of the source TOML"
            )
        sure = [getattr(result, "hypothesis", result) for result in one.results]
        best = max(sure, key=lambda result: result.score, default=None)
        kind = UNKNOWN
        if best is not None:
            label = best.class_id if hasattr(best, "class_id") else best.id
            kind = int(kind_of(where, label, context.kinds))
        pose = context.pose(one.bbox.center.position, one.bbox.center.orientation)
        size = one.bbox.size.x, one.bbox.size.y
        yield _obstacle(message, context, name, pose, NAN, size, kind)


_tracked = _autoware("pose_with_covariance.pose", "twist_with_covariance.twist.linear")
_predicted = _autoware(
    "initial_pose_with_covariance.pose", "initial_twist_with_covariance.twist.linear"
)
# role -> type of message -> how it becomes rows
TYPES: dict[str, dict[str, Reader]] = {
    "ego": {
        # the twist is in child_frame_id, its length in no frame
        "nav_msgs/msg/Odometry": _ego("pose.pose", "twist.twist.linear"),
        "geometry_msgs/msg/PoseStamped": _ego("pose"),
        "geometry_msgs/msg/PoseWithCovarianceStamped": _ego("pose.pose"),
        "tf2_msgs/msg/TFMessage": _transforms,
    },
    "velocity": {
        "geometry_msgs/msg/TwistStamped": _velocity("twist.linear"),
        "geometry_msgs/msg/TwistWithCovarianceStamped": _velocity("twist.twist.linear"),
    },
    "obstacles": {
        "autoware_perception_msgs/msg/TrackedObjects": _tracked,
        "autoware_auto_perception_msgs/msg/TrackedObjects": _tracked,
        "autoware_perception_msgs/msg/PredictedObjects": _predicted,
        "autoware_auto_perception_msgs/msg/PredictedObjects": _predicted,
        "derived_object_msgs/msg/ObjectArray": _derived,
        "vision_msgs/msg/Detection3DArray": _detections,
    },
    "lights": {
        "autoware_perception_msgs/msg/TrafficLightGroupArray": _lights(
            "stamp", "traffic_light_groups", "traffic_light_group_id", "elements"
        ),
        "autoware_perception_msgs/msg/TrafficSignalArray": _lights(  # before
            "stamp", "signals", "traffic_signal_id", "elements"
        ),
        "autoware_auto_perception_msgs/msg/TrafficSignalArray": _lights(
            "header.stamp", "signals", "map_primitive_id", "lights"
        ),
    },
    "driver": {
        "autoware_vehicle_msgs/msg/ControlModeReport": _control_mode,
        "autoware_auto_vehicle_msgs/msg/ControlModeReport": _control_mode,
    },
}
