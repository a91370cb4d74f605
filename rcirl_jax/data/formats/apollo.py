"""Baidu Apollo's cyber records: localization, chassis, obstacles, routing.

Read: `*.record`, `*.record.00000`, `.00001`, ... of Apollo 3.5 and later; the
parts of one drive make one Recording, or one per window of a long drive. The
numbers of the messages' fields are those of modules/common_msgs in the Apollo
sources, the same in all releases.

Traps: a pose is that of the rear axle's centre, not of the box; the quaternion's
zero is north, the heading's is east; messages are irregular and on clocks of
their own, so everything is put on one uniform clock; where perception recorded
nothing, prediction repeats its obstacles; a drive may be the planner's own, not
a human's; a drive may have several destinations, and the ego is another track
from each new one on.

Layout of a record: cyber/proto/record.proto and cyber/record/file in the sources. A
section has a head of 16 bytes (type int32, 4 bytes unused, size int64); that of the
header takes 2048 bytes, however short the header is. Sections are walked from the
start and not by the index, so records that were never closed can be read as well.
"""

import dataclasses
import math
import mmap
import re
import struct
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from rcirl_jax.data.formats.files import files_below, log_name
from rcirl_jax.data.formats.messages import Drive, Row, Window, topics_of
from rcirl_jax.data.formats.options import one_pattern
from rcirl_jax.data.formats.perception import UNKNOWN
from rcirl_jax.data.readers.protobuf import Message, parsers
from rcirl_jax.data.readers.reading import reading
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Recording, Track

HEAD = struct.Struct("<i4xq")  # type and size of a section
HEADER_BYTES = 2048  # bytes that the header's section takes
HEADER, CHUNK_HEADER, CHUNK_BODY, INDEX, CHANNEL = range(5)
MAX_BYTES = 16 * 1024**2  # bytes of a message, or of what is said of a channel
VARINT, LENGTH = 0, 2  # wire types
SIZES = {1: 8, 5: 4}  # bytes of those of one size
# NAME.record, or a part .record.00000; some releases add when it began, .112907, and
# cyber_recorder what it did to a copy
NAME = re.compile(
    r"[^/]+?\.record(?:\.(?P<part>\d{1,9})(?:\.\d{1,20})?)?(?:\.(?:split|recover))?"
)

SECTIONS = parsers(
    """
Header: compress 3 int64, is_complete 13 bool
Channel: name 1 string, message_type 2 string
"""
)


class Run:
    """A record and, if it is a part, those that follow: .00000, .00001, ..."""

    def __init__(self, first: Path) -> None:
        match = NAME.fullmatch(first.name)
        is_part = match is not None and match["part"] is not None
        drive, number = _drive_and_part(first)
        beside = first.parent.glob("*.record.*") if is_part else ()
        known = _drives(beside).get(drive, {})
        self.first, self.drive, self.files = first, drive.name, [first]
        while (following := known.get(number + len(self.files))) is not None:
            self.files.append(following)
        # its drive's, and its part behind a missing one
        is_first = number <= min(known, default=0)
        self.name = self.drive if is_first else f"{self.drive}-{number:05d}"
        # the drive has other parts, which do not follow
        self.is_cut = len(known) > len(self.files)


def first_parts(folder: Path, pattern: str) -> list[Path]:
    """Lists the first file of each run of parts at any depth of a folder, sorted."""
    drives = _drives(files_below(folder, pattern)).values()
    firsts = [f for parts in drives for n, f in parts.items() if n - 1 not in parts]
    if not firsts:
        raise InputError(f"{folder}: no file matches {pattern}: expected cyber records")
    return sorted(firsts)


def _drives(files: Iterable[Path]) -> dict[Path, dict[int, Path]]:
    """Parts by drive and number; of a file and its copies the shortest name counts."""
    drives: dict[Path, dict[int, Path]] = {}
    for file in filter(lambda one: NAME.fullmatch(one.name), sorted(files)):
        drive, number = _drive_and_part(file)
        drives.setdefault(drive, {}).setdefault(number, file)
    return drives


def _drive_and_part(file: Path) -> tuple[Path, int]:
    """Drive of a record, told from those of its name in other folders; its number."""
    match = NAME.fullmatch(file.name)
    number = int(match["part"] or 0) if match else 0
    return file.parent / file.name.split(".record")[0], number


class Record:
    """One record file; its messages are read once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.types: dict[str, str] = {}  # channel -> type of its messages
        self.is_complete = True

    def _error(self, field: str, found: object, expected: str) -> InputError:
        return InputError(f"{self.path}: {field}: {found}: expected {expected}")

    def messages(
        self, wanted: Container[str], show: Callable[[int], object] = lambda _: None
    ) -> Iterator[tuple[str, int, memoryview]]:
        """Yields (channel, time ns, content) of the messages on the wanted channels.

        Args:
          wanted: names of channels.
          show: called with the bytes of each section that has been read.
        """
        try:
            with self.path.open("rb") as handle:
                whole = mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise self._error("record", error, "a cyber record") from error
        try:
            for kind, section in self._sections(memoryview(whole)):
                if kind == CHANNEL:
                    check_size("channel", section)
                    channel = SECTIONS["Channel"](bytes(section))
                    self.types[channel.name] = channel.message_type
                elif kind == CHUNK_BODY:
                    for number, value in _fields(section):
                        if number == 1 and (sent := _message(value))[0] in wanted:
                            yield sent
                show(len(section))
        except DecodeError as error:
            raise InputError(
                f"{self.path}: {error}: expected a cyber record"
            ) from error

    def _sections(self, data: memoryview) -> Iterator[tuple[int, memoryview]]:
        """(type, content) of the sections behind the header, up to the index."""
        at, end = HEAD.size + HEADER_BYTES, len(data)
        kind, size = HEAD.unpack_from(data) if end >= at else (-1, end)
        if kind != HEADER or not 0 <= size <= HEADER_BYTES:
            found = f"type {kind}, {size} bytes"
            raise self._error("header", found, "that of a cyber record")
        header = SECTIONS["Header"](bytes(data[HEAD.size : HEAD.size + size]))
        if header.compress != 0:
            expected = "0, none (no Apollo release writes compressed chunks)"
            raise self._error("header: compress", header.compress, expected)
        self.is_complete = header.is_complete
        # behind the index is the rest of a file written over
        while at < end and kind != INDEX:
            size, where = HEAD.size, at
            if size <= end - at:
                kind, size = HEAD.unpack_from(data, at)
                at += HEAD.size
                if not HEADER < kind <= CHANNEL or size < 0:
                    found, expected = f"type {kind}, {size} bytes", "type 1 to 4"
                    raise self._error(f"section at byte {where}", found, expected)
            if size > end - at:
                found = f"{size} bytes of {end - at} left"
                expected = "a whole record; truncated?"
                raise self._error(f"section at byte {where}", found, expected)
            yield kind, data[at : at + size]
            at += size


def check_size(what: str, content: memoryview) -> None:
    """Refuses long content: parsed, a message takes many times its bytes."""
    if len(content) > MAX_BYTES:
        raise DecodeError(f"{what}: {len(content)} bytes of at most {MAX_BYTES}")


def _message(single: int | memoryview) -> tuple[str, int, memoryview]:
    """SingleMessage: channel_name 1, time 2, content 3."""
    found: dict[int, Any] = {1: b"", 2: 0, 3: memoryview(b""), **dict(_fields(single))}
    name, time, content = found[1], found[2], found[3]
    if isinstance(name, int) or not isinstance(time, int) or isinstance(content, int):
        raise DecodeError("message: a number for bytes")
    return bytes(name).decode(errors="replace"), time, content


def _fields(buffer: int | memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """(number, value) of a message's whole numbers and bytes; nothing is copied.

    By hand: the library copies all pictures and point clouds, in eight times the time.
    """
    if isinstance(buffer, int):
        raise DecodeError("message: number: expected bytes")
    at, end = 0, len(buffer)
    while at < end:
        key, at = _varint(buffer, at)
        number, wire = key >> 3, key & 7
        value, size = None, SIZES.get(wire, 0)
        if wire == VARINT:
            value, at = _varint(buffer, at)
        elif wire == LENGTH:
            size, at = _varint(buffer, at)
        elif not size:
            raise DecodeError(f"field {number}: wire type {wire}")
        if size > end - at:
            raise DecodeError(f"field {number}: {size} bytes of {end - at} left")
        if wire == LENGTH:
            value = buffer[at : at + size]
        at += size
        if value is not None:
            yield number, value


def _varint(buffer: memoryview, at: int) -> tuple[int, int]:
    """(value, place behind it) of a base-128 number of at most ten bytes."""
    if at < len(buffer) and buffer[at] < 0x80:  # most are short
        return buffer[at], at + 1
    value = 0
    for place, byte in enumerate(buffer[at : at + 10]):
        value |= (byte & 0x7F) << (7 * place)
        if byte < 0x80:
            return value, at + place + 1
    raise DecodeError("varint: no end within ten bytes")


# the fields that are read; whole numbers and enums are int64, as coded they are alike
SCHEMA = """
Header: timestamp_sec 1 double
Point: x 1 double=nan, y 2 double=nan
Quaternion: qx 1 double=nan, qy 2 double=nan, qz 3 double=nan, qw 4 double=nan
Pose: position 1 Point, orientation 2 Quaternion, linear_velocity 3 Point,\
 heading 6 double=nan
LocalizationEstimate: header 1 Header, pose 2 Pose, measurement_time 4 double
Chassis: speed_mps 5 float=nan, driving_mode 21 int64, header 25 Header
PerceptionObstacle: id 1 int64, position 2 Point, theta 3 double, velocity 4 Point,\
 length 5 double, width 6 double, type 10 int64, timestamp 11 double
PerceptionObstacles: perception_obstacle 1 PerceptionObstacle*, header 2 Header
PredictionObstacle: perception_obstacle 1 PerceptionObstacle
PredictionObstacles: header 1 Header, prediction_obstacle 2 PredictionObstacle*
LaneWaypoint: pose 3 Point
RoutingRequest: waypoint 2 LaneWaypoint*
RoutingResponse: routing_request 4 RoutingRequest
PlanningCommand: lane_follow_command 3 RoutingResponse
"""
PARSERS = parsers(SCHEMA)
MANUAL = 0  # Chassis.DrivingMode of a human driver, COMPLETE_MANUAL
# PerceptionObstacle.Type: UNKNOWN_UNMOVABLE, PEDESTRIAN, BICYCLE, VEHICLE
KINDS = {2: Kind.STATIC, 3: Kind.PEDESTRIAN, 4: Kind.CYCLIST, 5: Kind.VEHICLE}
CLOCK_TOLERANCE_S = 1.0  # s, two topics' clocks differ by more: not one clock
REPEAT_S = 1.5  # s; Apollo sends the routing in force again every second
OBSTACLES = ("perception", "prediction")
# role -> columns of its rows, as `Drive` has them, and the time of recording, s
WIDTHS = {"ego": 6, "velocity": 3, "driver": 3, "perception": 10, "prediction": 10}
WIDTHS["routing"] = 3  # x, y where a route ends

Leg = tuple[float, tuple[float, float] | None]  # s, from when on; destination, m


# --------------------------------------------------------------------- topics


_pose = attrgetter(
    *("header.timestamp_sec", "measurement_time", "pose.position.x", "pose.position.y"),
    *("pose.heading", "pose.linear_velocity.x", "pose.linear_velocity.y"),
    *(f"pose.orientation.{name}" for name in ("qx", "qy", "qz", "qw")),
)
_mode = attrgetter("header.timestamp_sec", "speed_mps", "driving_mode")
_obstacle = attrgetter(
    *("timestamp", "id", "position.x", "position.y", "theta"),
    *("velocity.x", "velocity.y", "length", "width", "type"),
)


def _stamp(sent: float, own: float) -> float:
    """The time of measurement, s; that of the header where it is on another clock."""
    return own if abs(own - sent) <= CLOCK_TOLERANCE_S else sent


def _localization(message: Message) -> Iterator[tuple[str, Row]]:
    sent, own, x, y, heading, vx, vy, qx, qy, qz, qw = _pose(message)
    if math.isnan(heading):  # the quaternion turns (right, forward, up) from east
        yaw = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
        heading = yaw + 0.5 * math.pi
    yield "ego", (_stamp(sent, own), x, y, heading, math.hypot(vx, vy))


def _chassis(message: Message) -> Iterator[tuple[str, Row]]:
    sent, speed, mode = _mode(message)
    yield "velocity", (sent, speed)
    yield "driver", (sent, float(mode == MANUAL))


def _state(role: str, sent: float, obstacle: Message) -> tuple[str, Row]:
    """A row of an obstacle; NaN: a position, velocity or size that is not recorded."""
    own, number, x, y, theta, vx, vy, length, width, kind = _obstacle(obstacle)
    size = length or math.nan, width or math.nan
    place = _stamp(sent, own), float(number), x, y, theta
    return role, (*place, math.hypot(vx, vy), *size, float(KINDS.get(kind, UNKNOWN)))


def _perceived(message: Message) -> Iterator[tuple[str, Row]]:
    sent = message.header.timestamp_sec
    for one in message.perception_obstacle:
        yield _state("perception", sent, one)


def _predicted(message: Message) -> Iterator[tuple[str, Row]]:
    sent = message.header.timestamp_sec
    for one in message.prediction_obstacle:
        if one.HasField("perception_obstacle"):
            yield _state("prediction", sent, one.perception_obstacle)


def _end(message: Message) -> Iterator[tuple[str, Row]]:
    """Returns the end of a route, m."""
    for point in message.routing_request.waypoint[-1:]:
        x, y = point.pose.x, point.pose.y
        if math.isfinite(x) and math.isfinite(y):
            yield "routing", (x, y)


# topic of the source TOML, with the channels of all releases -> type of its messages,
# without its package, and what makes rows by role of one
TOPICS: dict[str, tuple[str, Callable[[Message], Iterator[tuple[str, Row]]]]] = {
    "localization": ("LocalizationEstimate", _localization),
    "chassis": ("Chassis", _chassis),
    "perception": ("PerceptionObstacles", _perceived),
    "prediction": ("PredictionObstacles", _predicted),
    "routing": ("RoutingResponse", _end),
    "routing_history": ("RoutingResponse", _end),
    # since Apollo 9; who listens late is given the last of the history
    "command": ("PlanningCommand", lambda sent: _end(sent.lane_follow_command)),
}


# --------------------------------------------------------------------- drives


def parts(path: Path, spec: dict) -> list[Path]:
    """Lists the first file of each run of parts: runs can be read alone."""
    if path.is_file():
        return [path]
    return first_parts(path, one_pattern(spec))


def files_of(first: Path) -> list[Path]:
    """Lists the files of a run, by its first one."""
    return Run(first).files


def own_name(first: Path) -> str:
    """Returns the name of a run, as long as no other folder has one called alike."""
    return Run(first).name


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per drive, or per window of a long one, or run of parts."""
    for first in parts(path, spec):
        yield from ApolloDrive(Run(first), spec).recordings()


class ApolloDrive(Drive):
    """Rows of a drive, put onto one clock: of measurement, or of recording.

    Where topics are stamped on different clocks, the times of recording, in the last
    column, are common to all.
    """

    widths = WIDTHS
    obstacles = OBSTACLES
    stamp_field = "timestamp_sec"
    by_hand = "in COMPLETE_MANUAL"
    has_no_map = "records hold no map"

    def __init__(self, run: Run, spec: dict) -> None:
        name = log_name(run.first, spec, run.name)
        super().__init__(run.first, spec, name, run.drive)
        self.run = run
        self._offset = 0.0  # s, what the clock shows less the time of recording
        self._is_one_clock = True

    def rows(self) -> Iterator[tuple[str, float, float, Row]]:
        """Yields the rows of all wanted messages in the order of recording."""
        wanted = {
            channel: TOPICS[name]
            for name, channels in topics_of(self.spec, TOPICS).items()
            for channel in channels
        }
        files, numbers, done = self.run.files, dict.fromkeys(wanted, 0), 0
        total = max(sum(file.stat().st_size for file in files if file.is_file()), 1)
        with reading(self.path, files) as show:

            def count(size: int) -> None:
                nonlocal done
                done += size
                show(size)

            for file in files:
                record = Record(file)
                for channel, time, content in record.messages(wanted, count):
                    kind, rows_of = wanted[channel]
                    where = f"{file}: {channel}: message {numbers[channel]}"
                    found = record.types.get(channel) or kind
                    if found.rpartition(".")[2] != kind:
                        raise InputError(
                            f"{where}: type {found!a:.80}: expected {kind}"
                        )
                    try:
                        check_size("message", content)
                        message = PARSERS[kind](bytes(content))
                    except DecodeError as error:
                        raise InputError(
                            f"{where}: {error}: expected an Apollo message"
                        ) from error
                    numbers[channel] += 1
                    recorded, share = time * 1e-9, min(done / total, 1.0)
                    for role, row in rows_of(message):
                        yield role, recorded, share, (*row, recorded)
                if not record.is_complete:
                    self.notes.append(f"{file.name} was never closed; read to its end")

    def settle(self) -> None:
        """Chooses the clock, and where it starts."""
        ahead = {
            role: self.tables[role][:, 0] - self.tables[role][:, -1]
            for role in (*self.in_use, "driver")
            if len(self.tables[role])
        }
        medians = [float(np.median(offsets)) for offsets in ahead.values()]
        if medians:
            self._is_one_clock = max(medians) - min(medians) <= CLOCK_TOLERANCE_S
        super().settle()
        places = [self.stamps(r) - self.tables[r][:, -1] for r in self.in_use]
        if not math.isnan(self.start):
            self._offset = float(np.median(np.concatenate(places)))

    def stamps(self, role: str) -> np.ndarray:
        """Returns what the clock shows [s] at each row of a role."""
        return self.tables[role][:, 0 if self._is_one_clock else -1]

    @property
    def now(self) -> float:
        """Returns when [s] the last position was recorded; -inf without any held."""
        tables = [self.tables[role] for role in self.in_use]
        recorded = [table[-1, -1] for table in tables if len(table)]
        return max(recorded, default=-math.inf) + self._offset - self.start

    def between(self, role: str, low: float, high: float) -> np.ndarray:
        """Returns which rows [n] count; all routings, which are in force for long."""
        if role == "routing":
            return np.ones(len(self.tables[role]), bool)
        return super().between(role, low, high)

    def selected(self, table: np.ndarray) -> tuple[np.ndarray, list[str]]:
        """Drops states without a position, or of the ego (negative number)."""
        seen = ~np.isnan(table[:, 2:4]).any(axis=1) & (table[:, 1] >= 0)
        notes = []
        if not seen.all():
            lost = np.count_nonzero(~seen)
            notes = [f"{lost} obstacle states without position or id left out"]
        if self.in_use[1] == "prediction" and len(table):
            notes.append("no perception recorded; obstacles are those of prediction")
        return table[seen], notes

    def surroundings(self, window: Window) -> tuple[dict[str, Any], list[str]]:
        """Makes lanes of the paths, and legs of the ego's track."""
        fields, notes = super().surroundings(window)
        legs = self._legs()
        fields["tracks"] = tuple(
            _with_destinations(window.tracks, legs, window.places[2])
        )
        fields["group"] = self.run.drive if self.run.is_cut else None
        is_routed = any(start < window.within[1] and place for start, place in legs)
        if len(self.tables["ego"]) and not is_routed:
            notes.append("no routing recorded; the ego's destination is unknown")
        if not self._is_one_clock:
            notes.append("topics stamped on different clocks; times of recording used")
        return fields, notes

    def _legs(self) -> list[Leg]:
        """Destinations in the order of time, the first valid from the start.

        A routing that came within REPEAT_S of the start was in force before.
        """
        legs: list[Leg] = [(-math.inf, None)]
        table = self.tables["routing"]
        for x, y, time in table[np.lexsort(table.T)].tolist():
            if (x, y) != legs[-1][1]:
                legs.append((time + self._offset - self.start, (x, y)))
        while len(legs) > 1 and legs[1][0] <= (REPEAT_S if legs[0][1] is None else 0.0):
            legs[:2] = [(-math.inf, legs[1][1])]
        return legs


def _with_destinations(
    tracks: Sequence[Track], legs: list[Leg], origin: np.ndarray
) -> Iterator[Track]:
    """The tracks, the ego's cut where a routing set another destination.

    The destination is the one valid at the time: the driver knew no later one.
    """
    changes = np.array([start for start, _ in legs[1:]])
    for track in tracks:
        user, *again = track.id.split("#")
        if user != "ego":
            yield track
            continue
        which = np.searchsorted(changes, track.t + 1e-6, side="right")
        for leg in np.unique(which).tolist():
            name = user if leg == 0 else f"{user}-leg{leg + 1}"
            rows, place = which == leg, legs[leg][1]
            series = ("t", "x", "y", "heading", "speed")
            yield dataclasses.replace(
                track,
                id="#".join((name, *again)),
                destination=place and tuple((np.array(place) - origin).tolist()),
                **{field: getattr(track, field)[rows] for field in series},
            )
