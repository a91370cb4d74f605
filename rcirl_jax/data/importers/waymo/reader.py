"""Waymo Open Motion Dataset: `Scenario` messages in TFRecord files.

Read without TensorFlow and without the data set's package; field numbers are
those of the public scenario.proto and map.proto
(https://github.com/waymo-research/waymo-open-dataset, protos). Files are named
`*.tfrecord` or `*.tfrecord-00000-of-01000`, in the folders `scenario/training`,
`training_20s`, `validation`, `testing`, ...; the `tf_example` files hold
another message and are refused.

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

from rcirl_jax.data.importers.files import files_matching
from rcirl_jax.data.importers.options import (
    kind_of,
    number,
    patterns,
    recording_car,
    section,
)
from rcirl_jax.data.importers.perception import without_outliers
from rcirl_jax.data.importers.shapes import (
    check_coordinates,
    local_origin,
    origin_notes,
)
from rcirl_jax.data.importers.waymo.map import read_map
from rcirl_jax.data.readers.tfrecord import FRAME_BYTES, read_records
from rcirl_jax.data.readers.wire_columns import Fields, Record
from rcirl_jax.data.recording import LENGTH_RANGE_M, WIDTH_RANGE_M, accepted
from rcirl_jax.types import Lane, Recording, Track

# field numbers of scenario.proto
TIMESTAMPS, TRACKS, SCENARIO_ID, SDC_TRACK_INDEX = 1, 2, 5, 6
DYNAMIC_MAP_STATES, MAP_FEATURES = 7, 8
TRACK_ID, OBJECT_TYPE, STATES = 1, 2, 3
STATE = {
    2: "double",  # center_x
    3: "double",  # center_y
    5: "float",  # length
    6: "float",  # width
    8: "float",  # heading
    9: "float",  # velocity_x
    10: "float",  # velocity_y
    11: "int",  # valid
}
X, Y, LENGTH, WIDTH, HEADING, VX, VY, VALID = STATE
TYPES = {0: "unset", 1: "vehicle", 2: "pedestrian", 3: "cyclist", 4: "other"}
RATE_HZ = 10.0  # 1/s, the data set's
RATE_TOLERANCE = 0.05  # relative; real stamps jitter by less
MAX_SPAN_S = 3600.0  # s of one scenario
MAX_GAP_STEPS = 5.5  # invalid steps bridged inside one track
LIMIT_MPS = 15.65  # m/s, 35 mph
SMALL_M = 0.05  # m; smaller boxes are errors, larger ones are clipped
PATTERNS = ("*.tfrecord", "*.tfrecord-*-of-*")
WINDOW_S = (5.0, 12.0)  # s, scenarios of this length are overlapping windows
MIB = 1024**2
MAX_NAME = 100  # characters kept of a scenario id


@dataclasses.dataclass(frozen=True, kw_only=True)
class _States:
    """All states of a scenario as arrays [tracks, steps]."""

    t: np.ndarray  # [steps] s
    values: dict[int, np.ndarray]  # by field number of ObjectState
    valid: np.ndarray  # bool


def parts(path: Path, spec: dict) -> list[Path]:
    """The TFRecord files; each can be read alone."""
    return files_matching(path, patterns(spec, PATTERNS), "TFRecord files")


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per scenario, one record in memory at a time."""
    limit = int(number(spec, "max_record_mib", 256) * MIB)
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
    record = Record(where, data)
    wanted = (TIMESTAMPS, TRACKS, SCENARIO_ID, SDC_TRACK_INDEX)
    wanted += (DYNAMIC_MAP_STATES, MAP_FEATURES)
    scenario = record.walk((0, len(data)), wanted)
    spans = scenario.spans(TRACKS)
    if not len(spans):
        raise record.error(
            "tracks: none",
            "Scenario messages (the folder scenario/, not tf_example/ or "
            "lidar_and_camera/)",
        )
    heads = [record.walk(span, (TRACK_ID, OBJECT_TYPE, STATES)) for span in spans]
    states = _states(record, scenario, heads)
    origin = local_origin(
        states.values[X][states.valid], states.values[Y][states.valid]
    )
    states.values[X] -= origin[0]
    states.values[Y] -= origin[1]
    tracks, notes = _tracks(record, heads, states, spec, _recorder(scenario, heads))
    lanes, signals, map_notes = read_map(
        record,
        scenario.spans(MAP_FEATURES),
        scenario.spans(DYNAMIC_MAP_STATES),
        states.t,
        origin,
        spec,
    )
    name = scenario.text(SCENARIO_ID)[:MAX_NAME] or default
    return Recording(
        name=name,
        source=str(spec.get("source", "Waymo Open Motion Dataset")),
        licence=str(spec.get("licence", "unknown")),
        rate_hz=_rate(record, states.t),
        tracks=tracks,
        lanes=lanes,
        signals=signals,
        group=name,
        default_speed_limit=_usual_limit(lanes, spec),
        notes=(
            *origin_notes(origin),
            *_scenario_notes(scenario, heads, states.t),
            *notes,
            *map_notes,
        ),
    )


def _states(record: Record, scenario: Fields, heads: list[Fields]) -> _States:
    t = scenario.doubles(TIMESTAMPS)
    if not t.size or not np.isfinite(t).all() or np.any(np.diff(t) <= 0.0):
        raise record.error(
            f"timestamps_seconds: {t[:4].tolist()} ({t.size})", "increasing times"
        )
    if t[-1] - t[0] > MAX_SPAN_S:
        raise record.error(
            f"timestamps_seconds: {t[-1] - t[0]:g} s", f"at most {MAX_SPAN_S:g} s"
        )
    spans = [head.spans(STATES) for head in heads]
    for head, own in zip(heads, spans, strict=True):
        if len(own) != t.size:
            raise record.error(
                f"track {head.whole(TRACK_ID)}: {len(own)} states",
                f"{t.size}, one per timestamp",
            )
    values = record.columns(np.concatenate(spans), STATE)
    shape = (len(heads), t.size)
    values = {field: column.reshape(shape) for field, column in values.items()}
    valid = values[VALID] != 0
    for column in values.values():
        column[~valid] = 0  # what an invalid state holds means nothing
    seen = np.stack([values[field][valid] for field in (X, Y, VX, VY)], axis=1)
    names = ("center_x", "center_y", "velocity_x", "velocity_y")
    check_coordinates(record.where, "states", names, seen)
    return _States(t=t - t[0], values=values, valid=valid)


def _rate(record: Record, t: np.ndarray) -> float:
    rate = 1.0 / float(np.median(np.diff(t))) if t.size > 1 else RATE_HZ
    if abs(rate / RATE_HZ - 1.0) > RATE_TOLERANCE:
        raise record.error(
            f"timestamps_seconds: {rate:g} per second", f"{RATE_HZ:g} (unit s)"
        )
    return RATE_HZ


def _usual_limit(lanes: tuple[Lane, ...], spec: dict) -> float:
    """Limit [m/s] of lanes without one: the median of the scenario's, if any."""
    limits = [lane.speed_limit for lane in lanes if lane.speed_limit is not None]
    return (
        float(np.median(limits)) if limits else number(spec, "speed_limit", LIMIT_MPS)
    )


def _recorder(scenario: Fields, heads: list[Fields]) -> int | None:
    """Number of the recording car's track."""
    row = scenario.whole(SDC_TRACK_INDEX, -1)
    return row if 0 <= row < len(heads) else None


def _scenario_notes(
    scenario: Fields, heads: list[Fields], t: np.ndarray
) -> Iterator[str]:
    if (row := _recorder(scenario, heads)) is not None:
        yield f"the recording car is track {heads[row].whole(TRACK_ID)}"
    low, high = WINDOW_S
    if low < t[-1] < high:
        yield "9.1 s windows of one drive may share vehicles; training_20s has none"


def _tracks(
    record: Record,
    heads: list[Fields],
    states: _States,
    spec: dict,
    recorder: int | None,
) -> tuple[tuple[Track, ...], list[str]]:
    tracks: list[Track] = []
    unset = unseen = 0
    for row, head in enumerate(heads):
        kind = head.whole(OBJECT_TYPE)
        seen = np.flatnonzero(states.valid[row])
        if not seen.size:
            unseen += 1
        elif TYPES.get(kind) == "unset":
            unset += 1
        else:
            name = str(head.whole(TRACK_ID))
            found = _pieces(record, name, kind, states, row, seen, spec)
            automated = recording_car(spec) if row == recorder else ()
            tracks += [dataclasses.replace(t, automated=automated) for t in found]
    tracks, notes = without_outliers(tracks)
    if unset:
        notes.append(f"{unset} tracks of unset type left out")
    if unseen:
        notes.append(f"{unseen} tracks without a valid state left out")
    return tuple(tracks), notes


def _pieces(
    record: Record,
    name: str,
    kind: int,
    states: _States,
    row: int,
    seen: np.ndarray,
    spec: dict,
) -> Iterator[Track]:
    """The parts of a track between long gaps: "id", "id#2", ..."""
    found = TYPES.get(kind, str(kind))
    known = kind_of(f"{record.where}: track {name}", found, section(spec, "kinds"))
    values = {field: column[row] for field, column in states.values.items()}
    length = _size(values[LENGTH][seen], LENGTH_RANGE_M)
    width = _size(values[WIDTH][seen], WIDTH_RANGE_M)
    cuts = np.flatnonzero(np.diff(seen) > MAX_GAP_STEPS) + 1
    for part, rows in enumerate(np.split(seen, cuts), start=1):
        yield Track(
            id=name if part == 1 else f"{name}#{part}",
            kind=known,
            length=length,
            width=width,
            t=states.t[rows],
            x=values[X][rows],
            y=values[Y][rows],
            heading=values[HEADING][rows],
            speed=np.hypot(values[VX][rows], values[VY][rows]),
        )


def _size(sizes: np.ndarray, allowed: tuple[float, float]) -> float:
    """Median size [m]; estimates a little below the smallest are raised to it."""
    size = float(np.median(sizes))
    return max(size, allowed[0]) if size >= SMALL_M else size
