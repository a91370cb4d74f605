"""SQLite files of others, opened for reading only and with bounded work.

A database can make its reader run code: views may recurse without end, generated
columns and triggers call functions, and every cell may have any type. So the file is
opened immutable, only tables are read, only SELECT is authorised, schema functions are
not trusted, values are short, and the virtual machine stops after a number of steps in
proportion to the file's size.
"""

import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

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
        self._check_head()
        self._ticks = max(MIN_STEPS, STEPS_PER_BYTE * self.path.stat().st_size)
        self._ticks //= CHECK_STEPS
        uri = f"{self.path.resolve().as_uri()}?mode=ro&immutable=1"
        try:
            self._connection = sqlite3.connect(uri, uri=True, isolation_level=None)
        except sqlite3.Error as error:
            raise self.error("database", str(error), "a SQLite file") from error
        try:
            for pragma in ("trusted_schema=OFF", "query_only=ON", "cell_size_check=ON"):
                self._execute(f"PRAGMA {pragma}", ())
        except InputError:
            self._connection.close()
            raise
        limit = self._connection.setlimit
        limit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_VALUE_BYTES)
        limit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
        limit(sqlite3.SQLITE_LIMIT_TRIGGER_DEPTH, 1)
        self._connection.set_progress_handler(self._tick, CHECK_STEPS)
        self._connection.set_authorizer(_authorise)
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def error(self, field: str, found: str, expected: str) -> InputError:
        """The line for something wrong in this file."""
        return InputError(f"{self.path}: {field}: {found[:120]}: expected {expected}")

    def _tick(self) -> int:
        self._ticks -= 1
        return int(self._ticks < 0)  # not 0: interrupt

    def _check_head(self) -> None:
        """Magic and, where the head is valid, as many pages as it says."""
        try:
            with self.path.open("rb") as handle:
                head = handle.read(100)
            size = self.path.stat().st_size
        except OSError as error:
            raise self.error("database", str(error), "a SQLite file") from error
        if len(head) < 100 or not head.startswith(MAGIC):
            raise self.error("database", f"{head[:16]!r}", "a SQLite file")
        page = int.from_bytes(head[16:18], "big")
        pages = int.from_bytes(head[28:32], "big")
        expected = pages * (65536 if page == 1 else page)
        if head[24:28] == head[92:96] and size < expected:
            raise self.error(
                "size", f"{size} bytes", f"{expected} bytes; truncated file?"
            )

    def columns(self, table: str) -> tuple[str, ...]:
        """Names of a table's columns; none if there is no such table.

        Raises:
          InputError: it is a view or a virtual table, or the schema is broken.
        """
        found = self._rows(
            "SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)
        )
        kinds = [row for rows in found for row in rows if row[0] in ("table", "view")]
        if not kinds:
            return ()
        kind, sql = kinds[0]
        virtual = str(sql).split(maxsplit=2)[1:2] in (["VIRTUAL"], ["virtual"])
        if kind != "table" or virtual:
            raise self.error(
                table, f"a {'virtual table' if virtual else kind}", "a table"
            )
        cursor = self._execute(f"SELECT * FROM {_quoted(table)} LIMIT 0", ())
        return tuple(entry[0] for entry in cursor.description or ())

    def need(self, table: str, columns: Sequence[str]) -> None:
        """A table with these columns has to be there."""
        found = self.columns(table)
        if not found:
            raise self.error(f"table {table}", "missing", "it in the database")
        for column in columns:
            if column not in found:
                raise self.error(
                    f"{table}.{column}", "missing", f"it among {', '.join(found)}"
                )

    def table(
        self,
        name: str,
        columns: Sequence[str],
        most: int,
        optional: Sequence[str] = (),
    ) -> list[tuple]:
        """All rows of a table: the columns, which have to be there, and optional ones.

        Args:
          name: of the table.
          columns: their names, which the file may have chosen.
          most: rows allowed.
          optional: other columns, or NULL where there are none.
        """
        self.need(name, columns)
        known = self.columns(name)
        chosen = [_quoted(column) for column in columns]
        chosen += [_quoted(one) if one in known else "NULL" for one in optional]
        sql = f"SELECT {', '.join(chosen)} FROM {_quoted(name)}"
        return [row for rows in self.chunks(sql, (name,), most) for row in rows]

    def numbers(
        self, sql: str, names: Sequence[str], most: int, values: tuple = ()
    ) -> np.ndarray:
        """[rows, columns] float64 of a query of numbers; NULL is NaN.

        Args:
          sql: a SELECT.
          names: of its columns, for errors.
          most: rows allowed.
          values: of its parameters.
        """
        parts = [np.zeros((0, len(names)))]
        for rows in self.chunks(sql, names, most, values):
            parts.append(self.floats(rows, names))
        return np.concatenate(parts)

    def chunks(
        self, sql: str, names: Sequence[str], most: int, values: tuple = ()
    ) -> Iterator[list[tuple]]:
        """Rows of a query, many at a time."""
        total = 0
        for rows in self._rows(sql, values):
            total += len(rows)
            if total > most:
                raise self.error(names[0], f"more than {most} rows", "fewer")
            yield rows

    def floats(self, rows: Sequence[tuple], names: Sequence[str]) -> np.ndarray:
        """[rows, columns] float64; NULL is NaN, text and blobs are errors."""
        for name, cells in zip(names, zip(*rows, strict=True), strict=True):
            # numpy would read numbers out of text
            wrong = set(map(type, cells)) - {int, float, type(None)}
            if wrong:
                bad = next(cell for cell in cells if type(cell) in wrong)
                raise self.error(name, repr(bad)[:40], "a number")
        return np.array(rows, np.float64)

    def _rows(self, sql: str, values: tuple) -> Iterator[list[tuple]]:
        cursor = self._execute(sql, values)
        try:
            while rows := cursor.fetchmany(CHUNK_ROWS):
                yield rows
        except FAULTS as error:
            raise self._failed(error) from error

    def _execute(self, sql: str, values: tuple) -> sqlite3.Cursor:
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


def _authorise(action: int, *_: object) -> int:
    return sqlite3.SQLITE_OK if action in ALLOWED else sqlite3.SQLITE_DENY
