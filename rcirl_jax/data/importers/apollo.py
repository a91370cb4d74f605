"""Baidu Apollo's cyber records: localization, chassis, obstacles, routing.

Read: `*.record`, `*.record.00000`, `.00001`, ... of Apollo 3.5 and later; the
parts of one drive make one Recording. Messages are decoded by the descriptors in
the record (modules/common_msgs in the Apollo sources: localization.proto,
chassis.proto, perception_obstacle.proto, prediction_obstacle.proto,
routing.proto), so no Apollo or protobuf package is needed.

Traps: a pose is that of the rear axle's centre, not of the box; the quaternion's
zero is north, the heading's is east; messages are irregular and on clocks of
their own, so everything is put on one uniform clock; where perception recorded
nothing, prediction repeats its obstacles; a drive may be the planner's own, not
a human's (a note says how much of it).
"""

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rcirl_jax.data.importers.apollo_messages import (
    MANUAL,
    TOPICS,
    Drive,
    read_drive,
)
from rcirl_jax.data.importers.apollo_obstacles import COLUMNS
from rcirl_jax.data.importers.cyber_record import (
    drive_name,
    first_parts,
    parts_from,
)
from rcirl_jax.data.importers.paths import path_lanes
from rcirl_jax.data.importers.perception import (
    Boxes,
    positive,
    section,
    tracks_of,
)
from rcirl_jax.data.importers.shapes import (
    check_coordinates,
    local_origin,
    origin_notes,
)
from rcirl_jax.data.importers.tables import number
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Recording, Track

RATE_HZ = 10.0  # 1/s
MAX_GAP_S = 0.55  # s without a message inside one track
CLOCK_TOLERANCE_S = 1.0  # s, two topics' clocks differ by more: not one clock
MAX_DURATION_S = 86400.0  # s, of one drive
LIMIT_MPS = 29.06  # m/s, 65 mph
LANE_WIDTH_M = 3.5  # m
# Lincoln MKZ in Apollo's mkz_example: 3.89 m before, 1.043 m behind the rear axle
EGO = {"length": 4.933, "width": 2.11, "rear_axle_to_centre": 1.4235}  # m
NAN = float("nan")


def parts(path: Path, spec: dict) -> list[Path]:
    """The first file of each drive: drives can be read without the others."""
    if path.is_file():
        return [path]
    return first_parts(path, str(spec.get("pattern", "*.record*")))


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per drive: a record file and the parts that follow it."""
    for first in parts(path, spec):
        drive = read_drive(parts_from(first), spec)
        yield validate_recording(_recording(first, drive, spec), first)


def _recording(path: Path, drive: Drive, spec: dict) -> Recording:
    rate = positive(spec, "rate_hz", RATE_HZ)
    key = "perception" if any(map(len, drive.perception)) else "prediction"
    rows = {
        "localization": _table(drive.localization, 7),
        "chassis": _table(drive.chassis, 3),
        key: np.concatenate([np.zeros((0, COLUMNS)), *getattr(drive, key)]),
    }
    _check_present(path, drive, key, len(rows[key]))
    clocks = _clocks(rows, drive.notes)
    seen = [clocks[name] for name in ("localization", key) if clocks[name].size]
    start = min(float(clock.min()) for clock in seen)
    end = max(float(clock.max()) for clock in seen)
    if not end - start <= MAX_DURATION_S:
        raise InputError(
            f"{path}: timestamp_sec: {end - start:g} s from first to last: "
            f"expected at most {MAX_DURATION_S:g} s"
        )
    clocks = {name: clock - start for name, clock in clocks.items()}
    tracks = _ego(path, rows, clocks, drive, spec, rate)
    obstacles, notes = _obstacles(path, rows[key], clocks[key], spec, rate)
    tracks += obstacles
    if not tracks:
        raise InputError(
            f"{path}: tracks: none on a clock of {rate:g} Hz: expected a longer record"
        )
    tracks, origin_note = _localise(path, tracks)
    lanes = path_lanes(
        tracks,
        positive(spec, "lane_width_m", LANE_WIDTH_M),
        positive(spec, "speed_limit", LIMIT_MPS),
    )
    return Recording(
        name=drive_name(path),
        source=str(spec.get("source", "Apollo cyber record")),
        licence=str(spec.get("licence", "unknown")),
        rate_hz=rate,
        tracks=tuple(tracks),
        lanes=lanes,
        default_speed_limit=positive(spec, "speed_limit", LIMIT_MPS),
        notes=(
            *drive.notes,
            *notes,
            *origin_note,
            f"records hold no map; {len(lanes)} lanes fitted to the longest paths",
        ),
    )


def _table(rows: list[tuple], columns: int) -> np.ndarray:
    """[n, columns] numbers."""
    return np.array(rows, np.float64).reshape(-1, columns)


def _check_present(path: Path, drive: Drive, key: str, obstacles: int) -> None:
    """Say what is missing; without any position there is nothing to read."""
    if not drive.localization and not obstacles:
        raise InputError(
            f"{path}: {TOPICS['localization']}: no messages, nor obstacles: "
            "expected at least one of them"
        )
    if not drive.localization:
        drive.notes.append("no localization recorded; no ego track")
    if not obstacles:
        drive.notes.append("no obstacles recorded; the ego is alone")
    elif key == "prediction":
        drive.notes.append("no perception recorded; obstacles are those of prediction")
    automatic = 1.0 - float(np.mean(drive.modes)) if drive.modes else 0.0
    if automatic > 0.0:
        drive.notes.append(
            f"{automatic:.0%} of the drive not in {MANUAL}: the ego is no human there"
        )


def _clocks(rows: dict[str, np.ndarray], notes: list[str]) -> dict[str, np.ndarray]:
    """Time [s] of each row: of measurement, or of recording where clocks differ."""
    offsets = [
        float(np.median(table[:, 0] - table[:, 1]))
        for table in rows.values()
        if len(table)
    ]
    if not max(offsets) - min(offsets) <= CLOCK_TOLERANCE_S:
        notes.append("topics stamped on different clocks; times of recording used")
        return {name: table[:, 1] for name, table in rows.items()}
    clocks = {}
    for name, table in rows.items():
        own = table[:, 2] if name != "chassis" else table[:, 0]
        near = np.abs(own - table[:, 0]) <= CLOCK_TOLERANCE_S
        clocks[name] = np.where(near, own, table[:, 0])
    return clocks


def _ego(
    path: Path,
    rows: dict[str, np.ndarray],
    clocks: dict[str, np.ndarray],
    drive: Drive,
    spec: dict,
    rate: float,
) -> list[Track]:
    """The recording car's box, moved from its rear axle to its centre."""
    size = {
        name: number(section(spec, "ego"), name, default)
        for name, default in EGO.items()
    }
    t, table = clocks["localization"], rows["localization"]
    x, y, heading, speed = table[:, 3:].T
    where = f"{path}: {TOPICS['localization']}"
    check_coordinates(where, "pose", ("x", "y", "heading"), table[:, 3:6])
    if t.size and not np.isfinite(speed).all():
        speed = _chassis_speed(t, clocks["chassis"], rows["chassis"][:, 2])
    ahead = size["rear_axle_to_centre"]
    boxes = _uniform(
        ids=np.zeros(t.size, np.int64),
        names=("ego",),
        t=t,
        columns=(
            x + ahead * np.cos(heading),
            y + ahead * np.sin(heading),
            heading,
            speed,
            np.full(t.size, size["length"]),
            np.full(t.size, size["width"]),
        ),
        kind=np.full(t.size, int(Kind.VEHICLE)),
        rate=rate,
    )
    tracks, _ = tracks_of(path, boxes, MAX_GAP_S)
    return [
        dataclasses.replace(track, destination=drive.destination) for track in tracks
    ]


def _chassis_speed(t: np.ndarray, clock: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Speed [m/s] of the wheels at times t; NaN where there is none."""
    known = np.isfinite(speed)
    if np.count_nonzero(known) < 2:
        return np.full(t.shape, NAN)
    order = np.argsort(clock[known], kind="stable")
    return np.interp(t, clock[known][order], speed[known][order])


def _obstacles(
    path: Path, table: np.ndarray, clock: np.ndarray, spec: dict, rate: float
) -> tuple[list[Track], list[str]]:
    # a state without a position, or of the ego (negative id), is none
    seen = ~np.isnan(table[:, 4:6]).any(axis=1) & (table[:, 3] >= 0)
    lost = int(np.count_nonzero(~seen))
    table, clock = table[seen], clock[seen]
    where = f"{path}: obstacles"
    check_coordinates(where, "perception_obstacle", ("x", "y", "theta"), table[:, 4:7])
    number_of, ids = np.unique(table[:, 3].astype(np.int64), return_inverse=True)
    boxes = _uniform(
        ids=ids,
        names=tuple(str(found) for found in number_of.tolist()),
        t=clock,
        columns=tuple(table[:, 4:10].T),
        kind=table[:, 10].astype(np.int64),
        rate=rate,
    )
    unknown = str(spec.get("unknown", "auto"))
    tracks, notes = tracks_of(path, boxes, MAX_GAP_S, unknown)
    if lost:
        notes.append(f"{lost} obstacle states without position or id left out")
    return tracks, notes


def _uniform(
    *,
    ids: np.ndarray,
    names: tuple[str, ...],
    t: np.ndarray,
    columns: tuple[np.ndarray, ...],
    kind: np.ndarray,
    rate: float,
) -> Boxes:
    """Boxes on the clock k / rate, between the messages of each gapless piece.

    Linear interpolation; headings (column 2) are unwrapped first. A piece
    between two ticks of the clock gives nothing. Of several messages of one
    time the first counts.
    """
    order = np.lexsort((t, ids))
    step, same = np.diff(t[order]), np.diff(ids[order]) == 0
    order = order[np.concatenate([[True], ~same | (step > 0.0)])[: order.size]]
    step, same = np.diff(t[order]), np.diff(ids[order]) == 0
    breaks = np.flatnonzero(~same | (step > MAX_GAP_S)) + 1
    parts: list[tuple[np.ndarray, ...]] = []
    for rows in np.split(order, breaks) if order.size else []:
        first = math.ceil(float(t[rows[0]]) * rate - 1e-6)
        last = math.floor(float(t[rows[-1]]) * rate + 1e-6)
        clock = np.arange(first, last + 1) / rate
        values = [column[rows] for column in columns]
        values[2] = np.unwrap(values[2])
        at = np.minimum(np.searchsorted(t[rows], clock), rows.size - 1)
        parts.append(
            (
                np.full(clock.size, ids[rows[0]]),
                clock,
                *(np.interp(clock, t[rows], value) for value in values),
                kind[rows][at],
            )
        )
    empty = (np.zeros(0, np.int64), *[np.zeros(0)] * 7, np.zeros(0, np.int64))
    merged = [np.concatenate(group) for group in zip(empty, *parts, strict=True)]
    fields = ("t", "x", "y", "heading", "speed", "length", "width")
    return Boxes(
        ids=merged[0],
        names=names,
        kind=merged[8],
        **dict(zip(fields, merged[1:8], strict=True)),
    )


def _localise(path: Path, tracks: list[Track]) -> tuple[list[Track], list[str]]:
    """Tracks and destinations less a local origin (records are in UTM)."""
    origin = local_origin(
        np.concatenate([track.x for track in tracks]),
        np.concatenate([track.y for track in tracks]),
    )
    moved = [
        dataclasses.replace(
            track,
            x=track.x - origin[0],
            y=track.y - origin[1],
            destination=None
            if track.destination is None
            else (
                track.destination[0] - float(origin[0]),
                track.destination[1] - float(origin[1]),
            ),
        )
        for track in tracks
    ]
    return moved, origin_notes(origin)
