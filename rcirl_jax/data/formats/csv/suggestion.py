"""What is suggested for a table, in words: the TOML, what is known, the first rows."""

import dataclasses
import json
import math
import re
from collections.abc import Callable
from collections.abc import Mapping as AnyMapping
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.formats.csv.heading import OPTION
from rcirl_jax.data.formats.csv.mapping import HOLE, Mapping
from rcirl_jax.data.formats.csv.meaning import Meaning
from rcirl_jax.data.formats.csv.reader import PATTERNS
from rcirl_jax.data.formats.files import table_stem
from rcirl_jax.data.readers.tables.rows import LINE
from rcirl_jax.data.readers.tables.table import Table

ROWS_SHOWN = 5
SHOWN = ("t", "id", "x", "y", "heading", "speed", "length", "width", "kind", "lane")
SHOWN_UNITS = {
    **dict.fromkeys(("x", "y", "length", "width"), "m"),
    **{"t": "s", "heading": "deg", "speed": "m/s"},
}


@dataclasses.dataclass(kw_only=True)
class Guess:
    """The options of a source TOML so far."""

    columns: dict[str, str]
    said: list[str]
    units: dict[str, str] = dataclasses.field(default_factory=dict)
    scale: dict[str, float] = dataclasses.field(default_factory=dict)
    kinds: dict[str, str] = dataclasses.field(default_factory=dict)
    rate_hz: float | None = None
    open: list[str] = dataclasses.field(default_factory=list)  # what is not known

    def spec(self) -> dict:
        """As the TOML's content."""
        rate = {} if self.rate_hz is None else {"rate_hz": self.rate_hz}
        return {
            "columns": self.columns,
            "units": self.units,
            "scale": self.scale,
            "kinds": self.kinds,
            "max_bad_rows": 0.5,
            **rate,
        }


def recognised(
    table: Table, guess: Guess, mapping: Mapping, meaning: Meaning
) -> list[str]:
    """What was recognised, a line each."""
    layout = table.layout
    form = "Parquet or Feather" if layout is None else layout.in_words()
    fields = [
        f"{field}: column {column}"
        + (f", {guess.units[field]}" if field in guess.units else "")
        for field, column in guess.columns.items()
    ]
    found = [form, *fields, *guess.said, *mapping.notes, *meaning.notes]
    return [f"recognised: {line}" for line in found]


def unknown(table: Table, guess: Guess) -> list[str]:
    """What is not known, a line each."""
    used = set(guess.columns.values())
    forms = [re.escape(n).replace(re.escape(HOLE), ".+") for n in used if HOLE in n]
    unused = [
        name
        for name in table.header
        if name and name not in used and not any(re.fullmatch(f, name) for f in forms)
    ]
    missing = [
        f"{field}: no column; {instead}"
        for field, instead in (
            ("heading", "by the positions"),
            ("speed", "by the positions"),
            ("length", "4.5 m for all"),
            ("width", "1.8 m for all"),
            ("kind", "all are vehicles"),
            ("lane", "lanes along the paths driven"),
        )
        if field not in guess.columns and not _has_velocity(field, guess)
    ]
    rest = [
        *guess.open,
        *missing,
        "speed_limit: 29.06 m/s (65 mph) until you say better",
        "reference_point: the centre of the box is assumed",
        "source, licence: yours to fill in",
    ]
    lines = [f"not known: {line}" for line in rest]
    return lines + ([f"not used: {', '.join(unused)}"] if unused else [])


def _has_velocity(field: str, guess: Guess) -> bool:
    return field in ("heading", "speed") and {"vx", "vy"} <= guess.columns.keys()


def shown(rows: AnyMapping[str, np.ndarray]) -> list[str]:
    """The first rows as a table: m, m/s, degrees."""
    names = [name for name in SHOWN if name in rows]
    origin = rows["t"].min()
    cells = [[f"{n} [{SHOWN_UNITS[n]}]" if n in SHOWN_UNITS else n for n in names]]
    for row in np.argsort(rows[LINE], kind="stable")[:ROWS_SHOWN]:
        values: dict[str, Any] = {name: rows[name][row] for name in names}
        values["t"] = values["t"] - origin
        if "heading" in values:
            turn = np.angle(np.exp(1j * values["heading"]))
            values["heading"] = float(np.rad2deg(turn))
        cells.append([_cell(value) for value in values.values()])
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [
        "  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True))
        for row in cells
    ]


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "unknown" if math.isnan(value) else f"{value:.2f}"
    return str(value) or "unknown"


def toml_of(path: Path, guess: Guess, meaning: Meaning) -> str:
    """The text of the source TOML."""
    form = meaning.form  # of headings; said where it is not as usual
    own = path.name.removeprefix(table_stem(path))
    ending = own if f"*{own}" in PATTERNS else path.name.removeprefix(path.stem)
    return TOML.format(
        name=path.name,
        source=_text(table_stem(path)),
        pattern=_text(f"*{ending}"),
        convention=f'{OPTION} = "{form.name}"\n' if form and form.note else "",
        columns=_table(guess.columns),
        units=_table(guess.units),
        scale=f"\n[scale]\n{_numbers(guess.scale)}\n" if guess.scale else "",
        rate=guess.rate_hz or 10.0,
        kinds=f"\n[kinds]\n{_table(guess.kinds, _text)}\n" if guess.kinds else "",
    )


TOML = """\
# How {name} is read, as names and first rows suggest. Every option:
# data_specs/sources/csv_example.toml
source = {source}
licence = "unknown"                    # of the data
pattern = {pattern}
speed_limit = 29.06                    # m/s, where a lane has none
lane_width_m = 3.5                     # m
reference_point = "centre"             # what x, y point at, or front, rear
max_bad_rows = 0.01                    # share of rows that may be dropped
{convention}
[columns]
{columns}

[units]
{units}
{scale}
[defaults]
rate_hz = {rate:g}
length = 4.5                           # m, where nothing is known
width = 1.8                            # m
kind = "vehicle"
{kinds}"""


def _table(
    values: AnyMapping[str, str], key: Callable[[str], str] = lambda name: name
) -> str:
    """Lines of a table of TOML."""
    return "\n".join(f"{key(name)} = {_text(value)}" for name, value in values.items())


def _numbers(values: AnyMapping[str, float]) -> str:
    """Lines of a table of TOML with numbers."""
    return "\n".join(f"{name} = {value!r}" for name, value in values.items())


def _text(value: str) -> str:
    """A text of TOML, which JSON writes alike."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
