"""Rows of Parquet and Feather files, with sizes checked before they are read.

The footer is checked first: number of columns, bytes of a row group after
decompression. Text is read as dictionary codes, so that a long text that is met in
every row exists once.
"""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rcirl_jax.data.readers.tables.streams import first_bytes
from rcirl_jax.errors import MALFORMED, InputError, extra_module

MAX_GROUP_BYTES = 512 * 2**20  # bytes of a row group, decompressed
MAX_ROWS = 2**33  # of a file; what is held whole has a limit of its own
MAX_COLUMNS = 10_000
MAX_FOOTER_BYTES = 16 * 2**20  # bytes of a text in the footer (pandas metadata)
BATCH_ROWS = 2**16  # rows read at a time
PARQUET, FEATHER, OLD_FEATHER = b"PAR1", b"ARROW1", b"FEA1"


def is_columnar(path: Path) -> bool:
    """True if the first bytes are those of Parquet or Feather."""
    return first_bytes(path).startswith((PARQUET, FEATHER, OLD_FEATHER))


def columns_of(path: Path) -> list[str]:
    """Returns the names of the columns.

    Raises:
      InputError: a damaged file, or more columns than tables have.
    """
    with _opened(path) as file:
        schema = getattr(file, "schema_arrow", None) or file.schema
        _check(path, "columns", len(schema), MAX_COLUMNS)
        return list(schema.names)


def columnar_batches(path: Path, names: Sequence[str]) -> Iterator[tuple[list, float]]:
    """Yields (arrays of the columns, share of the file read) of some rows at a time.

    Raises:
      InputError: a damaged file, or a row group too large to be held.
    """
    is_parquet = first_bytes(path).startswith(PARQUET)
    wanted = list(dict.fromkeys(names))
    for batch, share in (_parquet if is_parquet else _feather)(path, wanted):
        with _one_line(path):
            # indices and text of a damaged page, which reading does not check
            batch.validate(full=True)
        yield [batch.column(name) for name in names], share


def _check(path: Path, what: str, found: int, most: int) -> None:
    """Refuses what would fill the memory."""
    if found > most:
        raise InputError(f"{path}: {what}: {found}: expected at most {most}")


@contextlib.contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Turns what a damaged file makes of its reader into one line."""
    arrow = extra_module("pyarrow")
    try:
        yield
    except InputError:
        raise
    except (*MALFORMED, arrow.ArrowException, OSError) as error:
        kind = "Parquet" if first_bytes(path).startswith(PARQUET) else "Feather"
        why = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: {kind.lower()}: {why}: expected {kind}") from error


@contextlib.contextmanager
def _opened(path: Path, words: Sequence[str] = (), places: Any = None) -> Iterator[Any]:  # noqa: ANN401
    """Opens either: Parquet with dictionaries of `words`, Feather with some columns."""
    arrow, head = extra_module("pyarrow"), first_bytes(path)
    if head.startswith(OLD_FEATHER):
        raise InputError(f"{path}: Feather version 1: expected version 2, or Parquet")
    with _one_line(path):
        if head.startswith(PARQUET):
            with extra_module("pyarrow.parquet").ParquetFile(
                path,
                thrift_string_size_limit=MAX_FOOTER_BYTES,
                thrift_container_size_limit=5_000_000,
                page_checksum_verification=True,
                read_dictionary=list(words),
            ) as file:
                yield file
            return
        options = arrow.ipc.IpcReadOptions(included_fields=places, use_threads=False)
        with (
            arrow.OSFile(str(path)) as source,
            arrow.ipc.open_file(source, options=options) as file,
        ):
            yield file


def _parquet(path: Path, names: Sequence[str]) -> Iterator[tuple[Any, float]]:
    types = extra_module("pyarrow").types
    with _opened(path) as file:
        found = file.metadata
        words = [n for n in names if types.is_string(file.schema_arrow.field(n).type)]
        groups = [found.row_group(i) for i in range(found.num_row_groups)]
        counts = [found.num_rows, *(group.num_rows for group in groups)]
        if min(counts) < 0 or max(counts) > MAX_ROWS or sum(counts[1:]) != counts[0]:
            raise InputError(
                f"{path}: rows: {counts[0]} in row groups of {counts[1:5]}: "
                f"expected their sum, at most {MAX_ROWS}"
            )
        # not the sizes of single columns: pyarrow aborts the process over damaged ones
        largest = max((group.total_byte_size for group in groups), default=0)
        _check(path, "row group: bytes", largest, MAX_GROUP_BYTES)
    with _opened(path, words) as file:
        done, total = 0, max(file.metadata.num_rows, 1)
        for batch in file.iter_batches(BATCH_ROWS, columns=names, use_threads=False):
            done += batch.num_rows
            yield batch, done / total


def _feather(path: Path, names: Sequence[str]) -> Iterator[tuple[Any, float]]:
    with _opened(path) as file:
        places = [file.schema.get_field_index(name) for name in names]
    with _opened(path, places=places) as file:
        for number in range(file.num_record_batches):
            whole = file.get_batch(number)
            _check(path, f"batch {number}: bytes", whole.nbytes, MAX_GROUP_BYTES)
            yield whole, (number + 1) / file.num_record_batches
