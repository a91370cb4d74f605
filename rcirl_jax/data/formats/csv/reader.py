"""Tables of a user's own with a TOML mapping: logs need no code.

data_specs/sources/csv_example.toml explains every option of the mapping. Large
coordinates and clocks lose their origin here, in float64: the package computes
in float32 later.
"""

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.csv.map import (
    LIMIT_MPS,
    LogTable,
    lane_file_of,
    lanes_of,
)
from rcirl_jax.data.formats.csv.mapping import Mapping, mapping_of
from rcirl_jax.data.formats.csv.meaning import Meaning, meaning_of
from rcirl_jax.data.formats.csv.users import track_of
from rcirl_jax.data.formats.declared import open_log
from rcirl_jax.data.formats.files import (
    firsts_of_a_name,
    is_input,
    is_long_file,
    log_name,
    table_stem,
)
from rcirl_jax.data.formats.options import number, patterns
from rcirl_jax.data.formats.projection import projected
from rcirl_jax.data.formats.shapes import local_origin, origin_notes
from rcirl_jax.data.formats.tracks import split_tracks
from rcirl_jax.data.readers.long_logs import rows_of
from rcirl_jax.data.readers.tables.rows import RowStats, attach_row_stats
from rcirl_jax.data.readers.tables.table import Table
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording

PATTERNS = (
    *("*.csv", "*.csv.gz", "*.csv.zst", "*.csv.bz2"),
    *("*.tsv", "*.tsv.gz", "*.tsv.zst", "*.tsv.bz2", "*.parquet", "*.feather"),
)  # of files that are read; of those called alike the first pattern's
MAX_GAP_STEPS = 5.5  # missing rows bridged inside one track
STILL_M = 0.5  # m; a log in which all road users stay within it is in degrees


@dataclasses.dataclass(frozen=True, kw_only=True)
class Log:
    """One file, its mapping and what becomes of its rows."""

    table: Table
    spec: dict
    mapping: Mapping
    stats: RowStats

    @property
    def path(self) -> Path:
        """The file."""
        return self.table.path

    @property
    def name(self) -> str:
        """Name of its recording, or what its recordings' names begin with."""
        return log_name(self.path, self.spec, own_name(self.path))

    def metres(self, points: np.ndarray) -> np.ndarray:
        """Positions [n, 2] of the file in metres."""
        if self.mapping.middle is None:
            return points
        degrees = points * self.mapping.degrees
        east, north = projected(degrees[:, 0], degrees[:, 1], self.mapping.middle)
        return np.stack([east, north], axis=1)

    def placed(self, rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Rows with x and y in metres."""
        if self.mapping.middle is None:
            return rows
        x, y = self.metres(np.stack([rows["x"], rows["y"]], axis=1)).T
        return {**rows, "x": x, "y": y}


def parts(path: Path, spec: dict) -> list[Path]:
    """The tables; each can be read alone.

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
    """One Recording per file, or per value of the `recording` column.

    Of a file too long for memory one per minute.
    """
    for file in parts(path, spec):
        log = opened(file, spec)
        for made in _recordings(log, is_long_file(file, spec)):
            yield validate_recording(attach_row_stats(made, log.stats), file)


def opened(file: Path, spec: dict) -> Log:
    """A file with its mapping, none of whose rows is read."""
    table, stats = open_log(file, spec)
    return Log(table=table, spec=spec, mapping=mapping_of(table, spec), stats=stats)


def _recordings(log: Log, is_long: bool) -> Iterator[Recording]:
    fields, gap_s = log.mapping.fields, MAX_GAP_STEPS / log.mapping.rate_hz
    with rows_of(
        log.table,
        fields,
        log.stats,
        is_long=is_long,
        distance=log.mapping.distance,
        is_clock=log.mapping.is_clock,
    ) as rows:
        every = rows.recordings()
        minutes = (log.placed(part) for one in every for part in rows.minutes(one))
        automated = rows.texts_of("automated")
        meaning = meaning_of(log.path, minutes, automated, log.mapping, log.spec)
        for recording in every:
            name = log.name if recording is None else f"{log.name}-{recording}"
            for piece in rows.slices(recording, gap_s):
                table = _localise(log, log.placed(piece.values), meaning)
                made = _recording(f"{name}{piece.label}", table, log, meaning)
                yield piece.of_log(name, made)


def _localise(log: Log, values: dict[str, np.ndarray], meaning: Meaning) -> LogTable:
    """Move far coordinates near the origin."""
    values = meaning.applied(values)
    x, y = values["x"], values["y"]
    span = max(np.ptp(x), np.ptp(y))
    if not log.mapping.has_units and 0.0 < span < STILL_M:
        raise InputError(
            f"{log.path}: x, y: all within {span:.3g} m: expected road users that move;"
            ' longitude and latitude? say units.x = "deg", units.y = "deg"'
        )
    origin = local_origin(x, y)
    return LogTable(
        path=log.path,
        values={**values, "x": x - origin[0], "y": y - origin[1]},
        rate_hz=log.mapping.rate_hz,
        origin=origin,
        notes=(*log.mapping.notes, *meaning.notes, *origin_notes(origin)),
        metres=log.metres,
    )


def _recording(name: str, table: LogTable, log: Log, meaning: Meaning) -> Recording:
    spec, values = log.spec, table.values
    gap_s = MAX_GAP_STEPS / table.rate_hz
    # rows may come in any order
    places = np.stack([values["x"], values["y"]], axis=1)
    pieces = split_tracks(
        table.path, values["id"], values["t"], gap_s, reuse=0.0, places=places
    )
    tracks = tuple(
        track_of(label, table, rows, spec, meaning) for label, rows in pieces
    )
    lanes, notes = lanes_of(table, spec, tracks)
    return Recording(
        name=name,
        source=str(spec.get("source", "CSV log")),
        licence=str(spec.get("licence", "unknown")),
        rate_hz=table.rate_hz,
        tracks=tracks,
        lanes=lanes,
        default_speed_limit=number(spec, "speed_limit", LIMIT_MPS),
        notes=(*table.notes, *notes),
    )
