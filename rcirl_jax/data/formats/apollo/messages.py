"""Messages of an Apollo drive as rows of numbers, about a minute at a time.

They are read by the descriptors that the record holds for each channel, fields by
name, so that records of every release read alike. What is not wanted is not parsed.
Fields that a release lacks, and those that a message does not set, are NaN, 0 or
UNSET. A new field of a message is named in the `wanted` of its topic in TOPICS and put
into a column by the topic's `finish`.
"""

import array
import dataclasses
import itertools
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2 as pb
from google.protobuf.message import DecodeError

from rcirl_jax.data.formats.apollo.records import Record, check_size
from rcirl_jax.data.formats.messages import PIECE_S, Rows, check_held, topics_of
from rcirl_jax.data.formats.perception import UNKNOWN
from rcirl_jax.data.readers.protobuf import Field, Message, parser, table_of
from rcirl_jax.data.readers.reading import reading
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind

MANUAL = "COMPLETE_MANUAL"  # driving mode of a human driver
KIND_NAMES = {
    "PEDESTRIAN": Kind.PEDESTRIAN,
    "BICYCLE": Kind.CYCLIST,
    "VEHICLE": Kind.VEHICLE,
    "UNKNOWN_UNMOVABLE": Kind.STATIC,
}
MAX_TYPES = 100_000  # messages and enums of a channel's descriptors
# fields that every release has
NEEDED = (
    *("header", "timestamp_sec", "perception_obstacle", "prediction_obstacle"),
    *("id", "position", "velocity", "x", "y"),
)
LACKING = 2**29 - 1  # the highest number of a field, for one that a release lacks
NO_NUMBERS = ("string", "bytes", "message", "group", "enum")
PROTO_DESC = "ProtoDesc: desc 1 bytes, dependencies 2 ProtoDesc*"
_read_proto_desc = parser(table_of(PROTO_DESC))

# field -> its default for a number, ENUM, a dict for a message, a list of one dict for
# repeated ones
Wanted = Mapping[str, Any]
ENUM = "enum"  # a field that is wanted as the number of an enum's value
UNSET = -1  # that number where the message does not set it
NAN = math.nan
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


# ------------------------------------------------------------------- channels


class UndescribedError(DecodeError):
    """A channel that its record does not describe."""


def reading_of(
    message: str, proto_desc: bytes, wanted: Wanted
) -> tuple[Callable[[bytes], Message], Names]:
    """Makes what parses wanted fields of a message type, and names of enums' values.

    Args:
      message: full name, e.g. "apollo.localization.LocalizationEstimate".
      proto_desc: ProtoDesc of the file that defines it, with all those it imports.
      wanted: fields of the message.

    Raises:
      UndescribedError: there are no descriptors.
      DecodeError: damaged descriptors, an unknown message type, a field of another
        type than wanted, or none that is needed.
    """
    files = [*dict.fromkeys(_contents(_read_proto_desc(proto_desc)))]
    if not any(files):
        raise UndescribedError(f"message type {message}: no descriptors")
    known: dict[str, Any] = {}
    for content in files:
        file = pb.FileDescriptorProto.FromString(content)
        _add_types(known, file.package, (*file.enum_type, *file.message_type))
    tables: dict[str, dict[str, Field]] = {}
    names: dict[str, dict[int, str]] = {}

    def table_for(kind: str | None, wanted: Wanted) -> str:
        """Makes the table of a message type; None: of one that a release lacks."""
        found = known.get(kind) if kind is not None else pb.DescriptorProto()
        if not isinstance(found, pb.DescriptorProto):
            raise DecodeError(f"message type {kind}: not among the descriptors")
        own = f"Message{len(tables)}"
        table = tables[own] = {}
        fields = {field.name: field for field in found.field}
        for place, (name, want) in enumerate(wanted.items()):
            if kind is not None and name in NEEDED and name not in fields:
                raise DecodeError(f"field {name}: not among the descriptors")
            table[name] = field_for(
                fields.get(name), LACKING - place, f"{kind}.{name}", want
            )
        return own

    def field_for(
        field: pb.FieldDescriptorProto | None,
        number: int,
        where: str,
        want: Any,  # noqa: ANN401 - see Wanted
    ) -> Field:
        """Makes a field; one that a release lacks by a number that no message has."""
        kind, below, is_list = "double", None, isinstance(want, list)
        if field is not None:
            kind = field.Type.Name(field.type).removeprefix("TYPE_").lower()
            number, below = field.number, str(field.type_name).lstrip(".")
            if isinstance(want, dict | list):
                fits = kind == "message"
            else:
                fits = kind == ENUM if want == ENUM else kind not in NO_NUMBERS
            if is_list != (field.label == field.LABEL_REPEATED) or not fits:
                raise DecodeError(f"{where}: type {kind}: another is known")
        if isinstance(want, dict | list):
            inner = want[0] if isinstance(want, list) else want
            return Field(table_for(below, inner), number, is_list)
        if want == ENUM:
            values = getattr(known.get(below or ""), "value", ())
            name = where.rpartition(".")[2]
            names[name] = {value.number: value.name for value in values}
            return Field("int32", number, default=str(UNSET))
        is_unset = kind in ("double", "float") and math.isnan(want)
        return Field(kind, number, default="nan" if is_unset else "")

    table_for(message, wanted)
    try:
        return parser(tables), names
    except TypeError as error:
        raise DecodeError(f"{message}: {error}") from error


def _contents(found: Message) -> Iterator[bytes]:
    """The FileDescriptorProto of a ProtoDesc and of those that it depends on."""
    yield found.desc
    yield from itertools.chain.from_iterable(map(_contents, found.dependencies))


def _add_types(known: dict[str, Any], scope: str, types: Iterable) -> None:
    """Adds types of a file or of a message by full name, and those nested in them."""
    for found in types:
        name = f"{scope}.{found.name}".lstrip(".")
        known[name] = found
        if isinstance(found, pb.DescriptorProto):
            _add_types(known, name, (*found.enum_type, *found.nested_type))
    if len(known) > MAX_TYPES:
        raise DecodeError(f"descriptors: more than {MAX_TYPES} types")


# --------------------------------------------------------------------- topics


@dataclasses.dataclass(frozen=True, kw_only=True)
class Topic:
    """Messages that say the same, on the channels of all releases."""

    channels: tuple[str, ...]
    role: str  # of the rows
    wanted: Wanted  # fields of a message
    read: Callable[[Message], Iterable[tuple[float, ...]]]  # rows of a message
    # rows [n, 1 + m], the time of recording before what was read, as columns of numbers
    finish: Callable[[np.ndarray, Names], np.ndarray]


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


_pose = operator.attrgetter(
    *("header.timestamp_sec", "measurement_time", "pose.position.x", "pose.position.y"),
    *("pose.heading", "pose.linear_velocity.x", "pose.linear_velocity.y"),
    *(f"pose.orientation.{name}" for name in QUATERNION),
)
_mode = operator.attrgetter("header.timestamp_sec", "speed_mps", "driving_mode")
_obstacle = operator.attrgetter(
    *("timestamp", "id", "position.x", "position.y", "theta"),
    *("velocity.x", "velocity.y", "length", "width", "type"),
)


def _perceived(message: Message) -> Iterator[tuple[float, ...]]:
    for one in message.perception_obstacle:
        yield message.header.timestamp_sec, *_obstacle(one)


def _predicted(message: Message) -> Iterator[tuple[float, ...]]:
    for one in message.prediction_obstacle:
        if one.HasField("perception_obstacle"):
            yield message.header.timestamp_sec, *_obstacle(one.perception_obstacle)


def _end(message: Message) -> list[tuple[float, ...]]:
    """Where a route ends."""
    points = message.routing_request.waypoint[-1:]
    return [(point.pose.x, point.pose.y) for point in points]


def _route(*channels: str, wanted: Wanted = ROUTE, read: Callable = _end) -> Topic:
    return Topic(
        channels=channels,
        role="routing",
        wanted=wanted,
        read=read,
        finish=_destinations,
    )


LOCALIZATION = "/apollo/localization/pose"
TOPICS = {
    "localization": Topic(
        channels=(LOCALIZATION,),
        role="localization",
        wanted={"header": STAMP, "measurement_time": 0.0, "pose": POSE},
        read=lambda message: [_pose(message)],
        finish=_localization,
    ),
    "chassis": Topic(
        channels=("/apollo/canbus/chassis",),
        role="chassis",
        wanted={"header": STAMP, "speed_mps": NAN, "driving_mode": ENUM},
        read=lambda message: [_mode(message)],
        finish=_chassis,
    ),
    "perception": Topic(
        channels=("/apollo/perception/obstacles",),
        role="perception",
        wanted={"header": STAMP, "perception_obstacle": [OBSTACLE]},
        read=_perceived,
        finish=_obstacles,
    ),
    "prediction": Topic(
        channels=("/apollo/prediction",),
        role="prediction",
        wanted={
            "header": STAMP,
            "prediction_obstacle": [{"perception_obstacle": OBSTACLE}],
        },
        read=_predicted,
        finish=_obstacles,
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
# columns by role, as `finish` makes them
WIDTHS = {"localization": 7, "chassis": 4, **dict.fromkeys(OBSTACLES, 11), "routing": 3}


# --------------------------------------------------------------------- drives


def read_drive(files: list[Path], spec: dict) -> Iterator[Rows]:
    """Reads all wanted messages of the files of one drive, piece by piece."""
    usual = {name: topic.channels for name, topic in TOPICS.items()}
    topics = {
        channel: topic
        for topic, channels in topics_of(spec, usual).items()
        for channel in channels
    }
    numbers = dict.fromkeys(TOPICS, 0)  # messages of each topic
    undescribed: dict[str, str] = {}  # channel -> what is wrong with it
    done, total = 0, sum(file.stat().st_size for file in files if file.is_file())
    with reading(files[0], files) as show:

        def count(size: int) -> None:
            nonlocal done
            done += size
            show(size)

        for file in files:
            for rows in _read_file(Record(file), topics, numbers, undescribed, count):
                rows.progress = min(done / max(total, 1), 1.0)
                yield rows
    if undescribed and not any(numbers.values()):
        channel, why = next(iter(undescribed.items()))
        raise InputError(f"{files[0]}: {channel}: {why}: expected an Apollo message")


class _Channel:
    """Messages of one channel as numbers, one row after the other."""

    def __init__(self, record: Record, channel: str, topic: str) -> None:
        if channel not in record.channels:
            raise UndescribedError("no descriptors before its first message")
        self.topic, self._type = topic, TOPICS[topic]
        self._parse, self._names = reading_of(
            *record.channels[channel], self._type.wanted
        )
        self.values, self.width = array.array("d"), 1

    def add(self, time: float, content: memoryview) -> None:
        """Appends rows of a message recorded at a time [s]."""
        check_size("message", content)
        for row in self._type.read(self._parse(bytes(content))):
            self.values.append(time)
            self.values.extend(row)
            self.width = 1 + len(row)

    def rows(self) -> tuple[str, np.ndarray]:
        """Returns the role, and rows since the last call."""
        values, self.values = np.array(self.values), array.array("d")
        if not values.size:
            return self._type.role, np.zeros((0, WIDTHS[self._type.role]))
        table = values.reshape(-1, self.width)
        return self._type.role, self._type.finish(table, self._names)


def _read_file(
    record: Record,
    topics: dict[str, str],
    numbers: dict[str, int],
    undescribed: dict[str, str],
    show: Callable[[int], object],
) -> Iterator[Rows]:
    """Rows of a file; channels without descriptors are noted once and passed over."""
    channels: dict[str, _Channel] = {}
    began, notes = None, []

    def rows() -> Rows:
        tables = {role: [np.zeros((0, width))] for role, width in WIDTHS.items()}
        for channel in channels.values():
            role, table = channel.rows()
            tables[role].append(table)
        return Rows(tables={role: np.concatenate(t) for role, t in tables.items()})

    def is_wanted(channel: str) -> bool:
        return channel in topics and channel not in undescribed

    for channel, time, content in record.messages(is_wanted, show):
        began = time if began is None else began
        if abs(time - began) > PIECE_S * 1e9:
            yield rows()
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
            seen = [one for one in channels.values() if one.topic in OBSTACLES]
            held = sum(len(one.values) // one.width for one in seen)
            check_held(f"{record.path}: {channel}", held)
        numbers[topic] += 1
    last = rows()
    if not record.is_complete:
        notes.append(f"{record.path.name} was never closed; read to its end")
    last.notes = notes
    yield last
