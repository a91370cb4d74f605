"""One reader for tables of text, Parquet and Feather.

`open_table` finds how a table is written, `batches` gives its columns in SI units a
few MiB at a time, `read` all of them. A row that cannot be read, or lacks a needed
cell, is dropped and counted in `RowStats`, which refuses a table of too many; an empty
cell elsewhere is unknown. Every row keeps its line in the file, under `LINE`.
"""

import dataclasses
import functools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.readers.tables import cells
from rcirl_jax.data.readers.tables.columnar import (
    columnar_batches,
    columns_of,
    is_columnar,
)
from rcirl_jax.data.readers.tables.rows import LINE, Rows, RowStats
from rcirl_jax.data.readers.tables.text import (
    NUMBER,
    Layout,
    decimal_of,
    recognise,
    text_batches,
)
from rcirl_jax.errors import InputError, did_you_mean, extra_module

SAMPLES = 60  # rows from which the meaning of a column is recognised
COMMON = ("t", "recording")  # fields that say when and where, not who
MAX_BYTES = 2**30  # of a table that is held whole: a few times the longest known
MAX_ROWS = 10_000_000  # likewise
CUT_IT = "cut it into recordings (a csv or NGSIM log: lower long_bytes)"
MAX_PLACE_M = 1e8  # m, farther is no place on earth
MAX_VELOCITY_MPS = 1e4  # m/s; keeps squares finite, recording.py has the true limit
MAX_TIME = 1e14  # s, ms or frames; ms since 1970 are 2e12
LIMITS = {
    **{"time": MAX_TIME, "place": MAX_PLACE_M, "speed": MAX_VELOCITY_MPS},
    "longitude": 180.0,
    **{"count": 1e12, "number": np.inf, "text": np.inf},
}  # what cells are -> beyond it no log means anything, in the file's unit


# field -> [n], of texts (codes [n], names), of which several may be equal
Batch = dict[str, Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Field:
    """A column of the file, and what its cells mean.

    A number is (cell * scale + offset) * factor; a text is taken as it is.
    """

    name: str
    column: str
    needed: bool = True  # a row without it is none; else empty cells are unknown
    text: bool = False
    lower: bool = False  # text in small letters
    # of a time: `cells.ISO`, one of `cells.CLOCK_DIGITS` or a pattern of strptime; "":
    # a number
    form: str = ""
    scale: float = 1.0
    offset: float = 0.0
    factor: float = 1.0  # of the unit
    limit: float = np.inf  # in the file's unit; beyond it a number is absurd
    hint: str = ""  # what to do where a cell is bad
    zero_is_empty: bool = False  # a receiver without a fix is at 0 degrees
    # whose column it is, in a table that has a row for all of a moment
    user: str | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """A table whose columns are known."""

    path: Path
    header: tuple[str, ...]
    layout: Layout | None = None  # None: Parquet or Feather
    head: tuple[tuple[str, ...], ...] = ()  # cells of the first rows, of a text

    @property
    def unit(self) -> str:
        """Returns the unit that rows are counted by."""
        return "row" if self.layout is None else "line"

    @functools.cached_property
    def _places(self) -> dict[str, list[int]]:
        """Name, also in small letters, -> the numbers of its columns."""
        found: dict[str, list[int]] = {}
        for change in (str, str.casefold):
            names = list(map(change, self.header))
            for name in set(names) - found.keys():
                found[name] = [k for k, other in enumerate(names) if other == name]
        return found

    def _found(self, column: str) -> list[int]:
        """Numbers of the columns of a name, else of that name in another case."""
        return self._places.get(column) or self._places.get(column.casefold(), [])

    def has(self, column: str) -> bool:
        """True if there is a column of this name; its case does not matter."""
        return bool(self._found(column))

    def place(self, column: str) -> int:
        """Returns the number of a column.

        Raises:
          InputError: it is missing, or met twice.
        """
        found = self._found(column)
        if len(found) == 1:
            return found[0]
        where = f"{self.path}: column {column}"
        if found:
            raise InputError(f"{where}: met twice: expected once")
        known = [name for name in self.header if name]
        hint = did_you_mean(column, known)
        if sum(bool(NUMBER.fullmatch(name)) for name in known) > len(known) / 2:
            hint = "; no header? name the columns by names in [table]"
        shown = [*known[:40], *(["..."] if len(known) > 40 else [])]
        raise InputError(f"{where}: missing: expected it among {shown}{hint}")

    def unit_of(self, column: str) -> str:
        """Returns the unit of a column by the line below the header; "" without one."""
        units = self.layout.units if self.layout else ()
        return units[self.place(column)].strip("[]() ") if units else ""

    def marks(self, column: str) -> tuple[str, str]:
        """Returns (decimal mark, mark between thousands) of numbers written as text."""
        if self.layout is not None:
            return self.layout.decimal, self.layout.thousands
        return decimal_of([self.samples(column)], "")

    def samples(self, column: str) -> list[str]:
        """Returns cells of a column in the first rows, as text."""
        place = self.place(column)
        if self.layout is not None:
            return [row[place].strip() for row in self.head if len(row) > place]
        for (found,), _ in columnar_batches(self.path, [self.header[place]]):
            first = found.slice(0, SAMPLES).to_pylist()
            return ["" if value is None else str(value) for value in first]
        return []


def open_table(
    path: Path, options: Mapping | None = None, known: Collection[str] = ()
) -> Table:
    """Opens a table of any of the forms, its layout recognised.

    Args:
      path: file.
      options: [table] of the source TOML, which wins over what is recognised.
      known: names that the table should hold, which may tell its encoding.

    Raises:
      InputError: no table.
    """
    if is_columnar(path):
        return Table(path=path, header=tuple(columns_of(path)))
    layout, rows = recognise(path, options or {}, known)
    head = tuple(tuple(row) for row in rows)
    return Table(path=path, header=layout.header, layout=layout, head=head)


def fields_of(
    table: Table,
    needed: Mapping[str, str],
    optional: Mapping[str, str] | None = None,
    *,
    columns: Mapping[str, str] | None = None,
    factors: Mapping[str, float] | None = None,
    lower: bool = False,
) -> list[Field]:
    """Returns columns as fields: those needed, and others that are there.

    Args:
      table: of `open_table`.
      needed: field -> what its cells are (a key of `LIMITS`); a row without one of
        them is none.
      optional: likewise, fields whose column may be missing, and cells empty.
      columns: field -> name of its column, where it is not the field's.
      factors: field -> factor of its unit.
      lower: texts are taken in small letters.
    """
    own = columns or {}
    return [
        Field(
            name=name,
            column=own.get(name, name),
            needed=name in needed,
            text=kind == "text",
            lower=lower and kind == "text",
            limit=LIMITS[kind],
            factor=(factors or {}).get(name, 1.0),
        )
        for name, kind in {**needed, **(optional or {})}.items()
        if name in needed or table.has(own.get(name, name))
    ]


def batches(
    table: Table,
    fields: Sequence[Field],
    stats: RowStats,
    show: Callable[[int], object] | None = None,
) -> Iterator[Batch]:
    """Yields the readable rows of a few MiB in SI units.

    Args:
      table: of `open_table`.
      fields: what is read; with `user`, the rows of all users come below each other.
      stats: counts what is dropped.
      show: called with the bytes of the file just read.

    Raises:
      InputError: a column is missing or of another type, or the file is damaged.
    """
    places = [table.place(field.column) for field in fields]
    if table.layout is not None:
        for made in text_batches(table.path, table.layout, places, show):
            columns, lines, unreadable = made
            for line, why in unreadable:
                stats.drop("unreadable", f"line {line}: {why}")
            stats.read += len(unreadable)
            yield _batch(table, fields, columns, lines, stats)
        return
    done, size, last = 0, table.path.stat().st_size, 0.0
    names = [table.header[place] for place in places]
    for columns, share in columnar_batches(table.path, names):
        rows = np.arange(done + 1, done + 1 + len(columns[0]))
        done += rows.size
        if show is not None:
            show(round(size * (share - last)))
        last = share
        yield _batch(table, fields, columns, rows, stats)


@dataclasses.dataclass(frozen=True)
class _Column:
    """A field's cells of a batch."""

    field: Field
    cells: Any  # as they are in the file
    values: np.ndarray  # [n] numbers in the file's unit, or codes of names
    names: list[str] | None
    empty: np.ndarray  # [n]
    bad: np.ndarray  # [n] unreadable, absurd, or empty and needed

    def complaint(self, row: int) -> str:
        """Says what is wrong with the cell of a row."""
        field, value = self.field, self.values[row]
        cell = self.cells[row].as_py()
        text = "" if cell is None else str(cell)
        shown = f"'{text[:40]}{'...' if len(text) > 40 else ''}'"
        expected = f"a time as {field.form}" if field.form else "a finite number"
        if self.names is not None:
            long = f"up to {cells.TEXT_CHARS} characters"
            expected = "a text" if self.empty[row] else long
        elif np.isfinite(value) and abs(value) > field.limit:
            shown, expected = f"{value:g}", f"within {field.limit:g}"
        hint = f"; {field.hint}" if field.hint else ""
        return f"{field.column}: {shown}: expected {expected}{hint}"


def _column(table: Table, field: Field, found: Any) -> _Column:  # noqa: ANN401
    """Cells as numbers or texts, still with those that cannot be read."""
    names = None
    try:
        if field.text:
            values, names, wrong = cells.texts(found, field.lower)
        elif field.form and field.form not in cells.CLOCK_DIGITS:
            values, wrong = cells.times(found, field.form)
        else:
            marks = table.marks(field.column) if cells.is_texts(found) else (".", "")
            values, wrong = cells.numbers(found, *marks)
            if field.form:
                values, bad = cells.times_of_day(values, field.form)
                wrong |= bad
    except (TypeError, extra_module("pyarrow").ArrowException) as error:
        why = " ".join(str(error).split())[:200]
        expected = "texts" if field.text else "times" if field.form else "numbers"
        raise InputError(
            f"{table.path}: column {field.column}: {why}: expected {expected}"
        ) from error
    if names is not None:
        empty = np.array([not name for name in names], bool)[values]
    else:
        if field.scale != 1.0 or field.offset:
            values = values * field.scale + field.offset
        wrong = wrong | (np.abs(values) > field.limit)
        empty = (np.isnan(values) & ~wrong) | (field.zero_is_empty & (values == 0.0))
    return _Column(field, found, values, names, empty, wrong | (empty & field.needed))


def _batch(
    table: Table,
    fields: Sequence[Field],
    found: Sequence[Any],
    lines: np.ndarray,
    stats: RowStats,
) -> Batch:
    """A batch's readable rows in SI units, of all users below each other.

    Rows without anything but a time are none at all. What a user has no column for is
    unknown.
    """
    made = [_column(table, *pair) for pair in zip(fields, found, strict=True)]
    users = list(dict.fromkeys(field.user for field in fields if field.user))
    parts = []
    for number, user in enumerate(users or [None]):
        columns = {c.field.name: c for c in made if c.field.user in (None, user)}
        own = [
            column.empty
            for name, column in columns.items()
            if column.field.needed and name not in COMMON
        ]
        blank = np.all(own, axis=0) if len(own) > 1 else np.zeros(lines.size, bool)
        bad = np.any([column.bad for column in columns.values()], axis=0)
        dropped, rows = bad & ~blank, ~bad & ~blank
        stats.read += int(np.sum(~blank))
        if dropped.any():
            row = int(np.argmax(dropped))
            first = next(column for column in columns.values() if column.bad[row])
            why = f"{table.unit} {lines[row]}: {first.complaint(row)}"
            stats.drop("unreadable", why, int(dropped.sum()))
        count = int(rows.sum())
        part: Batch = {LINE: lines[rows]}
        for field in fields:
            column = columns.get(field.name)
            if field.text:
                codes = (
                    np.zeros(count, np.int64) if column is None else column.values[rows]
                )
                part[field.name] = codes, [""] if column is None else column.names
            elif column is None:
                part[field.name] = np.full(count, np.nan)
            else:
                part[field.name] = column.values[rows] * column.field.factor
        if users:
            part["id"] = np.full(count, number), users
        parts.append(part)
    return _below_each_other(parts)


def _below_each_other(parts: Sequence[Batch]) -> Batch:
    """Batches of the same fields as one; names of texts stand behind each other."""
    if len(parts) == 1:
        return parts[0]
    made: Batch = {}
    for name in parts[0] if parts else ():
        columns = [part[name] for part in parts]
        if isinstance(columns[0], tuple):
            starts = np.cumsum([0, *(len(names) for _, names in columns)])
            codes = [
                own + start for (own, _), start in zip(columns, starts, strict=False)
            ]
            names = [text for _, names in columns for text in names]
            made[name] = np.concatenate(codes), names
        else:
            made[name] = np.concatenate(columns)
    return made


def number_texts(batch: Batch, known: dict[str, dict[str, int]]) -> Rows:
    """Returns a batch whose texts are numbers: those of `known`, which grows.

    Args:
      batch: of `batches`.
      known: field -> text -> its number, in order of appearance.
    """
    made = dict(batch)
    for name, column in batch.items():
        if isinstance(column, tuple):
            codes, texts = column
            own = known.setdefault(name, {})
            is_met = np.bincount(codes, minlength=len(texts)) > 0
            numbers = [
                own.setdefault(text, len(own)) if is_used else 0
                for text, is_used in zip(texts, is_met.tolist(), strict=True)
            ]
            made[name] = np.array(numbers, np.float64)[codes]
    return made


def check_rows(table: Table, count: int) -> None:
    """Refuses a table of more rows than are held at once."""
    if count > MAX_ROWS:
        raise InputError(
            f"{table.path}: rows: more than {MAX_ROWS}: expected fewer; {CUT_IT}"
        )


def read(table: Table, fields: Sequence[Field], stats: RowStats) -> Rows:
    """Returns all readable rows: numbers, NaN where unknown; texts, "" likewise.

    Raises:
      InputError: as `batches`; a table too long to be held whole, without rows, or
        with more unreadable ones than are allowed.
    """
    size = table.path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(
            f"{table.path}: size: {size >> 20} MiB: expected {MAX_BYTES >> 20} at "
            f"most; {CUT_IT}"
        )
    parts = []
    for batch in batches(table, fields, stats):
        parts.append(batch)
        check_rows(table, stats.read)
    stats.check()
    return as_texts(table, _below_each_other(parts))


def as_texts(table: Table, batch: Batch) -> Rows:
    """Returns a batch with its texts themselves.

    Raises:
      InputError: one text is so long that all of them would fill the memory.
    """
    made = dict(batch)
    for name, column in batch.items():
        if isinstance(column, tuple):
            codes, names = column
            longest, rows = max(map(len, names)), codes.size
            if 4 * longest * rows > MAX_BYTES:  # numpy gives all cells as much room
                raise InputError(
                    f"{table.path}: {name}: {rows} rows of texts up to {longest} "
                    f"characters: expected {MAX_BYTES >> 20} MiB at most; {CUT_IT}"
                )
            made[name] = np.array(names)[codes]
    return made
