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

A lane is a centre line; its width comes from the road lines and road edges that
its boundary segments name. Signals are recorded per lane and step; a lane that has one
usually begins there: it is the path across the junction.
"""

import dataclasses
import functools
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from rcirl_jax.data.formats.files import files_below
from rcirl_jax.data.formats.options import (
    kind_of,
    lane_types,
    number,
    patterns,
    recording_car,
    section,
)
from rcirl_jax.data.formats.perception import (
    STATES,
    fitted_lanes,
    signal_of,
    without_outliers,
)
from rcirl_jax.data.formats.shapes import (
    MIN_HALF_WIDTH_M,
    check_coordinates,
    distances_to_lines,
    line_across,
    local_origin,
    moves,
    origin_notes,
)
from rcirl_jax.data.formats.tracks import of_one_name
from rcirl_jax.data.readers.protobuf import Message, columns, parsers
from rcirl_jax.data.readers.tfrecord import FRAME_BYTES, read_records
from rcirl_jax.data.recording import (
    LENGTH_RANGE_M,
    MAX_SPEED_MPS,
    WIDTH_RANGE_M,
    accepted,
)
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane, Recording, Signal, Track
from rcirl_jax.units import MPH_MPS

NEIGHBOUR = ("feature_id", "self_start_index", "self_end_index")
BOUNDARY = ("lane_start_index", "lane_end_index", "boundary_feature_id")
SIDES = ("left", "right")
LANE_TYPES = {0: "undefined", 1: "freeway", 2: "surface_street", 3: "bike_lane"}
DRIVEN = ("undefined", "freeway", "surface_street")
MAX_HALF_WIDTH_M = 5.0  # m; a farther line does not bound the lane
MEASURE_STEP = 4  # points (2 m) between those at which widths are measured
MAX_POINTS = 5_000_000  # of all lanes; 10,000 km of them are no map
# LANE_STATE_*: unknown, arrow stop/caution/go, stop/caution/go, flashing stop/caution
OFF, RED, YELLOW, GREEN = range(len(STATES))
COLOURS = np.array([OFF, RED, YELLOW, GREEN, RED, YELLOW, GREEN, OFF, OFF], np.int8)
FLASHING_STOP = 7  # a stop sign, in effect
MAX_COLOURS = 50_000_000  # lanes by steps; 1000 lanes over an hour take 36 million


def read_map(
    where: str, scenario: Message, t: np.ndarray, origin: np.ndarray, spec: dict
) -> tuple[tuple[Lane, ...], tuple[Signal, ...], list[str]]:
    """Reads lanes, signals and notes of one scenario.

    Args:
      where: names file and record in errors.
      scenario: the message.
      t: [T] s, times of the steps.
      origin: [2] m, subtracted from all points.
      spec: source TOML.
    """
    features = scenario.map_features
    steps = scenario.dynamic_map_states
    signals, points, flashing = _signals(where, steps, t, origin, spec)
    signs: dict[int, np.ndarray] = {}  # lane id -> [2] m, the sign that governs it
    for sign in _by_id(where, features, "stop_sign").values():
        if sign.HasField("position"):
            place = _points(where, [sign.position], origin)[0]
            signs.update(dict.fromkeys(sign.lane, place))
    lanes, notes = _lanes(where, features, {**signs, **points}, origin, spec)
    lit = {signal.id for signal in signals}
    signed = {str(key) for key in signs.keys() | flashing}
    lanes = tuple(
        dataclasses.replace(
            lane,
            signal_ids=(lane.id,) if lane.id in lit else (),
            stop_sign=lane.id in signed,
        )
        for lane in lanes
    )
    return lanes, signals, notes


def _points(where: str, messages: Iterable[Message], origin: np.ndarray) -> np.ndarray:
    """Map points [n, 2] m; heights are not read."""
    points = columns(messages, "x", "y")
    check_coordinates(where, "map points", ("x", "y"), points)
    return points - origin


def _by_id(where: str, features: Iterable[Message], kind: str) -> dict[int, Message]:
    """Feature id -> its data, of all features of a kind."""
    found = {}
    for feature in features:
        if feature.HasField(kind):
            if feature.id in found:
                raise InputError(
                    f"{where}: map feature {feature.id}: met twice: expected once"
                )
            found[feature.id] = getattr(feature, kind)
    return found


def _polylines(
    where: str, lines: Mapping[int, Message], origin: np.ndarray
) -> dict[int, np.ndarray]:
    """Feature id -> points [n, 2] m of its polyline."""
    if not lines:
        return {}
    parts = [line.polyline for line in lines.values()]
    points = _points(where, itertools.chain.from_iterable(parts), origin)
    ends = np.cumsum([len(part) for part in parts])[:-1]
    return dict(zip(lines, np.split(points, ends), strict=True))


# ---------------------------------------------------------------------- lanes


def _lanes(
    where: str,
    features: Sequence[Message],
    stops: Mapping[int, np.ndarray],
    origin: np.ndarray,
    spec: dict,
) -> tuple[list[Lane], list[str]]:
    """Lanes of the wanted types and of two or more points; stops [2] m by lane id."""
    every = _by_id(where, features, "lane")
    wanted = lane_types(spec, tuple(LANE_TYPES.values()), DRIVEN)
    driven = {
        key: lane
        for key, lane in every.items()
        if LANE_TYPES.get(lane.type, "undefined") in wanted
    }
    centres = _polylines(where, driven, origin)
    heads = {key: driven[key] for key, line in centres.items() if moves(line).sum() > 1}
    both = [_by_id(where, features, kind) for kind in ("road_line", "road_edge")]
    lines = {key: line for kind in both for key, line in kind.items() if line.polyline}
    bounds = _polylines(where, lines, origin)
    order, default = list(heads.values()), 0.5 * number(spec, "lane_width_m")
    line_of = [centres[key] for key in heads]
    widths = [_half_widths(where, side, order, line_of, bounds) for side in SIDES]
    beside = [_neighbours(order, side) for side in SIDES]
    exits = {key: dict.fromkeys(head.exit_lanes) for key, head in heads.items()}
    for key, head in heads.items():
        for before in head.entry_lanes:
            exits.get(before, {})[key] = None
    lanes = []
    for row, (key, head) in enumerate(heads.items()):
        keep = moves(line_of[row])
        line = line_of[row][keep]
        found = [side[row] for side in widths]
        usual = np.full(len(line), default)
        sides = [usual if half is None else half[keep] for half in found]
        across, limit = None, head.speed_limit_mph  # zero: unknown
        if (point := stops.get(key)) is not None:
            across = line_across(line, sides[0], sides[1], point)
        if not 0.0 <= limit * MPH_MPS < MAX_SPEED_MPS:
            raise InputError(
                f"{where}: lane {key}: speed_limit_mph: {limit:g}: "
                f"expected 0 to {MAX_SPEED_MPS / MPH_MPS:.0f}"
            )
        lane = Lane(
            id=str(key),
            centre=line,
            left_width=sides[0],
            right_width=sides[1],
            speed_limit=limit * MPH_MPS or None,
            successors=tuple(map(str, exits[key])),
            left=beside[0][row],
            right=beside[1][row],
            stop_line=across,
            width_assumed=any(half is None for half in found),
        )
        lanes.append(lane)
    notes = []
    if others := len(every) - len(driven):
        notes.append(f"{others} lanes not of type {', '.join(wanted)} left out")
    if short := len(driven) - len(heads):
        notes.append(f"{short} lanes of one point left out")
    return lanes, notes


def _half_widths(
    where: str,
    side: str,
    heads: Sequence[Message],
    lanes: Sequence[np.ndarray],
    lines: Mapping[int, np.ndarray],
) -> list[np.ndarray | None]:
    """Distance [n] m of each lane's points from what bounds them on one side.

    A lane names the road lines and edges beside it, each for a range of its points.
    Measured at every fourth point, interpolated between, held beyond; None of lanes
    without a known bound.

    Args:
      where: names file and record in errors.
      side: left or right.
      heads: of the lanes.
      lanes: points [n, 2] m of each lane.
      lines: feature id -> points [m >= 1, 2] m.
    """
    if not heads:
        return []
    lane, table = _of_lanes(heads, f"{side}_boundaries", BOUNDARY)
    first, last, bound = table.T
    sizes = np.array([len(points) for points in lanes], np.int64)
    longest = int(sizes.max())
    first, last = np.clip(first, 0, longest), np.clip(last, -1, longest)
    total = int(np.maximum(last - first + 1, 0).sum())
    if total > MAX_POINTS:
        raise InputError(
            f"{where}: {side}_boundaries: {total} points: expected at most {MAX_POINTS}"
        )
    begins = np.cumsum(sizes) - sizes
    half = np.full(int(sizes.sum()), np.nan)
    last = np.minimum(last, sizes[lane] - 1)
    use = np.flatnonzero(np.isin(bound, [*lines]) & (first <= last))
    if use.size:
        count = (last[use] - first[use]) // MEASURE_STEP + 2
        owner = np.repeat(use, count)
        place = np.arange(owner.size) - np.repeat(np.cumsum(count) - count, count)
        point = np.minimum(first[owner] + MEASURE_STEP * place, last[owner])
        row = begins[lane[owner]] + point
        keys, which = np.unique(bound[owner], return_inverse=True)
        near = [lines[key] for key in keys.tolist()]
        half[row] = distances_to_lines(np.concatenate(lanes)[row], near, which)
    found: list[np.ndarray | None] = []
    for part in np.split(half, begins[1:]):
        known = np.flatnonzero(part <= MAX_HALF_WIDTH_M)  # NaN compares false
        filled = None
        if known.size:
            filled = np.interp(np.arange(part.size), known, part[known])
            filled = np.maximum(filled, MIN_HALF_WIDTH_M)
        found.append(filled)
    return found


def _neighbours(heads: Sequence[Message], side: str) -> list[str | None]:
    """Per lane the neighbour along its longest part; all go the same way."""
    lane, table = _of_lanes(heads, f"{side}_neighbors", NEIGHBOUR)
    key, first, last = table.T
    found: list[str | None] = [None] * len(heads)
    for row in np.argsort(last - first, kind="stable"):
        found[lane[row]] = str(int(key[row]))
    return found


def _of_lanes(
    heads: Sequence[Message], field: str, names: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns a repeated field of lanes: numbers of the lanes [n], int64 [n, names]."""
    parts = [getattr(head, field) for head in heads]
    lane = np.repeat(np.arange(len(heads)), [len(part) for part in parts])
    items = itertools.chain.from_iterable(parts)
    return lane, columns(items, *names, dtype=np.int64)


# -------------------------------------------------------------------- signals


def _signals(
    where: str, steps: Sequence[Message], t: np.ndarray, origin: np.ndarray, spec: dict
) -> tuple[tuple[Signal, ...], dict[int, np.ndarray], frozenset[int]]:
    """Signals by the lane they govern, stop points, lanes of flashing red."""
    if len(steps) not in (0, t.size):
        raise InputError(
            f"{where}: dynamic_map_states: {len(steps)}: "
            f"expected {t.size}, one per timestamp"
        )
    heads = itertools.chain.from_iterable(step.lane_states for step in steps)
    lane, state = columns(heads, "lane", "state", dtype=np.int64).T
    if not lane.size:
        return (), {}, frozenset()
    bad = np.flatnonzero((state < 0) | (state >= len(COLOURS)))
    if bad.size:
        raise InputError(
            f"{where}: lane {lane[bad[0]]}: signal state {state[bad[0]]}: "
            f"expected 0 to {len(COLOURS) - 1}"
        )
    ids, rows = np.unique(lane, return_inverse=True)
    if ids.size * t.size > MAX_COLOURS:
        raise InputError(
            f"{where}: dynamic_map_states: {ids.size} lanes over {t.size} steps: "
            f"expected at most {MAX_COLOURS} states"
        )
    colours = np.full((ids.size, t.size), OFF, np.int8)
    counts = [len(step.lane_states) for step in steps]
    step = np.repeat(np.arange(len(steps)), counts)
    # of two heads for one lane the first that is known counts: it is written last
    known = np.flatnonzero(COLOURS[state] != OFF)[::-1]
    colours[rows[known], step[known]] = COLOURS[state[known]]
    gap = number(spec, "signal_gap_s")
    for row in colours:  # fill short unseen times between equal colours
        known = np.flatnonzero(row != OFF)
        before, after = known[:-1], known[1:]
        fill = (row[before] == row[after]) & (t[after] - t[before] <= gap)
        for first, last in zip(before[fill], after[fill], strict=True):
            row[first:last] = row[first]
    signals = tuple(
        signal_of(str(key), t, row) for key, row in zip(ids, colours, strict=True)
    )
    stops = {
        head.lane: head.stop_point
        for step in reversed(steps)  # of two points of one lane the first counts
        for head in reversed(step.lane_states)
        if head.HasField("stop_point")
    }
    points = _points(where, stops.values(), origin)
    flashing = np.bincount(rows, state == FLASHING_STOP) > 0.5 * np.bincount(rows)
    return (
        signals,
        dict(zip(stops, points, strict=True)),
        frozenset(ids[flashing].tolist()),
    )


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
