"""Messages of an Apollo drive as rows of numbers, about a minute at a time.

A new field of a message is named in `WANTED` and read in `_add`.
"""

import collections
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from rcirl_jax.data.importers.apollo.descriptors import ENUM, Reading, reading_of
from rcirl_jax.data.importers.apollo.obstacles import Obstacles
from rcirl_jax.data.importers.apollo.records import Record, check_size
from rcirl_jax.data.importers.options import section
from rcirl_jax.data.readers.protobuf import Message
from rcirl_jax.data.readers.reading import reading
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
NAN = float("nan")
# fields and what they are where they are not set
POINT = {"x": NAN, "y": NAN}
STAMP = {"timestamp_sec": 0.0}
OBSTACLE = {
    "id": 0,
    "position": POINT,
    "theta": 0.0,
    "velocity": POINT,
    "length": 0.0,
    "width": 0.0,
    "type": ENUM,
    "timestamp": 0.0,
}
ROUTE = {"routing_request": {"waypoint": [{"pose": POINT}]}}
WANTED = {
    "localization": {
        "header": STAMP,
        "measurement_time": 0.0,
        "pose": {
            "position": POINT,
            "orientation": dict.fromkeys(("qx", "qy", "qz", "qw"), NAN),
            "linear_velocity": POINT,
            "heading": NAN,
        },
    },
    "chassis": {"header": STAMP, "speed_mps": NAN, "driving_mode": ENUM},
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
    readings: dict[str, Reading] = {}
    obstacles: dict[str, Obstacles] = {}
    rows, began = Rows(), None
    for channel, time, content in record.messages(topics.__contains__, show):
        began = time if began is None else began
        if abs(time - began) > PIECE_S * 1e9:
            yield _finished(rows, obstacles, topics)
            rows, began = Rows(), time
        topic = topics[channel]
        try:
            if channel not in readings:
                readings[channel] = _reading(record, channel, topic)
                if topic in ("perception", "prediction"):
                    obstacles[channel] = Obstacles(readings[channel].names["type"])
            check_size("message", content)
            message = readings[channel].parse(bytes(content))
        except DecodeError as error:
            raise InputError(
                f"{record.path}: {channel}: message {numbers[topic]}: {error}: "
                "expected an Apollo message"
            ) from error
        if channel in obstacles:
            seen = _seen(message, topic)
            held = sum(found.count for found in obstacles.values())
            check_held(f"{record.path}: {channel}", held + len(seen))
            obstacles[channel].add(message.header.timestamp_sec, time * 1e-9, seen)
        else:
            _add(rows, topic, time * 1e-9, message, readings[channel].names)
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


def _reading(record: Record, channel: str, topic: str) -> Reading:
    if channel not in record.channels:
        raise DecodeError("no descriptor before its first message")
    return reading_of(*record.channels[channel], WANTED[topic])


def check_held(where: str, count: int) -> None:
    """No more obstacle states than MAX_ROWS are held."""
    if count > MAX_ROWS:
        raise InputError(
            f"{where}: more than {MAX_ROWS} obstacle states in a few minutes: "
            "expected one drive"
        )


def _seen(message: Message, topic: str) -> Sequence[Message]:
    """Perception's obstacles, of its own message or of prediction's."""
    if topic == "perception":
        return message.perception_obstacle
    return [
        predicted.perception_obstacle
        for predicted in message.prediction_obstacle
        if predicted.HasField("perception_obstacle")
    ]


def _add(
    rows: Rows,
    topic: str,
    time: float,
    message: Message,
    names: Mapping[str, Mapping[int, str]],
) -> None:
    """Append a message of another topic to its rows; `names` are those of enums."""
    if topic == "localization":
        pose = message.pose
        row = (
            *(message.header.timestamp_sec, time, message.measurement_time),
            *(pose.position.x, pose.position.y, _heading(pose)),
            math.hypot(pose.linear_velocity.x, pose.linear_velocity.y),
        )
        rows.localization.append(row)
    elif topic == "chassis":
        mode = names["driving_mode"].get(message.driving_mode)
        is_manual = mode == MANUAL or not message.HasField("driving_mode")
        stamp, speed = message.header.timestamp_sec, message.speed_mps
        rows.chassis.append((stamp, time, speed, is_manual))
    else:
        route = message.lane_follow_command if topic == "command" else message
        waypoints = route.routing_request.waypoint
        x, y = (waypoints[-1].pose.x, waypoints[-1].pose.y) if waypoints else (NAN, NAN)
        if math.isfinite(x) and math.isfinite(y):
            rows.routing.append((time, x, y))


def _heading(pose: Message) -> float:
    """Heading [rad] from east; the quaternion turns (right, forward, up) from east."""
    if pose.HasField("heading"):
        return pose.heading
    q = pose.orientation
    qx, qy, qz, qw = q.qx, q.qy, q.qz, q.qw
    yaw = np.arctan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
    return float(yaw + 0.5 * np.pi)
