"""Waymo Open Motion Dataset: `Scenario` messages in TFRecord files.

SCHEMA has the fields that are read of the public scenario.proto and map.proto
(https://github.com/waymo-research/waymo-open-dataset, protos). Files are named
`*.tfrecord` or `*.tfrecord-00000-of-01000`; the `tf_example` files hold another
message and are refused.

A scenario is 9.1 s at 10 Hz (`testing`: 1.1 s, `training_20s`: 20 s); states are
box centres in metres about an arbitrary origin, headings radians
counter-clockwise. Traps: every track has a state per step, `valid = false` where
it was not seen; up to seven 9.1 s windows overlap inside one 20 s segment and
cannot be told apart, so only `training_20s` is free of shared vehicles.
"""

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from rcirl_jax.data.formats.files import files_below
from rcirl_jax.data.formats.options import (
    kind_of,
    number,
    patterns,
    recording_car,
    section,
)
from rcirl_jax.data.formats.perception import fitted_lanes, without_outliers
from rcirl_jax.data.formats.shapes import check_coordinates, local_origin, origin_notes
from rcirl_jax.data.formats.tracks import of_one_name
from rcirl_jax.data.formats.waymo.map import read_map
from rcirl_jax.data.readers.protobuf import Message, columns, parsers
from rcirl_jax.data.readers.tfrecord import FRAME_BYTES, read_records
from rcirl_jax.data.recording import LENGTH_RANGE_M, WIDTH_RANGE_M, accepted
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording, Track

# the fields that are read of scenario.proto and map.proto; whole numbers and enums are
# all int64: as coded they are alike, and numbers that no release knows are seen rather
# than dropped
SCHEMA = """
Scenario: timestamps_seconds 1 double*, tracks 2 Track*, scenario_id 5 string,\
 sdc_track_index 6 int64=-1, dynamic_map_states 7 DynamicMapState*,\
 map_features 8 MapFeature*
Track: id 1 int64, object_type 2 int64, states 3 ObjectState*
ObjectState: center_x 2 double, center_y 3 double, length 5 float, width 6 float,\
 heading 8 float, velocity_x 9 float, velocity_y 10 float, valid 11 bool
DynamicMapState: lane_states 1 LaneState*
LaneState: lane 1 int64, state 2 int64, stop_point 3 MapPoint
MapFeature: id 1 int64, lane 3 Lane, road_line 4 Line, road_edge 5 Line,\
 stop_sign 7 StopSign
MapPoint: x 1 double, y 2 double
Lane: speed_limit_mph 1 double, type 2 int64, polyline 8 MapPoint*,\
 entry_lanes 9 int64*, exit_lanes 10 int64*,\
 left_neighbors 11 Neighbor*, right_neighbors 12 Neighbor*,\
 left_boundaries 13 Boundary*, right_boundaries 14 Boundary*
Neighbor: feature_id 1 int64, self_start_index 2 int64, self_end_index 3 int64
Boundary: lane_start_index 1 int64, lane_end_index 2 int64, boundary_feature_id 3 int64
Line: polyline 2 MapPoint*
StopSign: lane 1 int64*, position 2 MapPoint
"""

read_message = parsers(SCHEMA)["Scenario"]
# what is read of each state
STATE = (
    *("center_x", "center_y", "length", "width"),
    *("heading", "velocity_x", "velocity_y", "valid"),
)
TYPES = {0: "unset", 1: "vehicle", 2: "pedestrian", 3: "cyclist", 4: "other"}
RATE_HZ = 10.0  # 1/s, the data set's
RATE_TOLERANCE = 0.05  # relative; real stamps jitter by less
MAX_SPAN_S = 3600.0  # s of one scenario
MAX_STATES = 2_000_000  # of all tracks; a scenario has some 1e5
MAX_GAP_STEPS = 5.5  # invalid steps bridged inside one track
SMALL_M = 0.05  # m; smaller boxes are errors, larger ones are clipped
WINDOW_S = (5.0, 12.0)  # s, scenarios of this length are overlapping windows
MIB = 1024**2
MAX_NAME = 100  # characters kept of a scenario id
EXPECTED = (
    "Scenario messages (the folder scenario/, not tf_example/ or lidar_and_camera/)"
)


def parts(path: Path, spec: dict) -> list[Path]:
    """Lists the TFRecord files; each can be read alone."""
    return files_below(path, patterns(spec), "TFRecord files")


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per scenario, one record in memory at a time."""
    limit = int(number(spec, "max_record_mib") * MIB)
    for file in parts(path, spec):
        size, done = file.stat().st_size, 0
        for count, data in enumerate(read_records(file, limit)):
            where = f"{file}: record {count}"
            name = f"{file.name}-{count}"
            make = functools.partial(_read_scenario, where, name, data, spec)
            made = accepted(make, name, where, spec)
            done += FRAME_BYTES + len(data)
            yield dataclasses.replace(made, progress=done / size)


def _read_scenario(where: str, default: str, data: bytes, spec: dict) -> Recording:
    try:
        scenario = read_message(data)
    except DecodeError as error:
        raise InputError(f"{where}: {error}: expected {EXPECTED}") from error
    if not scenario.tracks:
        raise InputError(f"{where}: tracks: none: expected {EXPECTED}")
    t = _times(where, scenario)
    values, valid = _states(where, scenario, t.size)
    x, y = values["center_x"], values["center_y"]
    origin = local_origin(x[valid], y[valid])
    x -= origin[0]
    y -= origin[1]
    tracks, notes = _tracks(where, scenario, t, values, valid, spec)
    lanes, signals, map_notes = read_map(where, scenario, t, origin, spec)
    if not lanes:
        lanes, note = fitted_lanes(tracks, spec)
        map_notes = [*map_notes, f"no lanes in the map: {note}"]
    name = scenario.scenario_id[:MAX_NAME] or default
    limits = [lane.speed_limit for lane in lanes if lane.speed_limit is not None]
    if WINDOW_S[0] < t[-1] < WINDOW_S[1]:
        shared = "9.1 s windows of one drive may share vehicles; training_20s has none"
        notes = [shared, *notes]
    return Recording(
        name=name,
        source=spec["source"],
        licence=spec["licence"],
        rate_hz=RATE_HZ,
        tracks=tracks,
        lanes=lanes,
        signals=signals,
        group=name,
        # of lanes without one: the median of the scenario's, if any
        default_speed_limit=float(np.median(limits or [number(spec, "speed_limit")])),
        notes=(*origin_notes(origin), *notes, *map_notes),
    )


def _times(where: str, scenario: Message) -> np.ndarray:
    """The time [steps] s of each step, since the first."""
    t = np.array(scenario.timestamps_seconds, np.float64)
    field, span = f"{where}: timestamps_seconds", t[-1] - t[0] if t.size else 0.0
    if not t.size or not np.isfinite(t).all() or np.any(np.diff(t) <= 0.0):
        found = f"{t[:4].tolist()} ({t.size})"
        raise InputError(f"{field}: {found}: expected increasing times")
    if span > MAX_SPAN_S:
        raise InputError(f"{field}: {span:g} s: expected at most {MAX_SPAN_S:g} s")
    rate = 1.0 / float(np.median(np.diff(t))) if t.size > 1 else RATE_HZ
    if abs(rate / RATE_HZ - 1.0) > RATE_TOLERANCE:
        raise InputError(f"{field}: {rate:g} per second: expected {RATE_HZ:g} (unit s)")
    return t - t[0]


def _states(
    where: str, scenario: Message, steps: int
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Values [tracks, steps] by field of ObjectState, and which are valid."""
    tracks = scenario.tracks
    if len(tracks) * steps > MAX_STATES:
        raise InputError(
            f"{where}: tracks: {len(tracks)} of {steps} states: "
            f"expected at most {MAX_STATES} states"
        )
    for track in tracks:
        if len(track.states) != steps:
            raise InputError(
                f"{where}: track {track.id}: {len(track.states)} states: "
                f"expected {steps}, one per timestamp"
            )
    rows = columns((state for track in tracks for state in track.states), *STATE)
    table = np.moveaxis(rows.reshape(len(tracks), steps, len(STATE)), 2, 0)
    values = dict(zip(STATE, np.ascontiguousarray(table), strict=True))
    valid = values.pop("valid") != 0.0
    for column in values.values():
        column[~valid] = 0.0  # what an invalid state holds means nothing
    names = ("center_x", "center_y", "velocity_x", "velocity_y")
    seen = np.stack([values[name][valid] for name in names], axis=1)
    check_coordinates(where, "states", names, seen)
    return values, valid


def _tracks(
    where: str,
    scenario: Message,
    t: np.ndarray,
    values: dict[str, np.ndarray],
    valid: np.ndarray,
    spec: dict,
) -> tuple[tuple[Track, ...], list[str]]:
    """Tracks, with notes; the parts between long gaps are "id", "id#2", ..."""
    tracks: list[Track] = []
    unset = unseen = 0
    recorder = scenario.sdc_track_index
    for row, track in enumerate(scenario.tracks):
        seen, kind = np.flatnonzero(valid[row]), TYPES.get(track.object_type)
        if not seen.size or kind == "unset":
            unseen += not seen.size
            unset += bool(seen.size)
            continue
        name, own = str(track.id), {key: column[row] for key, column in values.items()}
        known = kind_of(
            f"{where}: track {name}",
            kind or str(track.object_type),
            section(spec, "kinds"),
        )
        cuts = np.flatnonzero(np.diff(seen) > MAX_GAP_STEPS) + 1
        for part, rows in enumerate(np.split(seen, cuts), start=1):
            made = Track(
                id=name if part == 1 else f"{name}#{part}",
                kind=known,
                length=_size(own["length"][seen], LENGTH_RANGE_M),
                width=_size(own["width"][seen], WIDTH_RANGE_M),
                t=t[rows],
                x=own["center_x"][rows],
                y=own["center_y"][rows],
                heading=own["heading"][rows],
                speed=np.hypot(own["velocity_x"][rows], own["velocity_y"][rows]),
                automated=recording_car(spec) if row == recorder else (),
            )
            tracks.append(made)
    tracks, doubled = of_one_name(tracks)
    tracks, notes = without_outliers(tracks)
    notes += doubled
    if 0 <= recorder < len(scenario.tracks):
        car = scenario.tracks[recorder].id
        notes = [f"the recording car is track {car}", *notes]
    for count, words in ((unset, "of unset type"), (unseen, "without a valid state")):
        if count:
            notes.append(f"{count} tracks {words} left out")
    return tuple(tracks), notes


def _size(sizes: np.ndarray, allowed: tuple[float, float]) -> float:
    """Median size [m]; estimates a little below the smallest are raised to it."""
    size = float(np.median(sizes))
    return max(size, allowed[0]) if size >= SMALL_M else size
