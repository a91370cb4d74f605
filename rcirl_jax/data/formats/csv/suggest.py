"""A source TOML for a table of which nothing is said, and its first rows as understood.

Names of columns, units in them and the numbers of the first rows tell what can be told;
a column known by its content alone is marked as guessed. A needed column that nothing
tells is written as `?`, with the columns that it may be. Without one the TOML is read
back like any other: what is shown is what an import would take.
"""

import contextlib
import dataclasses
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.csv.columns import (
    ALLOWED_UNITS,
    CLOCKS,
    CONVENTION,
    DEGREES,
    HOLE,
    ISO_TIMES,
    NEEDED,
    NO,
    OF_PIXELS,
    OPTIONAL,
    PATTERN,
    RATE_HZ,
    TEXT,
    UNCLEAR,
    YES,
    LogColumns,
    Meaning,
    clock_digits,
    date_pattern,
    first_cell,
    half_seconds,
    is_large,
    known_cells,
    meaning_of,
    sampled,
    with_velocity,
)
from rcirl_jax.data.formats.csv.content import fields_by_content, unclear
from rcirl_jax.data.formats.csv.names import (
    fields_by_name,
    foreign_words,
    is_in_pixels,
    kind_by_name,
    unit_of,
)
from rcirl_jax.data.formats.csv.reader import PATTERNS, STILL_M, Log, opened
from rcirl_jax.data.formats.files import table_stem
from rcirl_jax.data.formats.options import KINDS, UNITS
from rcirl_jax.data.readers.tables.cells import ISO
from rcirl_jax.data.readers.tables.rows import LINE, Rows, RowStats
from rcirl_jax.data.readers.tables.streams import UNTOLD
from rcirl_jax.data.readers.tables.table import (
    MAX_TIME,
    Field,
    Table,
    as_texts,
    batches,
    open_table,
)
from rcirl_jax.data.readers.tables.text import NUMBER, Layout
from rcirl_jax.errors import InputError, as_input_error

USUAL_RATES = (1, 2, 4, 5, 10, 12.5, 15, 20, 24, 25, 29.97, 30, 50, 60, 100, 120)
RATE_FITS = 0.1  # relative
FRAMES_FIT = 0.02  # likewise, of a rate that speeds tell
SPEED_FITS = 0.06  # likewise, of a unit of speed
NOT_MEASURED = "not measured: rows per second of one road user"
NO_RATE = "rate_hz: rows per second of one road user; 10 is assumed"
# field -> m of the median vehicle at most, in the first unit in which it is no larger
LARGE_M = {"length": 9.0, "width": 3.0}
SIZE_UNITS = ("m", "ft", "cm", "mm")
# recorded speed over that of the positions, both in m/s if it were m/s
SPEED_RATIOS = {"m/s": 1.0, "km/h": 3.6, "ft/s": 3.2808, "mph": 2.2369, "kn": 1.9438}
ROWS_SHOWN = 5
# field -> its unit where rows are shown, "": none
SHOWN = {
    **{"t": "s", "id": "", "x": "m", "y": "m", "heading": "deg", "speed": "m/s"},
    **{"length": "m", "width": "m", "kind": "", "lane": ""},
}
INSTEAD = {
    **{"heading": "by the positions", "speed": "by the positions"},
    **{"length": "4.5 m for all", "width": "1.8 m for all"},
    **{"kind": "all are vehicles", "lane": "lanes along the paths driven"},
}  # field -> what is taken where no column says it
NAMES_SHOWN = 20  # of columns that a field may be
READ_AS = (
    "encoding: read as {}, a guess; if names look wrong set [table] encoding, for "
    "example cp1250"
)
FILL_IN = (
    f'fill in the lines with "{UNCLEAR}" before you import; words by which columns are '
    "known may be added to data_specs/column_names.toml"
)
NEVER_KNOWN = (
    "speed_limit: 29.06 m/s (65 mph) until you say better",
    "reference_point: the centre of the box is assumed",
    'y: counts to the left of x; where it counts downwards as in pictures: y = "-NAME"',
    "source, licence: yours to fill in",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Suggestion:
    """The suggestion for a table."""

    toml: str
    lines: tuple[str, ...]  # for the terminal
    last: str = ""  # likewise, below the others


@dataclasses.dataclass(kw_only=True)
class _Guess:
    """The options of a source TOML so far."""

    columns: dict[str, str]
    said: list[str]
    layout: Layout | None  # of the text
    units: dict[str, str] = dataclasses.field(default_factory=dict)
    scale: dict[str, float] = dataclasses.field(default_factory=dict)
    kinds: dict[str, str] = dataclasses.field(default_factory=dict)
    rate_hz: float | None = None
    open: list[str] = dataclasses.field(default_factory=list)  # what is not known
    # field -> comment of its line: by what it was guessed, or what it may be
    comments: dict[str, str] = dataclasses.field(default_factory=dict)

    @property
    def unclear(self) -> list[str]:
        """Returns the needed fields of which nobody knows the column."""
        return [field for field, name in self.columns.items() if name == UNCLEAR]

    @property
    def is_untimed(self) -> bool:
        """Returns whether the time alone is unclear: rows of one user tell an order."""
        return self.unclear == ["t"] and HOLE not in self.columns.get("x", "")

    def spec(self) -> dict:
        """As the TOML's content; a place stands in for a time that nobody knows."""
        rate = {} if self.rate_hz is None else {"rate_hz": self.rate_hz}
        parts = ("columns", "units", "scale", "kinds")
        options = {name: dict(getattr(self, name)) for name in parts}
        if self.is_untimed:
            place = "lat" if "lat" in self.columns else "x"
            options["columns"]["t"] = self.columns[place].removeprefix("-")
            options["units"]["t"] = "s"
        return {**options, "max_bad_rows": 0.5, **rate}


def suggested(path: Path) -> Suggestion:
    """Returns a source TOML by the head of a table.

    Raises:
      InputError: no table, or one whose first rows nobody can read.
    """
    with as_input_error(str(path), "a table with a row per road user and time"):
        table = open_table(path, known=foreign_words())
        guess = _guess_columns(table)
        if "t" not in guess.unclear:
            _guess_time_form(table, guess)
        meaning, lines = Meaning(), []
        if not guess.unclear:
            meaning, lines = _guess_the_rest(path, table, guess)
        elif guess.is_untimed:
            with contextlib.suppress(InputError):
                meaning, lines = _guess_the_rest(path, table, guess)
        if not lines:
            _guess_what_is_stated(table, guess)
            lines = _in_words(table, guess, ())
        last = FILL_IN if guess.unclear else ""
        draft = _toml_of(path, guess, meaning)
        return Suggestion(toml=draft, lines=tuple(lines), last=last)


def _guess_the_rest(
    path: Path, table: Table, guess: _Guess
) -> tuple[Meaning, list[str]]:
    """Returns the meaning of headings by the first rows, and all they tell in words."""
    _, raw = _first_rows(path, guess)
    _guess_clock(table, raw, guess)
    _guess_lengths(table, raw, guess)
    _guess_heading_and_speed(table, raw, guess)
    _guess_texts(raw, guess)
    rows, meaning, columns = _understood(path, guess)
    if meaning.is_mirrored:
        _swap_axes(guess)
        rows, meaning, columns = _understood(path, guess)
    lines = _in_words(table, guess, (*columns.notes, *meaning.notes))
    if guess.is_untimed:
        del rows["t"]
    return meaning, [*lines, "", "the first rows as understood:", *_shown(rows)]


def _guess_columns(table: Table) -> _Guess:
    """Field -> column, and how a table with a row per frame was told."""
    found, said = fields_by_name(table.header), []
    forms: list[str] = []  # {id} for the number in a name
    for name in table.header:
        match = re.fullmatch(r"(\D*)(\d+)(\D*)", name)
        if match and (match[1] or match[3]):
            forms.append(f"{match[1]}{HOLE}{match[3]}")
    several = {f.replace(HOLE, "_"): f for f in forms if forms.count(f) > 1}
    wide = {
        field: several[name]
        for field, name in fields_by_name(list(several)).items()
        if field in (*NEEDED, *OPTIONAL) and field not in ("t", "id")
    }
    # columns from which no other differs by a number only
    bare = [re.sub(r"\d+", "", name) for name in table.header]
    alone = {f for f, n in found.items() if bare.count(re.sub(r"\d+", "", n)) == 1}
    if {"x", "y"} <= wide.keys() and not {"id", "x", "y"} <= alone:
        found = {k: v for k, v in found.items() if k == "t"} | wide
        said.append(f"a row per frame: {wide['x']}, {wide['y']} for each road user")
    needed = ("t", "id", *(("lat", "lon") if "lat" in found else ("x", "y")))
    is_wide = HOLE in found.get("x", "")
    layout = table.layout
    guess = _Guess(columns=found, said=said, layout=layout)
    if layout and layout.is_guess:
        guess.open.append(READ_AS.format(layout.encoding))
    for field, one in ({} if is_wide else fields_by_content(table, found)).items():
        guess.columns[field] = one.column
        guess.comments[field] = f"guessed: {one.why}"
    for field in needed:
        if field not in guess.columns and not (is_wide and field == "id"):
            names = unclear(table, field, [*guess.columns.values()])[:NAMES_SHOWN]
            guess.columns[field] = UNCLEAR
            guess.comments[field] = f"one of: {', '.join(names)}"
            if any(map(is_in_pixels, names)):
                guess.comments[field] += f"; {OF_PIXELS}"
    order = [*needed, *guess.columns]
    columns = {f: guess.columns[f] for f in order if f in guess.columns}
    return dataclasses.replace(guess, columns=columns)


def _first_rows(path: Path, guess: _Guess) -> tuple[Log, Rows]:
    """A log, and rows of its first MiB as its draft takes them.

    Without a time those of a road user are `RATE_HZ` rows apart, in their order.
    """
    log = opened(path, guess.spec())
    for batch in batches(log.table, log.columns.fields, log.stats):
        if batch[LINE].size:
            rows = as_texts(log.table, batch)
            if guess.is_untimed:
                order = np.argsort(rows["id"], kind="stable")
                rows["t"][order] = np.arange(order.size) / RATE_HZ
            return log, rows
    log.stats.check()
    raise InputError(f"{path}: rows: none: expected rows below the header")


def _guess_time_form(table: Table, guess: _Guess) -> None:
    """Unit of times that are no seconds, milliseconds or frames: by the first cell."""
    name = guess.columns["t"]
    first, form = first_cell(table, name), ISO
    if not re.match(ISO_TIMES, first):
        form = date_pattern(known_cells(table, name))
    stats = RowStats(table.path, allowed=0.5)
    field = Field(name="t", column=name, form=form)
    values = next(batches(table, [field], stats))["t"]
    if 2 * values.size < stats.read:
        guess.columns["t"] = UNCLEAR
        cell = f"'{first[:40]}', no time in a form that is known: say units.t"
        guess.comments["t"] = f"one of: {name}; its cells are such as {cell}"
    elif form:
        guess.units["t"] = form
    elif NUMBER.fullmatch(first) and abs(float(first)) > MAX_TIME:
        guess.units["t"] = "ns" if float(first) > 1e3 * MAX_TIME else "us"
    else:
        _guess_clock_digits(table, values, guess)
    found = sampled(table, guess.columns["lat"]) if "lat" in guess.columns else None
    if found is not None and found.size and np.abs(found).min() > DEGREES["y"]:
        raise InputError(
            f"{table.path}: {guess.columns['lat']}: {found[0]:.12g}: expected degrees; "
            "if these are raw numbers, write the TOML by hand, with their [scale], "
            "such as lat = 1e-7, lon = 1e-7"
        )


def _guess_clock_digits(table: Table, values: np.ndarray, guess: _Guess) -> None:
    """Tells by the numbers [n] of the first MiB if digits are times of day."""
    form, is_sure = clock_digits(known_cells(table, guess.columns["t"]), values)
    if is_sure:
        guess.units["t"] = form
        guess.said.append(f"units.t = {form}: seconds from 60 to 99 have no rows")
    elif form == "HHMMSSmmm":
        guess.units["t"] = (
            _said_unit(table, "t", guess, ("ms", "us", "ns", "s")) or "ms"
        )
        guess.open.append(f"units.t: {guess.units['t']}, or {form} of times of day?")


def _guess_what_is_stated(table: Table, guess: _Guess) -> None:
    """Units that names say, or the line below the header; kinds of the first MiB."""
    fields = [
        Field(name=field, column=name, needed=False, text=True)
        for field, name in guess.columns.items()
        if field in TEXT and table.has(name)
    ]
    texts = batches(table, fields, RowStats(table.path, allowed=1.0))
    _guess_texts(as_texts(table, next(texts, {})) if fields else {}, guess)
    for field in guess.columns.keys() & ALLOWED_UNITS.keys() - {*guess.unclear}:
        if unit := _said_unit(table, field, guess):
            guess.units.setdefault(field, unit)


def _usual_rate(rate: float, fits: float) -> float | None:
    """The usual rate [1/s] that a rate is nearest to; None: none is near."""
    near = min(USUAL_RATES, key=lambda usual: abs(rate / usual - 1.0))
    return near if abs(rate / near - 1.0) < fits else None


def _guess_clock(table: Table, raw: Rows, guess: _Guess) -> None:
    """Unit of the time and rows per second, by the step of the road users' times."""
    if guess.unclear:
        guess.open.append(NO_RATE)
        return
    ids = np.unique(raw["id"], return_inverse=True)[1]
    order = np.lexsort((raw["t"], ids))
    steps = np.diff(raw["t"][order])[np.diff(ids[order]) == 0]
    steps = steps[steps > 0.0]
    step = float(np.median(steps)) if steps.size else math.nan
    if "t" not in guess.units:
        unit = _said_unit(table, "t", guess, ("ms", "us", "ns", "s"))
        is_frame = "frame" in guess.columns["t"].lower()
        if not unit and is_frame and step == round(step) < 10:
            unit = "frame"
        possible = ("s", "ms", "us", "ns", "day")
        fitting = (u for u in possible if 0.005 <= step * UNITS[u] <= 2.0)
        unit = unit or next(fitting, "s")
        if unit == "frame" and step > 1.0:
            guess.scale["t"] = 1.0 / step
            guess.said.append(f"scale.t: every {step:g}th frame has rows")
        guess.units["t"], step = unit, step * UNITS.get(unit, math.nan)
    if not math.isfinite(step):
        guess.open.append(NO_RATE)
        return
    rate = 1.0 / step
    guess.rate_hz = _usual_rate(rate, RATE_FITS) or float(f"{rate:.4g}")
    guess.said.append(
        f"rate_hz = {guess.rate_hz:g}: a row of a road user every {1 / rate:.4g} s"
    )


def _said_unit(
    table: Table, field: str, guess: _Guess, allowed: Sequence[str] = ()
) -> str:
    """The unit that a column's name says, or the line below the header."""
    allowed = allowed or ALLOWED_UNITS[field]
    bare = guess.columns[field].removeprefix("-")
    own = "" if HOLE in bare else table.unit_of(bare)
    return unit_of(bare, allowed) or unit_of(f"[{own}]", allowed)


def _guess_lengths(table: Table, raw: Rows, guess: _Guess) -> None:
    """Units of places and sizes: as their names say, else metres if cars fit them.

    Places without a unit are in feet where sizes without one are.
    """
    if "lat" in guess.columns:
        guess.units.update({"lat": "deg", "lon": "deg"})
    places = "m"
    for field in (f for f in ("length", "width", "x", "y") if f in guess.columns):
        said = _said_unit(table, field, guess, ALLOWED_UNITS["length"])
        guess.units[field] = said or places
        if said or field not in LARGE_M:
            continue
        known = raw[field][np.isfinite(raw[field])]
        middle = float(np.median(known)) if known.size else 0.0
        fitting = (u for u in SIZE_UNITS if middle * UNITS[u] <= LARGE_M[field])
        guess.units[field] = unit = next(fitting, "m")
        places = "ft" if unit == "ft" else places
        if unit != "m":
            guess.said.append(f"units.{field} = {unit}: {middle:.3g} in the median")
    if "lat" in guess.columns or any(_said_unit(table, f, guess) for f in ("x", "y")):
        return
    span = max(np.ptp(raw["x"]), np.ptp(raw["y"]))
    if 0.0 < span < STILL_M and np.abs(raw["y"]).max() <= DEGREES["y"]:
        guess.units.update({"x": "deg", "y": "deg"})
        guess.said.append(f"x, y: all within {span:.3g}: longitude and latitude")


def _guess_heading_and_speed(table: Table, raw: Rows, guess: _Guess) -> None:
    """Units of angles by their size; of speeds by the speed of the positions."""
    if "heading" in guess.columns:
        said = _said_unit(table, "heading", guess, ("deg", "rad"))
        guess.units["heading"] = said or ("deg" if is_large(raw["heading"]) else "rad")
    speeds = [field for field in ("speed", "vx", "vy") if field in guess.columns]
    units = {field: _said_unit(table, field, guess) for field in speeds}
    guess.units.update({field: units[field] or "m/s" for field in speeds})
    told = ["speed"] if "speed" in speeds else speeds  # by which the speed is known
    if told not in (["speed"], ["vx", "vy"]):
        return
    is_said = any(units[field] for field in told)
    ratio = None
    if guess.rate_hz is None or not is_said:
        ratio = _speed_ratio(table.path, guess)
    if guess.rate_hz is None and ratio is not None:
        # the usual rate at which frames are apart as recorded speeds say, if one is
        ratios = {guess.units[told[0]]: 1.0} if is_said else SPEED_RATIOS
        for unit, times in ratios.items():
            if (near := _usual_rate(RATE_HZ * ratio / times, FRAMES_FIT)) is not None:
                guess.rate_hz = near
                guess.open.remove(NO_RATE)
                guess.said.append(
                    f"rate_hz = {near:g}: by the speeds, if they are in {unit}"
                )
                ratio = None if is_said else _speed_ratio(table.path, guess)
                break
    if is_said or ratio is None:
        return
    apart = {unit: abs(ratio / times - 1.0) for unit, times in SPEED_RATIOS.items()}
    unit = min(apart, key=lambda name: apart[name])
    if apart[unit] > SPEED_FITS:
        guess.open.append(f"units.speed: {ratio:.3g} times the speed of the positions")
        unit = "m/s"
    else:
        guess.said.append(f"units.speed = {unit}: {ratio:.3g} times the positions' m/s")
    guess.units.update(dict.fromkeys(told, unit))


def _speed_ratio(path: Path, guess: _Guess) -> float | None:
    """Recorded speed over that of the positions; None: too few road users move."""
    rows, _, columns = _understood(path, guess)
    first, _, last = half_seconds(rows, columns.rate_hz)
    dx, dy, dt = (rows[name][last] - rows[name][first] for name in ("x", "y", "t"))
    real, found = np.hypot(dx, dy) / np.maximum(dt, 1e-9), rows["speed"][first]
    used = (real > 2.0) & np.isfinite(found)
    if used.sum() <= 9:
        return None
    return float(np.median(np.abs(found[used]) / real[used]))


def _guess_texts(raw: Rows, guess: _Guess) -> None:
    """Kinds by their names; flags only where they are yes or no."""
    for text in np.unique(raw.get("kind", [])).tolist():
        if text and text not in KINDS:
            guess.kinds[text] = kind_by_name(text) or "vehicle"
            if not kind_by_name(text):
                guess.open.append(f"kinds: {text}: taken for a vehicle")
    if "automated" in guess.columns:
        texts = {text.lower() for text in np.unique(raw["automated"]).tolist()}
        if not texts <= {"", "0", "1", *YES, *NO}:
            del guess.columns["automated"]


def _swap_axes(guess: _Guess) -> None:
    """Exchanges x and y: the compass tells that x points north."""
    for part in (guess.columns, guess.units):
        part["x"], part["y"] = part["y"], part["x"]
    heading = guess.columns["heading"]
    for field, way in (("x", "east"), ("y", "north")):
        why = f"swapped: {heading} turns as a compass does if this points {way}"
        guess.comments[field] = why
    guess.open.append(
        f"x, y: swapped; if {heading} is no compass's, swap them back and say "
        f'{CONVENTION} = "ccw_from_x"'
    )


def _understood(path: Path, guess: _Guess) -> tuple[Rows, Meaning, LogColumns]:
    """First rows in SI units, as an import takes them.

    Headings that contradict the positions are left out of the guess.
    """
    log, rows = _first_rows(path, guess)
    rows = log.placed(rows)
    flags = np.unique(rows.get("automated", np.zeros(0, str))).tolist()
    try:
        meaning = meaning_of(path, [rows], flags, log.columns, log.spec)
    except InputError as error:
        if "heading" not in guess.columns:
            raise
        guess.open.append(str(error).removeprefix(f"{path}: "))
        del guess.columns["heading"], guess.units["heading"]
        return _understood(path, guess)
    return with_velocity(meaning.applied(rows)), meaning, log.columns


def _in_words(table: Table, guess: _Guess, notes: Sequence[str]) -> list[str]:
    """Lists what was recognised and what is not known, a line each."""
    columns, layout = guess.columns, table.layout
    found = ["Parquet or Feather" if layout is None else layout.in_words()]
    for field, column in columns.items():
        unit = f", {guess.units[field]}" if field in guess.units else ""
        why = f" ({guess.comments[field]})" if field in guess.comments else ""
        if column != UNCLEAR:
            found.append(f"{field}: column {column}{unit}{why}")
    known = {*columns}
    known |= {"heading", "speed"} if {"vx", "vy"} <= known else set()
    missing = [f"{f}: no column; {i}" for f, i in INSTEAD.items() if f not in known]
    used = "|".join(
        re.escape(n).replace(re.escape(HOLE), ".+") for n in columns.values()
    )
    unused = [name for name in table.header if name and not re.fullmatch(used, name)]
    return [
        *(f"recognised: {line}" for line in (*found, *guess.said, *notes)),
        *(f"not known: {f}: {guess.comments[f]}" for f in guess.unclear),
        *(f"not known: {line}" for line in (*guess.open, *missing, *NEVER_KNOWN)),
        *([f"not used: {', '.join(unused)}"] if unused else []),
    ]


def _shown(rows: Rows) -> list[str]:
    """The first rows as a table: m, m/s, degrees."""
    first = np.argsort(rows[LINE], kind="stable")[:ROWS_SHOWN]
    columns = []
    for name, unit in SHOWN.items():
        if name not in rows:
            continue
        values = rows[name][first]
        if name == "t":
            values = values - rows["t"].min()
        elif name == "heading":
            values = np.rad2deg(np.angle(np.exp(1j * values)))
        cells = [
            f"{v:.2f}" if isinstance(v, float) else str(v) for v in values.tolist()
        ]
        cells = ["unknown" if cell in ("", "nan") else cell for cell in cells]
        cells.insert(0, f"{name} [{unit}]" if unit else name)
        columns.append([cell.rjust(max(map(len, cells))) for cell in cells])
    return list(map("  ".join, zip(*columns, strict=True)))


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
{convention}{table}
[columns]
{columns}

[units]
{units}
{scale}
[defaults]
rate_hz = {rate:g}{measured}
length = 4.5                           # m, where nothing is known
width = 1.8                            # m
kind = "vehicle"
{kinds}"""


def _toml_of(path: Path, guess: _Guess, meaning: Meaning) -> str:
    """The text of the source TOML, whose texts JSON writes alike."""

    def comment(words: str) -> str:
        plain = "".join(c if c.isprintable() else " " for c in words)
        return f"  # {plain}" if plain else ""

    def text(value: str) -> str:
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")

    def lines(values: Mapping[str, str]) -> str:
        return "\n".join(f"{name} = {text(value)}" for name, value in values.items())

    columns = [
        f"{f} = {text(column)}{comment(guess.comments.get(f, ''))}"
        for f, column in guess.columns.items()
    ]

    layout = guess.layout
    encoding = layout.encoding if layout and layout.encoding in UNTOLD else ""
    table = f"\n[table]\nencoding = {text(encoding)}" if encoding else ""
    if layout and layout.is_guess:
        table += comment("a guess: another one, such as cp1250, if names look wrong")
    form = meaning.form  # of headings; said where it is not as usual
    own = path.name.removeprefix(table_stem(path))
    ending = own if f"*{own}" in PATTERNS else path.name.removeprefix(path.stem)
    units = {f: guess.units[f] for f in guess.columns if f in guess.units}
    forms = f"one of {', '.join(CLOCKS)}, {PATTERN}"
    unknown = f't = "{UNCLEAR}"{comment(forms)}' if "t" in guess.unclear else ""
    scale = "\n".join(f"{name} = {value!r}" for name, value in guess.scale.items())
    kinds = lines({text(name): kind for name, kind in guess.kinds.items()})
    return TOML.format(
        name=path.name,
        source=text(table_stem(path)),
        pattern=text(f"*{ending}"),
        convention=f'{CONVENTION} = "{form.name}"\n' if form and form.note else "",
        table=f"{table}\n" if table else "",
        columns="\n".join(columns),
        units="\n".join(filter(None, (unknown, lines(units)))),
        scale=f"\n[scale]\n{scale}\n" if scale else "",
        rate=guess.rate_hz or RATE_HZ,
        measured="" if guess.rate_hz else comment(NOT_MEASURED),
        kinds=f"\n[kinds]\n{kinds}\n" if kinds else "",
    )
