"""One OpenACC file: metadata lines, column names, and per car its samples."""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.declared import Columns
from rcirl_jax.data.formats.projection import utm, utm_zone
from rcirl_jax.data.readers.tables.columnar import is_columnar
from rcirl_jax.data.readers.tables.rows import RowStats
from rcirl_jax.data.readers.tables.streams import head_of
from rcirl_jax.data.readers.tables.table import Table, open_table
from rcirl_jax.errors import InputError

COLUMN = re.compile(r"(Speed|Lat|Lon|E|N|IVS|Driver)(\d{1,3})")
# first cells of the metadata lines
METADATA = ("date", "vehicle_order", "number_of_vehicles", "acc", "distance_setting")
SIZE_M = (4.6, 1.85)  # m, a car whose model is not listed
MAX_HEADER_LINES = 30  # lines looked at for the row of column names
KINDS = {"Driver": "text", "Speed": "speed", "E": "place", "N": "place"}  # of cells


@dataclasses.dataclass(frozen=True, kw_only=True)
class Car:
    """One car of a drive, with a sample for each of the drive's rows."""

    number: int  # in the platoon
    name: str  # number and model
    size: tuple[float, float]  # m, length and width
    size_assumed: bool  # the file does not say both
    x: np.ndarray  # [n] m, NaN where it is unknown
    y: np.ndarray  # [n] m
    speed: np.ndarray  # [n] m/s
    modes: np.ndarray  # [n] who drives: "human", "acc" or "unknown"
    spacing: np.ndarray | None  # [n] m, bumper to bumper to the next car

    @property
    def known(self) -> np.ndarray:
        """Whether a sample [n] has a place and a speed."""
        return np.isfinite(self.x) & np.isfinite(self.y) & np.isfinite(self.speed)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drive:
    """One file: when and by whom it was driven."""

    path: Path
    date: str  # "" where the file says none
    t: np.ndarray  # [n] s, from 0
    cars: dict[int, Car]
    notes: tuple[str, ...]


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


def is_log(file: Path, table: Table | None) -> bool:
    """Whether it is a drive, by several columns of cars, wherever they are named."""
    del table
    if is_columnar(file) or not is_drive(file):
        return False
    try:
        lines = head_of(file)[1]
    except InputError:
        return False
    names = (name.strip() for line in lines for name in line.split(","))
    return sum(bool(COLUMN.fullmatch(name)) for name in names) > 2


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


def open_drive(path: Path) -> Table:
    """A drive's table, whose column names stand below the lines of metadata.

    Raises:
      InputError: no column names, or one of a car met twice.
    """
    lines = _first_lines(path)
    if not _ends_with_names(lines):
        raise InputError(
            f"{path}: column Time: missing: expected it in the first "
            f"{MAX_HEADER_LINES} lines, below the metadata"
        )
    names = lines[-1]
    twice = [n for n in names if COLUMN.fullmatch(n) and names.count(n) > 1]
    if twice:
        raise InputError(f"{path}: column {twice[0]!r}: met twice: expected once")
    return open_table(path, {"delimiter": ",", "names": names, "skip": len(lines)})


def read_drive(table: Table, spec: Mapping, stats: RowStats) -> Drive:
    """A file's cars that have positions, checked.

    Args:
      table: of `open_drive`.
      spec: source TOML.
      stats: of the file.

    Raises:
      InputError: no table of a drive, or numbers beyond any place, speed or time.
    """
    path, (time, *header) = table.path, table.header
    columns: dict[int, dict[str, str]] = {}
    for name in header:
        match = COLUMN.fullmatch(name)
        if match is not None:
            columns.setdefault(int(match[2]), {})[match[1]] = name
    names = {name: part for own in columns.values() for part, name in own.items()}
    rows = Columns(
        needed={time: "time"},
        optional={name: KINDS.get(part, "number") for name, part in names.items()},
        t=time,
        user=None,
        name_of=lambda _: "of the row",
    ).read(table, stats)
    about = {cells[0].lower(): cells[1:] for cells in _first_lines(path)[:-1] if cells}
    cars, notes = {}, []
    for number, found in sorted(columns.items()):
        values = {part: rows[name] for part, name in found.items()}
        if {"E", "N"} <= values.keys() or {"Lat", "Lon"} <= values.keys():
            if "Speed" in values:
                cars[number] = _car(path, number, values, about, spec)
        elif "Speed" in values:
            notes.append(f"car {number} has no positions; left out")
    if not cars:
        raise InputError(
            f"{path}: columns: {[time, *header][:8]}: expected Speed1, E1, N1 of one "
            "car or more"
        )
    return Drive(
        path=path,
        date="-".join(cell for cell in about.get("date", []) if cell),
        t=rows[time] - rows[time].min(),
        cars=cars,
        notes=tuple(notes),
    )


def _car(
    path: Path,
    number: int,
    values: Mapping[str, np.ndarray],
    about: Mapping[str, list[str]],
    spec: Mapping,
) -> Car:
    """One car by its columns and the lines of metadata, key in lower case -> cells."""
    names = about.get("vehicle_order", [])
    model = re.sub(r"\s+", "", names[number - 1]) if 0 < number <= len(names) else ""
    name = f"{number}-{model[:40]}" if model else str(number)
    flag = "".join(about.get("acc", []))
    modes = np.full(values["Speed"].shape, "human" if flag == "0" else "unknown")
    if "Driver" in values:
        modes = np.char.lower(values["Driver"])
        modes = np.where(modes == "", "unknown", modes)
    x, y = _place(values)
    size, is_said = _size(path, number, name, about, spec)
    return Car(
        number=number,
        name=name,
        size=size,
        size_assumed=not is_said,
        x=x,
        y=y,
        speed=values["Speed"],
        modes=modes,
        spacing=values.get("IVS"),
    )


def _size(
    path: Path,
    number: int,
    name: str,
    about: Mapping[str, list[str]],
    spec: Mapping,
) -> tuple[tuple[float, float], bool]:
    """Length and width [m]: of the header, of the model, or a car's.

    And whether the header says both.
    """
    size, said = list(_model_size(name, spec.get("sizes", {}))), set()
    for place, field in enumerate(("length", "width")):
        for key, cells in about.items():
            if field in key and 0 < number <= len(cells):
                said.add(field)
                try:
                    size[place] = float(cells[number - 1])
                except ValueError as error:
                    raise InputError(
                        f"{path}: {key[:40]}: '{cells[number - 1][:40]}': "
                        "expected a number of metres"
                    ) from error
    return (size[0], size[1]), len(said) == len(size)


def _model_size(name: str, sizes: Mapping[str, list[float]]) -> tuple[float, float]:
    """The size of the longest model's name that occurs in a name."""

    def plain(text: str) -> str:
        return re.sub(r"[^a-z0-9]", "", text.lower())

    known = [key for key in sizes if plain(key) in plain(name)]
    if not known:
        return SIZE_M
    length, width = sizes[max(known, key=len)]
    return float(length), float(width)


def _place(values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """x, y [m] from E, N, or from latitude and longitude in radians or degrees."""
    if "E" in values and "N" in values:
        return values["E"], values["N"]
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
    return place[:, 0], place[:, 1]
