"""How a table of text is written: recognised from its head, or as the TOML says.

A delimiter is the one that cuts most lines into equally many cells. The header is the
first line with as many cells; what stands above it (comments, `sep=;`) is passed over.
A comma inside of numbers is a decimal comma unless it can only stand between thousands.
"""

import collections
import csv
import dataclasses
import functools
import itertools
import re
import string
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rcirl_jax.data.readers.tables.streams import head_of
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.checked import check_names

MAX_COLUMNS = 10_000  # of a table; logs have some dozens
MOST = 0.8  # share of a head's rows that repeat their last columns
SAMPLE_CELLS = 20_000  # cells of the head from which decimals are recognised
DELIMITERS = {"tab": "\t", "space": " ", "comma": ",", "semicolon": ";", "pipe": "|"}
TRIED = ("\t", ";", "|", ",")  # delimiters, the likelier first where two cut as well
HASHES = ("#", "%")  # before comments, and before the header where it is one
BLANKS = " "  # a delimiter that stands for any run of blanks and tabs
GROUPS = ",.'’ \u00a0\u202f"  # what may stand between thousands
# texts that say that nothing is known, in small letters
EMPTY = (
    *("", "nan", "na", "n/a", "#n/a", "null", "none", "nil", "nat", "<na>"),
    *("-", "--", "?", "\\n"),
)
MARKED = frozenset(GROUPS) - {"."}
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
MARKS = {
    "decimal": (".", ","),
    "thousands": (*GROUPS, ""),
    "quote": ('"', "'", ""),
}
OPTIONS = (
    *("delimiter", "decimal", "thousands", "encoding", "quote"),
    *("skip", "names", "repeating"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Layout:
    """How the text of a table is written."""

    encoding: str
    delimiter: str
    quote: str = '"'  # around cells; "": none
    decimal: str = "."
    thousands: str = ""  # between groups of three digits; "": none
    skip: int = 0  # lines above the first row, the header's among them
    header: tuple[str, ...] = ()
    units: tuple[str, ...] = ()  # of the columns, in a line below the header
    # last columns of the header that a row goes on repeating: pNEUMA's one row a drive
    repeating: int = 0

    def cells(self, line: str) -> list[str]:
        """Cells of one line."""
        return cells_of([line], self.delimiter, self.quote)[0]

    def in_words(self) -> str:
        """The layout in one line."""
        names = {mark: name for name, mark in DELIMITERS.items()}
        between = names.get(self.delimiter, repr(self.delimiter))
        said = [f"text in {self.encoding}", f"{between} between cells"]
        said.append("decimal comma" if self.decimal == "," else "decimal point")
        if self.thousands:
            said.append(f"{self.thousands!r} between thousands")
        if self.repeating:
            last = ", ".join(self.header[-self.repeating :])
            said.append(f"a row per road user, which repeats {last}")
        return ", ".join(said)


@functools.cache
def grouped(mark: str, decimal: str) -> str:
    """Pattern of a number with a mark between its thousands."""
    return (
        rf"[-+]?[1-9]\d{{0,2}}(?:{re.escape(mark)}\d{{3}})+(?:{re.escape(decimal)}\d*)?"
    )


def recognise(path: Path, section: Mapping) -> tuple[Layout, list[list[str]]]:
    """The layout of a table, and the cells of its first rows.

    Args:
      path: file.
      section: [table] of the source TOML, whose options win.

    Raises:
      InputError: no text, an unknown option, more columns than tables have.
    """
    given = _options(path, section)
    encoding, lines = head_of(path, given.get("encoding", ""))
    lines = _without_hashes(lines)
    quote = _quote(given, lines)
    delimiter = given.get("delimiter") or _delimiter(lines, quote)
    rows = cells_of(lines, delimiter, quote)
    if "names" in given:
        header, first = given["names"], given.get("skip", 0)
    else:
        at = min(given.get("skip", _header_line(rows)), len(rows) - 1)
        header, first = [name.strip() for name in rows[at]], at + 1
    if not any(header):
        raise InputError(f"{path}: header: empty: expected column names and rows")
    if len(header) > MAX_COLUMNS:
        raise InputError(
            f"{path}: header: {len(header)} columns: expected up to {MAX_COLUMNS}"
        )
    below = [row for row in rows[first:] if any(cell.strip() for cell in row)]
    units: Sequence[str] = ()
    if "names" not in given and _are_units(below, len(header)):
        units, first, below = below[0], first + 1, below[1:]
    repeating = given.get("repeating", _repeating(len(header), below))
    if repeating > len(header):
        raise InputError(
            f"{path}: table.repeating: {repeating}: expected up to {len(header)}, the "
            "number of columns"
        )
    if not repeating and "names" not in given and _has_row_names(header, below):
        header = ["", *header]
    decimal, thousands = decimal_of(below, delimiter)
    layout = Layout(
        encoding=encoding,
        delimiter=delimiter,
        quote=quote,
        decimal=given.get("decimal", decimal),
        thousands=given.get("thousands", thousands),
        skip=first,
        header=tuple(header),
        units=tuple(unit.strip() for unit in units),
        repeating=repeating,
    )
    return layout, below


def _without_hashes(lines: Sequence[str]) -> list[str]:
    """Lines without the marks of comments; comments are empty.

    They are all that is marked above a header without a mark; else the last marked
    line may be the header itself.
    """
    plain = [line for line in lines if line[:1] not in HASHES and line.strip()]
    cells = re.split(r"[,;|\t]", plain[0]) if plain else []
    has_header = len(cells) > 1 and not any(
        NUMBER.fullmatch(cell.strip(" \"'")) for cell in cells
    )
    return [
        line if line[:1] not in HASHES else ("" if has_header else line.lstrip("#% "))
        for line in lines
    ]


def _are_units(rows: Sequence[Sequence[str]], width: int) -> bool:
    """Whether the first row says the units of columns: words where others count."""
    if len(rows) < 3 or len(rows[0]) != width:
        return False
    words = 0
    for cell, *others in zip(*(row[:width] for row in rows[:3]), strict=False):
        text = cell.strip()
        if not all(
            NUMBER.fullmatch(other.strip().replace(",", ".")) for other in others
        ):
            continue
        if NUMBER.fullmatch(text.replace(",", ".")):
            return False
        words += text.lower() not in EMPTY
    return words > 0


def _options(path: Path, section: Mapping) -> dict[str, Any]:
    """[table] of a source TOML, checked.

    Raises:
      InputError: an unknown option, or one of another form.
    """
    found: dict[str, Any] = {}
    check_names(f"{path}: table.", section, OPTIONS)
    for name, value in section.items():
        where = f"{path}: table.{name}: {value}"
        if name in ("skip", "repeating"):
            if type(value) is not int or not 0 <= value <= MAX_COLUMNS:
                raise InputError(f"{where}: expected a number of lines or columns")
        elif name == "names":
            if not isinstance(value, list) or not all(map(_is_text, value)):
                raise InputError(f"{where}: expected a list of names")
        else:
            value = _mark(where, name, value)
        found[name] = value
    if found.get("decimal") and found.get("decimal") == found.get("thousands"):
        raise InputError(f"{path}: table.thousands: expected another than the decimal")
    return found


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _mark(where: str, name: str, value: object) -> str:
    """An option of one character; "" says that there is none."""
    if not isinstance(value, str):
        raise InputError(f"{where}: expected a text")
    if name == "encoding":
        return value
    if name == "delimiter":
        value = DELIMITERS.get(value, value)
        if value == "\t" or (len(value) == 1 and value in string.punctuation + " "):
            return value
        raise InputError(f"{where}: expected one of {', '.join(DELIMITERS)}, or a mark")
    if value not in MARKS[name]:
        raise InputError(f"{where}: expected one of {' '.join(MARKS[name])}")
    return value


def cells_of(lines: Sequence[str], delimiter: str, quote: str) -> list[list[str]]:
    """Cells of each line, taken alone."""
    if delimiter == BLANKS and not any(quote and quote in line for line in lines):
        return [line.split() for line in lines]
    rows = []
    for line in lines:
        text = re.sub(r"[ \t]+", " ", line.strip()) if delimiter == BLANKS else line
        if not quote or quote not in text:
            rows.append(text.split(delimiter))
            continue
        try:
            rows.append(
                next(
                    csv.reader(
                        [text],
                        delimiter=delimiter,
                        quotechar=quote,
                        skipinitialspace=True,
                    )
                )
            )
        except (csv.Error, StopIteration):
            rows.append(text.split(delimiter))
    return rows


def _quote(given: Mapping, lines: Sequence[str]) -> str:
    """Double quotes; single ones where they enclose cells and no others do."""
    if "quote" in given:
        return str(given["quote"])
    text = "\n".join(lines)
    if '"' not in text and re.search(r"(^|[,;\t|])'[^'\n]*'([,;\t|]|$)", text, re.M):
        return "'"
    return '"'


def _delimiter(lines: Sequence[str], quote: str) -> str:
    """What cuts most lines into as many cells as most others; blanks at last.

    Spreadsheets say it in a first line `sep=;`.
    """
    if lines[0].lower().startswith("sep=") and len(lines[0]) == 5:
        return lines[0][-1]
    best, most = BLANKS, (0.0, 0)
    for mark in TRIED:
        counts = [_count(line, mark, quote) for line in lines]
        width, times = max(
            collections.Counter(counts).items(), key=lambda item: (item[1], item[0])
        )
        if width == 1 and counts[0] > 1:  # rows of different lengths
            width, times = counts[0], 1
        if width > 1 and (times / len(counts), width) > most:
            best, most = mark, (times / len(counts), width)
    if best != BLANKS and most[0] > 0.5:
        return best
    blanks = [len(line.split()) for line in lines]
    width, times = collections.Counter(blanks).most_common(1)[0]
    if width > 1 and times / len(blanks) > max(most[0], 0.5):
        return BLANKS
    return best if best != BLANKS else (BLANKS if max(blanks) > 1 else ",")


def _count(line: str, mark: str, quote: str) -> int:
    """Number of a line's cells."""
    if quote and quote in line:
        return len(cells_of([line], mark, quote)[0])
    return line.count(mark) + 1


def _header_line(rows: Sequence[Sequence[str]]) -> int:
    """The first line with as many cells as most, or one fewer (names of rows).

    Empty cells at the ends of lines count, or not. The first one if all are empty.
    """
    wholes = [len(row) for row in rows]
    filled = [len(_trimmed(row)) for row in rows]
    if not any(filled):
        return 0
    wanted = {_usual(wholes, filled), _usual(filled, filled)} - {0}
    for at, counts in enumerate(zip(wholes, filled, strict=True)):
        if counts[1] > 1 and any(c in (w, w - 1) for c in counts for w in wanted):
            return at
    several = (at for at, count in enumerate(filled) if count > 1)
    return next(several, next(at for at, count in enumerate(filled) if count))


def _usual(counts: Sequence[int], filled: Sequence[int]) -> int:
    """What most lines count that are not empty; 0: each another number."""
    known = [count for count, some in zip(counts, filled, strict=True) if some]
    usual, times = max(
        collections.Counter(known).items(), key=lambda item: (item[1], item[0])
    )
    return usual if times > 1 else 0


def _repeating(width: int, rows: Sequence[Sequence[str]]) -> int:
    """Last columns of the header that longer rows go on repeating, 0 of a usual table.

    Nearly all rows are longer, by different multiples of one number of cells.
    """
    more = [len(_trimmed(row)) - width for row in rows]
    if len(set(more)) < 2 or sum(count > 0 for count in more) < MOST * len(more):
        return 0
    for group in range(width, 1, -1):
        if sum(count % group == 0 for count in more) >= MOST * len(more):
            return group
    return 0


def _trimmed(row: Sequence[str]) -> list[str]:
    """Cells without the empty ones at the end."""
    cells = list(row)
    while cells and not cells[-1].strip():
        cells.pop()
    return cells


def _has_row_names(header: Sequence[str], rows: Sequence[Sequence[str]]) -> bool:
    """Whether every row has a cell more than the header, and no empty last one."""
    return bool(rows) and all(
        len(row) == len(header) + 1 and row[-1].strip() for row in rows
    )


def decimal_of(rows: Sequence[Sequence[str]], delimiter: str) -> tuple[str, str]:
    """(decimal mark, mark between thousands) of the numbers in rows."""
    cells = itertools.chain.from_iterable(rows)
    every = [cell.strip() for cell in itertools.islice(cells, SAMPLE_CELLS)]
    points = any("." in cell and NUMBER.fullmatch(cell) for cell in every)
    # few cells are numbers with anything but a point
    odd = [c for c in every if c.count(".") > 1 or not MARKED.isdisjoint(c)]
    commas = [cell for cell in odd if COMMA.fullmatch(cell)]
    sure = any(not re.fullmatch(grouped(",", "."), cell) for cell in commas)
    both = any(re.fullmatch(grouped(".", ","), c) and "," in c for c in odd)
    is_comma = both or sure or bool(commas and delimiter != "," and not points)
    decimal = "," if is_comma else "."
    for mark in GROUPS:
        if mark == decimal:
            continue
        found = [cell for cell in odd if re.fullmatch(grouped(mark, decimal), cell)]
        # 1.234 alone may be a number with three decimals
        if any(mark != "." or decimal in c or c.count(".") > 1 for c in found):
            return decimal, mark
    return decimal, ""
