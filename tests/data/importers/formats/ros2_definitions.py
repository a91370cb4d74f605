"""Definitions of ROS 2 messages: fields as in the packages' .msg files."""

POINT = "float64 x\nfloat64 y\nfloat64 z"
STAMPED = "std_msgs/Header header\n"
# type -> its fields; types of messages in them are collected by `definition`
DEFINITIONS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "unique_identifier_msgs/UUID": "uint8[16] uuid",
    "geometry_msgs/Point": POINT,
    "geometry_msgs/Point32": POINT.replace("64", "32"),
    "geometry_msgs/Vector3": POINT,
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Polygon": "geometry_msgs/Point32[] points",
    "geometry_msgs/Pose": """geometry_msgs/Point position
geometry_msgs/Quaternion orientation""",
    "geometry_msgs/PoseWithCovariance": """geometry_msgs/Pose pose
float64[36] covariance""",
    "geometry_msgs/PoseStamped": STAMPED + "geometry_msgs/Pose pose",
    "geometry_msgs/Twist": """geometry_msgs/Vector3 linear
geometry_msgs/Vector3 angular""",
    "geometry_msgs/TwistWithCovariance": """geometry_msgs/Twist twist
float64[36] covariance""",
    "geometry_msgs/TwistStamped": STAMPED + "geometry_msgs/Twist twist",
    "geometry_msgs/Accel": """geometry_msgs/Vector3 linear
geometry_msgs/Vector3 angular""",
    "geometry_msgs/AccelWithCovariance": """geometry_msgs/Accel accel
float64[36] covariance""",
    "geometry_msgs/Transform": """geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation""",
    "geometry_msgs/TransformStamped": STAMPED
    + """string child_frame_id
geometry_msgs/Transform transform""",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "nav_msgs/Odometry": STAMPED
    + """string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist""",
    "autoware_perception_msgs/ObjectClassification": """uint8 UNKNOWN = 0
uint8 label
float32 probability""",
    "autoware_perception_msgs/Shape": """uint8 type
geometry_msgs/Polygon footprint
geometry_msgs/Vector3 dimensions""",
    "autoware_perception_msgs/TrackedObjectKinematics": """\
geometry_msgs/PoseWithCovariance pose_with_covariance
geometry_msgs/TwistWithCovariance twist_with_covariance
geometry_msgs/AccelWithCovariance acceleration_with_covariance
uint8 orientation_availability
bool is_stationary""",
    "autoware_perception_msgs/TrackedObject": """unique_identifier_msgs/UUID object_id
float32 existence_probability
autoware_perception_msgs/ObjectClassification[] classification
autoware_perception_msgs/TrackedObjectKinematics kinematics
autoware_perception_msgs/Shape shape""",
    "autoware_perception_msgs/TrackedObjects": STAMPED
    + "autoware_perception_msgs/TrackedObject[] objects",
    "autoware_perception_msgs/PredictedPath": """geometry_msgs/Pose[] path
float32 confidence""",
    "autoware_perception_msgs/PredictedObjectKinematics": """\
geometry_msgs/PoseWithCovariance initial_pose_with_covariance
geometry_msgs/TwistWithCovariance initial_twist_with_covariance
geometry_msgs/AccelWithCovariance initial_acceleration_with_covariance
autoware_perception_msgs/PredictedPath[<=100] predicted_paths""",
    "autoware_perception_msgs/PredictedObject": """unique_identifier_msgs/UUID object_id
float32 existence_probability
autoware_perception_msgs/ObjectClassification[] classification
autoware_perception_msgs/PredictedObjectKinematics kinematics
autoware_perception_msgs/Shape shape""",
    "autoware_perception_msgs/PredictedObjects": STAMPED
    + "autoware_perception_msgs/PredictedObject[] objects",
    "autoware_perception_msgs/TrafficLightElement": """uint8 color
uint8 shape
uint8 status
float32 confidence""",
    "autoware_perception_msgs/TrafficLightGroup": """int64 traffic_light_group_id
autoware_perception_msgs/TrafficLightElement[] elements""",
    "autoware_perception_msgs/TrafficLightGroupArray": """\
builtin_interfaces/Time stamp
autoware_perception_msgs/TrafficLightGroup[] traffic_light_groups""",
    "autoware_auto_perception_msgs/TrafficSignal": """int32 map_primitive_id
autoware_perception_msgs/TrafficLightElement[] lights""",
    "autoware_auto_perception_msgs/TrafficSignalArray": STAMPED
    + "autoware_auto_perception_msgs/TrafficSignal[] signals",
    "autoware_vehicle_msgs/ControlModeReport": """builtin_interfaces/Time stamp
uint8 mode""",
    "shape_msgs/SolidPrimitive": "uint8 type\nfloat64[<=3] dimensions",
    "derived_object_msgs/Object": STAMPED
    + """uint32 id
uint8 detection_level
bool object_classified
geometry_msgs/Pose pose
geometry_msgs/Twist twist
geometry_msgs/Accel accel
geometry_msgs/Polygon polygon
shape_msgs/SolidPrimitive shape
uint8 classification
uint8 classification_certainty
uint32 classification_age""",
    "derived_object_msgs/ObjectArray": STAMPED + "derived_object_msgs/Object[] objects",
    "vision_msgs/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/ObjectHypothesisWithPose": """vision_msgs/ObjectHypothesis hypothesis
geometry_msgs/PoseWithCovariance pose""",
    "vision_msgs/BoundingBox3D": """geometry_msgs/Pose center
geometry_msgs/Vector3 size""",
    "vision_msgs/Detection3D": STAMPED
    + """vision_msgs/ObjectHypothesisWithPose[] results
vision_msgs/BoundingBox3D bbox
string id""",
    "vision_msgs/Detection3DArray": STAMPED + "vision_msgs/Detection3D[] detections",
    "sensor_msgs/Image": STAMPED + "uint8[] data",
}
# of before: the same messages in the older package
DEFINITIONS |= {
    name.replace("autoware_p", "autoware_auto_p"): text.replace(
        "autoware_p", "autoware_auto_p"
    )
    for name, text in DEFINITIONS.items()
    if name.startswith("autoware_perception_msgs/") and "Traffic" not in name
}


def definition(name):
    """The definition of a type with those of all types in it, as bags hold it."""
    found, todo = {}, [name]
    while todo:
        one = todo.pop()
        if one in found or one not in DEFINITIONS:
            continue
        found[one] = DEFINITIONS[one]
        kinds = (line.split()[0] for line in found[one].splitlines())
        todo += [kind.partition("[")[0] for kind in kinds]
    first = found.pop(name)
    others = [f"{'=' * 80}\nMSG: {key}\n{text}\n" for key, text in found.items()]
    return f"{first}\n" + "".join(others)
