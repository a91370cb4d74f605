"""Tables of text: read, check, convert; shared by the NGSIM and CSV importers."""

import collections
import csv
import dataclasses
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NoReturn, TextIO

import numpy as np

from rcirl_jax.data.recording import check_lanes_length, check_span
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane
from rcirl_jax.units import FOOT_M, MPH_MPS

TEXT_CHARS = 64  # characters of a text cell
MAX_COLUMNS = 10_000  # of a table; logs have some dozens
MAX_LINE = 2**20  # characters of a line
MAX_BYTES = 2**30  # of a file that is held whole: a few times the longest known
UNITS = {
    "m": 1.0,
    "ft": FOOT_M,
    "m/s": 1.0,
    "ft/s": FOOT_M,
    "km/h": 1.0 / 3.6,
    "mph": MPH_MPS,
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
    "rad": 1.0,
    "deg": np.pi / 180.0,
}
# a quoted number with separators between thousands: "1,118,846,979,700"
GROUPED = re.compile(r'"([-+]?\d{1,3}(?:,\d{3})+(?:\.\d*)?)"')
HEADING_WINDOW_S = 1.0  # s, heading is the direction of travel over this window
MIN_TRAVEL_M = 0.5  # m in that window; below it the heading is held
LANE_STEP_M = 5.0  # m between points of a fitted lane
NEIGHBOUR_WIDTHS = 1.6  # lane widths between centres up to which lanes adjoin


@dataclasses.dataclass(frozen=True, kw_only=True)
class StraightLane:
    """A lane parallel to the x axis, as observed."""

    id: str
    y: float  # m, of the centre line
    lower: float  # m, first x
    upper: float  # m, last x
    forward: bool = True  # driven towards +x


def check_size(path: Path) -> None:
    """A file that is held whole is no larger than `MAX_BYTES`."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(
            f"{path}: size: {size >> 20} MiB: expected {MAX_BYTES >> 20} at most; "
            "cut it into recordings (a csv or NGSIM log: lower long_bytes)"
        )


def lines_of(handle: TextIO) -> Iterator[str]:
    """Lines of a text of which no more than one is held, of a bounded length.

    Raises:
      InputError: a line of more than `MAX_LINE` characters.
    """
    while line := handle.readline(MAX_LINE + 1):
        if len(line) > MAX_LINE:
            raise InputError(
                f"{handle.name}: a line of more than {MAX_LINE} characters: "
                "expected one a row"
            )
        yield line


def rows_of(
    handle: TextIO, change: Callable[[str], str] = str
) -> Iterator[tuple[int, list[str]]]:
    """(number of its last line, cells) of each row of a CSV.

    Args:
      handle: of the text, opened with `newline=""`.
      change: what is made of each line first.

    Raises:
      InputError: a line, or a row over several, of more than `MAX_LINE` characters.
      csv.Error: a cell too long, or what is no CSV.
    """
    held = 0

    def lines() -> Iterator[str]:
        nonlocal held
        for line in lines_of(handle):
            held += len(line)
            if held > MAX_LINE:
                raise InputError(
                    f"{handle.name}: a row of more than {MAX_LINE} characters: "
                    "expected one a line"
                )
            yield change(line)

    reader = csv.reader(lines())
    for row in reader:
        held = 0
        yield reader.line_num, row


def read_header(path: Path) -> list[str]:
    """Column names of a comma-separated file: not empty or too many, each once."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as handle:
            _, names = next(rows_of(handle), (0, []))
            header = [name.strip() for name in names]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: header: {error}: expected CSV text") from error
    if not any(header):
        raise InputError(f"{path}: header: empty: expected column names and rows")
    if len(header) > MAX_COLUMNS:
        raise InputError(
            f"{path}: header: {len(header)} columns: expected up to {MAX_COLUMNS}"
        )
    for name, count in collections.Counter(header).items():
        if count > 1:
            raise InputError(f"{path}: column {name}: met twice: expected once")
    return header


def read_table(
    path: Path,
    wanted: Sequence[str],
    optional: Sequence[str],
    text: Sequence[str],
    *,
    grouped: bool = False,
) -> dict[str, np.ndarray]:
    """Columns of a comma-separated file with a header.

    Args:
      path: file.
      wanted: columns that have to be there.
      optional: columns that may be.
      text: names among both that are not numbers.
      grouped: numbers may have separators between thousands (`is_grouped`).

    Returns:
      Column name -> values; numbers as float64 (finite), text as str.

    Raises:
      InputError: empty file, missing or doubled column, a row of another
        length, a cell that is no finite number (with its line).
    """
    header = read_header(path)
    check_size(path)
    for name in wanted:
        if name not in header:
            raise InputError(
                f"{path}: column {name}: missing: expected it among {header}"
            )
    chosen = [*wanted, *(name for name in optional if name in header)]
    kinds = ["f8" if name in chosen and name not in text else "U1" for name in header]
    for place, name in enumerate(header):
        if name in chosen and name in text:
            kinds[place] = f"U{TEXT_CHARS + 1}"
    names = [f"c{place}" for place in range(len(header))]
    numeric = [name for name in chosen if name not in text]
    try:
        with path.open(encoding="utf-8-sig") as handle:
            lines = lines_of(handle)
            rows = load_rows(
                map(ungrouped, lines) if grouped else lines,
                list(zip(names, kinds, strict=True)),
                ",",
                skip=1,
            )
    except (ValueError, UnicodeError):
        _find_bad_cell(path, header, numeric, grouped)
    if rows.size == 0:
        raise InputError(f"{path}: rows: none: expected rows below the header")
    table = {name: rows[f"c{header.index(name)}"] for name in chosen}
    for name in chosen:
        if name in text:
            table[name] = np.char.strip(table[name])
            _check_lengths(path, name, table[name])
        elif not np.isfinite(table[name]).all():
            _find_bad_cell(path, header, [name], grouped)
    return table


def _check_lengths(path: Path, name: str, texts: np.ndarray) -> None:
    """Longer ones are not whole: two could be cut to the same."""
    bad = np.flatnonzero(np.char.str_len(texts) > TEXT_CHARS)
    if bad.size:
        raise InputError(
            f"{path}: row {bad[0] + 1}: column {name}: '{texts[bad[0]][:40]}...': "
            f"expected up to {TEXT_CHARS} characters"
        )


def is_grouped(path: Path) -> bool:
    """Whether a number of the first row has separators between thousands."""
    try:
        with path.open(encoding="utf-8-sig") as handle:
            lines = lines_of(handle)
            next(lines, "")
            return GROUPED.search(next(lines, "")) is not None
    except UnicodeDecodeError:
        return False  # refused by whoever reads it


def ungrouped(line: str) -> str:
    """A line of a CSV without separators between thousands, and their quotes."""
    return GROUPED.sub(lambda found: found[1].replace(",", ""), line)


def load_rows(
    path: Path | Iterable[str],
    dtype: str | list,
    delimiter: str | None,
    skip: int = 0,
) -> np.ndarray:
    """`np.loadtxt` with quotes, without comments or a warning about no rows."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*input contained no data")
        return np.loadtxt(
            path,
            dtype=dtype,
            delimiter=delimiter,
            quotechar='"',
            comments=None,
            skiprows=skip,
            ndmin=1 if isinstance(dtype, list) else 2,
            encoding="utf-8-sig",
        )


def _find_bad_cell(
    path: Path, header: list[str], numeric: list[str], grouped: bool
) -> NoReturn:
    """Read slowly and name the first line that is wrong."""
    check_cells(path, header, numeric, grouped)
    raise InputError(f"{path}: rows: unreadable: expected comma-separated cells")


def check_cells(
    path: Path, header: list[str], numeric: list[str], grouped: bool = False
) -> None:
    """Every row of a CSV is as `check_row` says; slow, to explain a failure."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as handle:
            rows = rows_of(handle, ungrouped if grouped else str)
            next(rows)
            for line, row in rows:
                if row:
                    check_row(path, line, row, header, numeric)
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: text: {error}: expected CSV text") from error


def check_row(
    path: Path,
    line: int,
    cells: Sequence[str],
    header: Sequence[str],
    numeric: Sequence[str],
) -> None:
    """One row has a cell per column, finite numbers in the numeric ones."""
    if len(cells) != len(header):
        raise InputError(
            f"{path}: line {line}: {len(cells)} cells: expected {len(header)}"
        )
    for name, cell in zip(header, cells, strict=True):
        if name not in numeric:
            continue
        try:
            finite = bool(np.isfinite(float(cell)))
        except ValueError:
            finite = False
        if not finite:
            raise InputError(
                f"{path}: line {line}: {name}: '{cell[:40]}': expected a finite number"
            )


def unit_factor(path: Path, field: str, unit: str, allowed: Sequence[str]) -> float:
    """Factor from a declared unit to SI."""
    if unit not in allowed:
        raise InputError(
            f"{path}: units.{field}: {unit}: expected one of {', '.join(allowed)}"
        )
    return UNITS[unit]


def number(spec: Mapping, key: str, default: float) -> float:
    """A finite number from a source TOML."""
    value = spec.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"source TOML: {key}: {value}: expected a number")
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if not math.isfinite(found):
        raise InputError(f"source TOML: {key}: {value}: expected a finite number")
    return found


def split_tracks(
    path: Path, ids: np.ndarray, t: np.ndarray, max_gap: float, reuse: float = np.inf
) -> list[tuple[str, np.ndarray]]:
    """Rows of each track: one road user without a gap.

    A gap longer than `max_gap` starts another track of the same id, named
    "id#2", "id#3", ... A step back by more than `reuse` is a number given to
    somebody else at another time; by less it is an error.

    Args:
      path: named in errors.
      ids: [n] of each row, text or numbers.
      t: [n] in any unit.
      max_gap: in the unit of t.
      reuse: in the unit of t.

    Returns:
      (name, row numbers in the order of time) per track.

    Raises:
      InputError: time goes backwards, or is met twice, inside an id, or most
        steps are gaps.
    """
    _, codes = np.unique(ids, return_inverse=True)
    order = np.argsort(codes, kind="stable")
    step, same = np.diff(t[order]), np.diff(codes[order]) == 0
    wrong = np.flatnonzero(same & (step < 0.0) & (step >= -reuse))
    if wrong.size:
        row = order[wrong[0] + 1]
        raise InputError(
            f"{path}: id {ids[row]}: t: {t[row]:.12g} after {t[order[wrong[0]]]:.12g}: "
            "goes backwards; expected increasing times"
        )
    order = np.lexsort((t, codes))
    step, same = np.diff(t[order]), np.diff(codes[order]) == 0
    twice = np.flatnonzero(same & (step == 0.0))
    if twice.size:
        row = order[twice[0]]
        raise InputError(
            f"{path}: id {ids[row]}: t: {t[row]:.12g}: met twice: expected once"
        )
    if same.any() and np.median(step[same]) > max_gap:
        raise InputError(
            f"{path}: t: median step {np.median(step[same]):g}: "
            f"expected at most {max_gap:g}; wrong unit of time or rate?"
        )
    pieces = np.split(order, np.flatnonzero(~same | (step > max_gap)) + 1)
    parts: dict[str, int] = {}
    tracks = []
    for rows in pieces:
        name = str(ids[rows[0]])
        parts[name] = parts.get(name, 0) + 1
        tracks.append((name if parts[name] == 1 else f"{name}#{parts[name]}", rows))
    return tracks


def spans_of(t: np.ndarray, holds: np.ndarray) -> tuple[tuple[float, float], ...]:
    """(begin, end) of each run of samples [n] that hold, up to the next that does not.

    The last run has no end. t [n] s in any order.
    """
    order = np.argsort(t, kind="stable")
    flips = np.flatnonzero(np.diff(np.concatenate([[False], holds[order]])))
    ends = [*t[order][flips].tolist(), np.inf]
    return tuple(zip(ends[:-1:2], ends[1::2], strict=False))


def travel_heading(
    t: np.ndarray, x: np.ndarray, y: np.ndarray, standing: float = 0.0
) -> np.ndarray:
    """Direction of travel [n] rad, over a second around each sample.

        heading(t) = atan2(y(t + h) - y(t - h), x(t + h) - x(t - h)),  h = 0.5 s

    Held from the last moving sample (before the first: from it) where the car
    covers less than half a metre; `standing` [rad] for one that never moves.
    """
    half = 0.5 * HEADING_WINDOW_S
    dx, dy = (np.interp(t + half, t, v) - np.interp(t - half, t, v) for v in (x, y))
    moving = np.flatnonzero(np.hypot(dx, dy) > MIN_TRAVEL_M)
    if moving.size == 0:
        return np.full(t.shape, standing)
    held = np.searchsorted(moving, np.arange(t.size), side="right") - 1
    return np.arctan2(dy, dx)[moving[np.maximum(held, 0)]]


def straight_lanes(
    path: Path, found: Sequence[StraightLane], width: float, limit: float | None
) -> tuple[Lane, ...]:
    """Lanes parallel to the x axis, with bounds midway between neighbours.

    Lanes are neighbours if they are driven the same way and no more than
    `NEIGHBOUR_WIDTHS` lane widths apart; outer bounds lie half a width out.
    """
    for lane in found:
        ends = np.array([lane.lower, lane.upper])
        check_span(f"{path}: lane {lane.id}", "position along the road", ends)
    check_lanes_length(str(path), sum(lane.upper - lane.lower for lane in found))
    lanes = []
    for lane in found:
        above = _beside(lane, found, width, +1.0)
        below = _beside(lane, found, width, -1.0)
        up = 0.5 * width if above is None else 0.5 * (above.y - lane.y)
        down = 0.5 * width if below is None else 0.5 * (lane.y - below.y)
        x = np.linspace(
            lane.lower, lane.upper, int((lane.upper - lane.lower) / LANE_STEP_M) + 2
        )
        left, right = (above, below) if lane.forward else (below, above)
        sides = (up, down) if lane.forward else (down, up)
        x = x if lane.forward else x[::-1]
        lanes.append(
            Lane(
                id=lane.id,
                centre=np.stack([x, np.full(x.shape, lane.y)], axis=1),
                left_width=np.full(x.shape, sides[0]),
                right_width=np.full(x.shape, sides[1]),
                speed_limit=limit,
                left=None if left is None else left.id,
                right=None if right is None else right.id,
            )
        )
    return tuple(lanes)


def _beside(
    lane: StraightLane, found: Sequence[StraightLane], width: float, side: float
) -> StraightLane | None:
    """The nearest lane on the side of +y (side = 1) or -y (side = -1), if adjoining.

    Lanes nearer than 0.4 widths are one lane under two names (on- and off-ramp).
    """
    apart = {
        other.id: side * (other.y - lane.y)
        for other in found
        if other.forward == lane.forward
    }
    near = [
        other
        for other in found
        if 0.4 * width < apart.get(other.id, 0.0) < NEIGHBOUR_WIDTHS * width
    ]
    return min(near, key=lambda other: apart[other.id], default=None)
