"""Tables of text with empty cells, and bounds on what their numbers may be."""

import csv
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np

from rcirl_jax.data.readers.tables import (
    check_row,
    check_size,
    lines_of,
    load_rows,
    rows_of,
)
from rcirl_jax.errors import InputError

MAX_PLACE_M = 1e8  # m, farther is no place on earth
MAX_VELOCITY_MPS = 1e4  # m/s; keeps squares finite, recording.py has the true limit
MAX_TIME = 1e14  # s, ms or frames; ms since 1970 are 2e12


def read_sparse_table(
    path: Path,
    header: Sequence[str],
    chosen: Sequence[str],
    text: Mapping[str, int],
    skip: int = 1,
) -> dict[str, np.ndarray]:
    """Columns of a comma-separated file whose cells may be empty.

    Args:
      path: file.
      header: names of all its columns.
      chosen: those to read.
      text: those among them that are no numbers -> characters kept.
      skip: lines before the first row.

    Returns:
      Column name -> values; numbers as float64, NaN where a cell is empty.

    Raises:
      InputError: no rows, a row of another length (commas too many at its end
        are allowed), a cell that is no number.
    """
    kinds = [
        f"U{text[name]}" if name in text else "f8" if name in chosen else "U1"
        for name in header
    ]
    names = [f"c{place}" for place in range(len(header))]
    dtype = list(zip(names, kinds, strict=True))
    check_size(path)
    try:
        with path.open(encoding="utf-8-sig") as handle:
            lines = itertools.islice(lines_of(handle), skip, None)
            rows = load_rows(_filled(lines, len(header)), dtype, ",")
    except (ValueError, UnicodeError):
        _find_bad_sparse_cell(path, header, [n for n in chosen if n not in text], skip)
    if rows.size == 0:
        raise InputError(f"{path}: rows: none: expected rows below the header")
    table = {name: rows[f"c{header.index(name)}"] for name in chosen}
    for name in chosen:
        if name in text:
            cells = np.char.strip(table[name])
            table[name] = np.where(cells == "nan", "", cells)
        elif np.isinf(table[name]).any():
            _find_bad_sparse_cell(path, header, [name], skip)
    return table


def _filled(lines: Iterable[str], count: int) -> Iterator[str]:
    """Lines with empty cells written as nan and surplus commas dropped."""
    for line in lines:
        row = line.rstrip("\r\n")
        at_the_end = len(row) - len(row.rstrip(","))
        surplus = max(row.count(",") - count + 1, 0)
        row = row[: len(row) - min(at_the_end, surplus)]
        if ",," in row:
            row = row.replace(",,", ",nan,").replace(",,", ",nan,")
        if row.endswith(","):
            row += "nan"
        yield "nan" + row if row.startswith(",") else row


def _find_bad_sparse_cell(
    path: Path, header: Sequence[str], numeric: Sequence[str], skip: int
) -> NoReturn:
    """Read slowly and name the first line that is wrong."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as handle:
            for line, (_, cells) in enumerate(rows_of(handle), start=1):
                if line > skip and cells:
                    while len(cells) > len(header) and not cells[-1].strip():
                        cells.pop()
                    filled = [cell if _is_filled(cell) else "0" for cell in cells]
                    check_row(path, line, filled, header, numeric)
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: text: {error}: expected CSV text") from error
    raise InputError(f"{path}: rows: unreadable: expected comma-separated cells")


def check_range(
    path: Path, table: Mapping[str, np.ndarray], fields: Sequence[str], limit: float
) -> None:
    """No number is absurdly large (NaN passes); else which, in the field's unit."""
    for name in fields:
        wrong = np.flatnonzero(np.abs(table[name]) > limit)
        if wrong.size:
            raise InputError(
                f"{path}: row {wrong[0] + 1}: {name}: {table[name][wrong[0]]:g}: "
                f"expected within {limit:g}"
            )


def _is_filled(cell: str) -> bool:
    return cell.strip().lower() not in ("", "nan")
