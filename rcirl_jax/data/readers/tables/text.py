"""Tables of text: how one is written, and its rows as columns of cells.

A delimiter is the one that cuts most lines into equally many cells. The header is the
first line with as many cells; what stands above it (comments, `sep=;`) is passed over.
A comma inside of numbers is a decimal comma unless it can only stand between thousands.
What the TOML says wins.

Each row keeps the number of its line. A row of another length than the header's is
unreadable, unless what it has too much is empty; a last line that breaks off ends the
reading. Rows that go on repeating their last columns are unfolded into one a group.
"""

import collections
import contextlib
import csv
import dataclasses
import functools
import itertools
import re
import string
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from rcirl_jax.data.readers.tables.streams import MAX_SPAN, blocks, head_of
from rcirl_jax.errors import InputError, extra_module
from rcirl_jax.runtime.checked import checked

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


_Count = Annotated[int, msgspec.Meta(ge=0, le=MAX_COLUMNS)]
_Decimal = Annotated[str, msgspec.Meta(pattern=r"^[.,]$")]
_Group = Annotated[str, msgspec.Meta(pattern=rf"^[{GROUPS}]?$")]
_Quote = Annotated[str, msgspec.Meta(pattern=r"""^["']?$""")]


class _Options(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """[table] of a source TOML; what is left out is recognised."""

    delimiter: str = ""
    decimal: _Decimal | None = None
    thousands: _Group | None = None
    quote: _Quote | None = None
    encoding: str = ""
    skip: _Count | None = None
    names: list[str] | None = None
    repeating: _Count | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Layout:
    """The layout of a table's text."""

    encoding: str
    delimiter: str
    is_guess: bool = False  # whether nothing tells the encoding
    quote: str = '"'  # around cells; "": none
    decimal: str = "."
    thousands: str = ""  # between groups of three digits; "": none
    skip: int = 0  # lines above the first row, the header's among them
    header: tuple[str, ...] = ()
    units: tuple[str, ...] = ()  # of the columns, in a line below the header
    # last columns of the header that a row goes on repeating: pNEUMA's one row a drive
    repeating: int = 0

    def in_words(self) -> str:
        """Returns the layout in one line."""
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
    """Returns the pattern of a number with a mark between its thousands."""
    return (
        rf"[-+]?[1-9]\d{{0,2}}(?:{re.escape(mark)}\d{{3}})+(?:{re.escape(decimal)}\d*)?"
    )


def recognise(
    path: Path, section: Mapping, known: Collection[str] = ()
) -> tuple[Layout, list[list[str]]]:
    """Returns the layout of a table, and the cells of its first rows.

    Args:
      path: file.
      section: [table] of the source TOML, whose options win.
      known: names that the text should hold, which may tell its encoding.

    Raises:
      InputError: no text, an unknown option, more columns than tables have.
    """
    given = _options(path, section)
    encoding, is_guess, lines = head_of(path, given.get("encoding", ""), known)
    plain = [line for line in lines if line[:1] not in HASHES and line.strip()]
    cells = re.split(r"[,;|\t]", plain[0]) if plain else []
    # comments are all that is marked above a header without a mark; else the last
    # marked line may be the header itself
    has_header = len(cells) > 1 and not any(
        NUMBER.fullmatch(cell.strip(" \"'")) for cell in cells
    )
    for at, line in enumerate(lines):
        if line[:1] in HASHES:
            lines[at] = "" if has_header else line.lstrip("#% ")
    # double quotes; single ones where they enclose cells and no others do
    text, single = "\n".join(lines), r"(^|[,;\t|])'[^'\n]*'([,;\t|]|$)"
    is_single = '"' not in text and re.search(single, text, re.M)
    quote = given.get("quote", "'" if is_single else '"')
    delimiter = given.get("delimiter") or _delimiter(lines, quote)
    rows = cells_of(lines, delimiter, quote)
    header, first = given.get("names"), given.get("skip", 0)
    has_names = header is not None
    if header is None:
        at = min(given.get("skip", _header_line(rows)), len(rows) - 1)
        header, first = [name.strip() for name in rows[at]], at + 1
    if not any(header):
        raise InputError(f"{path}: header: empty: expected column names and rows")
    if len(header) > MAX_COLUMNS:
        raise InputError(
            f"{path}: header: {len(header)} columns: expected up to {MAX_COLUMNS}"
        )
    below = [row for row in rows[first:] if any(cell.strip() for cell in row)]
    units: list[str] = []
    if not has_names and _are_units(below, len(header)):
        units, first, below = [cell.strip() for cell in below[0]], first + 1, below[1:]
    repeating = given.get("repeating", _repeating(len(header), below))
    if repeating > len(header):
        raise InputError(
            f"{path}: table.repeating: {repeating}: expected up to {len(header)}, the "
            "number of columns"
        )
    # rows with names: each has a cell more than the header, and no empty last one
    more = {len(row) - len(header) if row[-1].strip() else 0 for row in below}
    if more == {1} and not (repeating or has_names):
        header = ["", *header]
    decimal, thousands = decimal_of(below, delimiter)
    layout = Layout(
        encoding=encoding,
        is_guess=is_guess,
        delimiter=delimiter,
        quote=quote,
        decimal=given.get("decimal", decimal),
        thousands=given.get("thousands", thousands),
        skip=first,
        header=tuple(header),
        units=tuple(units),
        repeating=repeating,
    )
    return layout, below


def _options(path: Path, section: Mapping) -> dict[str, Any]:
    """Returns [table] of a source TOML, checked."""
    checked(section, _Options, f"{path}: table")
    found = dict(section)
    if "delimiter" in found:
        given = str(found["delimiter"])
        mark = DELIMITERS.get(given, given)
        if len(mark) != 1 or mark not in string.punctuation + " \t":
            expected = f"one of {', '.join(DELIMITERS)}, or a mark"
            raise InputError(f"{path}: table.delimiter: {mark}: expected {expected}")
        found["delimiter"] = mark
    if found.get("decimal") and found.get("decimal") == found.get("thousands"):
        raise InputError(f"{path}: table.thousands: expected another than the decimal")
    return found


def _are_units(rows: Sequence[Sequence[str]], width: int) -> bool:
    """True if the first row says the units of columns: words where others count."""
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


def cells_of(lines: Sequence[str], delimiter: str, quote: str) -> list[list[str]]:
    """Returns the cells of each line, taken alone."""
    rows = []
    for line in lines:
        cells = line.split() if delimiter == BLANKS else line.split(delimiter)
        if quote and quote in line:
            text = " ".join(cells) if delimiter == BLANKS else line
            reader = csv.reader(
                [text], delimiter=delimiter, quotechar=quote, skipinitialspace=True
            )
            with contextlib.suppress(csv.Error, StopIteration):
                cells = next(reader)
        rows.append(cells)
    return rows


def _delimiter(lines: Sequence[str], quote: str) -> str:
    """Returns what cuts most lines into equally many cells; blanks at last.

    Spreadsheets say it in a first line `sep=;`.
    """
    if lines[0].lower().startswith("sep=") and len(lines[0]) == 5:
        return lines[0][-1]
    best, most = BLANKS, (0.0, 0)
    for mark in TRIED:
        counts = [len(row) for row in cells_of(lines, mark, quote)]
        width, times = _most_common(counts)
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


def _header_line(rows: Sequence[Sequence[str]]) -> int:
    """The first line with as many cells as most, or one fewer (names of rows).

    Empty cells at the ends of lines count, or not. The first one if all are empty.
    """
    wholes, filled = [len(row) for row in rows], [len(_trimmed(row)) for row in rows]
    wanted = set()
    for counts in (wholes, filled):
        known = [count for count, some in zip(counts, filled, strict=True) if some]
        usual, times = _most_common(known) if known else (0, 0)
        wanted |= {usual, usual - 1} if times > 1 else set()
    for at, (whole, some) in enumerate(zip(wholes, filled, strict=True)):
        if some > 1 and not wanted.isdisjoint((whole, some)):
            return at
    several = (at for least in (1, 0) for at, n in enumerate(filled) if n > least)
    return next(several, 0)


def _most_common(counts: Sequence[int]) -> tuple[int, int]:
    """The number met most often, the larger of two, and how often it is met."""
    found = collections.Counter(counts)
    return max(found.items(), key=lambda item: (item[1], item[0]))


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


def decimal_of(rows: Sequence[Sequence[str]], delimiter: str) -> tuple[str, str]:
    """Returns (decimal mark, mark between thousands) of the numbers in rows."""
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


# pyarrow's text arrays [n] of the columns asked for, line [n] of each row, and
# (line, what is wrong with it) of rows that cannot be read
TextBatch = tuple[list[Any], np.ndarray, list[tuple[int, str]]]


def text_batches(
    path: Path,
    layout: Layout,
    places: Sequence[int],
    show: Callable[[int], object] | None = None,
) -> Iterator[TextBatch]:
    """Yields columns of a table, a few MiB at a time.

    Args:
      path: file.
      layout: of its text.
      places: numbers of the columns.
      show: called with the bytes of the file just read.

    Raises:
      InputError: the last line breaks off, or a line has no end.
    """
    for start, whole in blocks(path, layout.encoding, layout.quote, show):
        above = max(layout.skip - start + 1, 0)  # lines above the first row
        text = whole
        if above:
            text = whole.split("\n", above)[-1] if whole.count("\n") >= above else ""
        if not text:
            continue
        if layout.delimiter == BLANKS:  # runs as one, none at the ends of lines
            text = text.replace("\t", " ")
            while "  " in text:  # faster than a regular expression
                text = text.replace("  ", " ")
            text = text.replace("\n ", "\n").replace(" \n", "\n").strip(" ")
        first, lines = start + above, text.count("\n") + (not text.endswith("\n"))
        columns = None if layout.repeating else _columns_of(text, layout, places)
        if columns is not None and len(columns[0]) == lines:
            yield columns, np.arange(first, first + lines), []
            continue
        columns, numbers, unreadable = _row_by_row(text, first, layout, places)
        bad = unreadable[-1:]
        if not text.endswith("\n") and bad and bad[0][0] == first + lines - 1:
            raise InputError(
                f"{path}: line {bad[0][0]}: {bad[0][1]}; the last line breaks off: "
                "expected a whole file"
            )
        yield columns, numbers, unreadable


def _columns_of(text: str, layout: Layout, places: Sequence[int]) -> list[Any] | None:
    """Returns the columns of rows, one a line; None: some have another length."""
    arrow, reading = extra_module("pyarrow"), extra_module("pyarrow.csv")
    names = [f"c{place}" for place in range(len(layout.header))]
    wanted = [names[place] for place in places]
    if layout.quote:
        spaced = f"{layout.delimiter} {layout.quote}"
        text = text.replace(spaced, spaced.replace(" ", "", 1))
    data = text.encode()
    try:
        table = reading.read_csv(
            arrow.BufferReader(data),
            read_options=reading.ReadOptions(
                use_threads=False, block_size=len(data) + 1, column_names=names
            ),
            parse_options=reading.ParseOptions(
                delimiter=layout.delimiter,
                quote_char=layout.quote or False,
                newlines_in_values=True,
            ),
            convert_options=reading.ConvertOptions(
                column_types=dict.fromkeys(wanted, arrow.string()),
                include_columns=list(dict.fromkeys(wanted)),
                strings_can_be_null=False,
            ),
        )
    except arrow.ArrowInvalid:
        return None
    return [
        column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()
        for column in map(table.column, wanted)
    ]


def _row_by_row(
    text: str, first: int, layout: Layout, places: Sequence[int]
) -> TextBatch:
    """Returns columns of rows of which some are none, repeat, or take several lines."""
    width, fixed = len(layout.header), len(layout.header) - layout.repeating
    columns: list[list[str]] = [[] for _ in places]
    numbers: list[int] = []
    unreadable: list[tuple[int, str]] = []
    every, at = text.removesuffix("\n").split("\n"), 0
    while at < len(every):
        line, number, span = every[at], first + at, 1
        if layout.quote and line.count(layout.quote) % 2:
            span = _span(every[at : at + MAX_SPAN], layout)
            line = " ".join(every[at : at + span])
        at += max(span, 1)
        if not span:
            unreadable.append((number, "a quote without an end"))
        if not line.strip():
            continue
        made = cells_of([line], layout.delimiter, layout.quote)
        if layout.repeating:
            cells = _trimmed([cell.strip() for cell in made[0]])
            groups = range(fixed, len(cells), layout.repeating)
            made = [
                [*cells[:fixed], *cells[k : k + layout.repeating]] for k in groups
            ] or [cells]
        for row in made:
            while len(row) > width and not row[-1].strip():
                row.pop()
            if len(row) != width:
                unreadable.append((number, f"{len(row)} cells: expected {width}"))
                continue
            numbers.append(number)
            for column, place in zip(columns, places, strict=True):
                column.append(row[place])
    arrow = extra_module("pyarrow")
    arrays = [arrow.array(column, arrow.string()) for column in columns]
    return arrays, np.array(numbers, np.int64), unreadable


def _span(lines: Sequence[str], layout: Layout) -> int:
    """Returns the lines of a row that goes on inside of quotes; 0: they have no end."""
    reader = csv.reader(
        lines, delimiter=layout.delimiter, quotechar=layout.quote, strict=True
    )
    try:
        next(reader)
    except csv.Error as error:
        return 0 if "unexpected end" in str(error) else 1
    return reader.line_num
