"""Obstacles of messages of several packages, one form.

Numbers of classes, shapes and availabilities are those of the packages' .msg files:
autoware_perception_msgs (ObjectClassification, Shape, TrackedObjectKinematics; those
of autoware_auto_perception_msgs are the same), derived_object_msgs (Object),
shape_msgs (SolidPrimitive). Names of classes in vision_msgs are whatever the detector
calls them, so [kinds] of the source TOML says what they are.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping

from rcirl_jax.data.formats.options import kind_of
from rcirl_jax.data.formats.perception import UNKNOWN
from rcirl_jax.data.formats.ros2.bag_file import Message
from rcirl_jax.data.formats.ros2.poses import Pose, pose_of
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind

COLUMNS = (
    *("id", "x", "y", "heading", "speed"),
    *("length", "width", "kind", "in_base"),
)
LEFT_OUT = -2  # kind of what a car drives over or under
# ObjectClassification.label: CAR, TRUCK, BUS, TRAILER, MOTORCYCLE; BICYCLE;
# PEDESTRIAN, ANIMAL; HAZARD; OVER_DRIVABLE, UNDER_DRIVABLE; 0 is UNKNOWN
LABELS = {
    **dict.fromkeys((1, 2, 3, 4, 5), int(Kind.VEHICLE)),
    6: int(Kind.CYCLIST),
    **dict.fromkeys((7, 8), int(Kind.PEDESTRIAN)),
    9: int(Kind.STATIC),
    **dict.fromkeys((10, 11), LEFT_OUT),
}
# Object.classification: PEDESTRIAN; BIKE; CAR, TRUCK, MOTORCYCLE, OTHER_VEHICLE;
# BARRIER, SIGN; 0 to 3 are UNKNOWN of several sizes
CLASSES = {
    4: int(Kind.PEDESTRIAN),
    5: int(Kind.CYCLIST),
    **dict.fromkeys((6, 7, 8, 9), int(Kind.VEHICLE)),
    **dict.fromkeys((10, 11), int(Kind.STATIC)),
}
CYLINDER, POLYGON = 1, 2  # Shape.type
BOX, SPHERE, CONE = 1, 2, 4  # SolidPrimitive.type; 3 is CYLINDER
HAS_NO_HEADING, HAS_NO_SIGN = 0, 1  # TrackedObjectKinematics.orientation_availability


@dataclasses.dataclass(frozen=True)
class Found:
    """One obstacle of a message."""

    name: str  # the same in every message
    pose: Pose  # of the box centre; heading NaN: by the direction of travel
    speed: float  # m/s; NaN: from the positions
    size: tuple[float, float]  # m, length and width; 0: not known
    kind: int

    def row(self, number: int, in_base: float) -> tuple[float, ...]:
        """COLUMNS of it, by its number among the names of the drive."""
        length, width = (size or math.nan for size in self.size)
        place = self.pose.x, self.pose.y, self.pose.heading, self.speed
        return (float(number), *place, length, width, float(self.kind), in_base)


# message, where (for errors), [kinds] of the TOML -> its obstacles
Reader = Callable[[Message, str, Mapping[str, str]], Iterator[Found]]


def _tracked(message: Message, where: str, kinds: Mapping) -> Iterator[Found]:
    """TrackedObjects of Autoware: the twist is in the object's own frame."""
    for one in message.objects:
        how = one.kinematics
        pose = pose_of(
            where,
            how.pose_with_covariance.pose.position,
            how.pose_with_covariance.pose.orientation,
        )
        twist = how.twist_with_covariance.twist.linear
        found = how.orientation_availability
        if found == HAS_NO_HEADING:
            pose = dataclasses.replace(pose, heading=math.nan)
        elif found == HAS_NO_SIGN and twist.x < 0.0:
            pose = dataclasses.replace(pose, heading=pose.heading + math.pi)
        yield _of_autoware(one, pose, math.hypot(twist.x, twist.y))


def _predicted(message: Message, where: str, kinds: Mapping) -> Iterator[Found]:
    """PredictedObjects of Autoware: the tracked ones, with paths that are not read."""
    for one in message.objects:
        place = one.kinematics.initial_pose_with_covariance.pose
        twist = one.kinematics.initial_twist_with_covariance.twist.linear
        pose = pose_of(where, place.position, place.orientation)
        yield _of_autoware(one, pose, math.hypot(twist.x, twist.y))


def _of_autoware(one: Message, pose: Pose, speed: float) -> Found:
    best = max(one.classification, key=lambda c: c.probability, default=None)
    shape, size = one.shape, (one.shape.dimensions.x, one.shape.dimensions.y)
    if shape.type == CYLINDER:
        size = (shape.dimensions.x, shape.dimensions.x)
    elif shape.type == POLYGON and shape.footprint.points:
        # in the object's frame; its box need not have the object's place in its middle
        ahead = [point.x for point in shape.footprint.points]
        left = [point.y for point in shape.footprint.points]
        size = (max(ahead) - min(ahead), max(left) - min(left))
        middle = 0.5 * (max(ahead) + min(ahead)), 0.5 * (max(left) + min(left))
        pose = pose.moved(*middle)
    return Found(
        name=bytes(one.object_id.uuid).hex(),
        pose=pose,
        speed=speed,
        size=size,
        kind=UNKNOWN if best is None else LABELS.get(best.label, UNKNOWN),
    )


def _derived(message: Message, where: str, kinds: Mapping) -> Iterator[Found]:
    """derived_object_msgs/ObjectArray, as CARLA's bridge publishes it."""
    for one in message.objects:
        yield Found(
            name=str(one.id),
            pose=pose_of(where, one.pose.position, one.pose.orientation),
            speed=math.hypot(one.twist.linear.x, one.twist.linear.y),
            size=_of_primitive(one.shape.type, list(one.shape.dimensions)),
            kind=CLASSES.get(one.classification, UNKNOWN),
        )


def _of_primitive(kind: int, dimensions: list[float]) -> tuple[float, float]:
    """m, length and width of a SolidPrimitive; (0, 0) where it has none."""
    if kind == BOX and len(dimensions) > 1:
        return dimensions[0], dimensions[1]
    # radius: the only number of a sphere, behind the height of the others
    place = 0 if kind == SPHERE else 1
    is_round = BOX < kind <= CONE and len(dimensions) > place
    diameter = 2.0 * dimensions[place] if is_round else 0.0
    return diameter, diameter


def _detections(message: Message, where: str, kinds: Mapping) -> Iterator[Found]:
    """vision_msgs/Detection3DArray; the speed comes from the positions.

    The id is `id`, before ROS 2 Humble `tracking_id`; a class is `hypothesis.class_id`,
    before Galactic `id`.
    """
    for place, one in enumerate(message.detections):
        name = one.id if hasattr(one, "id") else one.tracking_id
        if not name:
            raise InputError(
                f"{where}: detections[{place}].id: '': expected one that stays with a "
                "road user; name the topic of a tracker in topics.obstacles of the "
                "source TOML"
            )
        sure = [getattr(result, "hypothesis", result) for result in one.results]
        best = max(sure, key=lambda result: result.score, default=None)
        kind = UNKNOWN
        if best is not None:
            label = best.class_id if hasattr(best, "class_id") else best.id
            kind = int(kind_of(f"{where}: detections[{place}]", label, kinds))
        box = one.bbox
        yield Found(
            name=name,
            pose=pose_of(where, box.center.position, box.center.orientation),
            speed=math.nan,
            size=(box.size.x, box.size.y),
            kind=kind,
        )


# type of message -> how it is read
TYPES: dict[str, Reader] = {
    "autoware_perception_msgs/msg/TrackedObjects": _tracked,
    "autoware_auto_perception_msgs/msg/TrackedObjects": _tracked,
    "autoware_perception_msgs/msg/PredictedObjects": _predicted,
    "autoware_auto_perception_msgs/msg/PredictedObjects": _predicted,
    "derived_object_msgs/msg/ObjectArray": _derived,
    "vision_msgs/msg/Detection3DArray": _detections,
}
