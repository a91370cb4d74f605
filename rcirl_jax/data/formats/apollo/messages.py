"""Messages of an Apollo drive as rows of numbers, about a minute at a time.

A new field of a message is named in the `wanted` of its topic in TOPICS and put into a
column by the topic's `finish`.
"""

import array
import dataclasses
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from rcirl_jax.data.formats.apollo.descriptors import (
    ENUM,
    UNSET,
    Reading,
    UndescribedError,
    Wanted,
    reading_of,
)
from rcirl_jax.data.formats.apollo.records import Record, check_size
from rcirl_jax.data.formats.messages import check_held, topics_of
from rcirl_jax.data.formats.perception import UNKNOWN
from rcirl_jax.data.readers.protobuf import Message
from rcirl_jax.data.readers.reading import reading
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind

MANUAL = "COMPLETE_MANUAL"  # driving mode of a human driver
PIECE_S = 60.0  # s of recording after which rows are handed on
KIND_NAMES = {
    "PEDESTRIAN": Kind.PEDESTRIAN,
    "BICYCLE": Kind.CYCLIST,
    "VEHICLE": Kind.VEHICLE,
    "UNKNOWN_UNMOVABLE": Kind.STATIC,
}
NAN = float("nan")
# fields and what they are where they are not set
POINT = {"x": NAN, "y": NAN}
STAMP = {"timestamp_sec": 0.0}
QUATERNION = dict.fromkeys(("qx", "qy", "qz", "qw"), NAN)
POSE = {"position": POINT, "orientation": QUATERNION}
POSE |= {"linear_velocity": POINT, "heading": NAN}
OBSTACLE = {
    **{"timestamp": 0.0, "id": 0, "position": POINT, "theta": 0.0},
    **{"velocity": POINT, "length": 0.0, "width": 0.0, "type": ENUM},
}
ROUTE = {"routing_request": {"waypoint": [{"pose": POINT}]}}

Names = Mapping[str, Mapping[int, str]]  # of an enum's values, by field
Values = Callable[[Message], tuple[float, ...]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Topic:
    """Messages that say the same, on the channels of all releases."""

    channels: tuple[str, ...]
    wanted: Wanted  # fields of a message
    read: Callable[[Message], Iterable[tuple[float, ...]]]  # rows of a message
    # rows [n, 1 + m], the time of recording before what was read, as columns of numbers
    finish: Callable[[np.ndarray, Names], np.ndarray]
    width: int  # of these


def _localization(table: np.ndarray, names: Names) -> np.ndarray:
    """Times [s] of header, recording and measurement; x, y, heading, speed."""
    time, stamp, measured, x, y, heading, vx, vy, qx, qy, qz, qw = table.T
    # the quaternion turns (right, forward, up) from east
    yaw = np.arctan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
    heading = np.where(np.isnan(heading), yaw + 0.5 * np.pi, heading)
    return np.stack([stamp, time, measured, x, y, heading, np.hypot(vx, vy)], axis=1)


def _chassis(table: np.ndarray, names: Names) -> np.ndarray:
    """Times [s] of header and recording; speed; 1 where a human drives."""
    time, stamp, speed, mode = table.T
    human = [UNSET, *(n for n, name in names["driving_mode"].items() if name == MANUAL)]
    return np.stack([stamp, time, speed, np.isin(mode, human)], axis=1)


def _obstacles(table: np.ndarray, names: Names) -> np.ndarray:
    """Times [s] as of a localization; id; x, y; heading; speed; length, width; kind.

    NaN where a position, velocity or size was not recorded.
    """
    head, (vx, vy, length, width, number) = table[:, :7], table[:, 7:].T
    numbers, inverse = np.unique(number, return_inverse=True)
    kinds = [KIND_NAMES.get(names["type"].get(int(n), ""), UNKNOWN) for n in numbers]
    series = (
        np.hypot(vx, vy),
        np.where(length == 0.0, np.nan, length),
        np.where(width == 0.0, np.nan, width),
        np.array(kinds, np.float64)[inverse],
    )
    return np.concatenate([head[:, [1, 0, *range(2, 7)]], np.stack(series, 1)], axis=1)


def _destinations(table: np.ndarray, names: Names) -> np.ndarray:
    """Time [s] of recording; x, y [m] where a route ends."""
    return table[np.isfinite(table).all(axis=1)]


_pose: Values = operator.attrgetter(
    *("header.timestamp_sec", "measurement_time", "pose.position.x", "pose.position.y"),
    *("pose.heading", "pose.linear_velocity.x", "pose.linear_velocity.y"),
    *(f"pose.orientation.{name}" for name in QUATERNION),
)
_mode: Values = operator.attrgetter("header.timestamp_sec", "speed_mps", "driving_mode")
_obstacle: Values = operator.attrgetter(
    *("timestamp", "id", "position.x", "position.y", "theta"),
    *("velocity.x", "velocity.y", "length", "width", "type"),
)


def _stamped(message: Message, seen: Iterable[Message]) -> Iterator[tuple[float, ...]]:
    stamp = message.header.timestamp_sec
    return ((stamp, *_obstacle(one)) for one in seen)


def _predicted(message: Message) -> Iterator[Message]:
    for one in message.prediction_obstacle:
        if one.HasField("perception_obstacle"):
            yield one.perception_obstacle


def _end(message: Message) -> list[tuple[float, ...]]:
    """Where a route ends."""
    points = message.routing_request.waypoint[-1:]
    return [(point.pose.x, point.pose.y) for point in points]


def _route(*channels: str, wanted: Wanted = ROUTE, read: Callable = _end) -> Topic:
    return Topic(
        channels=channels, wanted=wanted, read=read, finish=_destinations, width=3
    )


LOCALIZATION = "/apollo/localization/pose"
TOPICS = {
    "localization": Topic(
        channels=(LOCALIZATION,),
        wanted={"header": STAMP, "measurement_time": 0.0, "pose": POSE},
        read=lambda message: [_pose(message)],
        finish=_localization,
        width=7,
    ),
    "chassis": Topic(
        channels=("/apollo/canbus/chassis",),
        wanted={"header": STAMP, "speed_mps": NAN, "driving_mode": ENUM},
        read=lambda message: [_mode(message)],
        finish=_chassis,
        width=4,
    ),
    "perception": Topic(
        channels=("/apollo/perception/obstacles",),
        wanted={"header": STAMP, "perception_obstacle": [OBSTACLE]},
        read=lambda message: _stamped(message, message.perception_obstacle),
        finish=_obstacles,
        width=11,
    ),
    "prediction": Topic(
        channels=("/apollo/prediction",),
        wanted={
            "header": STAMP,
            "prediction_obstacle": [{"perception_obstacle": OBSTACLE}],
        },
        read=lambda message: _stamped(message, _predicted(message)),
        finish=_obstacles,
        width=11,
    ),
    "routing": _route("/apollo/routing_response", "/apollo/raw_routing_response"),
    "routing_history": _route(
        "/apollo/routing_response_history",
        "/apollo/raw_rrouting_response_history",  # so spelt since Apollo 9
    ),
    # since Apollo 9; who listens late is given the last of the history
    "command": _route(
        *("/apollo/planning/command", "/apollo/planning_command_history"),
        wanted={"lane_follow_command": ROUTE},
        read=lambda message: _end(message.lane_follow_command),
    ),
}
OBSTACLES = ("perception", "prediction")


@dataclasses.dataclass(kw_only=True)
class Rows:
    """A piece of a drive: (topic, its rows as `finish` makes them), and notes."""

    tables: list[tuple[str, np.ndarray]]
    notes: list[str] = dataclasses.field(default_factory=list)
    progress: float = 0.0  # share of the drive's bytes that is read


def read_drive(parts: list[Path], spec: dict) -> Iterator[Rows]:
    """All wanted messages of the files of one drive, piece by piece."""
    topics = _topics(spec)
    numbers = dict.fromkeys(TOPICS, 0)  # messages of each topic
    undescribed: dict[str, str] = {}  # channel -> what is wrong with it
    done, total = 0, sum(part.stat().st_size for part in parts if part.is_file())
    with reading(parts[0], parts) as show:

        def count(size: int) -> None:
            nonlocal done
            done += size
            show(size)

        for part in parts:
            with Record(part) as record:
                for rows in _read_part(record, topics, numbers, undescribed, count):
                    rows.progress = min(done / max(total, 1), 1.0)
                    yield rows
    if undescribed and not any(numbers.values()):
        channel, why = next(iter(undescribed.items()))
        raise InputError(f"{parts[0]}: {channel}: {why}: expected an Apollo message")


def _topics(spec: dict) -> dict[str, str]:
    """Channel -> topic."""
    usual = {name: topic.channels for name, topic in TOPICS.items()}
    return {
        channel: topic
        for topic, channels in topics_of(spec, TOPICS, usual).items()
        for channel in channels
    }


class _Channel:
    """Messages of one channel as numbers, one row after the other."""

    def __init__(self, record: Record, channel: str, topic: str) -> None:
        if channel not in record.channels:
            raise UndescribedError("no descriptors before its first message")
        self.topic, self._type = topic, TOPICS[topic]
        self._reading: Reading = reading_of(
            *record.channels[channel], self._type.wanted
        )
        self._values = array.array("d")
        self._width = 1  # of a row

    def add(self, time: float, content: memoryview) -> None:
        """A message recorded at a time [s]."""
        check_size("message", content)
        message = self._reading.parse(bytes(content))
        row = ()
        for row in self._type.read(message):
            self._values.append(time)
            self._values.extend(row)
        self._width = max(self._width, 1 + len(row))

    def count(self) -> int:
        """Rows since the last `rows`."""
        return len(self._values) // self._width

    def rows(self) -> tuple[str, np.ndarray]:
        """The topic, and rows since the last call."""
        values, self._values = np.array(self._values), array.array("d")
        if not values.size:
            return self.topic, np.zeros((0, self._type.width))
        table = values.reshape(-1, self._width)
        return self.topic, self._type.finish(table, self._reading.names)


def _read_part(
    record: Record,
    topics: dict[str, str],
    numbers: dict[str, int],
    undescribed: dict[str, str],
    show: Callable[[int], object],
) -> Iterator[Rows]:
    """Rows of a file; channels without descriptors are noted once and passed over."""
    channels: dict[str, _Channel] = {}
    began, notes = None, []

    def is_wanted(channel: str) -> bool:
        return channel in topics and channel not in undescribed

    for channel, time, content in record.messages(is_wanted, show):
        began = time if began is None else began
        if abs(time - began) > PIECE_S * 1e9:
            yield Rows(tables=[found.rows() for found in channels.values()])
            began = time
        topic = topics[channel]
        try:
            if channel not in channels:
                channels[channel] = _Channel(record, channel, topic)
            channels[channel].add(time * 1e-9, content)
        except UndescribedError as error:
            undescribed[channel] = str(error)
            lost = "; who drove is not known" if topic == "chassis" else ""
            notes.append(f"{channel}: not read: {error}{lost}")
            continue
        except DecodeError as error:
            raise InputError(
                f"{record.path}: {channel}: message {numbers[topic]}: {error}: "
                "expected an Apollo message"
            ) from error
        if topic in OBSTACLES:
            seen = [one.count() for one in channels.values() if one.topic in OBSTACLES]
            check_held(f"{record.path}: {channel}", sum(seen))
        numbers[topic] += 1
    rows = Rows(tables=[found.rows() for found in channels.values()], notes=notes)
    if not record.is_complete:
        rows.notes.append(f"{record.path.name} was never closed; read to its end")
    yield rows
