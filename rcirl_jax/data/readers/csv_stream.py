"""The columns of a long CSV, a few MiB at a time, by pyarrow (extra `[logs]`)."""

import dataclasses
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from rcirl_jax.data.readers.tables import TEXT_CHARS, check_cells, read_header
from rcirl_jax.errors import InputError

READ_BYTES = 8 * 2**20  # bytes of text parsed at a time


@dataclasses.dataclass(frozen=True, kw_only=True)
class Field:
    """A column of the file as a field in SI units."""

    name: str
    column: str
    factor: float = 1.0
    text: bool = False
    lower: bool = False  # text in small letters
    limit: float = np.inf  # in the file's unit; beyond it a number is absurd


def batches(
    path: Path, fields: list[Field], *, grouped: bool = False
) -> Iterator[dict[str, np.ndarray]]:
    """Columns of a few MiB; text as (codes, names) pairs; `grouped` as `is_grouped`."""
    try:
        arrow, csv = (importlib.import_module(n) for n in ("pyarrow", "pyarrow.csv"))
    except ImportError as error:
        raise InputError(
            f"{path}: pyarrow: not installed: expected the extra rcirl-jax[logs]"
        ) from error
    texts = {f.column for f in fields if f.text or grouped}
    columns = list(dict.fromkeys(f.column for f in fields))
    kinds = {c: arrow.string() if c in texts else arrow.float64() for c in columns}
    names = read_header(path)
    numeric = [f.column for f in fields if not f.text]
    try:
        reader = csv.open_csv(
            path,
            read_options=csv.ReadOptions(
                block_size=READ_BYTES, column_names=names, skip_rows=1
            ),
            convert_options=csv.ConvertOptions(
                column_types=kinds,
                include_columns=columns,
                strings_can_be_null=False,
            ),
        )
        start = 1
        for batch in reader:
            found = {f.name: _column(path, batch, f, start) for f in fields}
            start += batch.num_rows
            if any(column is None for column in found.values()):
                _refuse(path, names, numeric, "a cell is no number", grouped)
            yield found
    except arrow.ArrowException as error:
        _refuse(path, names, numeric, str(error)[:200], grouped)


def _column(path: Path, batch: Any, field: Field, start: int) -> Any:  # noqa: ANN401
    """Numbers [n], or (codes, names) of a text; None: not all are finite."""
    found = batch.column(field.column)
    if field.text:
        coded = found.dictionary_encode()
        names = [name.rstrip("\0 \t").strip() for name in coded.dictionary.to_pylist()]
        for name in names:  # a piece holds each text as wide as its longest
            if len(name) > TEXT_CHARS:
                raise InputError(
                    f"{path}: column {field.column}: '{name[:40]}...': "
                    f"{len(name)} characters: expected up to {TEXT_CHARS}"
                )
        names = [name.lower() if field.lower else name for name in names]
        return coded.indices.to_numpy(), names
    if str(found.type) == "string":  # with separators between thousands
        compute = importlib.import_module("pyarrow.compute")
        found = compute.replace_substring_regex(found, r",(\d{3})", r"\1")
        found = found.cast("float64")
    values = found.to_numpy(zero_copy_only=False)
    return in_si(path, values, field, start) if np.isfinite(values).all() else None


def in_si(path: Path, values: np.ndarray, field: Field, start: int) -> np.ndarray:
    """A field's numbers in SI units; `start`, the row of the first, is for errors.

    Raises:
      InputError: one is beyond the field's limit.
    """
    far = np.flatnonzero(np.abs(values) > field.limit)
    if far.size:
        raise InputError(
            f"{path}: row {start + far[0]}: {field.column}: {values[far[0]]:g}: "
            f"expected within {field.limit:g}"
        )
    return values * field.factor


def _refuse(
    path: Path, names: list[str], numeric: list[str], why: str, grouped: bool
) -> NoReturn:
    """Read slowly and name the first line that is wrong."""
    check_cells(path, names, numeric, grouped)
    reason = " ".join(why.split())
    raise InputError(f"{path}: {reason}: expected rows as the header says")
