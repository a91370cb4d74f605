"""One reader for tables of text, Parquet and Feather.

`open_table` finds how a table is written, `batches` gives its columns in SI units a
few MiB at a time, `read` all of them. A row that cannot be read, or lacks a needed
cell, is dropped and counted in a `Ledger`, which refuses a table of too many; an empty
cell elsewhere is unknown. Every row keeps its line in the file, under `LINE`.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.readers.tables import cells
from rcirl_jax.data.readers.tables.columnar import (
    columnar_batches,
    first_cells,
    is_columnar,
    schema_of,
)
from rcirl_jax.data.readers.tables.layout import NUMBER, Layout, decimal_of, recognise
from rcirl_jax.data.readers.tables.ledger import LINE, Ledger
from rcirl_jax.data.readers.tables.text_rows import text_batches
from rcirl_jax.errors import InputError, did_you_mean, extra_module

SAMPLES = 60  # rows from which the meaning of a column is recognised
COMMON = ("t", "recording")  # fields that say when and where, not who
MAX_BYTES = 2**30  # of a table that is held whole: a few times the longest known
MAX_ROWS = 10_000_000  # likewise
CUT_IT = "cut it into recordings (a csv or NGSIM log: lower long_bytes)"
MAX_PLACE_M = 1e8  # m, farther is no place on earth
MAX_VELOCITY_MPS = 1e4  # m/s; keeps squares finite, recording.py has the true limit
MAX_TIME = 1e14  # s, ms or frames; ms since 1970 are 2e12


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
    form: str = ""  # of a time: `cells.ISO` or a pattern of strptime; "": a number
    scale: float = 1.0
    offset: float = 0.0
    factor: float = 1.0  # of the unit
    limit: float = np.inf  # in the file's unit; beyond it a number is absurd
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
        """What rows are counted by."""
        return "row" if self.layout is None else "line"

    @functools.cached_property
    def _places(self) -> dict[str, list[int]]:
        return _numbered(self.header)

    @functools.cached_property
    def _small(self) -> dict[str, list[int]]:
        return _numbered([name.casefold() for name in self.header])

    def _found(self, column: str) -> list[int]:
        """Numbers of the columns of a name, else of that name in another case."""
        exact = self._places.get(column)
        return exact or self._small.get(column.casefold(), [])

    def has(self, column: str) -> bool:
        """Whether there is a column of this name; its case does not matter."""
        return bool(self._found(column))

    def place(self, column: str) -> int:
        """Number of a column.

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
        raise InputError(
            f"{where}: missing: expected it among {_shortened(known)}{hint}"
        )

    def unit_of(self, column: str) -> str:
        """The unit of a column by the line below the header; "" without one."""
        units = self.layout.units if self.layout else ()
        return units[self.place(column)].strip("[]() ") if units else ""

    def marks(self, column: str) -> tuple[str, str]:
        """(decimal mark, mark between thousands) of numbers written as text."""
        if self.layout is not None:
            return self.layout.decimal, self.layout.thousands
        return decimal_of([self.samples(column)], "")

    def samples(self, column: str) -> list[str]:
        """Cells of a column in the first rows, as text."""
        place = self.place(column)
        if self.layout is None:
            return first_cells(self.path, self.header[place], SAMPLES)
        return [row[place].strip() for row in self.head if len(row) > place]


def _numbered(names: Sequence[str]) -> dict[str, list[int]]:
    """Name -> the numbers of its columns."""
    found: dict[str, list[int]] = {}
    for place, name in enumerate(names):
        found.setdefault(name, []).append(place)
    return found


def _shortened(names: Sequence[str]) -> list[str]:
    return [*names[:40], *(["..."] if len(names) > 40 else [])]


def open_table(path: Path, options: Mapping | None = None) -> Table:
    """A table of any of the forms, its layout recognised.

    Args:
      path: file.
      options: [table] of the source TOML, which wins over what is recognised.

    Raises:
      InputError: no table.
    """
    if is_columnar(path):
        return Table(path=path, header=tuple(schema_of(path).names))
    layout, rows = recognise(path, options or {})
    head = tuple(tuple(row) for row in rows)
    return Table(path=path, header=layout.header, layout=layout, head=head)


def fields_of(
    table: Table,
    needed: Sequence[str],
    optional: Sequence[str] = (),
    *,
    texts: Sequence[str] = (),
    limits: Mapping[str, float] | None = None,
    columns: Mapping[str, str] | None = None,
    factors: Mapping[str, float] | None = None,
) -> list[Field]:
    """Columns as fields: those needed, and others that are there.

    Args:
      table: of `open_table`.
      needed: fields without which a row is none.
      optional: fields whose column may be missing, and whose cells may be empty.
      texts: names among both that are no numbers.
      limits: of numbers; beyond them they are absurd.
      columns: names of columns, where they are not those of their fields.
      factors: of units.
    """
    own = columns or {}
    return [
        Field(
            name=name,
            column=own.get(name, name),
            needed=name in needed,
            text=name in texts,
            limit=(limits or {}).get(name, np.inf),
            factor=(factors or {}).get(name, 1.0),
        )
        for name in (*needed, *optional)
        if name in needed or table.has(own.get(name, name))
    ]


def batches(
    table: Table,
    fields: Sequence[Field],
    ledger: Ledger,
    show: Callable[[int], object] | None = None,
) -> Iterator[dict[str, Any]]:
    """Columns of a few MiB of rows; texts as (codes, names).

    Args:
      table: of `open_table`.
      fields: what is read; with `user`, the rows of all users come below each other.
      ledger: what is dropped is added to it.
      show: called with the bytes of the file just read.

    Raises:
      InputError: a column is missing or of another type, or the file is damaged.
    """
    places = [table.place(field.column) for field in fields]
    if table.layout is not None:
        for made in text_batches(table.path, table.layout, places, show):
            for line, why in made.unreadable:
                ledger.drop("unreadable", f"line {line}: {why}")
            ledger.read += len(made.unreadable)
            yield _batch(table, fields, made.columns, made.lines, ledger)
        return
    done, size, last = 0, table.path.stat().st_size, 0.0
    names = [table.header[place] for place in places]
    for columns, share in columnar_batches(table.path, names):
        rows = np.arange(done + 1, done + 1 + len(columns[0]))
        done += rows.size
        if show is not None:
            show(round(size * (share - last)))
        last = share
        yield _batch(table, fields, columns, rows, ledger)


@dataclasses.dataclass(frozen=True)
class _Column:
    """A field's cells of a batch."""

    field: Field
    cells: Any  # as they are in the file
    values: np.ndarray  # [n] numbers in the file's unit, or codes of names
    names: list[str] | None
    empty: np.ndarray  # [n]
    wrong: np.ndarray  # [n] unreadable, or absurd

    @property
    def bad(self) -> np.ndarray:
        """Whether a row [n] cannot be used for this cell."""
        return self.wrong | (self.empty & self.field.needed)

    def kept(self, rows: np.ndarray) -> Any:  # noqa: ANN401
        """Some rows in SI units; (codes, names) of texts."""
        if self.names is not None:
            return self.values[rows], self.names
        return self.values[rows] * self.field.factor

    def complaint(self, row: int, where: str) -> str:
        """What is wrong with the cell of a row."""
        field, value = self.field, self.values[row]
        cell = self.cells[row].as_py()
        text = "" if cell is None else str(cell)
        shown = f"'{text[:40]}{'...' if len(text) > 40 else ''}'"
        expected = f"a time as {field.form}" if field.form else "a finite number"
        if self.names is not None:
            long = f"up to {cells.TEXT_CHARS} characters"
            expected = long if self.wrong[row] else "a text"
        elif np.isfinite(value) and abs(value) > field.limit:
            shown, expected = f"{value:g}", f"within {field.limit:g}"
        return f"{where}: {field.column}: {shown}: expected {expected}"


def _column(table: Table, field: Field, found: Any) -> _Column:  # noqa: ANN401
    """Cells as numbers or texts, still with those that cannot be read."""
    try:
        if field.text:
            codes, names, wrong = cells.texts(found, field.lower)
            empty = np.array([not name for name in names], bool)[codes]
            return _Column(field, found, codes, names, empty, wrong)
        if field.form:
            values, wrong = cells.times(found, field.form)
        else:
            marks = table.marks(field.column) if cells.is_texts(found) else (".", "")
            values, wrong = cells.numbers(found, *marks)
    except (TypeError, extra_module("pyarrow").ArrowException) as error:
        why = " ".join(str(error).split())[:200]
        raise InputError(f"{table.path}: column {field.column}: {why}") from error
    if field.scale != 1.0 or field.offset:
        values = values * field.scale + field.offset
    wrong = wrong | (np.abs(values) > field.limit)
    empty = (np.isnan(values) & ~wrong) | (field.zero_is_empty & (values == 0.0))
    return _Column(field, found, values, None, empty, wrong)


def _batch(
    table: Table,
    fields: Sequence[Field],
    found: Sequence[Any],
    lines: np.ndarray,
    ledger: Ledger,
) -> dict[str, Any]:
    """A batch's readable rows, of all users below each other."""
    common: list[_Column] = []
    owned: dict[str, list[_Column]] = {}
    for field, cell in zip(fields, found, strict=True):
        own = common if field.user is None else owned.setdefault(field.user, [])
        own.append(_column(table, field, cell))
    users = list(owned)
    parts = []
    for number, columns in enumerate(owned.values() or [[]]):
        columns = [*common, *columns]
        rows = _readable(table, columns, lines, ledger)
        part = {column.field.name: column.kept(rows) for column in columns}
        if users:
            part["id"] = np.full(int(rows.sum()), number), users
        parts.append({LINE: lines[rows], **part})
    return parts[0] if len(parts) == 1 else _below_each_other(parts)


def _readable(
    table: Table, columns: Sequence[_Column], lines: np.ndarray, ledger: Ledger
) -> np.ndarray:
    """Rows [n] that are kept; those without anything but a time are none at all."""
    own = [c.empty for c in columns if c.field.needed and c.field.name not in COMMON]
    blank = np.all(own, axis=0) if len(own) > 1 else np.zeros(lines.size, bool)
    bad = np.any([column.bad for column in columns], axis=0)
    dropped = bad & ~blank
    ledger.read += int(np.sum(~blank))
    if dropped.any():
        row = int(np.argmax(dropped))
        first = next(column for column in columns if column.bad[row])
        where = f"{table.unit} {lines[row]}"
        ledger.drop("unreadable", first.complaint(row, where), int(dropped.sum()))
    return ~bad & ~blank


def _below_each_other(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Batches of the same fields as one; a column that some lack is unknown there."""
    names = dict.fromkeys(name for part in parts for name in part)
    made: dict[str, Any] = {}
    for name in names:
        columns = [part.get(name) for part in parts]
        if any(isinstance(column, tuple) for column in columns):
            made[name] = _texts_below(parts, name)
        else:
            filled = [
                np.full(part[LINE].size, np.nan) if column is None else column
                for part, column in zip(parts, columns, strict=True)
            ]
            made[name] = np.concatenate(filled)
    return made


def _texts_below(
    parts: Sequence[dict[str, Any]], name: str
) -> tuple[np.ndarray, list[str]]:
    """(codes, names) of a text in several batches."""
    known: dict[str, int] = {}
    codes = []
    for part in parts:
        own, names = part.get(name, (np.zeros(part[LINE].size, np.int64), [""]))
        mine = [known.setdefault(text, len(known)) for text in names]
        codes.append(np.array(mine, np.int32)[own])
    return np.concatenate(codes), list(known)


def read(
    table: Table, fields: Sequence[Field], ledger: Ledger
) -> dict[str, np.ndarray]:
    """All readable rows: numbers float64, NaN where unknown; texts str, "" likewise.

    Raises:
      InputError: as `batches`; a table too long to be held whole, without rows, or
        with more unreadable ones than the ledger allows.
    """
    size = table.path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(
            f"{table.path}: size: {size >> 20} MiB: expected {MAX_BYTES >> 20} at "
            f"most; {CUT_IT}"
        )
    parts, rows = [], 0
    for batch in batches(table, fields, ledger):
        parts.append(batch)
        rows += batch[LINE].size
        if rows > MAX_ROWS:
            raise InputError(
                f"{table.path}: rows: more than {MAX_ROWS}: expected fewer; {CUT_IT}"
            )
    ledger.check()
    whole = _below_each_other(parts)
    for name, column in whole.items():
        if isinstance(column, tuple):
            codes, names = column
            longest = max(map(len, names))
            if 4 * longest * rows > MAX_BYTES:  # numpy gives all cells as much room
                raise InputError(
                    f"{table.path}: {name}: {rows} rows of texts up to {longest} "
                    f"characters: expected {MAX_BYTES >> 20} MiB at most; {CUT_IT}"
                )
            whole[name] = np.array(names)[codes]
    return whole
