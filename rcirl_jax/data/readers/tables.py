"""Tables of comma-separated text with a header, read and checked row by row."""

import collections
import csv
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NoReturn, TextIO

import numpy as np

from rcirl_jax.errors import InputError

TEXT_CHARS = 64  # characters of a text cell
MAX_COLUMNS = 10_000  # of a table; logs have some dozens
MAX_LINE = 2**20  # characters of a line
MAX_BYTES = 2**30  # of a file that is held whole: a few times the longest known
# a quoted number with separators between thousands: "1,118,846,979,700"
GROUPED = re.compile(r'"([-+]?\d{1,3}(?:,\d{3})+(?:\.\d*)?)"')


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
