"""One OpenACC file: metadata lines, column names, and per car its samples."""

import dataclasses
import re
from pathlib import Path

import numpy as np

from rcirl_jax.data.importers.projection import utm, utm_zone
from rcirl_jax.data.readers.tables.ledger import Ledger
from rcirl_jax.data.readers.tables.repair import single_rows
from rcirl_jax.data.readers.tables.streams import head_of
from rcirl_jax.data.readers.tables.table import (
    MAX_PLACE_M,
    MAX_TIME,
    MAX_VELOCITY_MPS,
    Field,
    Table,
    open_table,
    read,
)
from rcirl_jax.errors import InputError

COLUMN = re.compile(r"(Speed|Lat|Lon|E|N|IVS|Driver)(\d{1,3})")
# first cells of the metadata lines
METADATA = ("date", "vehicle_order", "number_of_vehicles", "acc", "distance_setting")
MAX_HEADER_LINES = 30  # lines looked at for the row of column names
LIMITS = {
    "Speed": MAX_VELOCITY_MPS,
    "E": MAX_PLACE_M,
    "N": MAX_PLACE_M,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drive:
    """One file: its header, and per car the samples."""

    path: Path
    about: dict[str, list[str]]  # metadata, key in lower case -> cells
    t: np.ndarray  # [n] s, from 0
    cars: dict[int, dict[str, np.ndarray]]  # number -> x, y, speed [n], maybe more
    notes: tuple[str, ...]
    ledger: Ledger  # of its rows


def is_drive(path: Path) -> bool:
    """Whether a table is a drive, or so damaged that one cannot tell."""
    try:
        lines = _first_lines(path)
    except InputError:
        return True
    if _ends_with_names(lines):
        return any(COLUMN.fullmatch(name) for name in lines[-1])
    firsts = {line[0].lower() for line in lines if line}
    return not firsts or not firsts.isdisjoint(METADATA)


def _first_lines(path: Path) -> list[list[str]]:
    """Cells of the lines down to the column names, or of the first ones."""
    lines: list[list[str]] = []
    for text in head_of(path)[1][:MAX_HEADER_LINES]:
        cells = [cell.strip().strip('"') for cell in text.strip().split(",")]
        while cells and not cells[-1]:
            cells.pop()
        lines.append(cells)
        if _ends_with_names(lines):
            break
    return lines


def _ends_with_names(lines: list[list[str]]) -> bool:
    return bool(lines and lines[-1]) and lines[-1][0].lower() == "time"


def _read_header(path: Path) -> tuple[dict[str, list[str]], list[str], int]:
    """Metadata, column names, and the number of lines down to the names."""
    lines = _first_lines(path)
    if not _ends_with_names(lines):
        raise InputError(
            f"{path}: column Time: missing: expected it in the first "
            f"{MAX_HEADER_LINES} lines, below the metadata"
        )
    _check_names(path, lines[-1])
    about = {cells[0].lower(): cells[1:] for cells in lines[:-1] if cells}
    return about, lines[-1], len(lines)


def _check_names(path: Path, names: list[str]) -> None:
    twice = [n for n in names if COLUMN.fullmatch(n) and names.count(n) > 1]
    if twice:
        raise InputError(f"{path}: column {twice[0]!r}: met twice: expected once")


def read_drive(path: Path, allowed: float) -> Drive:
    """A file's cars that have positions, checked.

    Args:
      path: file.
      allowed: share of bad rows.

    Raises:
      InputError: no table of a drive, or numbers beyond any place, speed or time.
    """
    about, header, skip = _read_header(path)
    columns: dict[int, dict[str, str]] = {}
    for name in header[1:]:
        match = COLUMN.fullmatch(name)
        if match is not None:
            columns.setdefault(int(match[2]), {})[match[1]] = name
    source = open_table(path, {"delimiter": ",", "names": header, "skip": skip})
    ledger = Ledger(path=path, unit=source.unit, allowed=allowed)
    table = _read_rows(source, header[0], columns, ledger)
    cars, without = {}, []
    for car, found in sorted(columns.items()):
        if "Speed" not in found:
            continue
        values = {field: table[name] for field, name in found.items()}
        if not ({"E", "N"} <= set(found) or {"Lat", "Lon"} <= set(found)):
            without.append(car)
            continue
        cars[car] = _located(values)
    if not cars:
        raise InputError(
            f"{path}: columns: {header[:8]}: expected Speed1, E1, N1 of one car or more"
        )
    notes = [f"car {car} has no positions; left out" for car in without]
    time = table[header[0]]
    return Drive(
        path=path,
        about=about,
        t=time - time.min(),
        cars=cars,
        notes=tuple(notes),
        ledger=ledger,
    )


def _read_rows(
    source: Table, time: str, columns: dict[int, dict[str, str]], ledger: Ledger
) -> dict[str, np.ndarray]:
    """Rows of a drive, each time once."""
    fields = [Field(name=time, column=time, limit=MAX_TIME)]
    fields += [
        Field(
            name=name,
            column=name,
            needed=False,
            text=part == "Driver",
            limit=LIMITS.get(part, np.inf),
        )
        for found in columns.values()
        for part, name in found.items()
    ]
    rows = read(source, fields, ledger)
    drive = {**rows, "t": rows[time], "id": np.zeros(rows[time].size)}
    compared = [field.name for field in fields]
    kept = single_rows(drive, ledger, compared, lambda _: "of the row")
    return {name: column[kept] for name, column in rows.items()}


def _located(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """x, y [m] from E, N, or from latitude and longitude in radians or degrees."""
    if "E" in values and "N" in values:
        return {**values, "x": values["E"], "y": values["N"]}
    degrees = [values[field] for field in ("Lat", "Lon")]
    known = np.isfinite(degrees[0]) & np.isfinite(degrees[1])
    # no latitude in radians is beyond pi / 2
    if not known.any() or np.median(np.abs(degrees[0][known])) <= 0.5 * np.pi:
        degrees = [np.rad2deg(angles) for angles in degrees]
    known &= (np.abs(degrees[0]) < 84.0) & (np.abs(degrees[1]) <= 180.0)
    place = np.full((known.size, 2), np.nan)
    if known.any():
        zone = utm_zone(float(np.median(degrees[1][known])))
        place[known] = utm(degrees[0][known], degrees[1][known], zone)
    return {**values, "x": place[:, 0], "y": place[:, 1]}
