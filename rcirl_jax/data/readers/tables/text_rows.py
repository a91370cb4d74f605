"""Rows of a table of text as columns of cells, by pyarrow (extra `[logs]`).

Each row keeps the number of its line. A row of another length than the header's is
unreadable, unless what it has too much is empty; a last line that breaks off ends the
reading. Rows that go on repeating their last columns are unfolded into one a group.
"""

import csv
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.readers.tables.layout import BLANKS, Layout
from rcirl_jax.data.readers.tables.streams import MAX_SPAN, blocks
from rcirl_jax.errors import InputError, extra_module


@dataclasses.dataclass(frozen=True, kw_only=True)
class TextBatch:
    """A few MiB of rows."""

    columns: list[Any]  # pyarrow's text arrays [n], of the columns asked for
    lines: np.ndarray  # [n] int64, of each row
    unreadable: list[tuple[int, str]]  # line and what is wrong with it


def text_batches(
    path: Path,
    layout: Layout,
    places: Sequence[int],
    show: Callable[[int], object] | None = None,
) -> Iterator[TextBatch]:
    """Columns of a table, a few MiB at a time.

    Args:
      path: file.
      layout: of its text.
      places: numbers of the columns.
      show: called with the bytes of the file just read.

    Raises:
      InputError: the last line breaks off, or a line has no end.
    """
    for start, whole, is_last in blocks(path, layout.encoding, layout.quote, show):
        text, first = _below_header(whole, start, layout.skip)
        if not text:
            continue
        if layout.delimiter == BLANKS:
            text = _single_blanks(text)
        if layout.quote:
            spaced = f"{layout.delimiter} {layout.quote}"
            text = text.replace(spaced, spaced.replace(" ", "", 1))
        if not layout.repeating:
            columns, odd = _parsed(text, layout, places)
            count = text.count("\n") + (not text.endswith("\n"))
            if not odd and len(columns[0]) == count:
                lines = np.arange(first, first + count)
                yield TextBatch(columns=columns, lines=lines, unreadable=[])
                continue
        made = _careful(text, first, layout, places)
        if is_last and not text.endswith("\n"):
            _check_last(path, made, first + text.count("\n"))
        yield made


def _below_header(text: str, start: int, skip: int) -> tuple[str, int]:
    """A block without the lines above the first row, and its first line's number."""
    at, left = 0, max(skip - start + 1, 0)
    for _ in range(left):
        end = text.find("\n", at)
        if end < 0:
            return "", start + left
        at = end + 1
    return text[at:], start + left


def _single_blanks(text: str) -> str:
    """Runs of blanks and tabs as one, none at the ends of lines."""
    text = text.replace("\t", " ")
    while "  " in text:
        text = text.replace("  ", " ")
    return text.replace("\n ", "\n").replace(" \n", "\n").strip(" ")


def _parsed(
    text: str, layout: Layout, places: Sequence[int]
) -> tuple[list[Any], list[tuple[int, int]]]:
    """Columns of text, and (number from 0, cells) of each row of another length."""
    arrow, reading = extra_module("pyarrow"), extra_module("pyarrow.csv")
    names = [f"c{place}" for place in range(len(layout.header))]
    wanted = [names[place] for place in places]
    odd: list[tuple[int, int]] = []

    def skipped(row: Any) -> str:  # noqa: ANN401
        odd.append((row.number - 1, row.actual_columns))
        return "skip"

    data = text.encode()
    table = reading.read_csv(
        arrow.BufferReader(data),
        read_options=reading.ReadOptions(
            use_threads=False, block_size=len(data) + 1, column_names=names
        ),
        parse_options=reading.ParseOptions(
            delimiter=layout.delimiter,
            quote_char=layout.quote or False,
            newlines_in_values=True,
            invalid_row_handler=skipped,
        ),
        convert_options=reading.ConvertOptions(
            column_types=dict.fromkeys(wanted, arrow.string()),
            include_columns=list(dict.fromkeys(wanted)),
            strings_can_be_null=False,
        ),
    )
    return [_one(table.column(name)) for name in wanted], odd


def _one(column: Any) -> Any:  # noqa: ANN401
    """An array of a chunked one."""
    return column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()


def _careful_rows(
    text: str, first: int, layout: Layout
) -> tuple[list[str], list[int], list[tuple[int, str]]]:
    """Rows of one line each, the line of each, and lines that are none.

    Empty lines are left out, line ends inside of quotes become blanks, and rows that
    repeat are unfolded.
    """
    rows: list[str] = []
    lines: list[int] = []
    unreadable: list[tuple[int, str]] = []
    every = text.removesuffix("\n").split("\n")
    at = 0
    while at < len(every):
        row, line, span = every[at], first + at, 1
        if layout.quote and row.count(layout.quote) % 2:
            span = _span(every, at, layout)
            if not span:
                unreadable.append((line, "a quote without an end"))
                at += 1
                continue
            row = " ".join(every[at : at + span])
        at += span
        if row.strip():
            made = _unfolded(row, layout) if layout.repeating else [row]
            rows += made
            lines += [line] * len(made)
    return rows, lines, unreadable


def _span(every: Sequence[str], at: int, layout: Layout) -> int:
    """Lines of a row that goes on inside of quotes; 0: they have no end."""
    reader = csv.reader(
        every[at : at + MAX_SPAN],
        delimiter=layout.delimiter,
        quotechar=layout.quote,
        strict=True,
    )
    try:
        next(reader)
    except csv.Error as error:
        return 0 if "unexpected end" in str(error) else 1
    return reader.line_num


def _unfolded(row: str, layout: Layout) -> list[str]:
    """A row for each group of last columns; what is left over stays, to be refused."""
    cells = [cell.strip() for cell in row.split(layout.delimiter)]
    while cells and not cells[-1]:
        cells.pop()
    fixed = len(layout.header) - layout.repeating
    head = layout.delimiter.join(cells[:fixed])
    return [
        layout.delimiter.join([head, *cells[k : k + layout.repeating]])
        if fixed
        else layout.delimiter.join(cells[k : k + layout.repeating])
        for k in range(fixed, len(cells), layout.repeating)
    ] or [row]


def _careful(text: str, first: int, layout: Layout, places: Sequence[int]) -> TextBatch:
    """Columns of rows of which some have another length than the header's."""
    rows, lines, unreadable = _careful_rows(text, first, layout)
    columns, odd = _parsed("\n".join(rows), layout, places)
    width = len(layout.header)
    surplus = [number for number, cells in odd if cells > width]
    for number in surplus:
        rows[number] = _without_surplus(rows[number], width, layout)
    if surplus:
        columns, odd = _parsed("\n".join(rows), layout, places)
    kept = np.ones(len(rows), bool)
    kept[[number for number, _ in odd]] = False
    found = [(lines[n], f"{cells} cells: expected {width}") for n, cells in odd]
    return TextBatch(
        columns=columns,
        lines=np.array(lines, np.int64)[kept],
        unreadable=sorted([*unreadable, *found]),
    )


def _check_last(path: Path, batch: TextBatch, line: int) -> None:
    """A last line without an end is whole, or the file is not."""
    if batch.unreadable and batch.unreadable[-1][0] == line:
        raise InputError(
            f"{path}: line {line}: {batch.unreadable[-1][1]}; the last line breaks "
            "off: expected a whole file"
        )


def _without_surplus(row: str, width: int, layout: Layout) -> str:
    """A row without the empty cells that it has too many at its end."""
    cells = layout.cells(row)
    while len(cells) > width and not cells[-1].strip():
        row = row[: row.rindex(layout.delimiter)]
        cells.pop()
    return row
