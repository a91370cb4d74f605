"""OpenACC (JRC): platoons of instrumented cars, one CSV per drive.

Some metadata lines (Date, Vehicle_order, Number_of_vehicles, ACC,
Distance_setting), then columns Time [s] and per car i Speed{i} [m/s], Lat{i},
Lon{i} [RADIANS], Alt{i}, E{i}, N{i}, U{i} [m, one local plane], IVS{i} [m,
bumper to bumper from car i to i + 1], Driver{i} (Human or ACC). Specification:
the notes beside each campaign (JRCDBT0001, "JRC_tests_notes.txt") and Makridis
et al. (2021), Transportation Research Part C 125, 103047.

Traps: cells are empty where a receiver lost its fix, rows may end in surplus
commas, cars may lack columns (numbers with holes, leaders without a Driver),
names hold spaces, ZalaZone's Lat and Lon are degrees whatever its notes say, most
followers are driven by their ACC and not by a human (option `drivers`), there
is no box: the antenna is taken for its centre. Beside the drives lie tables that
are none: specifications, lists of settings, a campaign of one car's speeds.

Drives last up to hours: they are cut into Recordings of `block_s`.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.files import files_below, log_name
from rcirl_jax.data.formats.openacc.drive import (
    Drive,
    is_drive,
    open_drive,
    read_drive,
)
from rcirl_jax.data.formats.options import number, one_pattern
from rcirl_jax.data.formats.paths import path_lanes
from rcirl_jax.data.formats.shapes import local_origin
from rcirl_jax.data.formats.tracks import spans_of, split_tracks, travel_heading
from rcirl_jax.data.readers.tables.rows import RowStats, allowed_share, attach_row_stats
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Recording, Track

NOT_LOGS = re.compile(r"(?i).*(spec|note|readme|label).*")
MIN_BLOCK_S = 1.0  # s that they may be
MAX_GAP_STEPS = 5.5  # missing rows bridged inside one track
DRIVERS = ("human", "all")  # whose drives are demonstrations


def parts(path: Path, spec: dict) -> list[Path]:
    """The drives, without specifications, notes and other tables beside them."""
    files = files_below(path, one_pattern(spec, "*.csv"))
    if path.is_dir():
        files = [file for file in files if not NOT_LOGS.fullmatch(file.name)] or files
        files = [file for file in files if is_drive(file)] or files
    return files


def own_name(file: Path) -> str:
    """Name of a log, as long as no other folder has one called alike."""
    return file.stem


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Recordings of `block_s` seconds, file by file."""
    for file in parts(path, spec):
        table = open_drive(file)
        stats = RowStats(path=file, unit=table.unit, allowed=allowed_share(spec))
        for block in _blocks(read_drive(table, spec, stats), spec):
            yield validate_recording(attach_row_stats(block, stats), file)


def _blocks(drive: Drive, spec: dict) -> Iterator[Recording]:
    """Parts of a drive; those without a car in motion or at rest are left out."""
    block_s = number(spec, "block_s")
    rate = number(spec, "rate_hz")
    if rate <= 0.0 or not (block_s == 0.0 or block_s >= MIN_BLOCK_S):
        raise InputError(
            f"source TOML: rate_hz, block_s: {rate:g}, {block_s:g}: expected above 0, "
            f"and at least {MIN_BLOCK_S:g} s or 0 (whole drives)"
        )
    if (wanted := spec["drivers"]) not in DRIVERS:
        raise InputError(f"source TOML: drivers: {wanted}: expected one of {DRIVERS}")
    part = np.zeros(drive.t.size) if block_s == 0.0 else drive.t // block_s
    order = np.argsort(part, kind="stable")
    numbers, firsts = np.unique(part[order], return_index=True)
    automated = {
        car.number: spans_of(drive.t, (car.modes != "human") & (wanted != "all"))
        for car in drive.cars.values()
    }
    width = number(spec, "lane_width_m")
    notes = [*drive.notes, *_driver_notes(drive), *_spacing_notes(drive)]
    name, found = log_name(drive.path, spec, own_name(drive.path)), False
    for block, rows in zip(numbers, np.split(order, firsts[1:]), strict=True):
        tracks, origin = _tracks(drive, rows, automated, MAX_GAP_STEPS / rate)
        if not tracks:
            continue
        found, lanes = True, path_lanes(tracks, width, None)
        fitted = f"no map; {len(lanes)} lanes fitted to the paths driven"
        yield Recording(
            name=name if numbers.size == 1 else f"{name}-{int(block):04d}",
            source=spec["source"],
            licence=spec["licence"],
            rate_hz=rate,
            tracks=tracks,
            lanes=lanes,
            # files of one day share cars and drivers
            group=f"drives of {drive.date}" if drive.date else drive.path.stem,
            default_speed_limit=number(spec, "default_speed_limit"),
            notes=(*notes, *origin, fitted),
        )
    if not found:
        raise InputError(
            f"{drive.path}: tracks: none with Speed and E, N: expected at least one car"
        )


def _driver_notes(drive: Drive) -> list[str]:
    shares = []
    for car in drive.cars.values():
        share = f"{100.0 * float(np.mean(car.modes == 'human')):.0f} %"
        unknown = bool(np.all(car.modes == "unknown"))
        shares.append(f"car {car.number} {'unknown' if unknown else share}")
    return [f"driven by a human: {', '.join(shares)}"]


def _spacing_notes(drive: Drive) -> list[str]:
    """How far positions and sizes are from the recorded spacing.

    |p_i - p_{i+1}| - (L_i + L_{i+1}) / 2 - IVS_i, the median over all samples
    """
    errors = [np.zeros(0)]
    for car in drive.cars.values():
        behind = drive.cars.get(car.number + 1)
        if car.spacing is not None and behind is not None:
            apart = np.hypot(car.x - behind.x, car.y - behind.y)
            errors.append(apart - 0.5 * (car.size[0] + behind.size[0]) - car.spacing)
    known = np.concatenate(errors)
    known = known[np.isfinite(known)]
    if known.size == 0:
        return []
    return [f"spacing of the boxes minus IVS: {np.median(known):.1f} m in the median"]


def _tracks(
    drive: Drive,
    rows: np.ndarray,
    automated: Mapping[int, tuple[tuple[float, float], ...]],
    gap: float,
) -> tuple[tuple[Track, ...], list[str]]:
    """Tracks of one block, and a note about their origin."""
    used = {number: rows[car.known[rows]] for number, car in drive.cars.items()}
    used = {number: part for number, part in used.items() if part.size}
    if not used:
        return (), []
    t0 = min(float(drive.t[part].min()) for part in used.values())
    places = [
        (drive.cars[n].x[part], drive.cars[n].y[part]) for n, part in used.items()
    ]
    origin = local_origin(*np.concatenate(places, axis=1))
    tracks = []
    for number_, part in used.items():
        car, times = drive.cars[number_], drive.t[part]
        low, high = times.min() - gap, times.max() + gap
        ids = np.full(part.size, number_)
        for label, piece in split_tracks(drive.path, ids, times, gap):
            inside = part[piece]
            t = drive.t[inside] - t0
            x, y = car.x[inside] - origin[0], car.y[inside] - origin[1]
            tracks.append(
                Track(
                    id=car.name + label.removeprefix(str(number_)),
                    kind=Kind.VEHICLE,
                    length=car.size[0],
                    width=car.size[1],
                    size_assumed=car.size_assumed,
                    t=t,
                    x=x,
                    y=y,
                    heading=travel_heading(t, x, y),
                    speed=car.speed[inside],
                    automated=tuple(
                        (begin - t0, end - t0)
                        for begin, end in automated[number_]
                        if end >= low and begin <= high
                    ),
                )
            )
    note = f"local origin at E = {origin[0]:.0f} m, N = {origin[1]:.0f} m"
    return tuple(tracks), [note] if origin.any() else []
