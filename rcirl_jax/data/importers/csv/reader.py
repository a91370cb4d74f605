"""Tables of a user's own with a TOML mapping: logs need no code.

data_specs/sources/csv_example.toml explains every option of the mapping. Large
coordinates and clocks lose their origin here, in float64: the package computes
in float32 later.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from rcirl_jax.data.importers.csv.earth import projected
from rcirl_jax.data.importers.csv.map import (
    LIMIT_MPS,
    LogTable,
    lane_file_of,
    lanes_of,
)
from rcirl_jax.data.importers.csv.mapping import Mapping, mapping_of
from rcirl_jax.data.importers.csv.meaning import Meaning, meaning_of
from rcirl_jax.data.importers.csv.users import track_of
from rcirl_jax.data.importers.files import (
    input_files,
    is_long_file,
    log_name,
    table_stem,
)
from rcirl_jax.data.importers.options import number, patterns, section
from rcirl_jax.data.importers.tracks import split_tracks
from rcirl_jax.data.readers import long_logs
from rcirl_jax.data.readers.tables.ledger import LINE, Ledger, allowed_share
from rcirl_jax.data.readers.tables.repair import single_rows
from rcirl_jax.data.readers.tables.table import Table, batches, open_table, read
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording

PATTERNS = (
    *("*.csv", "*.csv.gz", "*.csv.zst", "*.tsv", "*.parquet", "*.feather"),
)  # of files that are read; of those called alike the first pattern's
MAX_GAP_STEPS = 5.5  # missing rows bridged inside one track
FAR_M = 1e4  # m; coordinates beyond it (UTM) are moved to a local origin
ORIGIN_STEP_M = 1000.0  # m, local origins are multiples of it
STILL_M = 0.5  # m; a log in which all road users stay within it is in degrees


@dataclasses.dataclass(frozen=True, kw_only=True)
class Log:
    """One file, its mapping and what becomes of its rows."""

    table: Table
    spec: dict
    mapping: Mapping
    ledger: Ledger

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


def parts(path: Path, spec: dict) -> list[Path]:
    """The tables; each can be read alone.

    Of files in one folder with one name that of the first pattern counts: it is the
    same log.
    """
    lane_file = lane_file_of(spec)
    wanted = patterns(spec, PATTERNS)
    found: dict[tuple[Path, str], Path] = {}
    failed: InputError | None = None
    for pattern in wanted:
        try:
            files = input_files(path, pattern)
        except InputError as error:
            failed = failed or error
            continue
        for file in files:
            found.setdefault((file.parent, table_stem(file)), file)
    files = [file for file in found.values() if file.name != lane_file]
    if not found and failed is not None:
        expected = ", ".join(wanted)
        raise InputError(f"{path}: no file matches {expected}: expected log files")
    if not files:
        raise InputError(f"{path}: files: only {lane_file}: expected logs beside it")
    return files


def own_name(file: Path) -> str:
    """Name of a log, as long as no other folder has one called alike."""
    return table_stem(file)


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per file, or per value of the `recording` column."""
    for file in parts(path, spec):
        log = opened(file, spec)
        found = _long(log) if is_long_file(file, spec) else _whole(log)
        for made in found:
            counts, notes = log.ledger.news()
            notes = (*made.notes, *notes)
            yield validate_recording(
                dataclasses.replace(made, rows=counts, notes=notes), file
            )


def opened(file: Path, spec: dict) -> Log:
    """A file with its mapping, none of whose rows is read."""
    table = open_table(file, section(spec, "table"))
    return Log(
        table=table,
        spec=spec,
        mapping=mapping_of(table, spec),
        ledger=Ledger(path=file, unit=table.unit, allowed=allowed_share(spec)),
    )


def _whole(log: Log) -> Iterator[Recording]:
    """Recordings of a file that is held as a whole."""
    values = read(log.table, log.mapping.fields, log.ledger)
    names = values.pop("recording", None)
    found = {}
    for part in [None] if names is None else np.unique(names).tolist():
        rows = slice(None) if names is None else names == part
        found[part] = _placed(log, {n: column[rows] for n, column in values.items()})
    meaning = _meaning(log, found.values(), np.unique(values.get("automated", [])))
    for part, rows in found.items():
        compared = [name for name in rows if name != LINE]
        kept = single_rows(rows, log.ledger, compared)
        rows = {name: column[kept] for name, column in rows.items()}
        table = _localise(log, rows, meaning)
        name = log.name if part is None else f"{log.name}-{part}"
        yield _recording(name, table, log, meaning)


def _long(log: Log) -> Iterator[Recording]:
    """One Recording per minute of a file too long for memory."""
    with long_logs.spilled(
        log.path,
        lambda show: batches(log.table, log.mapping.fields, log.ledger, show),
        log.ledger,
    ) as spill:
        minutes = (
            _placed(log, minute)
            for recording in spill.recordings()
            for minute in spill.minutes(recording)
        )
        meaning = _meaning(log, minutes, spill.texts.get("automated", {}))
        for recording in spill.recordings():
            name = log.name if recording is None else f"{log.name}-{recording}"
            gap_s = MAX_GAP_STEPS / log.mapping.rate_hz
            for piece in spill.pieces(recording, gap_s):
                rows = _placed(log, piece.values)
                table = _localise(log, rows, meaning, start=0.0)
                made = _recording(f"{name}-{piece.label}", table, log, meaning)
                yield long_logs.piece_of(name, made, piece)


def _meaning(
    log: Log, rows: Iterable[dict[str, np.ndarray]], automated: Iterable[str]
) -> Meaning:
    return meaning_of(log.path, rows, automated, log.mapping, log.spec)


def _placed(log: Log, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Rows with x and y in metres."""
    if log.mapping.middle is None:
        return values
    points = np.stack([values["x"], values["y"]], axis=1)
    x, y = log.metres(points).T
    return {**values, "x": x, "y": y}


def _localise(
    log: Log,
    values: dict[str, np.ndarray],
    meaning: Meaning,
    start: float | None = None,
) -> LogTable:
    """Start the clock at 0 (or at `start`), move far coordinates near the origin."""
    values = meaning.applied(values)
    notes = [*log.mapping.notes, *meaning.notes]
    values["t"] = values["t"] - (values["t"].min() if start is None else start)
    span = max(np.ptp(values["x"]), np.ptp(values["y"]))
    if not log.mapping.has_units and 0.0 < span < STILL_M:
        raise InputError(
            f"{log.path}: x, y: all within {span:.3g} m: expected road users that move;"
            ' longitude and latitude? say units.x = "deg", units.y = "deg"'
        )
    middle = np.array([np.median(values["x"]), np.median(values["y"])])
    origin = np.zeros(2)
    if np.any(np.abs(middle) > FAR_M):
        origin = np.round(middle / ORIGIN_STEP_M) * ORIGIN_STEP_M
        notes.append(f"local origin at x = {origin[0]:.0f} m, y = {origin[1]:.0f} m")
    values["x"], values["y"] = values["x"] - origin[0], values["y"] - origin[1]
    return LogTable(
        path=log.path,
        values=values,
        rate_hz=log.mapping.rate_hz,
        origin=origin,
        notes=tuple(notes),
        metres=log.metres,
    )


def _recording(name: str, table: LogTable, log: Log, meaning: Meaning) -> Recording:
    spec = log.spec
    pieces = split_tracks(
        table.path,
        table.values["id"],
        table.values["t"],
        MAX_GAP_STEPS / table.rate_hz,
        reuse=0.0,  # rows may come in any order
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
