"""The meaning of a table's columns: the source TOML, and what it leaves open.

The TOML says which column is which field, in which unit, with which scale and offset.
What it does not say is recognised by the columns' names and first cells: ISO times and
dates, latitude and longitude. A column name with {id} stands for one column per road
user, of tables with one row per frame. Headings are

    heading = sign * (heading in the file) + zero

in the convention and unit that agree best with the directions of travel, unless the
TOML says them; what contradicts the positions is refused.
"""

import contextlib
import dataclasses
import datetime
import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.csv.names import (
    compass_axis,
    every_word,
    is_in_pixels,
    words_of,
)
from rcirl_jax.data.formats.options import UNITS, number, one_of, positive, section
from rcirl_jax.data.formats.projection import projected
from rcirl_jax.data.readers.tables.cells import (
    CLOCK_DIGITS,
    EMPTY,
    ISO,
    day_and_second,
    times_of_day,
)
from rcirl_jax.data.readers.tables.rows import DAY_S, Rows
from rcirl_jax.data.readers.tables.table import (
    MAX_PLACE_M,
    MAX_TIME,
    MAX_VELOCITY_MPS,
    Field,
    Table,
)
from rcirl_jax.data.readers.tables.text import NUMBER
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.checked import check_names

LENGTHS = ("m", "ft", "km", "cm", "mm")
SPEEDS = ("m/s", "km/h", "mph", "ft/s", "kn")
ANGLES = ("rad", "deg")
CLOCKS = ("s", "ms", "us", "ns", "min", "h", "day", "frame", ISO, *CLOCK_DIGITS)
# field of numbers -> its units, and what no log can mean, in the file's unit
NUMBERS = {
    "t": (CLOCKS, MAX_TIME),
    **dict.fromkeys(("x", "y"), ((*LENGTHS, *ANGLES), MAX_PLACE_M)),
    "heading": (ANGLES, MAX_PLACE_M),
    **dict.fromkeys(("speed", "vx", "vy"), (SPEEDS, MAX_VELOCITY_MPS)),
    **dict.fromkeys(("length", "width"), (LENGTHS, math.inf)),
}
ALLOWED_UNITS = {field: units for field, (units, _) in NUMBERS.items()}
TEXT = ("id", "kind", "lane", "recording", "automated")
NEEDED = ("t", "id", "x", "y")
OPTIONAL = tuple(field for field in (*NUMBERS, *TEXT) if field not in NEEDED)
EXPECTED = (*NEEDED, "automated")  # errors where they are named and not there
EARTH = {"lat": "y", "lon": "x"}  # names of x and y in degrees
DEGREES = {"x": 360.0, "y": 90.0}  # longitude counts from -180 or from 0
DEGREE_M = 111_320.0  # m of a degree of latitude
MIDDLE_DIGITS = 2  # of latitude and longitude of the projection's middle
RATE_HZ = 10.0  # 1/s
# as read; not 07:15.2, which are minutes and seconds, nor 07:15:02.3 PM
ISO_TIMES = (
    r"\d{4}-\d\d-\d\d[T ]|\d{8}T\d|\d{4}/\d\d/\d\d |"
    r"\d{1,2}:\d\d(?!\d*[.,]\d)(?!.*[AaPp]\.?[Mm])"
)
# dates that are neither numbers nor ISO's; the day comes first where both orders fit
DATES = (
    *("%d.%m.%Y", "%d.%m.%y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y", "%d-%b-%Y"),
    *("%Y%m%d", "%Y-%m-%d", "%Y.%m.%d"),
)
SEPARATORS = (" ", "-", "_", "T")  # of a date and a time
TIMES_OF_DAY = (
    *("%H:%M:%S.%f", "%H:%M:%S,%f", "%H:%M:%S", "%I:%M:%S.%f %p", "%I:%M:%S %p"),
    *("%H%M%S.%f", "%H%M%S", "%H-%M-%S.%f", "%H.%M.%S.%f"),
)
ZONE = re.compile(r"( ?)(?:(UTC|GMT)|Z|[-+]\d\d:?\d\d)$")  # below a date and a time
# without a date: of a day, as ISO does not write them, and of an hour
CLOCK_PATTERNS = ("%I:%M:%S.%f %p", "%I:%M:%S %p", "%M:%S.%f", "%M:%S,%f")
DATE = "%Y%m%d%H%M%S"
# dates and times as digits alone: of 14, 17 or 20, which no clock of Unix has
DATE_DIGITS = re.compile(
    r"(19|20)\d\d(0[1-9]|1[0-2])([0-2]\d|3[01])([01]\d|2[0-3])([0-5]\d){2}(\d{3}){0,2}"
)
CLOCK_FROM = 1e6  # HHMMSSmmm from 00:10 on; numbers below it are common counters
PATTERN = 'or a pattern such as "%d.%m.%Y %H:%M:%S.%f"'  # of times
HINTS = {
    "t": "units.t of the source TOML says how times are written: s, ms, us, ns, ..., "
    + PATTERN,
    "earth": "degrees with decimals; south and west are negative",
}  # of cells that cannot be read
HOUR_S = 3600.0  # s
HOLE_S = 40.0  # s that digits leave out at the end of a minute, 4040 of an hour
AT_A_MINUTE_S = 2.0  # s at most between the last row of a minute and the next one
OF_PIXELS = "places in pixels take metres per pixel in [scale], such as x = 0.1"
UNCLEAR = "?"  # in a draft: a needed column that nobody knows
HOLE = "{id}"  # in a column's name: which road user's it is
# name -> sign and zero [rad]; north is +y
CONVENTIONS = {
    "ccw_from_x": (1.0, 0.0),
    "cw_from_north": (-1.0, 0.5 * math.pi),
    "cw_from_x": (-1.0, 0.0),
    "ccw_from_north": (1.0, 0.5 * math.pi),
}
CONVENTION = "heading_convention"  # the options of this file
AUTOMATED = "automated_values"
MOVING_MPS = 0.5  # m/s; the direction of a slower velocity is noise
SPAN_S = 0.5  # s over which a direction of travel is taken
MOVED_M = 1.0  # m in that time; slower road users have none
ENOUGH = 20  # directions of travel by which a convention is judged
FITS = math.radians(20.0)  # rad from the direction of travel, in the median
FITS_WELL = math.radians(8.0)  # rad; what another convention than the usual has to
TURNED = math.radians(3.0)  # rad from the mean of a road user; less is noise
ALIKE = 0.7  # correlation of turns at least, or at most its negative
SURE = math.radians(3.0)  # rad; nearer than this the usual convention is kept
YES = (
    *("yes", "y", "true", "t", "on", "x", "ja", "j", "oui", "si", "sí", "sim", "sì"),
    *("wahr", "w", "vrai", "verdadero", "vero", "waar", "an", "ein", "aktiv", "active"),
    *("enabled", "activated"),
    *("auto", "automated", "automatic", "autonomous", "av", "acc", "cacc", "engaged"),
)
NO = (
    *("no", "n", "false", "f", "off", "nein", "non", "não", "nao", "nee", "falsch"),
    *("faux", "falso", "onwaar", "aus", "inaktiv", "inactive", "disabled"),
    *("manual", "human", "driver", "hv", "disengaged"),
)
Found = list[tuple[str, str, str | None]]  # field, column with its sign, user


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogColumns:
    """The fields of one table, and how its positions and headings are meant."""

    fields: tuple[Field, ...]
    rate_hz: float
    # latitude and longitude [deg] of the projection's middle; None: x and y are metres
    middle: tuple[float, float] | None = None
    clock: str = "s"  # unit of t, as the TOML has it
    degrees: float = 1.0  # of latitude and longitude in the file's unit
    heading_unit: str = ""  # rad or deg; "": recognised
    has_units: bool = True  # whether the TOML says the unit of x and y
    turn_s: float = DAY_S  # s after which the clock begins anew
    notes: tuple[str, ...] = ()

    def distance(self, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
        """Returns metres [n] of differences in x and y of the file, rough on earth."""
        if self.middle is None:
            return np.hypot(dx, dy)
        turn, north = 360.0 / self.degrees, self.degrees * DEGREE_M
        east = north * math.cos(math.radians(self.middle[0]))
        dx = (dx + 0.5 * turn) % turn - 0.5 * turn  # over the 180th meridian
        return np.hypot(east * dx, north * dy)

    def metres(self, points: np.ndarray) -> np.ndarray:
        """Returns positions [n, 2] of the file in metres."""
        if self.middle is None:
            return points
        degrees = points * self.degrees
        east, north = projected(degrees[:, 0], degrees[:, 1], self.middle)
        return np.stack([east, north], axis=1)


def columns_of(table: Table, spec: Mapping) -> LogColumns:
    """Returns the columns of a table by its source TOML.

    Raises:
      InputError: an unknown field or unit, a needed column that is missing.
    """
    rate = positive({**spec, **section(spec, "defaults")}, "rate_hz", RATE_HZ)
    columns, units, notes = _named(table, spec)
    _check_units(table, spec, units)
    found = _found(table, columns, notes)
    middle, degrees = None, 1.0
    if units.get("x") in ANGLES:
        degrees = 1.0 if units["x"] == "deg" else math.degrees(1.0)
        middle = _middle(table, found, degrees, spec)
        notes.append(
            f"latitude, longitude projected about {middle[0]:g}, {middle[1]:g} degrees"
        )
    clock = next(name.lstrip("-") for field, name, _ in found if field == "t")
    form, factor = _time(table, clock, units.get("t"), rate, notes)
    return LogColumns(
        fields=tuple(_field(*one, units, spec, form, factor) for one in found),
        rate_hz=rate,
        middle=middle,
        clock=form or str(units.get("t", "s")),
        degrees=degrees,
        heading_unit=units.get("heading", ""),
        has_units="x" in section(spec, "units") or middle is not None,
        turn_s=HOUR_S if form.startswith("%M") else DAY_S,
        notes=tuple(notes),
    )


def _named(
    table: Table, spec: Mapping
) -> tuple[dict[str, str], dict[str, str], list[str]]:
    """(field -> column, field -> unit, notes), latitude and longitude as y and x."""
    columns, units = dict(section(spec, "columns")), dict(section(spec, "units"))
    where = f"{table.path}: columns."
    check_names(where, columns, [*NEEDED, *OPTIONAL, *EARTH])
    for field, column in columns.items():
        if not isinstance(column, str) or not column:
            raise InputError(f"{where}{field}: {column}: expected a name")
    if still := [field for field, column in columns.items() if column == UNCLEAR]:
        raise InputError(
            f"{where}{still[0]}: {UNCLEAR}: expected the name of a column; fill in the "
            f"lines of the draft: {', '.join(still)}"
        )
    for name, field in EARTH.items():
        if name in columns:
            if field in columns:
                raise InputError(
                    f"{where}{name}: {columns[name]}: expected it, or "
                    f"columns.{field}, not both"
                )
            columns[field] = columns.pop(name)
            units[field] = units.pop(name, "deg")
    is_wide = HOLE in columns.get("x", "")
    for field in NEEDED:
        if field not in columns and not (is_wide and field == "id"):
            raise InputError(f"{where}{field}: missing: expected a column")
    if is_wide and "id" in columns:
        raise InputError(
            f"{where}id: {columns['id']}: expected none beside "
            f"columns.x = {columns['x']!r}, whose {HOLE} is the id"
        )
    own = {axis: columns[axis].removeprefix("-") for axis in "xy"}
    is_turned = any(name != columns[axis] for axis, name in own.items())
    if [compass_axis(own[axis]) for axis in "xy"] == ["y", "x"] and not is_turned:
        raise InputError(
            f"{table.path}: columns.x, columns.y: {own['x']}, {own['y']}: x is called "
            "north and y east: swap them (y must lie left of x); where the names are "
            "wrong, give others by names of [table]"
        )
    for axis, name in own.items():
        if is_in_pixels(name) and axis not in section(spec, "scale"):
            raise InputError(f"{where}{axis}: {name}: expected metres; {OF_PIXELS}")
    texts = {columns[field] for field in TEXT if field in columns}
    for field, column in columns.items():
        if field not in TEXT and column in texts:
            raise InputError(
                f"{where}{field}: {column}: expected a column of "
                "numbers, not one that is read as text"
            )
    if "x" in units or "y" in units or is_wide:
        return columns, units, []
    for x, y in (("x", "y"), ("y", "x")):  # degrees, by their names and cells
        own, names = {"x": columns[x], "y": columns[y]}, every_word()["fields"]
        if all(
            words_of(own[axis]) & {*names[name]} and table.has(own[axis])
            for name, axis in EARTH.items()
        ):
            values = {axis: sampled(table, name) for axis, name in own.items()}
            if all(v.size and np.abs(v).max() <= DEGREES[a] for a, v in values.items()):
                note = f"columns {columns[x]}, {columns[y]}: longitude and latitude"
                return {**columns, **own}, {**units, "x": "deg", "y": "deg"}, [note]
    return columns, units, []


def known_cells(table: Table, column: str) -> list[str]:
    """Returns the first cells of a column that are not empty."""
    return [cell for cell in table.samples(column) if cell.lower() not in EMPTY]


def first_cell(table: Table, column: str) -> str:
    """Returns the first cell of a column that is not empty, "" without one."""
    return next(iter(known_cells(table, column)), "")


def sampled(table: Table, column: str) -> np.ndarray:
    """Returns the numbers among the first cells of a column."""
    cells = table.samples(column)
    if table.marks(column)[0] == ",":
        cells = [cell.replace(",", ".") for cell in cells]
    return np.array([float(cell) for cell in cells if NUMBER.fullmatch(cell)])


def date_pattern(cells: Sequence[str]) -> str:
    """Returns the pattern of strptime that all cells have; "" if none is known."""
    zones = [match for match in map(ZONE.search, cells) if match]
    if zones and len(zones) == len(cells):
        forms = {match[1] + ("%Z" if match[2] else "%z") for match in zones}
        bare = date_pattern([ZONE.sub("", cell) for cell in cells])
        return bare + forms.pop() if bare and len(forms) == 1 else ""
    if cells and all(map(DATE_DIGITS.fullmatch, cells)):
        return DATE + ("%f" if len(cells[0]) > 14 else "")
    if not cells or not cells[0][:1].isdigit() or NUMBER.fullmatch(cells[0]):
        return ""  # a text or a number: none of the patterns need be tried
    dated = map("".join, itertools.product(DATES, SEPARATORS, TIMES_OF_DAY))
    for pattern in itertools.chain(CLOCK_PATTERNS, dated):
        with contextlib.suppress(ValueError):
            for cell in cells:
                datetime.datetime.strptime(cell, pattern)
            return pattern
    return ""


def clock_digits(cells: Sequence[str], values: np.ndarray) -> tuple[str, bool]:
    """Returns the form of CLOCK_DIGITS that a clock may have, and whether it is sure.

    It is sure of texts with a leading zero, such as 080459920, and where a minute's
    last row and the next one's first are one step apart as digits only.

    Args:
      cells: of the first rows, not empty.
      values: [n] of these or more rows, as numbers.
    """
    whole = [re.fullmatch(r"(\d+)([.,]\d*)?", cell) for cell in cells]
    if not cells or not values.size or not all(whole):
        return "", False
    sizes = {len(match[1]) for match in whole if match}
    is_long = values.max() >= CLOCK_FROM or sizes == {len("HHMMSSmmm")}
    form = "HHMMSSmmm" if is_long else "HHMMSS"
    if times_of_day(values, form)[1].any():
        return "", False
    is_padded = sizes == {len(form)} and any(cell[0] == "0" for cell in cells)
    is_padded &= values.max() >= 1e4 * CLOCK_DIGITS[form]  # 01:00 or later
    return form, is_padded or has_holes(np.unique(values) / CLOCK_DIGITS[form])


def has_holes(seconds: np.ndarray) -> bool:
    """True if rising times [n] s leave 60 to 99 out, as digits of a time of day do."""
    day, clock = day_and_second(seconds)
    if not seconds.size or day.any() or np.isnan(clock).any():
        return False
    if seconds[0] < 1.0 and seconds[-1] >= 235959.0:  # over midnight
        return True
    steps = np.diff(clock)
    is_hole = np.diff(seconds) - steps >= HOLE_S
    return bool(np.any(is_hole & (steps <= AT_A_MINUTE_S)))


def check_clock(path: Path, seconds: np.ndarray, columns: LogColumns) -> None:
    """Refuses times of day as digits that were read as numbers.

    Args:
      path: of the log.
      seconds: [n] whole seconds in which there are rows, rising.
      columns: of the log.
    """
    if columns.clock in ("s", "ms") and has_holes(seconds):
        form = [*CLOCK_DIGITS][columns.clock == "ms"]
        raise InputError(
            f"{path}: units.t: {columns.clock}: no row has seconds 60 to 99, and those "
            f'after 59 are of the next minute: expected units.t = "{form}" (times as '
            "digits)"
        )


def _scaled(field: str, spec: Mapping) -> tuple[float, float]:
    """Scale and offset of a field, also under its name as latitude or longitude."""
    alias = next((name for name, own in EARTH.items() if own == field), field)
    scale, offset = section(spec, "scale"), section(spec, "offset")
    return (
        number(scale, field, number(scale, alias, 1.0)),
        number(offset, field, number(offset, alias, 0.0)),
    )


def _middle(
    table: Table, found: Found, degrees: float, spec: Mapping
) -> tuple[float, float]:
    """Latitude and longitude [deg] near the first rows, rounded."""
    places = {}
    for axis, most in DEGREES.items():
        names = [name.lstrip("-") for field, name, _ in found if field == axis]
        values = np.concatenate([sampled(table, name) for name in names])
        scale, offset = _scaled(axis, spec)
        known = (values[values != 0.0] * scale + offset) * degrees
        known = known[np.abs(known) <= most]
        if axis == "x" and known.size:  # 179.9 and -179.9 are near each other
            known = known[0] + (known - known[0] + 180.0) % 360.0 - 180.0
        middle = float(np.median(known)) if known.size else 0.0
        places[axis] = round(middle, MIDDLE_DIGITS)
    return places["y"], (places["x"] + 180.0) % 360.0 - 180.0


def _check_units(table: Table, spec: Mapping, units: dict[str, str]) -> None:
    """Units are known; scales and offsets are numbers of fields that have a unit."""
    check_names(f"{table.path}: units.", units, [*NUMBERS])
    for name in ("scale", "offset"):
        own = section(spec, name)
        check_names(f"{table.path}: {name}.", own, [*NUMBERS, *EARTH])
    for field, unit in units.items():
        is_pattern = field == "t" and "%" in str(unit)
        if unit not in ALLOWED_UNITS[field] and not is_pattern:
            raise InputError(
                f"{table.path}: units.{field}: {unit}: "
                f"expected one of {', '.join(ALLOWED_UNITS[field])}"
                + (f", {PATTERN}" if field == "t" else "")
            )
    x, y = (units.get(axis, "m") for axis in "xy")
    if (x in ANGLES) != (y in ANGLES):
        raise InputError(
            f"{table.path}: units.x, units.y: {x} and {y}: expected both in degrees or "
            "both in metres"
        )


def _found(table: Table, columns: Mapping[str, str], notes: list[str]) -> Found:
    """All columns that are there; notes on those that are not."""
    found: Found = []
    users = _users(table, columns) if HOLE in columns.get("x", "") else []
    needed = [columns.get(field, "") for field in NEEDED]
    is_log = users or any(table.has(name.lstrip("-")) for name in needed)
    # without a header that names any, the missing column is named below
    if not is_log and not any(NUMBER.fullmatch(name) for name in table.header):
        raise InputError(
            f"{table.path}: header: {[*table.header[:20]]}: none of the columns "
            f"{', '.join(needed)}: expected a log; `pattern` of the TOML leaves "
            "out tables that are none"
        )
    for field, name in columns.items():
        plain = _plain(field, name)
        sign = name[: len(name) - len(plain)]
        for user in users if HOLE in name else [None]:
            column = plain if user is None else plain.replace(HOLE, user)
            if table.has(column):
                found.append((field, sign + column, user))
            elif field in EXPECTED:
                table.place(column)  # says that it is missing
            elif user is None:
                notes.append(f"no column '{column}': {field} computed or by default")
    return found


def _plain(field: str, name: str) -> str:
    """Name of a column; "-name" turns an axis round."""
    return name if field in TEXT else name.removeprefix("-")


def _users(table: Table, columns: Mapping[str, str]) -> list[str]:
    """Road users that have both an x and a y in a row per frame."""
    own = []
    for field in ("x", "y"):
        ends = map(re.escape, _plain(field, columns[field]).split(HOLE, 1))
        pattern = re.compile("(.+)".join(ends))
        matches = map(pattern.fullmatch, table.header)
        own.append([match[1] for match in matches if match])
    users = [user for user in own[0] if user in own[1]]
    if not users:
        raise InputError(
            f"{table.path}: columns.x: {columns['x']}: expected columns of this name "
            f"and of {columns['y']} in the header, such as for {HOLE} = 1"
        )
    return [user for user in users if user.isdigit()] or users


def _time(
    table: Table, name: str, unit: str | None, rate: float, notes: list[str]
) -> tuple[str, float]:
    """(form, factor) of the clock; where nothing is said, as its first cells are."""
    if unit in (ISO, *CLOCK_DIGITS) or (unit is not None and "%" in unit):
        return unit, 1.0
    first, form = first_cell(table, name), ISO
    if not re.match(ISO_TIMES, first):
        form = date_pattern(known_cells(table, name))
    if not form and unit is None:
        form, is_sure = clock_digits(known_cells(table, name), sampled(table, name))
        if form == "HHMMSSmmm" and not is_sure:
            raise InputError(
                f"{table.path}: units.t: missing: the cells of {name} are such as "
                f"'{first[:40]}', times of day as digits or milliseconds: expected "
                'units.t = "HHMMSSmmm" or "ms"'
            )
        form = form if is_sure else ""
    if not form:
        return "", 1.0 / rate if unit == "frame" else UNITS[unit or "s"]
    if unit is not None:
        raise InputError(
            f"{table.path}: units.t: {unit}: the cells of {name} are such as "
            f"'{first[:40]}': expected {form}"
        )
    said = "ISO times" if form == ISO else f"times as {form}"
    notes.append(f"column {name}: {said}")
    return form, 1.0


def _field(
    field: str,
    name: str,
    user: str | None,
    units: Mapping[str, str],
    spec: Mapping,
    form: str,
    clock: float,
) -> Field:
    """One column as the reader takes it."""
    plain, (scale, offset) = _plain(field, name), _scaled(field, spec)
    unit, factor = units.get(field, ""), 1.0
    limit = NUMBERS[field][1] if field in NUMBERS else math.inf
    is_place_on_earth = unit in ANGLES and field in DEGREES
    if field == "t":
        limit, factor = math.inf if form else limit / min(clock, 1.0), clock
    elif is_place_on_earth:
        limit = DEGREES[field] * (UNITS["deg"] if unit == "rad" else 1.0)
    elif unit in UNITS and field != "heading":
        factor = UNITS[unit]
    return Field(
        name=field,
        column=plain,
        needed=field in (*NEEDED, "recording"),
        text=field in TEXT,
        form=form if field == "t" else "",
        scale=scale,
        offset=offset,
        factor=-factor if plain != name else factor,
        limit=limit,
        hint=HINTS.get("earth" if is_place_on_earth else field, ""),
        zero_is_empty=is_place_on_earth,
        user=user,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeadingForm:
    """Converts a file's headings to radians counter-clockwise from +x."""

    name: str = "ccw_from_x"
    unit: str = "rad"
    note: str = ""
    turns_left: bool = False  # surely: no convention that turns right fits as well

    def radians(self, headings: np.ndarray) -> np.ndarray:
        """Returns headings [n] of the file in radians, counter-clockwise from +x."""
        sign, zero = CONVENTIONS[self.name]
        return sign * UNITS[self.unit] * headings + zero


@dataclasses.dataclass(frozen=True, kw_only=True)
class Meaning:
    """The conventions of a file's headings, velocities and flags."""

    form: HeadingForm | None = None  # None: no headings, or not to be believed
    flags: Mapping[str, bool] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()
    is_mirrored: bool = False  # a column named as a compass's shows that x points north

    def applied(self, values: Rows) -> Rows:
        """Returns rows with speed, and heading in radians counter-clockwise from +x."""
        made = with_velocity(values)
        if "heading" in made and self.form is None:
            del made["heading"]
        elif self.form is not None and "heading" in made:
            made["heading"] = self.form.radians(made["heading"])
        return made

    def automated(self, texts: np.ndarray) -> np.ndarray:
        """True where an automation drives [n], by the texts of its column."""
        names, codes = np.unique(texts, return_inverse=True)
        return np.array([self.flags[name] for name in names.tolist()], bool)[codes]


def meaning_of(
    path: Path,
    rows: Iterable[Rows],
    automated: Iterable[str],
    columns: LogColumns,
    spec: Mapping,
) -> Meaning:
    """Returns the meaning of a file.

    Args:
      path: named in errors.
      rows: in portions, x and y in metres; no more are taken than are needed.
      automated: all that the column of this field holds.
      columns: of the file.
      spec: source TOML.

    Raises:
      InputError: headings that contradict the positions, a flag neither yes nor no.
    """
    flags = flags_of(path, automated, spec)
    names = {field.name: field.column for field in columns.fields}
    rate = columns.rate_hz
    if "heading" in names:
        form = heading_form(path, rows, columns.heading_unit, spec, rate)
        says = [compass_axis(names[field]) for field in ("x", "y", "heading")]
        is_mirrored = form.turns_left and says == ["", "", "heading"]
        is_mirrored &= columns.middle is None
        notes = (form.note,) if form.note else ()
        if is_mirrored:
            notes += (
                f"heading: {names['heading']} is a compass's by its name, but turns "
                "counter-clockwise: x and y are mirrored if x points north and y east "
                "(swap them), or the name is wrong",
            )
        return Meaning(form=form, flags=flags, notes=notes, is_mirrored=is_mirrored)
    if {"vx", "vy"} <= names.keys():  # they are in the frame of x and y
        usual = {CONVENTION: "ccw_from_x"}
        try:
            form = heading_form(path, map(with_velocity, rows), "rad", usual, rate)
        except InputError:
            note = "vx, vy contradict the direction of travel; headings by positions"
            return Meaning(flags=flags, notes=(note,))
        return Meaning(form=form, flags=flags)
    return Meaning(flags=flags)


def flags_of(path: Path, texts: Iterable[str], spec: Mapping) -> dict[str, bool]:
    """Returns text -> whether an automation drives, or nobody knows who does.

    An empty cell is unknown, which counts as automated. If all other cells say yes, an
    empty one means no.

    Args:
      path: named in errors.
      texts: all that the column holds.
      spec: source TOML; its `automated_values` are those that mean yes.

    Raises:
      InputError: a text that is neither yes nor no.
    """
    own, found = {item.lower() for item in spec.get(AUTOMATED, [])}, {}
    for text in filter(None, texts):
        plain, point = text.lower(), text.replace(",", ".")
        if own:
            found[text] = plain in own
        elif NUMBER.fullmatch(point):
            found[text] = float(point) != 0.0
        elif plain in YES or plain in NO:
            found[text] = plain in YES
        else:
            raise InputError(
                f"{path}: automated: '{text[:40]}': expected yes or no; {AUTOMATED} of "
                "the source TOML lists those that mean yes"
            )
    return {**found, "": not all(found.values())}


def with_velocity(values: Rows) -> Rows:
    """Returns rows whose vx and vy stand for the speed and heading that they lack."""
    if "vx" not in values or "vy" not in values:
        return dict(values)
    speed = np.hypot(values["vx"], values["vy"])
    way = np.where(speed > MOVING_MPS, np.arctan2(values["vy"], values["vx"]), np.nan)
    return {"speed": speed, "heading": way, **values}


def heading_form(
    path: Path, rows: Iterable[Rows], unit: str, spec: Mapping, rate_hz: float
) -> HeadingForm:
    """Returns the form of a file's headings by the first rows in which enough move.

    Where they are too few, it is as declared, or as usual.

    Args:
      path: named in errors.
      rows: id, t [s], x, y [m], heading as in the file, [n] each, in portions.
      unit: rad or deg; "": whichever fits.
      spec: source TOML.
      rate_hz: rows per second of a road user.

    Raises:
      InputError: no convention, or not the declared one, agrees with the positions.
    """
    said = one_of(spec, CONVENTION, CONVENTIONS) if spec.get(CONVENTION) else ""
    headings = None
    for values in rows:
        first, middle, last = half_seconds(values, rate_hz)
        dx, dy, dt = (values[n][last] - values[n][first] for n in ("x", "y", "t"))
        amid = values["heading"][middle]
        used = (np.hypot(dx, dy) > MOVED_M) & (dt < 4.0 * SPAN_S) & np.isfinite(amid)
        if np.sum(used) >= ENOUGH:
            travel = np.arctan2(dy[used], dx[used])
            users = np.unique(values["id"][middle][used], return_inverse=True)[1]
            return _fitting(path, amid[used], travel, users, unit, said)
        if headings is None:
            headings = values["heading"]
    by_size = "rad" if headings is None or not is_large(headings) else "deg"
    return HeadingForm(name=said or "ccw_from_x", unit=unit or by_size)


def _turning(angles: np.ndarray, travel: np.ndarray, users: np.ndarray) -> float:
    """Returns 1 if angles [n] rad turn with `travel` [n] rad in curves, -1 if against.

    The offset of a convention does not matter to it. 0: too little turns, or neither.
    """

    def turned(values: np.ndarray) -> np.ndarray:
        """From the mean of the road user."""
        ways = np.exp(1j * values)
        east, north = (np.bincount(users, x) for x in (np.cos(values), np.sin(values)))
        means = east + 1j * north
        return np.angle(ways * np.conj(means[users]))

    real, found = turned(travel), turned(angles)
    used = np.abs(real) > TURNED
    real, found = real[used], found[used]
    spread = math.sqrt(float(np.sum(real**2) * np.sum(found**2)))
    alike = float(np.sum(real * found)) / spread if spread else 0.0
    return (
        math.copysign(1.0, alike) if real.size >= ENOUGH and abs(alike) > ALIKE else 0.0
    )


def _fitting(
    path: Path,
    headings: np.ndarray,
    travel: np.ndarray,
    users: np.ndarray,
    unit: str,
    said: str,
) -> HeadingForm:
    """The form that fits headings [n] of road users to directions of travel [n] rad."""
    possible = ["deg"] if is_large(headings) else ["rad", "deg"]

    def fits(units: Sequence[str], names: Sequence[str]) -> dict[HeadingForm, float]:
        """Form -> median angle [rad] to directions of travel; inf: turns against."""
        found = {}
        for one, name in itertools.product(units, names):
            form = HeadingForm(name=name, unit=one)
            angles = form.radians(headings)
            off = np.abs(np.angle(np.exp(1j * (angles - travel))))
            is_against = _turning(angles, travel, users) < 0.0
            found[form] = math.inf if is_against else float(np.median(off))
        return found

    apart = fits([unit] if unit else possible, [said] if said else [*CONVENTIONS])
    usual, best = next(iter(apart)), min(apart, key=lambda form: apart[form])
    is_far = apart[best] > FITS_WELL and math.isfinite(apart[usual])
    if is_far or apart[usual] <= max(SURE, 2.0 * apart[best]):
        best = usual
    if apart[best] > FITS:
        every = fits(possible, [*CONVENTIONS])
        right = min(every, key=lambda form: every[form])
        hint = "leave columns.heading out to take the direction of travel"
        if every[right] <= FITS_WELL:
            hint = (
                f'{CONVENTION} = "{right.name}" with units.heading = "{right.unit}" '
                "fits"
            )
        what = (
            f"{math.degrees(apart[best]):.0f} degrees from the direction of travel in "
            f"the median: expected up to {math.degrees(FITS):.0f}"
            if math.isfinite(apart[best])
            else "in curves it turns against the direction of travel: expected it to "
            "turn with it, or x and y are mirrored"
        )
        raise InputError(f"{path}: heading: {what}; {hint}")
    is_usual = best == HeadingForm(name=said or "ccw_from_x", unit=unit or "rad")
    note = "" if is_usual else (
        f"headings read as {best.name} in {best.unit}, which fits the direction of "
        "travel"
    )  # fmt: skip
    others = [off for form, off in apart.items() if CONVENTIONS[form.name][0] < 0.0]
    is_left = CONVENTIONS[best.name][0] > 0.0 and not said
    is_left &= min(others, default=math.inf) > max(SURE, 2.0 * apart[best])
    return dataclasses.replace(best, note=note, turns_left=is_left)


def is_large(headings: np.ndarray) -> bool:
    """True if angles are too large for radians of one turn."""
    known = headings[np.isfinite(headings)]
    return bool(np.any(np.abs(known) > 2.0 * math.pi + 0.1))


def half_seconds(
    values: Rows, rate_hz: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns rows [m] of a road user, half a second apart: first, middle and last."""
    codes = np.unique(values["id"], return_inverse=True)[1]
    order = np.lexsort((values["t"], codes))
    step = max(round(SPAN_S * rate_hz), 1)
    first, last = order[:-step], order[step:]
    middle = order[step // 2 : step // 2 + first.size]
    same = codes[first] == codes[last]
    return first[same], middle[same], last[same]
