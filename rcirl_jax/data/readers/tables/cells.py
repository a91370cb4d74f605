"""Cells of a table as numbers, times and texts; empty ones are unknown.

A cell is empty, readable or not. Unknown numbers are NaN, unknown texts "". Columns
come as pyarrow's arrays: texts of a file of text, or of any type of Parquet's.
"""

import contextlib
import datetime
import re
from typing import Any

import numpy as np

from rcirl_jax.data.readers.tables.text import EMPTY, NUMBER, grouped
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
# times of day as digits, with or without leading zeros -> a second in them
CLOCK_DIGITS = {"HHMMSS": 1.0, "HHMMSSmmm": 1e3}
EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
Found = tuple[np.ndarray, np.ndarray]  # values [n], whether each is unreadable [n]


def is_texts(column: Any) -> bool:  # noqa: ANN401
    """True if a column's type is text."""
    types = extra_module("pyarrow").types
    kind = column.type.value_type if types.is_dictionary(column.type) else column.type
    return types.is_string(kind) or types.is_large_string(kind)


def numbers(column: Any, decimal: str, thousands: str) -> Found:  # noqa: ANN401
    """Returns a column of numbers [n] float64, NaN where a cell is empty.

    Args:
      column: pyarrow's array.
      decimal: mark of numbers written as text.
      thousands: mark between their groups of three digits; "": none.

    Raises:
      ArrowException: a column of Parquet's that holds no numbers.
    """
    arrow, compute = extra_module("pyarrow"), extra_module("pyarrow.compute")
    if not is_texts(column):
        values = _typed(column)
        return values, np.isinf(values)
    cells = column.cast(arrow.string())
    found = _cast(cells, arrow.float64()) if decimal == "." else None
    if found is None:
        cells = compute.utf8_trim_whitespace(cells)
        if thousands:
            form = f"^{grouped(thousands, decimal)}$"
            plain = compute.replace_substring(cells, thousands, "")
            is_grouped = compute.match_substring_regex(cells, form)
            cells = compute.if_else(is_grouped, plain, cells)
        if decimal != ".":
            cells = compute.replace_substring(cells, ",", ".")
        cells = _with_none(cells)
        found = _cast(cells, arrow.float64())
    wrong = np.zeros(len(cells), bool)
    if found is None:
        readable = compute.match_substring_regex(cells, f"^({NUMBER.pattern})$")
        cells = compute.if_else(readable, cells, arrow.scalar(None, arrow.string()))
        found = cells.cast(arrow.float64())
        wrong = ~compute.fill_null(readable, True).to_numpy(zero_copy_only=False)
    values = found.to_numpy(zero_copy_only=False)
    return values, wrong | np.isinf(values)


def _cast(cells: Any, kind: Any) -> Any:  # noqa: ANN401
    """All cells as another type; None where one cannot be read."""
    with contextlib.suppress(extra_module("pyarrow").ArrowException):
        return cells.cast(kind)
    return None


def _with_none(cells: Any) -> Any:  # noqa: ANN401
    """Cells with None for the empty ones."""
    arrow, compute = extra_module("pyarrow"), extra_module("pyarrow.compute")
    empty = compute.is_in(compute.utf8_lower(cells), value_set=arrow.array(EMPTY))
    return compute.if_else(empty, arrow.scalar(None, arrow.string()), cells)


def _typed(column: Any) -> np.ndarray:  # noqa: ANN401
    """Numbers, flags and times of Parquet's own types, as float64; times in seconds."""
    arrow, types = extra_module("pyarrow"), extra_module("pyarrow").types
    if types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if types.is_date(column.type):
        column = column.cast(arrow.timestamp("s"))
    kind, factor = column.type, 1.0
    if types.is_temporal(kind) and hasattr(kind, "unit"):
        factor = SECONDS[kind.unit]
        column = column.cast(arrow.int32() if types.is_time32(kind) else arrow.int64())
    elif types.is_boolean(kind):
        column = column.cast(arrow.int8())
    made = column.cast(arrow.float64(), safe=False).to_numpy(zero_copy_only=False)
    return made * factor


def day_and_second(digits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the part [n] of digits above HHMMSS, and s of the day [n] of the rest.

    NaN where the rest is no time of day.
    """
    day, rest = np.divmod(digits, 1e6)
    hours, rest = np.divmod(rest, 1e4)
    minutes, seconds = np.divmod(rest, 100.0)
    good = (hours < 24.0) & (minutes < 60.0) & (seconds < 60.0)
    return day, np.where(good, 3600.0 * hours + 60.0 * minutes + seconds, np.nan)


def times_of_day(digits: np.ndarray, form: str) -> Found:
    """Returns s since midnight [n] of digits such as 80459920; NaN stays NaN.

    Args:
      digits: [n] as numbers.
      form: one of CLOCK_DIGITS.
    """
    day, seconds = day_and_second(digits / CLOCK_DIGITS[form])
    return seconds, ~np.isnan(digits) & ((day != 0.0) | np.isnan(seconds))


def times(column: Any, form: str) -> Found:  # noqa: ANN401
    """Returns times [n] s since 1970 (UTC where no zone is said), NaN where empty.

    Args:
      column: texts, digits, or times of Parquet's own types.
      form: `ISO`, or a pattern of Python's strptime.
    """
    arrow, compute = extra_module("pyarrow"), extra_module("pyarrow.compute")
    if not is_texts(column) and not arrow.types.is_integer(column.type):
        values = _typed(column)
        return values, np.isinf(values)
    cells = _with_none(compute.utf8_trim_whitespace(column.cast(arrow.string())))
    for changes in ((), NEARLY_ISO) if form == ISO else ():
        for wrong, right in changes:
            cells = compute.replace_substring_regex(cells, wrong, right)
        for zone in (None, "UTC"):
            found = _cast(cells, arrow.timestamp("ns", zone))
            if found is not None:
                return _typed(found), np.zeros(len(cells), bool)
    coded = cells.dictionary_encode()  # each text is read once
    known = np.full(len(coded.dictionary) + 1, np.nan)
    for place, text in enumerate(coded.dictionary.to_pylist()):
        try:
            if form == ISO:
                made = datetime.datetime.fromisoformat(text)
            else:
                made = datetime.datetime.strptime(text, form)
            zone = made.tzinfo or datetime.UTC
            known[place] = (made.replace(tzinfo=zone) - EPOCH).total_seconds()
        except (ValueError, OverflowError):
            known[place] = np.inf
    codes = coded.indices.fill_null(len(coded.dictionary))
    values = known[codes.to_numpy(zero_copy_only=False)]
    bad = np.isinf(values)
    return np.where(bad, np.nan, values), bad


def texts(column: Any, lower: bool) -> tuple[np.ndarray, list[str], np.ndarray]:  # noqa: ANN401
    """Returns (codes [n], names, whether each is unreadable [n]) of a column of texts.

    Several names may be equal. Numbers are taken as text too: 12.0 is 12. Texts too
    long are unreadable: two could be cut to the same.

    Raises:
      TypeError: a nested column of Parquet's.
    """
    types = extra_module("pyarrow").types
    if types.is_nested(column.type) or types.is_binary(column.type):
        raise TypeError(f"type {str(column.type)[:60]}")
    coded = column if types.is_dictionary(column.type) else column.dictionary_encode()
    names = []
    for value in coded.dictionary.to_pylist():
        plain = str(value).rstrip("\0 \t").strip()
        if (whole := WHOLE.fullmatch(plain)) is not None:
            plain = whole[1]
        plain = "" if plain.lower() in EMPTY else plain
        names.append(plain.lower() if lower else plain)
    codes = coded.indices
    if codes.null_count:
        codes, names = codes.fill_null(len(names)), [*names, ""]
    codes = codes.to_numpy(zero_copy_only=False)
    long = np.array([len(name) > TEXT_CHARS for name in names], bool)
    return codes.astype(np.int64), names, long[codes]
