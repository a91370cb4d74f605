"""Messages of an Apollo record as rows of numbers.

Fields are looked up by name in the record's own descriptors; those that a
release of Apollo lacks are NaN or 0. Obstacles that perception could not measure
get the size of their class.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.importers.cyber_record import Record
from rcirl_jax.data.importers.perception import UNKNOWN, section
from rcirl_jax.data.importers.wire import ENUM_NAME, Plan, WireError, decode
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind

TOPICS = {
    "localization": "/apollo/localization/pose",
    "chassis": "/apollo/canbus/chassis",
    "perception": "/apollo/perception/obstacles",
    "prediction": "/apollo/prediction",
    "routing": "/apollo/routing_response",
    "routing_history": "/apollo/routing_response_history",
}
POINT = {"x": None, "y": None}
STAMP = {"timestamp_sec": None}
OBSTACLE = {
    "id": None,
    "position": POINT,
    "theta": None,
    "velocity": POINT,
    "length": None,
    "width": None,
    "type": ENUM_NAME,
    "timestamp": None,
}
ROUTE = {"routing_request": {"waypoint": [{"pose": POINT}]}}
WANTED = {
    "localization": {
        "header": STAMP,
        "measurement_time": None,
        "pose": {
            "position": POINT,
            "orientation": dict.fromkeys(("qx", "qy", "qz", "qw")),
            "linear_velocity": POINT,
            "heading": None,
        },
    },
    "chassis": {"header": STAMP, "speed_mps": None, "driving_mode": ENUM_NAME},
    "perception": {"header": STAMP, "perception_obstacle": [OBSTACLE]},
    "prediction": {
        "header": STAMP,
        "prediction_obstacle": [{"perception_obstacle": OBSTACLE}],
    },
    "routing": ROUTE,
    "routing_history": ROUTE,
}
KIND_NAMES = {
    "PEDESTRIAN": Kind.PEDESTRIAN,
    "BICYCLE": Kind.CYCLIST,
    "VEHICLE": Kind.VEHICLE,
    "UNKNOWN_UNMOVABLE": Kind.STATIC,
}
# m, [length, width] where perception measured none
SIZES_M = {
    Kind.VEHICLE: (4.5, 1.8),
    Kind.CYCLIST: (1.8, 0.6),
    Kind.PEDESTRIAN: (0.5, 0.5),
}
OTHER_SIZE_M = (1.0, 1.0)  # m
MANUAL = "COMPLETE_MANUAL"  # driving mode of a human driver
MAX_ROWS = 20_000_000  # obstacle states of one drive
NAN = float("nan")


@dataclasses.dataclass(kw_only=True)
class Drive:
    """Rows of each topic; the first three columns are times [s].

    Times of the header, of the recording and, but for the chassis, of the
    measurement itself. Then: x, y [m], heading [rad], speed [m/s] of the
    localization; speed of the chassis; id, x, y, heading, speed, length, width
    [m], kind of obstacles.
    """

    localization: list[tuple] = dataclasses.field(default_factory=list)
    chassis: list[tuple] = dataclasses.field(default_factory=list)
    perception: list[tuple] = dataclasses.field(default_factory=list)
    prediction: list[tuple] = dataclasses.field(default_factory=list)
    destination: tuple[float, float] | None = None
    modes: list[bool] = dataclasses.field(default_factory=list)  # is manual
    counts: dict[str, int] = dataclasses.field(default_factory=dict)
    notes: list[str] = dataclasses.field(default_factory=list)


def read_drive(parts: list[Path], spec: dict) -> Drive:
    """All wanted messages of the files of one drive."""
    topics = {**TOPICS, **section(spec, "topics")}
    unknown = sorted(set(topics) - set(TOPICS))
    if unknown:
        raise InputError(
            f"source TOML: topics.{unknown[0]}: unknown: expected {', '.join(TOPICS)}"
        )
    names = {str(topic): key for key, topic in topics.items()}
    drive = Drive()
    for part in parts:
        with Record(part) as record:
            _read_part(record, names, drive)
            if not record.is_complete:
                drive.notes.append(f"{part.name} was never closed; read to its end")
    return drive


def _read_part(record: Record, names: dict[str, str], drive: Drive) -> None:
    plans: dict[str, Plan] = {}
    for topic, time, content in record.messages(names.__contains__):
        key = names[topic]
        try:
            if topic not in plans:
                if topic not in record.channels:
                    raise WireError("no descriptor before its first message")
                message, schema = record.channels[topic]
                plans[topic] = schema.plan(message, WANTED[key])
            found = decode(plans[topic], content)
        except WireError as error:
            raise InputError(
                f"{record.path}: {topic}: message {drive.counts.get(key, 0)}: {error}: "
                "expected an Apollo message"
            ) from error
        drive.counts[key] = drive.counts.get(key, 0) + 1
        _add(drive, key, time * 1e-9, found)
        if len(drive.perception) + len(drive.prediction) > MAX_ROWS:
            raise InputError(
                f"{record.path}: {topic}: more than {MAX_ROWS} obstacle states: "
                "expected one drive"
            )


def _add(drive: Drive, key: str, time: float, found: dict[str, Any]) -> None:
    """Append a decoded message to its topic's rows."""
    stamp = found.get("header", {}).get("timestamp_sec", 0.0)
    if key == "localization":
        pose = found.get("pose", {})
        drive.localization.append(
            (
                stamp,
                time,
                found.get("measurement_time", 0.0),
                *_point(pose, "position"),
                _heading(pose),
                np.hypot(*_point(pose, "linear_velocity")),
            )
        )
    elif key == "chassis":
        drive.chassis.append((stamp, time, found.get("speed_mps", NAN)))
        drive.modes.append(found.get("driving_mode", MANUAL) == MANUAL)
    elif key == "perception":
        for obstacle in found.get("perception_obstacle", []):
            drive.perception.append((stamp, time, *_obstacle(obstacle)))
    elif key == "prediction":
        for predicted in found.get("prediction_obstacle", []):
            obstacle = predicted.get("perception_obstacle", {})
            drive.prediction.append((stamp, time, *_obstacle(obstacle)))
    else:
        waypoints = found.get("routing_request", {}).get("waypoint", [])
        x, y = _point(waypoints[-1], "pose") if waypoints else (NAN, NAN)
        if np.isfinite(x) and np.isfinite(y):
            drive.destination = (float(x), float(y))


def _point(message: dict[str, Any], field: str) -> tuple[float, float]:
    point = message.get(field, {})
    return point.get("x", NAN), point.get("y", NAN)


def _heading(pose: dict[str, Any]) -> float:
    """Heading [rad] from east; the quaternion turns (right, forward, up) from east."""
    if "heading" in pose:
        return pose["heading"]
    q = pose.get("orientation", {})
    qx, qy, qz, qw = (q.get(name, NAN) for name in ("qx", "qy", "qz", "qw"))
    yaw = np.arctan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
    return float(yaw + 0.5 * np.pi)


def _obstacle(obstacle: dict[str, Any]) -> tuple:
    """Own time, id, x, y, theta, speed, length, width, kind."""
    kind = int(KIND_NAMES.get(obstacle.get("type", "UNKNOWN"), UNKNOWN))
    length, width = SIZES_M.get(Kind(max(kind, 0)), OTHER_SIZE_M)
    return (
        obstacle.get("timestamp", 0.0),
        obstacle.get("id", -1),
        *_point(obstacle, "position"),
        obstacle.get("theta", 0.0),
        np.hypot(*_point(obstacle, "velocity")),
        obstacle.get("length") or length,
        obstacle.get("width") or width,
        kind,
    )
