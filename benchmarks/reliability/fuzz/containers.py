"""Databases, column files and archives changed inside."""

import contextlib
import functools
import io
import random
import sqlite3
import zipfile
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet

from benchmarks.reliability.fuzz.trees import mutate_bytes, near, odd_scalar

MOST_VALUES = 10_000  # of an array that is changed value by value
HUGE = (0, 1, -1, 2**31, 2**40, 2**62)  # sizes that an array may claim


def sqlite(data: bytes, rng: random.Random) -> bytes:
    """A SQLite database: cells, rows, columns, tables, views."""
    connection = sqlite3.connect(":memory:")
    try:
        connection.deserialize(data)
        tables = connection.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table'"
        ).fetchall()
        for _ in range(rng.choice((1, 1, 2, 4))):
            with contextlib.suppress(sqlite3.Error, OverflowError):
                _change_table(connection, rng.choice(tables)[0], rng)
        connection.commit()
        return connection.serialize()
    finally:
        connection.close()


def _change_table(
    connection: sqlite3.Connection, name: str, rng: random.Random
) -> None:
    cursor = connection.execute(f'SELECT rowid, * FROM "{name}" ORDER BY RANDOM()')
    columns = [entry[0] for entry in cursor.description][1:]
    row = cursor.fetchone() or (0, *columns)
    column = rng.randrange(len(columns))
    kind, quoted = rng.randrange(12), f'"{columns[column]}"'
    if kind <= 6:
        rows = "" if kind == 0 else f"WHERE rowid = {row[0]}"
        value = _cell(row[1 + column], rng)
        connection.execute(f'UPDATE "{name}" SET {quoted} = ? {rows}', (value,))
    elif kind == 7:
        which = rng.choice(("1", "rowid % 2", f"rowid = {row[0]}"))
        connection.execute(f'DELETE FROM "{name}" WHERE {which}')
    elif kind == 8:
        marks = ", ".join("?" * len(columns))
        cells = [_cell(cell, rng) if rng.random() < 0.2 else cell for cell in row[1:]]
        connection.execute(f'INSERT INTO "{name}" VALUES ({marks})', cells)
    elif kind == 9:
        connection.execute(f'ALTER TABLE "{name}" RENAME COLUMN {quoted} TO odd')
    elif kind == 10:
        connection.execute(f'DROP TABLE "{name}"')
    else:
        connection.execute(f'ALTER TABLE "{name}" RENAME TO old')
        connection.execute(f'CREATE VIEW "{name}" AS SELECT * FROM old, old AS more')


def _cell(value: Any, rng: random.Random) -> Any:  # noqa: ANN401
    made = near(value, rng) if rng.random() < 0.6 else odd_scalar(rng)
    if isinstance(made, list | dict):
        return None
    return made


@functools.lru_cache(maxsize=4)
def _seed_table(data: bytes) -> pyarrow.Table:
    return pyarrow.parquet.read_table(io.BytesIO(data))


_first: list[bytes] = []


def parquet(data: bytes, rng: random.Random) -> bytes:
    """A Parquet file: values, types and number of columns and rows.

    The first file given is the seed of all: one that was damaged could end the
    process in the mutator instead of in the reader.
    """
    if not _first:
        _first.append(data)
    columns = dict(_columns(_seed_table(_first[0])))
    rows = len(next(iter(columns.values())))
    order = _rows(rows, rng)
    columns = {name: values.take(order) for name, values in columns.items()}
    for _ in range(rng.choice((1, 1, 2, 4))):
        _change_column(columns, rng)
    out = io.BytesIO()
    table = pyarrow.table(list(columns.values()), names=[*columns])
    if rng.random() < 0.1:
        field = rng.choice(table.column_names)
        table = table.append_column(field, table[field])
    size = rng.choice((None, None, 1 + len(order) // 3))
    pyarrow.parquet.write_table(table, out, row_group_size=size)
    return out.getvalue()


def _columns(table: pyarrow.Table) -> list[tuple[str, pyarrow.Array]]:
    return [(name, table[name].combine_chunks()) for name in table.column_names]


def _rows(count: int, rng: random.Random) -> list[int]:
    """Which rows, in which order."""
    order = list(range(count))
    kind = rng.randrange(8)
    if kind == 0:
        return []
    if kind == 1:
        rng.shuffle(order)
    elif kind == 2:
        order = order[: rng.randrange(count)]
    elif kind == 3:
        order += rng.choices(order, k=rng.choice((1, 10, 100)))
    elif kind == 4:
        order = rng.sample(order, k=rng.randrange(1, count + 1))
    return order


def _change_column(columns: dict[str, pyarrow.Array], rng: random.Random) -> None:
    name = rng.choice([*columns])
    values, kind = columns[name], rng.randrange(9)
    if kind <= 4:
        listed = values.to_pylist()
        places = range(len(listed)) if kind == 0 else [rng.randrange(len(listed) or 1)]
        odd = near(listed[0], rng) if listed and rng.random() < 0.5 else odd_scalar(rng)
        for place in places if listed else ():
            listed[place] = odd
        columns[name] = _array(listed, values.type)
    elif kind == 5:
        types = (pyarrow.string(), pyarrow.float32(), pyarrow.int64(), pyarrow.bool_())
        columns[name] = _array(values.to_pylist(), rng.choice(types))
    elif kind == 6:
        columns[rng.choice(("odd", "", "track_id"))] = columns.pop(name)
    elif kind == 7:
        columns[name] = values.dictionary_encode()
    elif len(columns) > 1:
        del columns[name]


def _array(values: list, kind: pyarrow.DataType) -> pyarrow.Array:
    """As wanted, or of any type that takes the values."""
    errors = (pyarrow.ArrowException, ValueError, TypeError, OverflowError)
    with contextlib.suppress(*errors):
        return pyarrow.array(values, kind)
    with contextlib.suppress(*errors):
        return pyarrow.array(values)
    return pyarrow.array([str(value) for value in values])


def npz(data: bytes, rng: random.Random) -> bytes:
    """An archive of arrays: values, types, claimed shapes, names, compression."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    for _ in range(rng.choice((1, 1, 2, 4))):
        name, kind = rng.choice([*members]), rng.randrange(7)
        if kind <= 2:
            members[name] = _npy(_changed(np.load(io.BytesIO(members[name])), rng))
        elif kind == 3:
            members[name] = claimed(members[name], rng)
        elif kind == 4:
            del members[name]
        elif kind == 5:
            members[rng.choice(("../odd.npy", "/odd.npy", "odd"))] = members[name]
        else:
            members[name] = mutate_bytes(members[name], rng)
        if not members:
            break
    return archive_of(members, rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))


def archive_of(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """A zip archive of these files."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()


def claimed(data: bytes, rng: random.Random) -> bytes:
    """An array whose head claims another shape or type than its data have."""
    shape = tuple(rng.choice(HUGE) for _ in range(rng.randrange(4)))
    kind = rng.choice(("<f8", "|O", "<U4", "|b1", "<c16", "<M8[s]", "|V0", "<U999999"))
    head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    text = head.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data[128:]


def _npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array, allow_pickle=False)
    return out.getvalue()


def _changed(array: np.ndarray, rng: random.Random) -> np.ndarray:
    kind = rng.randrange(6)
    if array.size > MOST_VALUES:  # of no bytes each, as any number of them may be
        return array.ravel()[:2]
    if kind == 0:
        return array[: rng.randrange(1 + len(array))] if array.ndim else array[None]
    if kind == 1:
        return array.astype(rng.choice(("U8", "float32", "complex64", "S3")))
    if kind == 2:
        return np.stack([array, array], axis=-1)
    if kind == 3:
        return np.array(rng.choice(("odd", 1.0, [], [1, 2], "a\0b", ["é\n"] * 3)))
    made = array.copy()
    if made.size and made.dtype.kind == "f":
        made.flat[rng.randrange(made.size)] = rng.choice((np.nan, np.inf, -1e30))
    elif made.size:
        made.flat[:] = made.flat[rng.randrange(made.size)]
    return made
