"""OpenACC (JRC): platoons of instrumented cars, one CSV per drive.

Some metadata lines (Date, Vehicle_order, Number_of_vehicles, ACC,
Distance_setting), then columns Time [s] and per car i Speed{i} [m/s], Lat{i},
Lon{i} [RADIANS], Alt{i}, E{i}, N{i}, U{i} [m, one local plane], IVS{i} [m,
bumper to bumper from car i to i + 1], Driver{i} (Human or ACC). Specification:
the notes beside each campaign and Makridis et al. (2021), Transportation Research
Part C 125, 103047.

Traps: cells are empty where a receiver lost its fix, rows may end in surplus
commas, cars may lack columns (numbers with holes, leaders without a Driver),
names hold spaces, ZalaZone's Lat and Lon are degrees whatever its notes say, most
followers are driven by their ACC and not by a human (option `drivers`), there
is no box: the antenna is taken for its centre. Beside the drives lie tables that
are none. Drives last up to hours: they are cut into Recordings of `block_s`.
"""

import dataclasses
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.declared import read_log, track_of
from rcirl_jax.data.formats.files import files_below, log_name
from rcirl_jax.data.formats.options import number, one_of, one_pattern
from rcirl_jax.data.formats.projection import utm, utm_zone
from rcirl_jax.data.formats.shapes import local_origin
from rcirl_jax.data.formats.tracks import spans_of, split_tracks
from rcirl_jax.data.readers.tables.columnar import is_columnar
from rcirl_jax.data.readers.tables.rows import (
    Rows,
    RowStats,
    allowed_share,
    attach_row_stats,
)
from rcirl_jax.data.readers.tables.streams import head_of
from rcirl_jax.data.readers.tables.table import Table, open_table
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, OpenRoads, Recording, Track

COLUMN = re.compile(r"(Speed|Lat|Lon|E|N|IVS|Driver)(\d{1,3})")
KINDS = {"Driver": "text", "Speed": "speed", "E": "place", "N": "place"}  # of cells
# first cells of the metadata lines
METADATA = ("date", "vehicle_order", "number_of_vehicles", "acc", "distance_setting")
MAX_HEADER_LINES = 30  # lines looked at for the row of column names
NOT_LOGS = re.compile(r"(?i).*(spec|note|readme|label).*")
SIZE_M = (4.6, 1.85)  # m, a car whose model is not listed
MIN_BLOCK_S = 1.0  # s that they may be
MAX_GAP_STEPS = 5.5  # missing rows bridged inside one track
DRIVERS = ("human", "all")  # whose drives are demonstrations


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Car:
    """One car of a drive, with a sample for each of the drive's rows."""

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
        """True for each sample [n] that has a place and a speed."""
        return np.isfinite(self.x) & np.isfinite(self.y) & np.isfinite(self.speed)


def is_log(file: Path, table: Table | None) -> bool:
    """True if it is a drive, by several columns of cars, wherever they are named."""
    del table
    if is_columnar(file) or not _is_drive(file):
        return False
    try:
        lines = head_of(file)[-1]
    except InputError:
        return False
    names = (name.strip() for line in lines for name in line.split(","))
    return sum(bool(COLUMN.fullmatch(name)) for name in names) > 2


def _is_drive(path: Path) -> bool:
    """True if a table is a drive, or so damaged that one cannot tell."""
    try:
        lines, header = _first_lines(path)
    except InputError:
        return True
    if header:
        return any(map(COLUMN.fullmatch, header))
    firsts = {line[0].lower() for line in lines if line}
    return not firsts or not firsts.isdisjoint(METADATA)


def _first_lines(path: Path) -> tuple[list[list[str]], list[str]]:
    """(cells of the lines above the column names, or of the first ones; the names)."""
    lines: list[list[str]] = []
    for text in head_of(path)[-1][:MAX_HEADER_LINES]:
        cells = [cell.strip().strip('"') for cell in text.strip().split(",")]
        while cells and not cells[-1]:
            cells.pop()
        if cells and cells[0].lower() == "time":
            return lines, cells
        lines.append(cells)
    return lines, []


def parts(path: Path, spec: dict) -> list[Path]:
    """Returns the drives, without specifications, notes and tables beside them."""
    files = files_below(path, one_pattern(spec))
    if path.is_dir():
        files = [file for file in files if not NOT_LOGS.fullmatch(file.name)] or files
        files = [file for file in files if _is_drive(file)] or files
    return files


def own_name(file: Path) -> str:
    """Returns the name of a log, as long as no other folder has one called alike."""
    return file.stem


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields recordings of `block_s` seconds, file by file."""
    for file in parts(path, spec):
        stats = RowStats(path=file, allowed=allowed_share(spec))
        for block in _blocks(file, spec, stats):
            yield validate_recording(attach_row_stats(block, stats), file)


def _read_drive(
    path: Path, spec: Mapping, stats: RowStats
) -> tuple[np.ndarray, dict[int, _Car], str, list[str]]:
    """(t [n] s from 0, cars by their numbers, date, notes) of a file.

    Cars without positions are left out; column names stand below the metadata.
    """
    lines, header = _first_lines(path)
    if not header:
        raise InputError(
            f"{path}: column Time: missing: expected it in the first "
            f"{MAX_HEADER_LINES} lines, below the metadata"
        )
    time, *names = header
    columns: dict[int, dict[str, str]] = {}  # car -> what it is -> its column
    kinds: dict[str, str] = {}
    for name in names:
        if match := COLUMN.fullmatch(name):
            columns.setdefault(int(match[2]), {})[match[1]] = name
            kinds[name] = KINDS.get(match[1], "number")
    options = {"delimiter": ",", "names": header, "skip": len(lines) + 1}
    table = open_table(path, options)
    options = {"t": time, "user": None, "name_of": lambda _: "of the row"}
    rows = read_log(table, stats, {time: "time"}, kinds, **options)
    about = {cells[0].lower(): cells[1:] for cells in lines if cells}
    cars, notes = {}, []
    for number_, found in sorted(columns.items()):
        values = {part: rows[name] for part, name in found.items()}
        if {"E", "N"} <= values.keys() or {"Lat", "Lon"} <= values.keys():
            if "Speed" in values:
                cars[number_] = _car(path, number_, values, about, spec)
        elif "Speed" in values:
            notes.append(f"car {number_} has no positions; left out")
    if not cars:
        raise InputError(
            f"{path}: columns: {header[:8]}: expected Speed1, E1, N1 of one car or more"
        )
    date = "-".join(cell for cell in about.get("date", []) if cell)
    return rows[time] - rows[time].min(), cars, date, notes


def _car(
    path: Path,
    number_: int,
    values: Rows,
    about: Mapping[str, list[str]],
    spec: Mapping,
) -> _Car:
    """One car by its columns and the lines of metadata, key in lower case -> cells.

    Its size is that of the header, of the longest model's name in its own, or a car's.
    """

    def plain(text: str) -> str:
        return re.sub(r"[^a-z0-9]", "", text.lower())

    names = about.get("vehicle_order", [])
    model = re.sub(r"\s+", "", names[number_ - 1]) if 0 < number_ <= len(names) else ""
    name = f"{number_}-{model[:40]}" if model else str(number_)
    flag = "".join(about.get("acc", []))
    modes = np.full(values["Speed"].shape, "human" if flag == "0" else "unknown")
    if "Driver" in values:
        modes = np.char.lower(values["Driver"])
        modes = np.where(modes == "", "unknown", modes)
    sizes = spec.get("sizes", {})
    known = [key for key in sizes if plain(key) in plain(name)]
    size = [*map(float, sizes[max(known, key=len)] if known else SIZE_M)]
    said = set()
    for place, field in enumerate(("length", "width")):
        for key, cells in about.items():
            if field not in key or not 0 < number_ <= len(cells):
                continue
            said.add(field)
            try:
                size[place] = float(cells[number_ - 1])
            except ValueError as error:
                raise InputError(
                    f"{path}: {key[:40]}: '{cells[number_ - 1][:40]}': "
                    "expected a number of metres"
                ) from error
    x, y = _place(values)
    return _Car(
        name=name,
        size=(size[0], size[1]),
        size_assumed=len(said) < len(size),
        x=x,
        y=y,
        speed=values["Speed"],
        modes=modes,
        spacing=values.get("IVS"),
    )


def _place(values: Rows) -> tuple[np.ndarray, np.ndarray]:
    """x, y [m] from E, N, or from latitude and longitude in radians or degrees."""
    if "E" in values and "N" in values:
        return values["E"], values["N"]
    degrees = np.stack([values["Lat"], values["Lon"]])
    known = np.isfinite(degrees).all(axis=0)
    # no latitude in radians is beyond pi / 2
    if not known.any() or np.median(np.abs(degrees[0][known])) <= 0.5 * np.pi:
        degrees = np.rad2deg(degrees)
    known &= (np.abs(degrees[0]) < 84.0) & (np.abs(degrees[1]) <= 180.0)
    place = np.full((known.size, 2), np.nan)
    if known.any():
        zone = utm_zone(float(np.median(degrees[1][known])))
        place[known] = utm(degrees[0][known], degrees[1][known], zone)
    return place[:, 0], place[:, 1]


def _blocks(path: Path, spec: dict, stats: RowStats) -> Iterator[Recording]:
    """Parts of a drive; those without a car in motion or at rest are left out."""
    block_s, rate = number(spec, "block_s"), number(spec, "rate_hz")
    if rate <= 0.0 or not (block_s == 0.0 or block_s >= MIN_BLOCK_S):
        raise InputError(
            f"source TOML: rate_hz, block_s: {rate:g}, {block_s:g}: expected above 0, "
            f"and at least {MIN_BLOCK_S:g} s or 0 (whole drives)"
        )
    wanted, width = one_of(spec, "drivers", DRIVERS), number(spec, "lane_width_m")
    t, cars, date, notes = _read_drive(path, spec, stats)
    notes += _notes(cars)
    part = np.zeros(t.size) if block_s == 0.0 else t // block_s
    order = np.argsort(part, kind="stable")
    numbers, firsts = np.unique(part[order], return_index=True)
    automated = {
        number_: spans_of(t, (car.modes != "human") & (wanted != "all"))
        for number_, car in cars.items()
    }
    name, found = log_name(path, spec, own_name(path)), False
    for block, rows in zip(numbers, np.split(order, firsts[1:]), strict=True):
        tracks, origin = _tracks(path, t, cars, rows, automated, MAX_GAP_STEPS / rate)
        if not tracks:
            continue
        found = True
        where = f"local origin at E = {origin[0]:.0f} m, N = {origin[1]:.0f} m"
        yield Recording(
            name=name if numbers.size == 1 else f"{name}-{int(block):04d}",
            source=spec["source"],
            licence=spec["licence"],
            rate_hz=rate,
            tracks=tracks,
            lanes=(),
            open_roads=OpenRoads(width=width),
            origin=(float(origin[0]), float(origin[1])),
            # files of one day share cars and drivers
            group=f"drives of {date}" if date else path.stem,
            default_speed_limit=number(spec, "default_speed_limit"),
            notes=(*notes, *([where] if origin.any() else [])),
        )
    if not found:
        raise InputError(
            f"{path}: tracks: none with Speed and E, N: expected at least one car"
        )


def _notes(cars: Mapping[int, _Car]) -> list[str]:
    """Notes who drove, and how far positions and sizes are from the recorded spacing.

    |p_i - p_{i+1}| - (L_i + L_{i+1}) / 2 - IVS_i, the median over all samples
    """
    shares, errors = [], [np.zeros(0)]
    for number_, car in cars.items():
        share = f"{100.0 * float(np.mean(car.modes == 'human')):.0f} %"
        is_unknown = bool(np.all(car.modes == "unknown"))
        shares.append(f"car {number_} {'unknown' if is_unknown else share}")
        behind = cars.get(number_ + 1)
        if car.spacing is not None and behind is not None:
            apart = np.hypot(car.x - behind.x, car.y - behind.y)
            errors.append(apart - 0.5 * (car.size[0] + behind.size[0]) - car.spacing)
    notes = [f"driven by a human: {', '.join(shares)}"]
    known = np.concatenate(errors)
    known = known[np.isfinite(known)]
    if known.size:
        apart = f"{np.median(known):.1f} m in the median"
        notes.append(f"spacing of the boxes minus IVS: {apart}")
    return notes


def _tracks(
    path: Path,
    t: np.ndarray,
    cars: Mapping[int, _Car],
    rows: np.ndarray,
    automated: Mapping[int, tuple[tuple[float, float], ...]],
    gap: float,
) -> tuple[tuple[Track, ...], np.ndarray]:
    """Tracks of one block's rows, and their origin [2] m."""
    used = {number_: rows[car.known[rows]] for number_, car in cars.items()}
    used = {number_: part for number_, part in used.items() if part.size}
    if not used:
        return (), np.zeros(2)
    t0 = min(float(t[part].min()) for part in used.values())
    places = [(cars[n].x[at], cars[n].y[at]) for n, at in used.items()]
    origin = local_origin(*np.concatenate(places, axis=1))
    tracks = []
    for number_, part in used.items():
        car, times = cars[number_], t[part]
        low, high = times.min() - gap, times.max() + gap
        spans = tuple(
            (begin - t0, end - t0)
            for begin, end in automated[number_]
            if end >= low and begin <= high
        )
        ids = np.full(part.size, number_)
        for label, piece in split_tracks(path, ids, times, gap):
            at = part[piece]
            values = {"t": t[at] - t0, "speed": car.speed[at]}
            values |= {"x": car.x[at] - origin[0], "y": car.y[at] - origin[1]}
            name = car.name + label.removeprefix(str(number_))
            made = track_of(name, values, Kind.VEHICLE, car.size, automated=spans)
            tracks.append(dataclasses.replace(made, size_assumed=car.size_assumed))
    return tuple(tracks), origin
