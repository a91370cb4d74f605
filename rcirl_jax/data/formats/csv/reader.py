"""Tables of a user's own with a TOML mapping: logs need no code.

data_specs/sources/csv_example.toml explains every option of the mapping. Large
coordinates and clocks lose their origin here, in float64: the package computes
in float32 later.
"""

import collections
import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path

import msgspec
import numpy as np

from rcirl_jax.data.formats.csv.columns import (
    LogColumns,
    Meaning,
    check_clock,
    columns_of,
    meaning_of,
)
from rcirl_jax.data.formats.declared import open_log, track_of
from rcirl_jax.data.formats.files import (
    firsts_of_a_name,
    is_input,
    is_long_file,
    log_name,
    table_stem,
)
from rcirl_jax.data.formats.lanes import (
    LANE_WIDTH_M,
    StraightLane,
    lane_file_of,
    lanes_of_toml,
    straight_lanes,
)
from rcirl_jax.data.formats.options import (
    KINDS,
    number,
    one_of,
    patterns,
    section,
    stated,
)
from rcirl_jax.data.formats.shapes import local_origin, origin_notes
from rcirl_jax.data.formats.tracks import spans_of, split_tracks
from rcirl_jax.data.readers.long_logs import rows_of
from rcirl_jax.data.readers.tables.rows import Rows, RowStats, attach_row_stats
from rcirl_jax.data.readers.tables.table import Table
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.checked import checked
from rcirl_jax.types import Kind, Lane, MissingAgent, OpenRoads, Recording, Track

PATTERNS = (
    *("*.csv", "*.csv.gz", "*.csv.zst", "*.csv.bz2"),
    *("*.tsv", "*.tsv.gz", "*.tsv.zst", "*.tsv.bz2", "*.parquet", "*.feather"),
)  # of files that are read; of those called alike the first pattern's
MAX_GAP_STEPS = 5.5  # missing rows bridged inside one track
STILL_M = 0.5  # m; a log in which all road users stay within it is in degrees
# box centre ahead of the recorded position, in box lengths
REFERENCE = {"centre": 0.0, "front": -0.5, "rear": 0.5}
SIZE_M = {"length": 4.5, "width": 1.8}  # m, a car
MAX_NAMED = 40  # unknown kinds
MARGIN_M = 50.0  # m of fitted lane beyond the first and last position
LIMIT_MPS = 29.06  # m/s, 65 mph


@dataclasses.dataclass(frozen=True, kw_only=True)
class Log:
    """One file, its columns and what becomes of its rows."""

    table: Table
    spec: dict
    columns: LogColumns
    stats: RowStats
    kinds: tuple[str, ...] = ()  # all texts of its kinds, once its rows are read

    def placed(self, rows: Rows) -> Rows:
        """Returns rows with x and y in metres."""
        if self.columns.middle is None:
            return rows
        x, y = self.columns.metres(np.stack([rows["x"], rows["y"]], axis=1)).T
        return {**rows, "x": x, "y": y}


def parts(path: Path, spec: dict) -> list[Path]:
    """Returns the tables; each can be read alone.

    Of files in one folder with one name that of the first pattern counts: it is the
    same log.
    """
    lane_file, wanted = lane_file_of(spec), patterns(spec, PATTERNS)
    found = [path]
    if path.is_dir():
        every = (sorted(path.glob(pattern)) for pattern in wanted)
        matching = itertools.chain.from_iterable(every)
        found = firsts_of_a_name(file for file in matching if is_input(path, file))
    if not found:
        expected = ", ".join(wanted)
        raise InputError(f"{path}: no file matches {expected}: expected log files")
    files = [file for file in found if file.name != lane_file]
    if not files:
        raise InputError(f"{path}: files: only {lane_file}: expected logs beside it")
    return files


own_name = table_stem  # of a log, as long as no other folder has one called alike


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per file, or per value of the `recording` column.

    Of a file too long for memory one per minute.
    """
    for file in parts(path, spec):
        log = opened(file, spec)
        columns, own = log.columns, log_name(file, spec, own_name(file))
        with rows_of(
            log.table,
            columns.fields,
            log.stats,
            is_long=is_long_file(file, spec),
            distance=columns.distance,
            turn_s=columns.turn_s,
        ) as rows:
            check_clock(file, rows.seconds(), columns)
            every = rows.recordings()
            minutes = (log.placed(part) for one in every for part in rows.minutes(one))
            log = dataclasses.replace(log, kinds=tuple(rows.texts_of("kind")))
            automated = rows.texts_of("automated")
            meaning = meaning_of(file, minutes, automated, columns, spec)
            for recording in every:
                name = own if recording is None else f"{own}-{recording}"
                for part in rows.slices(recording, MAX_GAP_STEPS / columns.rate_hz):
                    values = meaning.applied(log.placed(part.values))
                    of = (values, log, meaning)
                    made = _recording(f"{name}{part.label}", recording, *of)
                    made = dataclasses.replace(made, start_s=part.start)
                    made = attach_row_stats(part.of_log(name, made), log.stats)
                    yield validate_recording(made, file)


def opened(file: Path, spec: dict) -> Log:
    """Opens a file with its columns; none of its rows is read."""
    names = [*section(spec, "columns").values(), *section(spec, "kinds")]
    known = [name for name in names if isinstance(name, str)]
    table, stats = open_log(file, spec, known)
    return Log(table=table, spec=spec, columns=columns_of(table, spec), stats=stats)


def _recording(
    name: str, recording: str | None, values: Rows, log: Log, meaning: Meaning
) -> Recording:
    path, spec, columns = log.table.path, log.spec, log.columns
    span = max(np.ptp(values["x"]), np.ptp(values["y"]))
    if not columns.has_units and 0.0 < span < STILL_M:
        raise InputError(
            f"{path}: x, y: all within {span:.3g} m: expected road users that move;"
            ' longitude and latitude? say units.x = "deg", units.y = "deg"'
        )
    origin = local_origin(values["x"], values["y"])
    places = np.stack([values["x"], values["y"]], axis=1) - origin
    values = {**values, "x": places[:, 0], "y": places[:, 1]}
    gap_s = MAX_GAP_STEPS / columns.rate_hz
    # rows may come in any order
    pieces = split_tracks(
        path, values["id"], values["t"], gap_s, reuse=0.0, places=places
    )
    tracks = tuple(
        _track(label, {n: column[rows] for n, column in values.items()}, log, meaning)
        for label, rows in pieces
    )
    numbers = values.get("lane")
    labels = None if numbers is None else [numbers[rows] for _, rows in pieces]
    lanes, open_roads, notes = _lanes(values, tracks, labels, log, origin)
    if open_roads is not None:
        open_roads = dataclasses.replace(open_roads, place=recording or "")
    return Recording(
        name=name,
        source=str(spec.get("source", "CSV log")),
        licence=str(spec.get("licence", "unknown")),
        rate_hz=columns.rate_hz,
        tracks=tracks,
        lanes=lanes,
        open_roads=open_roads,
        origin=(float(origin[0]), float(origin[1])),
        missing_agents=_missing(spec, recording, origin),
        default_speed_limit=number(spec, "speed_limit", LIMIT_MPS),
        notes=(*columns.notes, *meaning.notes, *origin_notes(origin), *notes),
    )


class _Missing(msgspec.Struct, forbid_unknown_fields=True):
    """[[missing]]: a vehicle that drove there and has no rows."""

    time: tuple[float, float]  # s, as in the log
    x: tuple[float, float]  # m, at both times, as in the log
    y: tuple[float, float]
    recording: str = ""  # a value of the `recording` column, "": every one


def _missing(
    spec: Mapping, recording: str | None, origin: np.ndarray
) -> tuple[MissingAgent, ...]:
    """Returns the vehicles that the TOML says are missing from a recording."""
    every = checked(spec.get("missing", []), list[_Missing], "source TOML: missing")
    return tuple(
        MissingAgent(
            t0=one.time[0],
            t1=one.time[1],
            start=(one.x[0] - origin[0], one.y[0] - origin[1]),
            end=(one.x[1] - origin[0], one.y[1] - origin[1]),
        )
        for one in every
        if one.recording in ("", recording)
    )


def _track(name: str, rows: Rows, log: Log, meaning: Meaning) -> Track:
    """A track of some rows; what they do not say is that of [defaults]."""
    spec, usual = log.spec, section(log.spec, "defaults")
    known = collections.Counter(rows.get("kind", np.zeros(0, str)).tolist())
    del known[""]
    # the most frequent one
    found = max(known, key=lambda text: known[text], default=str(usual.get("kind", "")))

    def kind_of(text: str) -> str:
        return str(section(spec, "kinds").get(text, text or "vehicle")).lower()

    if kind_of(found) not in KINDS:
        every = sorted({found, *log.kinds})
        wrong = ", ".join([t for t in every if kind_of(t) not in KINDS][:MAX_NAMED])
        raise InputError(
            f"{log.table.path}: id {name}: kind: {wrong}: expected one of "
            f"{', '.join(KINDS)}, or an entry in [kinds] for each"
        )
    reference = one_of(spec, "reference_point", REFERENCE, "centre")
    automated = np.zeros(rows["t"].size, bool)
    if "automated" in rows:
        automated = meaning.automated(rows["automated"])
    length, width = (number(usual, field, size) for field, size in SIZE_M.items())
    spans = spans_of(rows["t"], automated)
    kind = Kind[kind_of(found).upper()]
    made = track_of(name, rows, kind, (length, width), automated=spans)
    ahead = REFERENCE[reference] * made.length
    return dataclasses.replace(
        made,
        x=made.x + ahead * np.cos(made.heading),
        y=made.y + ahead * np.sin(made.heading),
    )


def _lanes(
    values: Rows,
    tracks: tuple[Track, ...],
    labels: list[np.ndarray] | None,
    log: Log,
    origin: np.ndarray,
) -> tuple[tuple[Lane, ...], OpenRoads | None, list[str]]:
    """The lanes given; else straight ones of the lane column; else they are open."""
    path, spec = log.table.path, log.spec
    given = lanes_of_toml(path, spec, lambda p: log.columns.metres(p) - origin)
    if given:
        return given, None, []
    limit = stated(spec, "speed_limit")
    width = number(spec, "lane_width_m", LANE_WIDTH_M)
    found = _straight(values, tracks, width) if "lane" in values else None
    if found:
        lanes = straight_lanes(path, found, width, limit)
        return lanes, None, ["straight lanes fitted to the lane column"]
    own = None if labels is None else tuple(labels)
    return (), OpenRoads(width=width, limit=limit, labels=own), []


def _straight(
    values: Rows, tracks: tuple[Track, ...], width: float
) -> list[StraightLane] | None:
    """Lanes parallel to the x axis, or None where the rows of one are not."""
    x, y, names = (values[field] for field in ("x", "y", "lane"))
    towards = {t.id.split("#")[0]: float(t.x[-1] - t.x[0]) for t in tracks}
    travel = np.array([towards.get(str(i), 0.0) for i in values["id"]])
    found = []
    for name in np.unique(names[names != ""]):
        rows = names == name
        centre = float(np.median(y[rows]))
        if np.median(np.abs(y[rows] - centre)) > 0.5 * width:
            return None
        found.append(
            StraightLane(
                id=str(name),
                y=centre,
                lower=float(x[rows].min()) - MARGIN_M,
                upper=float(x[rows].max()) + MARGIN_M,
                forward=bool(np.median(travel[rows]) >= 0.0),
            )
        )
    return found
