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

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rcirl_jax.data.importers.files import files_below, log_name
from rcirl_jax.data.importers.openacc.drive import Drive, is_drive, read_drive
from rcirl_jax.data.importers.options import number, one_pattern
from rcirl_jax.data.importers.paths import path_lanes
from rcirl_jax.data.importers.shapes import local_origin
from rcirl_jax.data.importers.tracks import spans_of, split_tracks, travel_heading
from rcirl_jax.data.readers.tables.ledger import allowed_share
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Recording, Track

NOT_LOGS = re.compile(r"(?i).*(spec|note|readme|label).*")
RATE_HZ = 10.0  # 1/s
BLOCK_S = 120.0  # s of a drive in one Recording
MIN_BLOCK_S = 1.0  # s that they may be
MAX_GAP_STEPS = 5.5  # missing rows bridged inside one track
LANE_WIDTH_M = 3.5  # m, of lanes fitted to paths
LIMIT_MPS = 36.11  # m/s, 130 km/h, the motorways and tracks driven
SIZE_M = (4.6, 1.85)  # m, a car whose model is not listed
DRIVERS = ("human", "all")  # whose drives are demonstrations


def parts(path: Path, spec: dict) -> list[Path]:
    """The drives; specifications, notes and other tables beside them are none."""
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
        drive = read_drive(file, allowed_share(spec))
        for block in _blocks(drive, spec):
            counts, notes = drive.ledger.news()
            notes = (*block.notes, *notes)
            yield validate_recording(
                dataclasses.replace(block, rows=counts, notes=notes), file
            )


def _blocks(drive: Drive, spec: dict) -> Iterator[Recording]:
    """Parts of a drive; those without a car in motion or at rest are left out."""
    block_s = number(spec, "block_s", BLOCK_S)
    rate = number(spec, "rate_hz", RATE_HZ)
    if rate <= 0.0 or not (block_s == 0.0 or block_s >= MIN_BLOCK_S):
        raise InputError(
            f"source TOML: rate_hz, block_s: {rate:g}, {block_s:g}: expected above 0, "
            f"and at least {MIN_BLOCK_S:g} s or 0 (whole drives)"
        )
    part = np.zeros(drive.t.size) if block_s == 0.0 else drive.t // block_s
    order = np.argsort(part, kind="stable")
    numbers, firsts = np.unique(part[order], return_index=True)
    if (wanted := spec.get("drivers", DRIVERS[0])) not in DRIVERS:
        raise InputError(f"source TOML: drivers: {wanted}: expected one of {DRIVERS}")
    kept, automated = _located_samples(drive), _automated(drive, spec)
    notes = [*drive.notes, *_driver_notes(drive), *_spacing_notes(drive, spec)]
    found = False
    for block, rows in zip(numbers, np.split(order, firsts[1:]), strict=True):
        tracks, origin = _tracks(drive, rows, kept, automated, spec, rate)
        if not tracks:
            continue
        found = True
        stem = log_name(drive.path, spec, own_name(drive.path))
        name = stem if numbers.size == 1 else f"{stem}-{int(block):04d}"
        yield _recording(name, drive, tracks, spec, rate, [*notes, *origin])
    if not found:
        raise InputError(
            f"{drive.path}: tracks: none with Speed and E, N: expected at least one car"
        )


def _located_samples(drive: Drive) -> dict[int, np.ndarray]:
    """Car -> [n] bool, samples with a place and a speed."""
    return {
        car: np.all([np.isfinite(values[f]) for f in ("x", "y", "Speed")], axis=0)
        for car, values in drive.cars.items()
    }


def _automated(drive: Drive, spec: dict) -> dict[int, np.ndarray]:
    """Car -> [k, 2] s of the drive without a human; `drivers = "all"`: none."""
    if spec.get("drivers", DRIVERS[0]) == "all":
        return {car: np.zeros((0, 2)) for car in drive.cars}
    spans = {
        car: spans_of(drive.t, _modes(drive, car) != "human") for car in drive.cars
    }
    return {car: np.array(found).reshape(-1, 2) for car, found in spans.items()}


def _near(spans: np.ndarray, low: float, high: float) -> np.ndarray:
    """Those of the spans [k, 2] in order of time that reach into low to high."""
    first = np.searchsorted(spans[:, 1], low)
    return spans[first : np.searchsorted(spans[:, 0], high, side="right")]


def _modes(drive: Drive, car: int) -> np.ndarray:
    """[n] "human", "acc" or "unknown"; without a column by the file's ACC flag."""
    values = drive.cars[car]
    if "Driver" in values:
        modes = np.char.lower(values["Driver"])
        return np.where(modes == "", "unknown", modes)
    flag = "".join(drive.about.get("acc", []))
    return np.full(drive.t.shape, "human" if flag == "0" else "unknown")


def _driver_notes(drive: Drive) -> list[str]:
    shares = []
    for car in drive.cars:
        modes = _modes(drive, car)
        share = f"{100.0 * float(np.mean(modes == 'human')):.0f} %"
        unknown = bool(np.all(modes == "unknown"))
        shares.append(f"car {car} {'unknown' if unknown else share}")
    return [f"driven by a human: {', '.join(shares)}"]


def _spacing_notes(drive: Drive, spec: dict) -> list[str]:
    """How far positions and sizes are from the recorded spacing.

    |p_i - p_{i+1}| - (L_i + L_{i+1}) / 2 - IVS_i, the median over all samples
    """
    errors = []
    for car, values in drive.cars.items():
        behind = drive.cars.get(car + 1)
        if "IVS" in values and behind is not None:
            apart = np.hypot(values["x"] - behind["x"], values["y"] - behind["y"])
            halves = 0.5 * (_size(drive, car, spec)[0] + _size(drive, car + 1, spec)[0])
            errors.append(apart - halves - values["IVS"])
    known = np.concatenate(errors or [np.zeros(0)])
    known = known[np.isfinite(known)]
    if known.size == 0:
        return []
    return [f"spacing of the boxes minus IVS: {np.median(known):.1f} m in the median"]


def _name(drive: Drive, car: int) -> str:
    names = drive.about.get("vehicle_order", [])
    model = re.sub(r"\s+", "", names[car - 1]) if 0 < car <= len(names) else ""
    return f"{car}-{model[:40]}" if model else str(car)


def _size(drive: Drive, car: int, spec: dict) -> tuple[float, float]:
    """Length and width [m]: of the header, of the model, or a car's."""
    size = list(_model_size(_name(drive, car), spec))
    for place, field in enumerate(("length", "width")):
        for key, cells in drive.about.items():
            if field in key and 0 < car <= len(cells):
                try:
                    size[place] = float(cells[car - 1])
                except ValueError as error:
                    raise InputError(
                        f"{drive.path}: {key[:40]}: '{cells[car - 1][:40]}': "
                        "expected a number of metres"
                    ) from error
    return size[0], size[1]


def _model_size(name: str, spec: dict) -> tuple[float, float]:
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    sizes = spec.get("sizes", {})
    known = [key for key in sizes if re.sub(r"[^a-z0-9]", "", key.lower()) in plain]
    if not known:
        return SIZE_M
    length, width = sizes[max(known, key=len)]
    return float(length), float(width)


def _tracks(
    drive: Drive,
    rows: np.ndarray,
    kept: dict[int, np.ndarray],
    automated: dict[int, np.ndarray],
    spec: dict,
    rate: float,
) -> tuple[tuple[Track, ...], list[str]]:
    """Tracks of one block, and a note about their origin."""
    used = {car: rows[kept[car][rows]] for car in drive.cars}
    used = {car: part for car, part in used.items() if part.size}
    if not used:
        return (), []
    t0 = min(float(drive.t[part].min()) for part in used.values())
    x, y = (
        np.concatenate([drive.cars[c][axis][p] for c, p in used.items()])
        for axis in ("x", "y")
    )
    origin = local_origin(x, y)
    tracks = []
    for car, part in used.items():
        length, width = _size(drive, car, spec)
        ids = np.full(part.size, car)
        gap = MAX_GAP_STEPS / rate
        times = drive.t[part]
        spans = _near(automated[car], times.min() - gap, times.max() + gap) - t0
        for label, piece in split_tracks(drive.path, ids, times, gap):
            inside = part[piece]
            t = drive.t[inside] - t0
            x = drive.cars[car]["x"][inside] - origin[0]
            y = drive.cars[car]["y"][inside] - origin[1]
            tracks.append(
                Track(
                    id=_name(drive, car) + label.removeprefix(str(car)),
                    kind=Kind.VEHICLE,
                    length=length,
                    width=width,
                    t=t,
                    x=x,
                    y=y,
                    heading=travel_heading(t, x, y),
                    speed=drive.cars[car]["Speed"][inside],
                    automated=tuple((begin, end) for begin, end in spans.tolist()),
                )
            )
    note = f"local origin at E = {origin[0]:.0f} m, N = {origin[1]:.0f} m"
    return tuple(tracks), [note] if origin.any() else []


def _recording(
    name: str,
    drive: Drive,
    tracks: tuple[Track, ...],
    spec: dict,
    rate: float,
    notes: list[str],
) -> Recording:
    """Files of one day share cars and drivers, and so a group."""
    day = "-".join(cell for cell in drive.about.get("date", []) if cell)
    width = number(spec, "lane_width_m", LANE_WIDTH_M)
    lanes = path_lanes(tracks, width, None)
    return Recording(
        name=name,
        source=str(spec.get("source", "OpenACC, JRC")),
        licence=str(spec.get("licence", "European Commission, reuse with attribution")),
        rate_hz=rate,
        tracks=tracks,
        lanes=lanes,
        group=f"drives of {day}" if day else drive.path.stem,
        default_speed_limit=number(spec, "default_speed_limit", LIMIT_MPS),
        notes=(*notes, f"no map; {len(lanes)} lanes fitted to the paths driven"),
    )
