"""Columns of a Parquet file, with sizes and types checked before they are read.

The footer is checked first: number of rows, bytes after decompression, types of
the wanted columns. Text is read as dictionary codes, so that a long text that
is met in every row exists once.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rcirl_jax.errors import InputError, extra_module

if TYPE_CHECKING:  # an optional package
    import pyarrow
    import pyarrow.parquet

MAX_FILE_BYTES = 512 * 1024**2  # bytes of a file
MAX_GROUP_BYTES = 512 * 1024**2  # bytes of a row group, decompressed
MAX_ROWS = 5_000_000
MAX_COLUMNS = 1000
MAX_TEXT = 200  # characters of a text value
MAX_TEXT_BYTES = 128 * 1024**2  # bytes of a column of text; a scenario has 1e7
MAX_FOOTER_BYTES = 16 * 1024**2  # bytes of a text in the footer (pandas metadata)


def read_columns(
    path: Path, numbers: Sequence[str], text: Sequence[str], optional: Sequence[str]
) -> dict[str, np.ndarray]:
    """Columns of equal length, without nulls.

    Args:
      path: file.
      numbers: columns of numbers, read as float64; finite.
      text: columns of text; whole numbers are taken as text too.
      optional: names among both that may be missing.

    Raises:
      InputError: no Parquet file, a missing, doubled, nested or mistyped
        column, too many rows or bytes, an empty cell, a number not finite.
    """
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise InputError(
            f"{path}: size: {size} bytes: expected at most {MAX_FILE_BYTES}"
        )
    arrow = extra_module("pyarrow")
    try:
        table = _read(path, numbers, text, optional)
        # indices and text of a damaged page, which reading does not check
        table.validate(full=True)
        return {
            name: _values(path, name, table.column(name), name in numbers)
            for name in table.column_names
        }
    except InputError:
        raise
    except (
        arrow.ArrowException,
        OSError,
        ValueError,
        TypeError,
        LookupError,
        MemoryError,
        OverflowError,
    ) as error:
        raise InputError(f"{path}: parquet: {error}: expected Parquet") from error


def _read(
    path: Path, numbers: Sequence, text: Sequence, optional: Sequence
) -> "pyarrow.Table":
    limits: dict[str, Any] = {
        "thrift_string_size_limit": MAX_FOOTER_BYTES,
        "thrift_container_size_limit": MAX_ROWS,
        "page_checksum_verification": True,
    }
    open_file = extra_module("pyarrow.parquet").ParquetFile
    with open_file(path, **limits) as file:
        metadata = file.metadata
        if metadata.num_columns > MAX_COLUMNS:
            raise InputError(
                f"{path}: columns: {metadata.num_columns}: "
                f"expected at most {MAX_COLUMNS}"
            )
        if metadata.num_rows == 0:
            raise InputError(f"{path}: rows: none: expected at least one")
        _check_sizes(path, metadata)
        wanted = _wanted(path, file.schema_arrow, numbers, text, optional)
    words = [name for name in text if name in wanted]
    with open_file(path, metadata=metadata, read_dictionary=words, **limits) as file:
        return file.read(columns=wanted, use_threads=False)


def _wanted(
    path: Path,
    schema: "pyarrow.Schema",
    numbers: Sequence[str],
    text: Sequence[str],
    optional: Sequence[str],
) -> list[str]:
    """The columns that are there, each once and of its type."""
    wanted = []
    for name in (*numbers, *text):
        places = schema.get_all_field_indices(name)
        if len(places) > 1:
            raise InputError(f"{path}: column {name}: met twice: expected once")
        if places:
            wanted.append(name)
            _check_type(path, name, schema.field(name).type, name in numbers)
        elif name not in optional:
            raise InputError(
                f"{path}: column {name}: missing: expected it among {schema.names[:40]}"
            )
    return wanted


def _check_type(
    path: Path, name: str, kind: "pyarrow.DataType", is_number: bool
) -> None:
    types = extra_module("pyarrow").types
    plain = kind.value_type if types.is_dictionary(kind) else kind
    whole = types.is_integer(plain)
    if is_number:
        fits = whole or types.is_floating(plain)
    else:
        fits = whole or types.is_string(plain) or types.is_large_string(plain)
    if not fits:
        raise InputError(
            f"{path}: column {name}: type {str(kind)[:60]}: "
            f"expected {'numbers' if is_number else 'text'}"
        )


def _check_sizes(path: Path, metadata: "pyarrow.parquet.FileMetaData") -> None:
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    counts = [metadata.num_rows, *(group.num_rows for group in groups)]
    if min(counts) < 0 or max(counts) > MAX_ROWS or sum(counts[1:]) != counts[0]:
        raise InputError(
            f"{path}: rows: {counts[0]} in row groups of {counts[1:5]}: "
            f"expected their sum, at most {MAX_ROWS}"
        )
    # not the sizes of single columns: pyarrow aborts the process over damaged ones
    largest = max(group.total_byte_size for group in groups)
    if largest > MAX_GROUP_BYTES:
        raise InputError(
            f"{path}: row group: {largest} bytes: expected at most {MAX_GROUP_BYTES}"
        )


def _values(
    path: Path, name: str, column: "pyarrow.ChunkedArray", is_number: bool
) -> np.ndarray:
    if column.null_count:
        row = np.flatnonzero(column.is_null().to_numpy())[0]
        raise InputError(f"{path}: row {row}: {name}: null: expected a value")
    return (_numbers if is_number else _texts)(path, name, column)


def _numbers(path: Path, name: str, column: "pyarrow.ChunkedArray") -> np.ndarray:
    types = extra_module("pyarrow").types
    if types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    values = column.to_numpy().astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise InputError(
            f"{path}: row {bad[0]}: {name}: {values[bad[0]]}: expected a finite number"
        )
    return values


def _texts(path: Path, name: str, column: "pyarrow.ChunkedArray") -> np.ndarray:
    types = extra_module("pyarrow").types
    if not types.is_dictionary(column.type):
        column = column.dictionary_encode()
    merged = column.combine_chunks()
    chunks = getattr(merged, "chunks", [merged])
    values = [_words(path, name, chunk) for chunk in chunks]
    return np.concatenate(values)


def _words(path: Path, name: str, chunk: "pyarrow.DictionaryArray") -> np.ndarray:
    words = [str(value) for value in chunk.dictionary.to_pylist()]
    longest = max(words, key=len, default="")
    if len(longest) > MAX_TEXT:
        raise InputError(
            f"{path}: {name}: '{longest[:40]}...' of {len(longest)} characters: "
            f"expected at most {MAX_TEXT}"
        )
    # numpy gives every cell the room of the longest text
    size = 4 * len(longest) * max(len(words), len(chunk))
    if size > MAX_TEXT_BYTES:
        raise InputError(
            f"{path}: {name}: {len(chunk)} rows of texts up to {len(longest)} "
            f"characters: {size} bytes: expected at most {MAX_TEXT_BYTES}"
        )
    return np.array(words)[chunk.indices.to_numpy(zero_copy_only=False)]
