"""Messages of an Apollo drive as rows of numbers, about a minute at a time.

Fields are looked up by name in the record's own descriptors; those that a
release of Apollo lacks are NaN or 0.
"""

import collections
import dataclasses
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.importers.apollo.obstacles import Obstacles
from rcirl_jax.data.importers.apollo.records import Record
from rcirl_jax.data.importers.options import section
from rcirl_jax.data.readers.long_logs import reading
from rcirl_jax.data.readers.wire import ENUM_NAME, Plan, WireError, decode
from rcirl_jax.errors import InputError

LOCALIZATION = "/apollo/localization/pose"
# topic -> its channels, of all releases
TOPICS = {
    "localization": (LOCALIZATION,),
    "chassis": ("/apollo/canbus/chassis",),
    "perception": ("/apollo/perception/obstacles",),
    "prediction": ("/apollo/prediction",),
    "routing": ("/apollo/routing_response", "/apollo/raw_routing_response"),
    "routing_history": (
        "/apollo/routing_response_history",
        "/apollo/raw_rrouting_response_history",  # so spelt since Apollo 9
    ),
    # since Apollo 9; who listens late is given the last of the history
    "command": ("/apollo/planning/command", "/apollo/planning_command_history"),
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
    "command": {"lane_follow_command": ROUTE},
}
MANUAL = "COMPLETE_MANUAL"  # driving mode of a human driver
MAX_ROWS = 5_000_000  # obstacle states held at once
PIECE_S = 60.0  # s of recording after which rows are handed on
NAN = float("nan")


@dataclasses.dataclass(kw_only=True)
class Rows:
    """Rows of each topic of a piece of a drive; the first columns are times [s].

    Times of the header and of the recording; of the localization and of obstacles
    also that of the measurement. Then: x, y [m], heading [rad], speed [m/s] of the
    localization; speed of the chassis and 1 where a human drives; `Obstacles.rows`.
    A routing is its time of recording and x, y [m] of the destination.
    """

    localization: list[tuple] = dataclasses.field(default_factory=list)
    chassis: list[tuple] = dataclasses.field(default_factory=list)
    perception: list[np.ndarray] = dataclasses.field(default_factory=list)
    prediction: list[np.ndarray] = dataclasses.field(default_factory=list)
    routing: list[tuple[float, float, float]] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)
    progress: float = 0.0  # share of the drive's bytes that is read


def read_drive(parts: list[Path], spec: dict) -> Iterator[Rows]:
    """All wanted messages of the files of one drive, piece by piece."""
    topics = _topics(spec)
    numbers: collections.Counter[str] = collections.Counter()
    done, total = 0, sum(part.stat().st_size for part in parts if part.is_file())
    with reading(parts[0], parts) as show:

        def count(size: int) -> None:
            nonlocal done
            done += size
            show(size)

        for part in parts:
            with Record(part) as record:
                for rows in _read_part(record, topics, numbers, count):
                    rows.progress = min(done / max(total, 1), 1.0)
                    yield rows


def _topics(spec: dict) -> dict[str, str]:
    """Channel -> topic."""
    found = {**TOPICS, **section(spec, "topics")}
    channels: dict[str, str] = {}
    for topic, names in found.items():
        if topic not in TOPICS:
            raise InputError(
                f"source TOML: topics.{topic}: unknown: expected {', '.join(TOPICS)}"
            )
        every = [names] if isinstance(names, str) else names
        if not isinstance(every, list | tuple) or {*map(type, every)} != {str}:
            raise InputError(
                f"source TOML: topics.{topic}: {names}: expected a channel or a list"
            )
        channels |= dict.fromkeys(every, topic)
    return channels


def _read_part(
    record: Record,
    topics: dict[str, str],
    numbers: collections.Counter[str],
    show: Callable[[int], object],
) -> Iterator[Rows]:
    plans: dict[str, Plan] = {}
    obstacles: dict[str, Obstacles] = {}
    rows, began = Rows(), None
    for channel, time, content in record.messages(topics.__contains__, show):
        began = time if began is None else began
        if abs(time - began) > PIECE_S * 1e9:
            yield _finished(rows, obstacles, topics)
            rows, began = Rows(), time
        topic = topics[channel]
        try:
            if channel not in plans:
                plans[channel] = _plan(record, channel, topic)
                if topic in ("perception", "prediction"):
                    where = f"{record.path}: {channel}"
                    obstacles[channel] = Obstacles(where, plans[channel])
            if channel in obstacles:
                obstacles[channel].add(time * 1e-9, content)
                held = sum(found.count for found in obstacles.values())
                check_held(f"{record.path}: {channel}", held)
            else:
                _add(rows, topic, time * 1e-9, decode(plans[channel], content))
        except WireError as error:
            raise InputError(
                f"{record.path}: {channel}: message {numbers[topic]}: {error}: "
                "expected an Apollo message"
            ) from error
        numbers[topic] += 1
    if not record.is_complete:
        rows.notes.append(f"{record.path.name} was never closed; read to its end")
    yield _finished(rows, obstacles, topics)


def _finished(
    rows: Rows, obstacles: dict[str, Obstacles], topics: dict[str, str]
) -> Rows:
    """The rows with the obstacles decoded until now."""
    for channel, found in obstacles.items():
        getattr(rows, topics[channel]).append(found.rows())
    return rows


def _plan(record: Record, channel: str, topic: str) -> Plan:
    if channel not in record.channels:
        raise WireError("no descriptor before its first message")
    message, schema = record.channels[channel]
    return schema.plan(message, WANTED[topic])


def check_held(where: str, count: int) -> None:
    """No more obstacle states than MAX_ROWS are held."""
    if count > MAX_ROWS:
        raise InputError(
            f"{where}: more than {MAX_ROWS} obstacle states in a few minutes: "
            "expected one drive"
        )


def _add(rows: Rows, topic: str, time: float, found: dict[str, Any]) -> None:
    """Append a decoded message to its topic's rows."""
    stamp = found.get("header", {}).get("timestamp_sec", 0.0)
    if topic == "localization":
        pose = found.get("pose", {})
        rows.localization.append(
            (
                stamp,
                time,
                found.get("measurement_time", 0.0),
                *_point(pose, "position"),
                _heading(pose),
                math.hypot(*_point(pose, "linear_velocity")),
            )
        )
    elif topic == "chassis":
        is_manual = found.get("driving_mode", MANUAL) == MANUAL
        rows.chassis.append((stamp, time, found.get("speed_mps", NAN), is_manual))
    else:
        found = found.get("lane_follow_command", found)
        waypoints = found.get("routing_request", {}).get("waypoint", [])
        x, y = _point(waypoints[-1], "pose") if waypoints else (NAN, NAN)
        if np.isfinite(x) and np.isfinite(y):
            rows.routing.append((time, float(x), float(y)))


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
