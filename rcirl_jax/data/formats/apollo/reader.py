"""Baidu Apollo's cyber records: localization, chassis, obstacles, routing.

Read: `*.record`, `*.record.00000`, `.00001`, ... of Apollo 3.5 and later; the
parts of one drive make one Recording, or one per window of a long drive, made
while they are read. Messages are decoded by the descriptors in
the record (modules/common_msgs in the Apollo sources: localization.proto,
chassis.proto, perception_obstacle.proto, prediction_obstacle.proto,
routing.proto), so no Apollo package is needed.

Traps: a pose is that of the rear axle's centre, not of the box; the quaternion's
zero is north, the heading's is east; messages are irregular and on clocks of
their own, so everything is put on one uniform clock; where perception recorded
nothing, prediction repeats its obstacles; a drive may be the planner's own, not
a human's (a note says how much of it); a drive may have several destinations,
and the ego is another track from each new one on.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Self

import numpy as np

from rcirl_jax.data.formats.apollo.messages import (
    LOCALIZATION,
    MANUAL,
    OBSTACLES,
    WIDTHS,
    read_drive,
)
from rcirl_jax.data.formats.apollo.records import Run, first_parts
from rcirl_jax.data.formats.files import log_name
from rcirl_jax.data.formats.messages import (
    Drive,
    Windows,
    clock_rate,
    drive_windows,
    is_anybody,
    longest_window,
    no_tracks,
)
from rcirl_jax.data.formats.options import one_pattern, positive
from rcirl_jax.data.formats.perception import Boxes, fitted_lanes, placed
from rcirl_jax.data.formats.shapes import check_coordinates, origin_notes
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording, Track

LIMIT_MPS = 29.06  # m/s, 65 mph
# Lincoln MKZ in Apollo's mkz_example: 3.89 m before, 1.043 m behind the rear axle
EGO = {"length": 4.933, "width": 2.11, "rear_axle_to_centre": 1.4235}  # m
CLOCK_TOLERANCE_S = 1.0  # s, two topics' clocks differ by more: not one clock
REPEAT_S = 1.5  # s; Apollo sends the routing in force again every second

Leg = tuple[float, tuple[float, float] | None]  # s, from when on; destination, m


def parts(path: Path, spec: dict) -> list[Path]:
    """Lists the first file of each run of parts: runs can be read alone."""
    if path.is_file():
        return [path]
    return first_parts(path, one_pattern(spec, "*.record*"))


def files_of(first: Path) -> list[Path]:
    """Lists the files of a run, by its first one."""
    return Run(first).files


def own_name(first: Path) -> str:
    """Returns the name of a run, as long as no other folder has one called alike."""
    return Run(first).name


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per drive, or per window of a long one, or run of parts."""
    for first in parts(path, spec):
        run, drive, found = Run(first), ApolloDrive(first), False
        windows = Windows(log_name(first, spec, run.name), run.drive)
        for recording in drive_windows(
            drive,
            read_drive(run.files, spec),
            windows,
            longest_window(spec),
            lambda view, within, run=run: _recording(view, within, run, spec),
        ):
            found = True
            yield validate_recording(recording, first)
        if math.isnan(drive.start):
            raise InputError(
                f"{first}: {LOCALIZATION}: no messages, nor obstacles: "
                "expected at least one of them"
            )
        if not found:
            raise no_tracks(first, spec)


class ApolloDrive(Drive):
    """Rows of a drive, put onto one clock: of measurement, or of recording.

    Column 0 is the time of a message's header, column 1 of its recording; of poses and
    obstacles column 2 is that of measurement. Where topics are stamped on different
    clocks, the times of recording are common to all.
    """

    stamp_field = "timestamp_sec"
    driver_role = "chassis"

    def __init__(self, path: Path) -> None:
        super().__init__(path, WIDTHS, ("localization", *OBSTACLES))
        self._offset = 0.0  # s, what the clock shows less the time of recording
        self._is_one_clock = True

    @property
    def key(self) -> str:
        """Returns the role of the obstacles."""
        return "perception" if len(self.tables["perception"]) else "prediction"

    @property
    def in_use(self) -> Sequence[str]:
        """Roles whose rows become tracks."""
        return "localization", self.key

    @property
    def now(self) -> float:
        """Returns when [s] the last position was recorded; -inf without any held."""
        tables = [self.tables[role] for role in self.in_use]
        recorded = [table[-1, 1] for table in tables if len(table)]
        return max(recorded, default=-math.inf) + self._offset - self.start

    def settle(self) -> None:
        """Chooses the clock, and where it starts."""
        tables = [self.tables[role] for role in (*self.in_use, "chassis")]
        offsets = [float(np.median(t[:, 0] - t[:, 1])) for t in tables if len(t)]
        if offsets:
            self._is_one_clock = max(offsets) - min(offsets) <= CLOCK_TOLERANCE_S
        super().settle()
        if not math.isnan(self.start):
            ahead = [self.stamps(r) - self.tables[r][:, 1] for r in self.in_use]
            self._offset = float(np.median(np.concatenate(ahead)))

    def stamps(self, role: str) -> np.ndarray:
        """Returns what the clock shows [s] at each row of a role."""
        table = self.tables[role]
        if not self._is_one_clock:
            return table[:, 1]
        own = table[:, 0 if role == "chassis" else 2]
        near = np.abs(own - table[:, 0]) <= CLOCK_TOLERANCE_S
        return np.where(near, own, table[:, 0])

    def view(self, low: float, high: float) -> Self:
        """Returns rows from one time [s] to before another, notes since the last."""
        view = super().view(low, high)
        if not self.is_cut and not self._is_one_clock:
            note = "topics stamped on different clocks; times of recording used"
            view.notes = [*view.notes, note]
        return view

    def _rows(self, role: str, low: float, high: float = math.inf) -> np.ndarray:
        """Rows between two times [s]; all routings, which are in force for long."""
        every = self.tables[role]
        return every if role == "routing" else super()._rows(role, low, high)

    def legs(self) -> list[Leg]:
        """Returns destinations in the order of time, the first valid from the start.

        A routing that came within REPEAT_S of the start was in force before.
        """
        legs: list[Leg] = [(-math.inf, None)]
        for time, x, y in sorted(self.tables["routing"].tolist()):
            if (x, y) != legs[-1][1]:
                legs.append((time + self._offset - self.start, (x, y)))
        while len(legs) > 1 and legs[1][0] <= (REPEAT_S if legs[0][1] is None else 0.0):
            legs[:2] = [(-math.inf, legs[1][1])]
        return legs


def _recording(
    drive: ApolloDrive, within: tuple[float, float], run: Run, spec: dict
) -> Recording | None:
    """The tracks of the rows held, with notes on the time within; None: nothing."""
    obstacles, obstacle_notes = _obstacles(drive, spec)
    tracks = [*_ego(drive, spec), *obstacles]
    if not is_anybody(tracks, within):
        return None
    legs, missing = drive.legs(), []
    if not len(drive.tables["localization"]):
        missing.append("no localization recorded; no ego track")
    elif not any(start < within[1] and place for start, place in legs):
        missing.append("no routing recorded; the ego's destination is unknown")
    if not len(drive.tables[drive.key]):
        missing.append("no obstacles recorded; the ego is alone")
    elif drive.key == "prediction":
        missing.append("no perception recorded; obstacles are those of prediction")
    _, _, origin, tracks = placed(tracks)
    lanes, lanes_note = fitted_lanes(tracks, spec)
    return Recording(
        name=log_name(run.first, spec, run.name),
        group=run.drive if run.is_cut else None,
        source=str(spec.get("source", "Apollo cyber record")),
        licence=str(spec.get("licence", "unknown")),
        rate_hz=clock_rate(spec),
        tracks=tuple(_with_destinations(tracks, legs, origin)),
        lanes=lanes,
        default_speed_limit=positive(spec, "speed_limit", LIMIT_MPS),
        notes=(
            *drive.notes,
            *missing,
            *drive.driver_notes(within, f"in {MANUAL}"),
            *obstacle_notes,
            *origin_notes(origin),
            f"records hold no map; {lanes_note}",
        ),
    )


def _ego(drive: ApolloDrive, spec: dict) -> list[Track]:
    """The ego's track; without a chassis channel a human drives."""
    poses = drive.tables["localization"][:, 3:]
    where = f"{drive.path}: {LOCALIZATION}"
    check_coordinates(where, "pose", ("x", "y", "heading"), poses[:, :3])
    velocity = drive.clock("chassis"), drive.tables["chassis"][:, 2]
    return drive.ego_tracks(spec, EGO, poses, velocity, drive.driver_spans())


def _obstacles(drive: ApolloDrive, spec: dict) -> tuple[list[Track], list[str]]:
    table, clock = drive.tables[drive.key], drive.clock(drive.key)
    # a state without a position, or of the ego (negative id), is none
    seen = ~np.isnan(table[:, 4:6]).any(axis=1) & (table[:, 3] >= 0)
    lost = int(np.count_nonzero(~seen))
    table, clock = table[seen], clock[seen]
    where = f"{drive.path}: obstacles"
    check_coordinates(where, "perception_obstacle", ("x", "y", "theta"), table[:, 4:7])
    number_of, ids = np.unique(table[:, 3].astype(np.int64), return_inverse=True)
    names, kinds = [*map(str, number_of.tolist())], table[:, 10].astype(np.int64)
    x, y, heading, speed, length, width = table[:, 4:10].T
    boxes = Boxes(ids, names, clock, x, y, heading, speed, length, width, kinds)
    tracks, notes = drive.tracks(boxes, spec)
    if lost:
        notes.append(f"{lost} obstacle states without position or id left out")
    return tracks, notes


def _with_destinations(
    tracks: list[Track], legs: list[Leg], origin: np.ndarray
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
