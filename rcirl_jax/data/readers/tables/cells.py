"""Cells of a table as numbers, times and texts; empty ones are unknown.

A cell is empty, readable or not. Unknown numbers are NaN, unknown texts "". Columns
come as pyarrow's arrays: texts of a file of text, or of any type of Parquet's.
"""

import datetime
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from rcirl_jax.data.readers.tables.layout import EMPTY, NUMBER, grouped
from rcirl_jax.errors import extra_module

TEXT_CHARS = 64  # characters of a text cell
WHOLE = re.compile(r"([-+]?\d+)[.,]0+")  # 12.0, as tables write numbers with holes
# what ISO writes otherwise, pattern -> replacement; a clock alone is of the first day
NEARLY_ISO = (
    (r",(\d+)", r".\1"),
    (r"^(\d{4})/(\d\d)/(\d\d)", r"\1-\2-\3"),
    (r" ?(UTC|GMT|utc|z)$", "Z"),
    (r" ([-+]\d\d:?\d\d|[-+]\d\d)$", r"\1"),
    (r"^(\d:)", r"0\1"),
    (r"^(\d\d:)", r"1970-01-01 \1"),
)
ISO = "iso"  # times as ISO 8601 writes them
EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
Found = tuple[np.ndarray, np.ndarray]  # values [n], whether each is unreadable [n]


def is_texts(column: Any) -> bool:  # noqa: ANN401
    """Whether a column's type is text."""
    types = extra_module("pyarrow").types
    kind = column.type.value_type if types.is_dictionary(column.type) else column.type
    return types.is_string(kind) or types.is_large_string(kind)


def numbers(column: Any, decimal: str, thousands: str) -> Found:  # noqa: ANN401
    """A column of numbers [n] float64, NaN where a cell is empty.

    The marks are those of numbers written as text.

    Raises:
      TypeError: a column of Parquet's that holds no numbers.
    """
    arrow, compute = extra_module("pyarrow"), extra_module("pyarrow.compute")
    if not is_texts(column):
        values = _plain(column)
        return values, np.isinf(values)
    cells = column.cast(arrow.string())
    found = _cast(cells, arrow.float64()) if decimal == "." else None
    if found is None:
        cells = compute.utf8_trim_whitespace(cells)
        cells = _known(_with_points(cells, decimal, thousands))
        found = _cast(cells, arrow.float64())
    if found is not None:
        values = found.to_numpy(zero_copy_only=False)
        return values, np.isinf(values)
    readable = compute.match_substring_regex(cells, f"^({NUMBER.pattern})$")
    cells = compute.if_else(readable, cells, arrow.scalar(None, arrow.string()))
    values = cells.cast(arrow.float64()).to_numpy(zero_copy_only=False)
    wrong = ~compute.fill_null(readable, True).to_numpy(zero_copy_only=False)
    return values, wrong | np.isinf(values)


def _cast(cells: Any, kind: Any) -> Any:  # noqa: ANN401
    """All cells as another type; None where one cannot be read."""
    try:
        return cells.cast(kind)
    except extra_module("pyarrow").ArrowException:
        return None


def _plain(column: Any) -> np.ndarray:  # noqa: ANN401
    """Numbers, flags and times of Parquet's own types, as float64; times in seconds."""
    arrow, types = extra_module("pyarrow"), extra_module("pyarrow").types
    if types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if types.is_temporal(column.type):
        return _seconds(column)
    if types.is_boolean(column.type):
        column = column.cast(arrow.int8())
    if not (
        types.is_integer(column.type)
        or types.is_floating(column.type)
        or types.is_decimal(column.type)
    ):
        raise TypeError(f"type {str(column.type)[:60]}: expected numbers")
    return column.cast(arrow.float64(), safe=False).to_numpy(zero_copy_only=False)


def _seconds(column: Any) -> np.ndarray:  # noqa: ANN401
    """Times and spans of Parquet's own types in seconds, NaN where unknown."""
    arrow, types = extra_module("pyarrow"), extra_module("pyarrow").types
    if types.is_date(column.type):
        column = column.cast(arrow.timestamp("s"))
    if not hasattr(column.type, "unit"):
        raise TypeError(f"type {str(column.type)[:60]}: expected times")
    factor = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[column.type.unit]
    bits = arrow.int32() if types.is_time32(column.type) else arrow.int64()
    whole = column.cast(bits).cast(arrow.float64(), safe=False)
    return whole.to_numpy(zero_copy_only=False) * factor


def _known(cells: Any) -> Any:  # noqa: ANN401
    """Cells with None for the empty ones."""
    arrow, compute = extra_module("pyarrow"), extra_module("pyarrow.compute")
    empty = compute.is_in(compute.utf8_lower(cells), value_set=arrow.array(EMPTY))
    return compute.if_else(empty, arrow.scalar(None, arrow.string()), cells)


def _with_points(cells: Any, decimal: str, thousands: str) -> Any:  # noqa: ANN401
    """Numbers with a decimal point and nothing between thousands."""
    compute = extra_module("pyarrow.compute")
    if thousands:
        found = compute.match_substring_regex(cells, f"^{grouped(thousands, decimal)}$")
        plain = compute.replace_substring(cells, thousands, "")
        cells = compute.if_else(found, plain, cells)
    return cells if decimal == "." else compute.replace_substring(cells, ",", ".")


def times(column: Any, form: str) -> Found:  # noqa: ANN401
    """A column of times [n] s since 1970 (UTC where no zone is said), NaN where empty.

    Args:
      column: texts, or times of Parquet's own types.
      form: `ISO`, or a pattern of Python's strptime.
    """
    arrow, compute = extra_module("pyarrow"), extra_module("pyarrow.compute")
    if not is_texts(column):
        values = _plain(column)
        return values, np.isinf(values)
    cells = _known(compute.utf8_trim_whitespace(column.cast(arrow.string())))
    if form != ISO:
        return _each(cells, lambda text: datetime.datetime.strptime(text, form))
    for change in (lambda same: same, _as_iso):
        cells = change(cells)
        for zone in (None, "UTC"):
            found = _cast(cells, arrow.timestamp("ns", zone))
            if found is not None:
                values = _seconds(found)
                return values, np.zeros(len(values), bool)
    return _each(cells, datetime.datetime.fromisoformat)


def _as_iso(cells: Any) -> Any:  # noqa: ANN401
    """Times that are nearly ISO's: 10:00:00,1 and 2024/05/20 10:00:00 UTC."""
    compute = extra_module("pyarrow.compute")
    for wrong, right in NEARLY_ISO:
        cells = compute.replace_substring_regex(cells, wrong, right)
    return cells


def _each(cells: Any, parse: Callable[[str], datetime.datetime]) -> Found:  # noqa: ANN401
    """Times read one by one, each text once."""
    coded = cells.dictionary_encode()
    known = np.full(len(coded.dictionary) + 1, np.nan)
    for place, text in enumerate(coded.dictionary.to_pylist()):
        try:
            made = parse(text)
            zone = made.tzinfo or datetime.UTC
            known[place] = (made.replace(tzinfo=zone) - EPOCH).total_seconds()
        except (ValueError, OverflowError):
            known[place] = np.inf
    codes = coded.indices.fill_null(len(coded.dictionary))
    values = known[codes.to_numpy(zero_copy_only=False)]
    bad = np.isinf(values)
    return np.where(bad, np.nan, values), bad


def texts(column: Any, lower: bool) -> tuple[np.ndarray, list[str], np.ndarray]:  # noqa: ANN401
    """(codes [n], names, whether each is unreadable [n]) of a column of texts.

    Several names may be equal. Numbers are taken as text too: 12.0 is 12. Texts too
    long are unreadable: two could be cut to the same.

    Raises:
      TypeError: a nested column of Parquet's.
    """
    types = extra_module("pyarrow").types
    if types.is_nested(column.type) or types.is_binary(column.type):
        raise TypeError(f"type {str(column.type)[:60]}: expected text")
    coded = column if types.is_dictionary(column.type) else column.dictionary_encode()
    found = coded.dictionary
    names = [_name(str(value), lower) for value in found.to_pylist()]
    codes = coded.indices
    if codes.null_count:
        codes, names = codes.fill_null(len(names)), [*names, ""]
    codes = codes.to_numpy(zero_copy_only=False)
    long = np.array([len(name) > TEXT_CHARS for name in names], bool)
    return codes.astype(np.int64), names, long[codes]


def _name(text: str, lower: bool) -> str:
    """A text cell without blanks around it; "" where it says that nothing is known."""
    plain = text.rstrip("\0 \t").strip()
    if plain.lower() in EMPTY:
        return ""
    whole = WHOLE.fullmatch(plain)
    plain = whole[1] if whole else plain
    return plain.lower() if lower else plain
