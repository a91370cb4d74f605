"""Rows of Parquet and Feather files, with sizes checked before they are read.

The footer is checked first: number of columns, bytes of a row group after
decompression. Text is read as dictionary codes, so that a long text that is met in
every row exists once.
"""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rcirl_jax.data.readers.tables.streams import first_bytes
from rcirl_jax.errors import InputError, extra_module

if TYPE_CHECKING:  # an optional package
    import pyarrow
    import pyarrow.parquet

MAX_GROUP_BYTES = 512 * 2**20  # bytes of a row group, decompressed
MAX_ROWS = 2**33  # of a file; what is held whole has a limit of its own
MAX_COLUMNS = 10_000
MAX_FOOTER_BYTES = 16 * 2**20  # bytes of a text in the footer (pandas metadata)
BATCH_ROWS = 2**16  # rows read at a time
PARQUET, FEATHER, OLD_FEATHER = b"PAR1", b"ARROW1", b"FEA1"


def is_columnar(path: Path) -> bool:
    """Whether the first bytes are those of Parquet or Feather."""
    return first_bytes(path).startswith((PARQUET, FEATHER, OLD_FEATHER))


def schema_of(path: Path) -> "pyarrow.Schema":
    """Names and types of the columns.

    Raises:
      InputError: a damaged file, or more columns than tables have.
    """
    with _as_one_line(path):
        if first_bytes(path).startswith(PARQUET):
            with _parquet(path) as file:
                return file.schema_arrow
        with _feather(path) as file:
            if len(file.schema) > MAX_COLUMNS:
                raise InputError(
                    f"{path}: columns: {len(file.schema)}: expected at most "
                    f"{MAX_COLUMNS}"
                )
            return file.schema


def first_cells(path: Path, name: str, count: int) -> list[str]:
    """The first cells of a column as text, "" where there is none."""
    for (column,), _ in columnar_batches(path, [name]):
        found = column.slice(0, count).to_pylist()
        return ["" if value is None else str(value) for value in found]
    return []


def columnar_batches(path: Path, names: Sequence[str]) -> Iterator[tuple[list, float]]:
    """(arrays of the columns, share of the file read) of some rows at a time.

    Raises:
      InputError: a damaged file, or a row group too large to be held.
    """
    is_parquet = first_bytes(path).startswith(PARQUET)
    read = _parquet_batches if is_parquet else _feather_batches
    with _as_one_line(path):
        for batch, share in read(path, list(dict.fromkeys(names))):
            # indices and text of a damaged page, which reading does not check
            batch.validate(full=True)
            yield [batch.column(name) for name in names], share


@contextlib.contextmanager
def _as_one_line(path: Path) -> Iterator[None]:
    arrow = extra_module("pyarrow")
    try:
        yield
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
        kind = "Parquet" if first_bytes(path).startswith(PARQUET) else "Feather"
        why = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: {kind.lower()}: {why}: expected {kind}") from error


def _parquet(path: Path, **options: Any) -> "pyarrow.parquet.ParquetFile":  # noqa: ANN401
    return extra_module("pyarrow.parquet").ParquetFile(
        path,
        thrift_string_size_limit=MAX_FOOTER_BYTES,
        thrift_container_size_limit=5_000_000,
        page_checksum_verification=True,
        **options,
    )


def _parquet_batches(path: Path, names: Sequence[str]) -> Iterator[tuple[Any, float]]:
    types = extra_module("pyarrow").types
    with _parquet(path) as file:
        _check_sizes(path, file.metadata)
        words = [n for n in names if types.is_string(file.schema_arrow.field(n).type)]
    with _parquet(path, read_dictionary=words) as file:
        done, total = 0, max(file.metadata.num_rows, 1)
        for batch in file.iter_batches(BATCH_ROWS, columns=names, use_threads=False):
            done += batch.num_rows
            yield batch, done / total


def _check_sizes(path: Path, metadata: "pyarrow.parquet.FileMetaData") -> None:
    if metadata.num_columns > MAX_COLUMNS:
        raise InputError(
            f"{path}: columns: {metadata.num_columns}: expected at most {MAX_COLUMNS}"
        )
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    counts = [metadata.num_rows, *(group.num_rows for group in groups)]
    if min(counts) < 0 or max(counts) > MAX_ROWS or sum(counts[1:]) != counts[0]:
        raise InputError(
            f"{path}: rows: {counts[0]} in row groups of {counts[1:5]}: "
            f"expected their sum, at most {MAX_ROWS}"
        )
    # not the sizes of single columns: pyarrow aborts the process over damaged ones
    largest = max((group.total_byte_size for group in groups), default=0)
    if largest > MAX_GROUP_BYTES:
        raise InputError(
            f"{path}: row group: {largest} bytes: expected at most {MAX_GROUP_BYTES}"
        )


@contextlib.contextmanager
def _feather(path: Path) -> Iterator[Any]:
    arrow = extra_module("pyarrow")
    if first_bytes(path).startswith(OLD_FEATHER):
        raise InputError(f"{path}: Feather version 1: expected version 2, or Parquet")
    with arrow.OSFile(str(path)) as source, arrow.ipc.open_file(source) as file:
        yield file


def _feather_batches(path: Path, names: Sequence[str]) -> Iterator[tuple[Any, float]]:
    arrow = extra_module("pyarrow")
    with _feather(path) as file:
        places = [file.schema.get_field_index(name) for name in names]
    options = arrow.ipc.IpcReadOptions(included_fields=places, use_threads=False)
    with (
        arrow.OSFile(str(path)) as source,
        arrow.ipc.open_file(source, options=options) as file,
    ):
        for number in range(file.num_record_batches):
            whole = file.get_batch(number)
            if whole.nbytes > MAX_GROUP_BYTES:
                raise InputError(
                    f"{path}: batch {number}: {whole.nbytes} bytes: expected at most "
                    f"{MAX_GROUP_BYTES}"
                )
            yield whole, (number + 1) / file.num_record_batches
