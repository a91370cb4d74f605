"""NGSIM: the native 18-column text and the portal's CSV.

Column order, units and sizes come from data_specs/sources/ngsim.toml. Local_Y
is the front bumper along the road and Local_X the lateral position from the
left edge, to the right: our x = Local_Y - length / 2, our y = -Local_X. Files
without lateral positions (Local_X = 0) get them from the lane number.

The portal's CSV holds several sites and periods; vehicle and frame numbers
start anew in each. Sites become Recordings of their own; where the file has
Global_Time, it is the clock and rows may come in any order, else Frame_ID.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import numpy as np

from rcirl_jax.data.importers.files import input_files
from rcirl_jax.data.importers.tables import (
    StraightLane,
    check_row,
    load_rows,
    number,
    read_header,
    read_table,
    split_tracks,
    straight_lanes,
    travel_heading,
    unit_factor,
)
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, Recording, Track

NEEDED = ("Vehicle_ID", "Frame_ID", "Local_Y", "v_Class", "v_Vel", "Lane_ID")
OPTIONAL = ("Local_X", "v_Length", "v_Width", "Global_Time")
LENGTHS = ("Local_X", "Local_Y", "v_Length", "v_Width", "v_Vel")
SITE = "Location"
MAX_FRAME_GAP = 1  # frames; a larger gap starts a new track
REUSE_S = 60.0  # s; a step back by more is a number given to another vehicle
MARGIN_M = 50.0  # m of lane beyond the first and last position
LANE_WIDTH_M = 3.6576  # m, 12 ft, US freeway
SWITCH_S = 4.0  # s, a lane change takes 3 to 6 s
LIMIT_MPS = 29.06  # m/s, 65 mph
SIZE_M = (4.5, 1.8)  # m, a car


def parts(path: Path, spec: dict) -> list[Path]:
    """The text and CSV files; each can be read alone."""
    patterns = spec.get("pattern", ["*.txt", "*.csv"])
    files = [path] if path.is_file() else []
    for pattern in [] if files else patterns:
        files += [f for f in path.glob(pattern) if "notice" not in f.name.lower()]
    if not files:
        files = input_files(path, " or ".join(patterns))
    return sorted(files)


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per file and site."""
    for file in parts(path, spec):
        for recording in _read_file(file, spec):
            yield validate_recording(recording, file)


def _read_file(path: Path, spec: dict) -> Iterator[Recording]:
    table = _read_csv(path) if _has_header(path) else _read_text(path, spec)
    factor = unit_factor(path, "unit", spec.get("unit", "ft"), ("ft", "m"))
    for name in LENGTHS:
        table[name] = table[name] * factor
    if SITE not in table:
        yield _read_site(path, path.stem, table, spec, [])
        return
    sites = np.unique(table[SITE])
    known = [site for site in sites if site in spec.get("locations", sites)]
    if not known:
        raise InputError(
            f"{path}: {SITE}: {', '.join(sites)}: "
            f"expected one of {', '.join(spec['locations'])}"
        )
    left_out = [str(site) for site in sites if site not in known]
    notes = [f"left out, no freeway: {', '.join(left_out)}"] if left_out else []
    for site in known:
        rows = table[SITE] == site
        part = {name: values[rows] for name, values in table.items()}
        name = path.stem if len(sites) == 1 else f"{path.stem}-{site}"
        yield _read_site(path, name, part, spec, notes)


def _read_site(
    path: Path, name: str, table: dict, spec: dict, notes: list[str]
) -> Recording:
    frame_s = number(spec, "frame_s", 0.1)
    lateral = bool(np.any(table["Local_X"] != 0.0))
    notes = list(notes)
    if not lateral:
        notes.append("no lateral positions; built from lane numbers")
    for field, column in (("length", "v_Length"), ("width", "v_Width")):
        missing = len(np.unique(table["Vehicle_ID"][table[column] <= 0.0]))
        if missing:
            notes.append(f"{missing} vehicles without {field}; default by class")
    stamped = _has_stamps(table)
    table["frame"] = _clock(table, frame_s, stamped)
    repeated = _drop_repeated(table)
    if repeated:
        notes.append(f"{repeated} rows met twice, used once")
    # rows with stamps may come in any order: no step back has a meaning
    reuse = 0.0 if stamped else REUSE_S / frame_s
    vehicles = table["Vehicle_ID"].astype(np.int64)
    pieces = split_tracks(path, vehicles, table["frame"], MAX_FRAME_GAP, reuse)
    tracks = [_track(name, table, rows, spec, lateral) for name, rows in pieces]
    return Recording(
        name=name,
        source=spec.get("source", "NGSIM"),
        licence=spec.get("licence", "unknown"),
        rate_hz=1.0 / frame_s,
        tracks=tuple(tracks),
        lanes=_lanes(table, spec, lateral),
        default_speed_limit=number(spec, "speed_limit", LIMIT_MPS),
        notes=tuple(notes),
    )


def _has_stamps(table: dict) -> bool:
    """Whether Global_Time [ms] is the clock: positive, and not one for all rows."""
    stamps = table["Global_Time"]
    return bool(stamps.min() > 0.0 and stamps.max() > stamps.min())


def _clock(table: dict, frame_s: float, stamped: bool) -> np.ndarray:
    """Whole frames since the recording's first, from Global_Time if it is there."""
    if stamped:
        stamps = table["Global_Time"]
        frames = np.round((stamps - stamps.min()) / (1000.0 * frame_s))
    else:
        frames = table["Frame_ID"] - table["Frame_ID"].min()
    return np.round(frames)


def _drop_repeated(table: dict[str, np.ndarray]) -> int:
    """Remove rows that repeat another in every value; returns how many."""
    values = [column for name, column in table.items() if name != SITE]
    order = np.lexsort((np.arange(values[0].size), table["frame"], table["Vehicle_ID"]))
    stacked = np.stack(values, axis=1)[order]
    repeated = np.all(stacked[1:] == stacked[:-1], axis=1)
    if not repeated.any():
        return 0
    keep = np.ones(order.size, bool)
    keep[order[1:][repeated]] = False
    for name in table:
        table[name] = table[name][keep]
    return int(repeated.sum())


def _has_header(path: Path) -> bool:
    """Whether the file is the portal's CSV rather than the native text."""
    try:
        with path.open(encoding="utf-8-sig") as handle:
            first = handle.readline()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: text: {error}: expected NGSIM rows") from error
    if not first.strip():
        raise InputError(f"{path}: rows: none: expected NGSIM rows")
    return "," in first


def _read_csv(path: Path) -> dict[str, np.ndarray]:
    """CSV: header names are matched without regard to case."""
    actual = {name.lower(): name for name in read_header(path)}
    names = {n: actual.get(n.lower(), n) for n in (*NEEDED, *OPTIONAL, SITE)}
    found = read_table(
        path,
        [names[n] for n in NEEDED],
        [names[n] for n in (*OPTIONAL, SITE)],
        [names[SITE]],
    )
    count = found[names["Frame_ID"]].size
    table = {n: found.get(names[n], np.zeros(count)) for n in (*NEEDED, *OPTIONAL)}
    if names[SITE] in found:
        table[SITE] = np.char.lower(found[names[SITE]])
    return table


def _read_text(path: Path, spec: dict) -> dict[str, np.ndarray]:
    columns = spec.get("columns", [])
    for name in NEEDED:
        if name not in columns:
            raise InputError(f"source TOML: columns: {name}: missing: expected it")
    wanted = [name for name in (*NEEDED, *OPTIONAL) if name in columns]
    try:
        values = load_rows(path, "f8", None)
    except (ValueError, UnicodeError):
        values = np.zeros((0, 0))
    if values.shape[1:] != (len(columns),) or not np.isfinite(values).all():
        _find_bad_line(path, columns)
    table = {name: values[:, columns.index(name)] for name in wanted}
    return {n: table.get(n, np.zeros(len(values))) for n in (*NEEDED, *OPTIONAL)}


def _find_bad_line(path: Path, columns: list[str]) -> NoReturn:
    """Name the first line that is not a row of numbers."""
    with path.open(encoding="utf-8", errors="replace") as handle:
        for line, text in enumerate(handle, start=1):
            if text.strip():
                check_row(path, line, text.split(), columns, columns)
    raise InputError(f"{path}: rows: unreadable: expected {len(columns)} numbers each")


def _track(
    name: str, table: dict, rows: np.ndarray, spec: dict, lateral: bool
) -> Track:
    frame_s = number(spec, "frame_s", 0.1)
    sizes = spec.get("sizes", {})
    kind = str(int(table["v_Class"][rows[0]]))
    default = sizes.get(kind, sizes.get("0", SIZE_M))
    length = float(table["v_Length"][rows[0]]) or float(default[0])
    width = float(table["v_Width"][rows[0]]) or float(default[1])
    x = table["Local_Y"][rows] - 0.5 * length
    if lateral:
        y = -table["Local_X"][rows]
    else:
        y = _lateral_from_lanes(table["Lane_ID"][rows], spec)
    t = table["frame"][rows] * frame_s
    return Track(
        id=name,
        kind=Kind.VEHICLE,
        length=length,
        width=width,
        t=t,
        x=x,
        y=y,
        heading=travel_heading(t, x, y),
        speed=table["v_Vel"][rows],
    )


def _lateral_from_lanes(lane: np.ndarray, spec: dict) -> np.ndarray:
    """Lane centres [n] m, each switch spread over `lane_switch_s`.

        y = y_0 + sum_k (y_k - y_{k-1}) S((t - t_k) / 4 s + 1/2),  S(u) = 3u^2 - 2u^3

    with t_k midway between the last sample in the old lane and the first in the
    new one.
    """
    width = number(spec, "lane_width_m", LANE_WIDTH_M)
    span = number(spec, "lane_switch_s", SWITCH_S) / number(spec, "frame_s", 0.1)
    y = np.full(lane.shape, -width * (lane[0] - 0.5))
    samples = np.arange(lane.size)
    for at in np.flatnonzero(np.diff(lane) != 0.0):
        u = np.clip((samples - at - 0.5) / max(span, 1e-9) + 0.5, 0.0, 1.0)
        y -= width * (lane[at + 1] - lane[at]) * u**2 * (3.0 - 2.0 * u)
    return y


def _lanes(table: dict, spec: dict, lateral: bool) -> tuple[Lane, ...]:
    """One straight lane per lane number, over where it was driven +- 50 m."""
    width = number(spec, "lane_width_m", LANE_WIDTH_M)
    found = []
    for lane in np.unique(table["Lane_ID"].astype(int)):
        rows = table["Lane_ID"].astype(int) == lane
        along = table["Local_Y"][rows]
        across = float(np.median(table["Local_X"][rows])) if lateral else 0.0
        found.append(
            StraightLane(
                id=str(lane),
                y=-across if lateral else -width * (int(lane) - 0.5),
                lower=float(along.min()) - MARGIN_M,
                upper=float(along.max()) + MARGIN_M,
            )
        )
    return straight_lanes(found, width, number(spec, "speed_limit", LIMIT_MPS))
