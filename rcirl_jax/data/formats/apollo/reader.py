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
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from rcirl_jax.data.formats.apollo.records import Record, Run, check_size, first_parts
from rcirl_jax.data.formats.files import log_name
from rcirl_jax.data.formats.messages import Drive, Row, Window, topics_of
from rcirl_jax.data.formats.options import one_pattern
from rcirl_jax.data.formats.perception import UNKNOWN
from rcirl_jax.data.readers.protobuf import Message, parsers
from rcirl_jax.data.readers.reading import reading
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Recording, Track

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
