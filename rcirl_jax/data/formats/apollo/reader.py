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
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.apollo.held import Held, Leg
from rcirl_jax.data.formats.apollo.messages import LOCALIZATION, MANUAL, read_drive
from rcirl_jax.data.formats.apollo.records import Run, first_parts
from rcirl_jax.data.formats.clock import on_clock
from rcirl_jax.data.formats.files import log_name
from rcirl_jax.data.formats.messages import (
    MAX_GAP_S,
    automatic_notes,
    automatic_spans,
    clock_rate,
    drive_windows,
    is_anybody,
    no_tracks,
    speed_at,
)
from rcirl_jax.data.formats.options import one_pattern, positive
from rcirl_jax.data.formats.perception import (
    Boxes,
    Windows,
    ego_boxes,
    fitted_lanes,
    longest_window,
    placed,
    tracks_of,
)
from rcirl_jax.data.formats.shapes import check_coordinates, origin_notes
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording, Track

LIMIT_MPS = 29.06  # m/s, 65 mph
# Lincoln MKZ in Apollo's mkz_example: 3.89 m before, 1.043 m behind the rear axle
EGO = {"length": 4.933, "width": 2.11, "rear_axle_to_centre": 1.4235}  # m
# what is measured of a box
MEASURED = ("x", "y", "heading", "speed", "length", "width")


def parts(path: Path, spec: dict) -> list[Path]:
    """The first file of each run of parts: runs can be read without the others."""
    if path.is_file():
        return [path]
    return first_parts(path, one_pattern(spec, "*.record*"))


def files_of(first: Path) -> list[Path]:
    """The files of a run, by its first one."""
    return Run(first).files


def own_name(first: Path) -> str:
    """Name of a run, as long as no other folder has one called alike."""
    return Run(first).name


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per drive, or per window of a long one, or run of its parts."""
    for first in parts(path, spec):
        held, found = Held(first), False
        for recording in _windows(held, spec):
            found = True
            yield validate_recording(recording, first)
        if held.is_empty:
            raise InputError(
                f"{first}: {LOCALIZATION}: no messages, nor obstacles: "
                "expected at least one of them"
            )
        if not found:
            raise no_tracks(first, spec)


def _windows(held: Held, spec: dict) -> Iterator[Recording]:
    """Recordings of a drive."""
    run = Run(held.path)
    return drive_windows(
        held,
        read_drive(run.files, spec),
        Windows(log_name(run.first, spec, run.name), run.drive, MAX_GAP_S),
        longest_window(spec),
        lambda view, within: _recording(view, within, spec),
    )


def _recording(held: Held, within: tuple[float, float], spec: dict) -> Recording | None:
    """The tracks of the rows held, with notes on the time within; None: nothing."""
    run, rate, notes = Run(held.path), clock_rate(spec), list(held.notes)
    obstacles, obstacle_notes = _obstacles(held, spec, rate)
    tracks = [*_ego(held, spec, rate), *obstacles]
    if not is_anybody(tracks, within):
        return None
    notes += _what_is_missing(held, within)
    _, _, origin, tracks = placed(tracks)
    lanes, lanes_note = fitted_lanes(tracks, spec)
    return Recording(
        name=log_name(run.first, spec, run.name),
        group=run.drive if run.is_cut else None,
        source=str(spec.get("source", "Apollo cyber record")),
        licence=str(spec.get("licence", "unknown")),
        rate_hz=rate,
        tracks=tuple(_with_destinations(tracks, held.legs(), origin)),
        lanes=lanes,
        default_speed_limit=positive(spec, "speed_limit", LIMIT_MPS),
        notes=(
            *notes,
            *obstacle_notes,
            *origin_notes(origin),
            f"records hold no map; {lanes_note}",
        ),
    )


def _what_is_missing(held: Held, within: tuple[float, float]) -> list[str]:
    """Notes on topics without messages, and on driving that is no human's."""
    notes = []
    if not len(held.tables["localization"]):
        notes.append("no localization recorded; no ego track")
    elif not any(start < within[1] and place for start, place in held.legs()):
        notes.append("no routing recorded; the ego's destination is unknown")
    if not len(held.tables[held.key]):
        notes.append("no obstacles recorded; the ego is alone")
    elif held.key == "prediction":
        notes.append("no perception recorded; obstacles are those of prediction")
    clock, by_hand = held.clock("chassis"), held.tables["chassis"][:, 3]
    return notes + automatic_notes(clock, by_hand, within, f"in {MANUAL}")


def _ego(held: Held, spec: dict, rate: float) -> list[Track]:
    """The recording car's box, moved from its rear axle to its centre."""
    t, table = held.clock("localization"), held.tables["localization"]
    x, y, heading, speed = table[:, 3:].T
    where = f"{held.path}: {LOCALIZATION}"
    check_coordinates(where, "pose", ("x", "y", "heading"), table[:, 3:6])
    if t.size and not np.isfinite(speed).all():
        speed = speed_at(t, held.clock("chassis"), held.tables["chassis"][:, 2])
    boxes = ego_boxes(spec, EGO, t, x, y, heading, speed)
    boxes = on_clock(boxes, rate, MAX_GAP_S)
    # the first mode was in force before; without a chassis channel a human drives
    automated = automatic_spans(held.clock("chassis"), held.tables["chassis"][:, 3])
    return tracks_of(held.path, boxes, MAX_GAP_S, automated=automated)[0]


def _obstacles(held: Held, spec: dict, rate: float) -> tuple[list[Track], list[str]]:
    table, clock = held.tables[held.key], held.clock(held.key)
    # a state without a position, or of the ego (negative id), is none
    seen = ~np.isnan(table[:, 4:6]).any(axis=1) & (table[:, 3] >= 0)
    lost = int(np.count_nonzero(~seen))
    table, clock = table[seen], clock[seen]
    where = f"{held.path}: obstacles"
    check_coordinates(where, "perception_obstacle", ("x", "y", "theta"), table[:, 4:7])
    number_of, ids = np.unique(table[:, 3].astype(np.int64), return_inverse=True)
    boxes = Boxes(
        ids=ids,
        names=tuple(map(str, number_of.tolist())),
        t=clock,
        kind=table[:, 10].astype(np.int64),
        **dict(zip(MEASURED, table[:, 4:10].T, strict=True)),
    )
    unknown = str(spec.get("unknown", "auto"))
    boxes = on_clock(boxes, rate, MAX_GAP_S)
    tracks, notes = tracks_of(held.path, boxes, MAX_GAP_S, unknown)
    if lost:
        notes.append(f"{lost} obstacle states without position or id left out")
    return tracks, notes


def _with_destinations(
    tracks: list[Track], legs: list[Leg], origin: np.ndarray
) -> list[Track]:
    """The tracks, the ego's cut where a routing set another destination.

    The destination is the one valid at the time: the driver knew no later one.
    """
    changes = np.array([start for start, _ in legs[1:]])
    found: list[Track] = []
    for track in tracks:
        user, *again = track.id.split("#")
        if user != "ego":
            found.append(track)
            continue
        which = np.searchsorted(changes, track.t + 1e-6, side="right")
        for leg in np.unique(which).tolist():
            name = user if leg == 0 else f"{user}-leg{leg + 1}"
            rows, place = which == leg, legs[leg][1]
            series = {
                field: getattr(track, field)[rows]
                for field in ("t", "x", "y", "heading", "speed")
            }
            found.append(
                dataclasses.replace(
                    track,
                    id="#".join((name, *again)),
                    destination=None
                    if place is None
                    else (place[0] - float(origin[0]), place[1] - float(origin[1])),
                    **series,
                )
            )
    return found
