"""Argoverse 2 motion forecasting: scenario_<id>.parquet with a map beside it.

Layout of the data set (https://argoverse.github.io/user-guide, av2-api):
`{train,val,test}/<id>/scenario_<id>.parquet` and, in the same folder,
`log_map_archive_<id>.json`. A scenario lasts 11 s at 10 Hz (test: the first
5 s), positions are box centres in metres of the city's frame, headings are
radians counter-clockwise.

Traps: the files hold no box sizes, so these come by type from the source TOML;
`left_neighbor_id` of a map may name an oncoming lane; tracks of category
"fragment" are of low quality; scenarios cut from one slice of a drive share
vehicles, so the slice is the vehicle-disjoint group. The centre line of a lane lies
midway between its boundaries, as in the data set's own devkit. There are no speed
limits, signals or stop lines.
"""

import collections
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from rcirl_jax.data.formats.files import files_below
from rcirl_jax.data.formats.options import (
    kind_of,
    lane_types,
    number,
    patterns,
    recording_car,
    section,
)
from rcirl_jax.data.formats.perception import has_possible_speed, without_outliers
from rcirl_jax.data.formats.shapes import (
    check_coordinates,
    facing,
    lane_between,
    local_origin,
    origin_notes,
)
from rcirl_jax.data.formats.tracks import once_each, split_tracks
from rcirl_jax.data.readers.tables.rows import RowStats
from rcirl_jax.data.readers.tables.table import fields_of, open_table, read
from rcirl_jax.data.recording import MAX_SPEED_MPS, validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import read_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.types import Lane, Recording, Track

COLUMNS: dict[str, str] = dict.fromkeys(
    (
        *("object_category", "timestep", "position_x", "position_y", "heading"),
        *("velocity_x", "velocity_y", "start_timestamp", "end_timestamp"),
        "num_timestamps",
    ),
    "number",
)
COLUMNS |= dict.fromkeys(("track_id", "object_type", "scenario_id"), "text")
OPTIONAL = {"slice_id": "text"}
PREFIX, SUFFIX = "scenario_", ".parquet"
STEP_S = 0.1  # s, the data set's sampling interval
STEP_TOLERANCE = 0.01  # relative; the stamps are rounded to 64 ns
MAX_STEPS = 10_000  # 1000 s; a scenario has 110
MAX_CATEGORY = 3  # 0 fragment, 1 unscored, 2 scored, 3 focal track
RECORDER = "AV"  # id of the recording car
FRAGMENT = 0
MAX_GAP_STEPS = 5.5  # missing steps bridged inside one track
MAX_FILE_BYTES = 64 * 1024**2  # bytes of a map; published ones have 0.1 to 1 MB
LANE_TYPES = ("VEHICLE", "BUS", "BIKE")
DRIVEN = ("VEHICLE", "BUS")  # read unless the source TOML says otherwise


def parts(path: Path, spec: dict) -> list[Path]:
    """Lists the scenario files; each can be read alone."""
    return files_below(path, patterns(spec), "scenario files")


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per scenario file, of a file, a folder or a split."""
    for file in parts(path, spec):
        yield validate_recording(_read_scenario(file, spec), file)


def _read_scenario(file: Path, spec: dict) -> Recording:
    table = _read_rows(file)
    (name, group), notes = _names(file, table), _check_clock(file, table)
    fields = ("position_x", "position_y", "velocity_x", "velocity_y")
    values = np.stack([table[field] for field in fields], axis=1)
    check_coordinates(file, "rows", fields, values)
    origin = local_origin(values[:, 0], values[:, 1])
    table["x"], table["y"] = (values[:, :2] - origin).T.copy()
    table["speed"] = np.hypot(*values[:, 2:].T)
    tracks, track_notes = _read_tracks(file, table, spec)
    since = float(table["timestep"].min()) * STEP_S
    # the map lies beside a scenario, named by the scenario file or its id
    stem = file.name.removeprefix(PREFIX).removesuffix(SUFFIX)
    maps = [f"log_map_archive_{key}.json" for key in (stem, name)]
    found = [file.parent / n for n in maps if Path(n).name == n]
    found = [place for place in found if place.is_file()]
    if not found:
        raise InputError(f"{file}: map: missing: expected {maps[0]} beside it")
    lanes, lane_notes = _lanes(found[0], origin, spec)
    return Recording(
        name=name,
        source=spec["source"],
        licence=spec["licence"],
        rate_hz=1.0 / STEP_S,
        start_s=float(table["start_timestamp"][0]) * 1e-9 + since,
        origin=(float(origin[0]), float(origin[1])),
        tracks=tracks,
        lanes=lanes,
        group=group,
        default_speed_limit=number(spec, "speed_limit"),
        notes=(*origin_notes(origin), *notes, *track_notes, *lane_notes),
    )


def _read_rows(file: Path) -> dict[str, np.ndarray]:
    """The columns of a scenario, none of whose cells is empty."""
    source = open_table(file)
    if source.layout is not None:
        raise InputError(f"{file}: parquet: text: expected Parquet")
    stats = RowStats(path=file, unit=source.unit, allowed=0.0)
    return read(source, fields_of(source, COLUMNS, OPTIONAL), stats)


def _names(file: Path, table: dict[str, np.ndarray]) -> list[str]:
    """The scenario's id and its slice, if it has one; the same in every row."""
    found = []
    for field in ("scenario_id", "slice_id" if "slice_id" in table else "scenario_id"):
        values = [*map(str, np.unique(table[field])[:3])]
        if len(values) != 1 or not values[0].strip():
            raise InputError(f"{file}: {field}: {values}: expected one for all rows")
        found += values
    return found


def _check_clock(file: Path, table: dict[str, np.ndarray]) -> list[str]:
    """Checks steps against their number; notes stamps [ns] that are not at 10 Hz."""
    steps, count = table["timestep"], table["num_timestamps"][0]
    if not 1 <= count <= MAX_STEPS:
        raise InputError(
            f"{file}: num_timestamps: {count:g}: expected 1 to {MAX_STEPS}"
        )
    _check_whole(file, "timestep", steps, count - 1)
    table["t"] = (steps - steps.min()) * STEP_S
    span = (table["end_timestamp"][0] - table["start_timestamp"][0]) * 1e-9
    step = span / max(count - 1, 1)
    if count == 1 or abs(step / STEP_S - 1.0) <= STEP_TOLERANCE:
        return []
    return [f"timestamps {step:g} s apart; {STEP_S:g} s assumed, as specified"]


def _check_whole(file: Path, field: str, values: np.ndarray, most: float) -> None:
    bad = np.flatnonzero((values < 0) | (values > most) | (values % 1.0 != 0.0))
    if bad.size:
        raise InputError(
            f"{file}: row {bad[0]}: {field}: {values[bad[0]]:g}: "
            f"expected a whole number from 0 to {most:g}"
        )


def _read_tracks(
    file: Path, table: dict[str, np.ndarray], spec: dict
) -> tuple[tuple[Track, ...], list[str]]:
    _check_whole(file, "object_category", table["object_category"], MAX_CATEGORY)
    users = np.unique(table["track_id"], return_inverse=True)[1]
    kept, notes = once_each(users, table["timestep"])
    table = {name: column[kept] for name, column in table.items()}
    category = table["object_category"]
    least = number(spec, "min_category")
    tracks, low, wild = [], 0, 0
    pieces = split_tracks(file, table["track_id"], table["timestep"], MAX_GAP_STEPS)
    for name, rows in pieces:
        fastest = table["speed"][rows].max()
        if category[rows[0]] < least:
            low += 1
        elif category[rows[0]] == FRAGMENT and fastest > MAX_SPEED_MPS:
            wild += 1
        else:
            tracks.append(_track(file, name, table, rows, spec))
    # sizes are the source TOML's, so that a wrong one is no outlier
    # the recording car's own speed is measured: if that is wrong, so is the file
    tracks, outliers = without_outliers(
        tracks, lambda track: track.id == RECORDER or has_possible_speed(track)
    )
    if low:
        notes.append(f"{low} tracks below category {least:g} left out")
    if wild:
        notes.append(f"{wild} track fragments of impossible speed left out")
    notes += [*outliers, "box sizes by object type: the log has none"]
    return tuple(tracks), notes


def _track(
    file: Path, name: str, table: dict[str, np.ndarray], rows: np.ndarray, spec: dict
) -> Track:
    found, user = str(table["object_type"][rows[0]]), name.partition("#")[0]
    kind = kind_of(f"{file}: track {name}", found, section(spec, "kinds"))
    sizes = section(spec, "sizes")
    size = sizes.get(user, sizes.get(found))  # by id (the AV's), else by type
    try:
        length, width = map(float, size or ())
    except (TypeError, ValueError) as error:
        raise InputError(
            f"source TOML: sizes.{found}: {size}: expected [length, width] in m"
        ) from error
    return Track(
        id=name,
        kind=kind,
        length=length,
        width=width,
        size_assumed=True,
        automated=recording_car(spec) if user == RECORDER else (),
        t=table["t"][rows],
        x=table["x"][rows],
        y=table["y"][rows],
        heading=table["heading"][rows],
        speed=table["speed"][rows],
    )


# ------------------------------------------------------------------------ map


class _Point(msgspec.Struct):
    x: float
    y: float


_Bound = Annotated[list[_Point], msgspec.Meta(min_length=2)]


class _Segment(msgspec.Struct):
    """The fields of a lane segment that are read."""

    id: int
    lane_type: Literal["VEHICLE", "BUS", "BIKE"]
    left_lane_boundary: _Bound
    right_lane_boundary: _Bound
    successors: list[int]
    left_neighbor_id: int | None = None
    right_neighbor_id: int | None = None


class _Map(msgspec.Struct):
    lane_segments: dict[str, dict]


def _lanes(
    path: Path, origin: np.ndarray, spec: dict
) -> tuple[tuple[Lane, ...], list[str]]:
    """Reads lanes of the wanted types, with notes on what was left out."""
    wanted = lane_types(spec, LANE_TYPES, DRIVEN)
    content = read_json(path, "JSON", MAX_FILE_BYTES)
    segments = [
        checked(segment, _Segment, f"{path}: lane segment {key[:40]}")
        for key, segment in checked(content, _Map, path).lane_segments.items()
    ]
    kept = [segment for segment in segments if segment.lane_type in wanted]
    if not kept:
        raise InputError(
            f"{path}: lane_segments: {len(segments)}, none of type "
            f"{', '.join(wanted)}: expected at least one"
        )
    ids = collections.Counter(segment.id for segment in kept)
    if len(ids) < len(kept):
        twice = max(ids, key=ids.__getitem__)
        raise InputError(f"{path}: lane segment {twice}: id: met twice: expected once")
    found = [_lane(path, segment, origin) for segment in kept]
    whole = {lane.id: lane for lane in found if len(lane.centre) > 1}
    notes = []
    if others := len(segments) - len(kept):
        notes.append(f"{others} lanes not of type {', '.join(wanted)} left out")
    if empty := len(found) - len(whole):
        notes.append(f"{empty} lanes without length left out")
    chord = {name: lane.centre[-1] - lane.centre[0] for name, lane in whole.items()}

    def same_way(lane: Lane, other: str | None) -> str | None:
        """The neighbour, if it is driven the same way."""
        return other if other in chord and chord[lane.id] @ chord[other] > 0.0 else None

    return tuple(
        dataclasses.replace(
            lane, left=same_way(lane, lane.left), right=same_way(lane, lane.right)
        )
        for lane in whole.values()
    ), notes


def _lane(path: Path, segment: _Segment, origin: np.ndarray) -> Lane:
    bounds = []
    for side in ("left_lane_boundary", "right_lane_boundary"):
        points = np.array([(point.x, point.y) for point in getattr(segment, side)])
        where = f"lane segment {segment.id}: {side}"
        check_coordinates(path, where, ("x", "y"), points)
        bounds.append(points - origin)
    return lane_between(
        str(segment.id),
        facing(*bounds),
        speed_limit=None,
        successors=tuple(map(str, segment.successors)),
        left=str(segment.left_neighbor_id),  # "None" is no lane's
        right=str(segment.right_neighbor_id),
    )
