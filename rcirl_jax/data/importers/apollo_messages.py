"""Messages of an Apollo record as rows of numbers.

Fields are looked up by name in the record's own descriptors; those that a
release of Apollo lacks are NaN or 0.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.importers.apollo_obstacles import Obstacles
from rcirl_jax.data.importers.cyber_record import Record
from rcirl_jax.data.importers.perception import section
from rcirl_jax.data.importers.reading import reading
from rcirl_jax.data.importers.wire import ENUM_NAME, Plan, WireError, decode
from rcirl_jax.errors import InputError

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
MANUAL = "COMPLETE_MANUAL"  # driving mode of a human driver
MAX_ROWS = 20_000_000  # obstacle states of one drive
NAN = float("nan")


@dataclasses.dataclass(kw_only=True)
class Drive:
    """Rows of each topic; the first columns are times [s].

    Times of the header and of the recording; of the localization and of obstacles
    also that of the measurement. Then: x, y [m], heading [rad], speed [m/s] of the
    localization; speed of the chassis; `Obstacles.rows`.
    """

    localization: list[tuple] = dataclasses.field(default_factory=list)
    chassis: list[tuple] = dataclasses.field(default_factory=list)
    # rows of the obstacles of each part, see `Obstacles.rows`
    perception: list[np.ndarray] = dataclasses.field(default_factory=list)
    prediction: list[np.ndarray] = dataclasses.field(default_factory=list)
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
    with reading(parts[0], parts) as show:
        for part in parts:
            with Record(part) as record:
                _read_part(record, names, drive, show)
                if not record.is_complete:
                    drive.notes.append(f"{part.name} was never closed; read to its end")
    return drive


def _read_part(
    record: Record, names: dict[str, str], drive: Drive, show: Callable[[int], object]
) -> None:
    plans: dict[str, Plan] = {}
    obstacles: dict[str, Obstacles] = {}
    for topic, time, content in record.messages(names.__contains__, show):
        key = names[topic]
        number = drive.counts[key] = drive.counts.get(key, -1) + 1
        try:
            if topic not in plans:
                plans[topic] = _plan(record, topic, key)
                if key in ("perception", "prediction"):
                    where = f"{record.path}: {topic}"
                    obstacles[topic] = Obstacles(where, plans[topic])
            if topic in obstacles:
                obstacles[topic].add(time * 1e-9, content)
                _check_count(record, topic, drive, obstacles)
            else:
                _add(drive, key, time * 1e-9, decode(plans[topic], content))
        except WireError as error:
            raise InputError(
                f"{record.path}: {topic}: message {number}: {error}: "
                "expected an Apollo message"
            ) from error
    for topic, found in obstacles.items():
        getattr(drive, names[topic]).append(found.rows())
        found.count = 0
        _check_count(record, topic, drive, obstacles)


def _plan(record: Record, topic: str, key: str) -> Plan:
    if topic not in record.channels:
        raise WireError("no descriptor before its first message")
    message, schema = record.channels[topic]
    return schema.plan(message, WANTED[key])


def _check_count(
    record: Record, topic: str, drive: Drive, obstacles: dict[str, Obstacles]
) -> None:
    done = [len(rows) for rows in (*drive.perception, *drive.prediction)]
    if sum(done) + sum(found.count for found in obstacles.values()) > MAX_ROWS:
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
                math.hypot(*_point(pose, "linear_velocity")),
            )
        )
    elif key == "chassis":
        drive.chassis.append((stamp, time, found.get("speed_mps", NAN)))
        drive.modes.append(found.get("driving_mode", MANUAL) == MANUAL)
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
