"""SQLite files of others, opened by Python's sqlite3 for reading only, in bounded work.

A database can make its reader run code (views, generated columns, triggers). So the
file is opened immutable, only tables are read, only SELECT is authorised, schema
functions are not trusted, values are short, and the virtual machine stops after a
number of steps in proportion to the file's size.
"""

import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.readers.tables.streams import first_bytes
from rcirl_jax.errors import InputError

MAGIC = b"SQLite format 3\x00"
MAX_VALUE_BYTES = 16 * 1024**2  # bytes of one cell
STEPS_PER_BYTE = 20  # instructions of the virtual machine per byte of the file
MIN_STEPS = 50_000_000  # instructions granted to the smallest file
CHECK_STEPS = 1_000_000  # instructions between checks
CHUNK_ROWS = 1024  # rows fetched at once; more keep Python's collector busy
# sqlite3's own messages may hold bytes of the file that are no text
FAULTS = (sqlite3.Error, sqlite3.Warning, OverflowError, UnicodeDecodeError)
ALLOWED = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)


class Database:
    """One SQLite file; use as a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> "Database":
        head, size = first_bytes(self.path, 100), self.path.stat().st_size
        if len(head) < 100 or not head.startswith(MAGIC):
            raise self.error("database", f"{head[:16]!r}", "a SQLite file")
        page, pages = (
            int.from_bytes(head[k:n], "big") for k, n in [(16, 18), (28, 32)]
        )
        expected = pages * (65536 if page == 1 else page)
        if head[24:28] == head[92:96] and size < expected:  # the head is valid
            raise self.error(
                "size", f"{size} bytes", f"{expected} bytes; truncated file?"
            )
        uri = f"{self.path.resolve().as_uri()}?mode=ro&immutable=1"
        self._connection = sqlite3.connect(uri, uri=True, isolation_level=None)
        self._ticks = max(MIN_STEPS, STEPS_PER_BYTE * size) // CHECK_STEPS
        try:
            for pragma in ("trusted_schema=OFF", "query_only=ON", "cell_size_check=ON"):
                self._execute(f"PRAGMA {pragma}")
        except InputError:
            self._connection.close()
            raise
        self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_VALUE_BYTES)
        self._connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
        self._connection.set_progress_handler(self._tick, CHECK_STEPS)
        self._connection.set_authorizer(
            lambda action, *_: (
                sqlite3.SQLITE_OK if action in ALLOWED else sqlite3.SQLITE_DENY
            )
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def _tick(self) -> int:
        self._ticks -= 1
        return int(self._ticks < 0)  # not 0: interrupt

    def error(self, field: str, found: str, expected: str) -> InputError:
        """Makes the line for something wrong in this file."""
        return InputError(f"{self.path}: {field}: {found[:120]}: expected {expected}")

    def columns(self, table: str) -> tuple[str, ...]:
        """Returns the names of a table's columns; none if there is no such table.

        Raises:
          InputError: it is a view or a virtual table, or the schema is broken.
        """
        kinds = "SELECT type, sql FROM sqlite_master WHERE name = ?"
        kinds += " AND type IN ('table', 'view')"
        for rows in self.chunks(kinds, (table,), values=(table,)):
            ((kind, text), *_) = rows
            is_virtual = "virtual" in str(text).lower().split()[1:2]
            if is_virtual or kind != "table":
                what = "a virtual table" if is_virtual else "a view"
                raise self.error(table, what, "a table")
            break
        else:
            return ()
        cursor = self._execute(f"SELECT * FROM {_quoted(table)} LIMIT 0")
        return tuple(entry[0] for entry in cursor.description or ())

    def need(self, table: str, columns: Sequence[str]) -> tuple[str, ...]:
        """Returns all columns of a table, among which these have to be."""
        found = self.columns(table)
        if not found:
            raise self.error(f"table {table}", "missing", "it in the database")
        for column in columns:
            if column not in found:
                raise self.error(
                    f"{table}.{column}", "missing", f"it among {', '.join(found)}"
                )
        return found

    def table(
        self, name: str, columns: Sequence[str], most: int, optional: Sequence[str] = ()
    ) -> list[tuple]:
        """Returns all rows: the columns, which have to be there, and optional ones."""
        known = self.need(name, columns)
        chosen = [_quoted(column) for column in columns]
        chosen += [_quoted(one) if one in known else "NULL" for one in optional]
        sql = f"SELECT {', '.join(chosen)} FROM {_quoted(name)}"
        return [row for rows in self.chunks(sql, (name,), most) for row in rows]

    def numbers(
        self, sql: str, names: Sequence[str], most: int, values: tuple = ()
    ) -> np.ndarray:
        """Returns [rows, columns] float64 of a query of numbers; NULL is NaN.

        At most `most` rows are allowed; `names` of its columns are for errors.
        """
        parts = [np.zeros((0, len(names)))]
        for rows in self.chunks(sql, names, most, values):
            for name, cells in zip(names, zip(*rows, strict=True), strict=True):
                # numpy would read numbers out of text
                wrong = set(map(type, cells)) - {int, float, type(None)}
                if wrong:
                    bad = next(cell for cell in cells if type(cell) in wrong)
                    raise self.error(name, repr(bad)[:40], "a number")
            parts.append(np.array(rows, np.float64))
        return np.concatenate(parts)

    def chunks(
        self, sql: str, names: Sequence[str], most: int = 10**9, values: tuple = ()
    ) -> Iterator[list[tuple]]:
        """Yields rows of a query, many at a time; arguments as of `numbers`."""
        cursor, total = self._execute(sql, values), 0
        try:
            while rows := cursor.fetchmany(CHUNK_ROWS):
                total += len(rows)
                if total > most:
                    raise self.error(names[0], f"more than {most} rows", "fewer")
                yield rows
        except FAULTS as error:
            raise self._failed(error) from error

    def _execute(self, sql: str, values: tuple = ()) -> sqlite3.Cursor:
        try:
            return self._connection.execute(sql, values)
        except FAULTS as error:
            raise self._failed(error) from error

    def _failed(self, error: Exception) -> InputError:
        if self._ticks < 0:
            return self.error("query", "too much work for the file's size", "tables")
        return self.error("database", str(error), "a readable SQLite file")


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
