"""Generic CSV with a TOML mapping: a user's own logs need no code.

data_specs/sources/csv_example.toml explains every option of the mapping. Large
coordinates and clocks lose their origin here, in float64: the package computes
in float32 later.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rcirl_jax.data.importers.csv.map import (
    LIMIT_MPS,
    LogTable,
    lane_file_of,
    lanes_of,
)
from rcirl_jax.data.importers.files import input_files, is_long_file
from rcirl_jax.data.importers.options import number, patterns, section, unit_factor
from rcirl_jax.data.importers.tracks import spans_of, split_tracks, travel_heading
from rcirl_jax.data.readers import csv_stream, long_logs
from rcirl_jax.data.readers.sparse_tables import (
    MAX_PLACE_M,
    MAX_TIME,
    MAX_VELOCITY_MPS,
    check_range,
)
from rcirl_jax.data.readers.tables import read_header, read_table
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Recording, Track

NEEDED = ("t", "id", "x", "y")
OPTIONAL = (
    *("heading", "speed", "length", "width"),
    *("kind", "lane", "recording", "automated"),
)
EXPECTED = (*NEEDED, "automated")  # errors where they are named and not there
TEXT = ("id", "kind", "lane", "recording")
LENGTH_UNITS = ("m", "ft")
ALLOWED_UNITS = {
    "t": ("s", "ms", "us", "ns", "frame"),
    "x": LENGTH_UNITS,
    "y": LENGTH_UNITS,
    "length": LENGTH_UNITS,
    "width": LENGTH_UNITS,
    "speed": ("m/s", "km/h", "mph", "ft/s"),
    "heading": ("rad", "deg"),
}
# in the file's unit: what no log can mean
LIMITS = {
    "t": MAX_TIME,
    "x": MAX_PLACE_M,
    "y": MAX_PLACE_M,
    "speed": MAX_VELOCITY_MPS,
    "heading": MAX_PLACE_M,
}
KINDS = ("vehicle", "cyclist", "pedestrian", "static")
# box centre ahead of the recorded position, in box lengths
REFERENCE = {"centre": 0.0, "front": -0.5, "rear": 0.5}
SIZE_M = {"length": 4.5, "width": 1.8}  # m, a car
RATE_HZ = 10.0  # 1/s
MAX_GAP_STEPS = 5.5  # missing rows bridged inside one track
FAR_M = 1e4  # m; coordinates beyond it (UTM) are moved to a local origin
ORIGIN_STEP_M = 1000.0  # m, local origins are multiples of it


def parts(path: Path, spec: dict) -> list[Path]:
    """The CSV files; each can be read alone."""
    lane_file = lane_file_of(spec)
    found = [input_files(path, pattern) for pattern in patterns(spec, ("*.csv",))]
    every = dict.fromkeys(itertools.chain.from_iterable(found))  # each file once
    files = [file for file in every if file.name != lane_file]
    if not files:
        raise InputError(f"{path}: files: only {lane_file}: expected logs beside it")
    return files


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per file, or per value of the `recording` column."""
    for file in parts(path, spec):
        if is_long_file(file, spec):
            yield from _long_recordings(file, spec)
            continue
        for name, table in _read_tables(file, spec):
            yield validate_recording(_recording(name, table, spec), file)


def _long_recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per minute of a file too long for memory."""
    columns, rate, header = _columns(path, spec), _rate(spec), read_header(path)
    units, notes, fields = _factors(path, spec, rate), [], []
    for field, (column, sign) in columns.items():
        if column in header:
            factor = sign * units.get(field, 1.0)
            fields.append(
                csv_stream.Field(
                    name=field,
                    column=column,
                    factor=factor,
                    text=field in TEXT,
                    limit=_limit(field, units),
                )
            )
        elif field in EXPECTED:
            raise InputError(
                f"{path}: column {column}: missing: expected it among {header}"
            )
        else:
            notes.append(f"no column '{column}': {field} computed or by default")
    for piece in long_logs.pieces(path, fields, MAX_GAP_STEPS / rate):
        log = path.stem if piece.recording is None else f"{path.stem}-{piece.recording}"
        table = _localise(path, piece.values, rate, notes, start=0.0)
        made = _recording(f"{log}-{piece.label}", table, spec)
        yield validate_recording(long_logs.piece_of(log, made, piece), path)


def _columns(path: Path, spec: dict) -> dict[str, tuple[str, float]]:
    """Field -> column name and sign ("-name" turns an axis round)."""
    columns = section(spec, "columns")
    unknown = sorted(set(columns) - set(NEEDED) - set(OPTIONAL))
    if unknown:
        raise InputError(
            f"{path}: columns.{unknown[0]}: unknown: "
            f"expected {', '.join((*NEEDED, *OPTIONAL))}"
        )
    for field in NEEDED:
        if field not in columns:
            raise InputError(f"{path}: columns.{field}: missing: expected a column")
    found = {}
    for field, column in columns.items():
        if not isinstance(column, str) or not column:
            raise InputError(f"{path}: columns.{field}: {column}: expected a name")
        turned = column.startswith("-") and field not in TEXT
        found[field] = (column[1:], -1.0) if turned else (column, 1.0)
    texts = {found[field][0] for field in TEXT if field in found}
    for field, (column, _) in found.items():
        if field not in TEXT and column in texts:
            raise InputError(
                f"{path}: columns.{field}: {column}: expected a column of numbers, "
                "not one that is read as text"
            )
    return found


def _rate(spec: dict) -> float:
    rate = number({**spec, **section(spec, "defaults")}, "rate_hz", RATE_HZ)
    if rate <= 0.0:
        raise InputError(f"source TOML: rate_hz: {rate:g}: expected > 0")
    return rate


def _read_tables(path: Path, spec: dict) -> Iterator[tuple[str, LogTable]]:
    """(name, table) of every recording in a file."""
    columns = _columns(path, spec)
    raw = read_table(
        path,
        [columns[field][0] for field in EXPECTED if field in columns],
        [columns[field][0] for field in OPTIONAL if field in columns],
        [columns[field][0] for field in TEXT if field in columns],
    )
    rate = _rate(spec)
    units = _factors(path, spec, rate)
    values, notes = {}, []
    for field, (column, sign) in columns.items():
        if column not in raw:
            notes.append(f"no column '{column}': {field} computed or by default")
        elif field in TEXT:
            values[field] = raw[column]
        else:
            check_range(path, raw, (column,), _limit(field, units))
            values[field] = sign * units.get(field, 1.0) * raw[column]
    names = values.pop("recording", None)
    parts = np.unique(names) if names is not None else [None]
    for part in parts:
        rows = slice(None) if names is None else names == part
        found = {field: column[rows] for field, column in values.items()}
        name = path.stem if part is None else f"{path.stem}-{part}"
        yield name, _localise(path, found, rate, notes)


def _factors(path: Path, spec: dict, rate: float) -> dict[str, float]:
    factors = {}
    for field, unit in section(spec, "units").items():
        if field not in ALLOWED_UNITS:
            raise InputError(
                f"{path}: units.{field}: unknown: expected {', '.join(ALLOWED_UNITS)}"
            )
        if field == "t" and unit == "frame":
            factors[field] = 1.0 / rate
        else:
            factors[field] = unit_factor(path, field, unit, ALLOWED_UNITS[field])
    return factors


def _limit(field: str, units: dict[str, float]) -> float:
    """What a field's numbers stay within, in the file's unit."""
    limit = LIMITS.get(field, np.inf)
    return limit / min(units.get("t", 1.0), 1.0) if field == "t" else limit


def _localise(
    path: Path,
    values: dict,
    rate: float,
    notes: list[str],
    start: float | None = None,
) -> LogTable:
    """Start the clock at 0 (or at `start`), move far coordinates near the origin."""
    notes = list(notes)
    values["t"] = values["t"] - (values["t"].min() if start is None else start)
    middle = np.array([np.median(values["x"]), np.median(values["y"])])
    origin = np.zeros(2)
    if np.any(np.abs(middle) > FAR_M):
        origin = np.round(middle / ORIGIN_STEP_M) * ORIGIN_STEP_M
        notes.append(f"local origin at x = {origin[0]:.0f} m, y = {origin[1]:.0f} m")
    values["x"], values["y"] = values["x"] - origin[0], values["y"] - origin[1]
    return LogTable(
        path=path, values=values, rate_hz=rate, origin=origin, notes=tuple(notes)
    )


def _recording(name: str, table: LogTable, spec: dict) -> Recording:
    pieces = split_tracks(
        table.path,
        table.values["id"],
        table.values["t"],
        MAX_GAP_STEPS / table.rate_hz,
    )
    tracks = tuple(_track(label, table, rows, spec) for label, rows in pieces)
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


def _track(name: str, table: LogTable, rows: np.ndarray, spec: dict) -> Track:
    defaults = section(spec, "defaults")
    values = {field: column[rows] for field, column in table.values.items()}
    t, x, y = values["t"], values["x"], values["y"]
    heading = values.get("heading")
    if heading is None:
        heading = travel_heading(t, x, y)
    speed = values.get("speed")
    if speed is None:
        speed = (
            np.hypot(np.gradient(x, t), np.gradient(y, t))
            if t.size > 1
            else np.zeros(t.shape)
        )
    size = {
        field: float(np.median(values[field]))
        if field in values
        else number(defaults, field, SIZE_M[field])
        for field in SIZE_M
    }
    reference = spec.get("reference_point", "centre")
    if reference not in REFERENCE:
        raise InputError(
            f"source TOML: reference_point: {reference}: "
            f"expected one of {', '.join(REFERENCE)}"
        )
    ahead = REFERENCE[reference] * size["length"]
    found = str(values["kind"][0] if "kind" in values else defaults.get("kind", ""))
    return Track(
        id=name,
        kind=_kind(table.path, name, found, spec),
        length=size["length"],
        width=size["width"],
        t=t,
        x=x + ahead * np.cos(heading),
        y=y + ahead * np.sin(heading),
        heading=heading,
        speed=speed,
        automated=spans_of(t, values.get("automated", np.zeros(t.size)) != 0.0),
    )


def _kind(path: Path, name: str, found: str, spec: dict) -> Kind:
    kind = str(section(spec, "kinds").get(found, found or "vehicle")).lower()
    if kind not in KINDS:
        raise InputError(
            f"{path}: id {name}: kind: {found}: expected one of {', '.join(KINDS)}, "
            "or an entry in [kinds]"
        )
    return Kind[kind.upper()]
