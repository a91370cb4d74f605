"""A source TOML for a table of which nothing is said, and its first rows as understood.

Names of columns, units in them and the numbers of the first rows tell what can be told.
The TOML is read back like any other: what is shown is what an import would take.
"""

import dataclasses
import math
import re
from collections.abc import Mapping as AnyMapping
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.csv.dates import date_pattern
from rcirl_jax.data.formats.csv.flags import NO, YES
from rcirl_jax.data.formats.csv.heading import half_seconds, is_large
from rcirl_jax.data.formats.csv.mapping import (
    ALLOWED_UNITS,
    DEGREES,
    HOLE,
    NEEDED,
    OPTIONAL,
    RATE_HZ,
    Mapping,
    first_cell,
    known_cells,
    sampled,
)
from rcirl_jax.data.formats.csv.meaning import Meaning, meaning_of, with_velocity
from rcirl_jax.data.formats.csv.names import fields_by_name, kind_by_name, unit_of
from rcirl_jax.data.formats.csv.reader import opened
from rcirl_jax.data.formats.csv.suggestion import (
    Guess,
    recognised,
    shown,
    toml_of,
    unknown,
)
from rcirl_jax.data.formats.options import KINDS, UNITS
from rcirl_jax.data.readers.tables.rows import LINE
from rcirl_jax.data.readers.tables.table import MAX_TIME, Table, batches, open_table
from rcirl_jax.data.readers.tables.text import NUMBER
from rcirl_jax.errors import InputError, as_input_error

USUAL_RATES = (1, 2, 4, 5, 10, 12.5, 15, 20, 24, 25, 29.97, 30, 50, 60, 100, 120)
RATE_FITS = 0.1  # relative
FRAMES_FIT = 0.02  # likewise, of a rate that speeds tell
NO_RATE = "rate_hz: rows per second of one road user; 10 is assumed"
LONG_CAR_M = 9.0  # m; a longer median vehicle was measured in feet
# recorded speed over that of the positions, both in m/s if it were m/s
SPEED_RATIOS = {"m/s": 1.0, "km/h": 3.6, "ft/s": 3.2808, "mph": 2.2369, "kn": 1.9438}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Suggestion:
    """What is suggested for a table."""

    toml: str
    lines: tuple[str, ...]  # for the terminal


def suggested(path: Path) -> Suggestion:
    """A source TOML by the head of a table.

    Raises:
      InputError: no table, or one without columns that look like time, id and places.
    """
    with as_input_error(str(path), "a table with a row per road user and time"):
        return _suggested(path)


def _suggested(path: Path) -> Suggestion:
    table = open_table(path)
    columns, said = _columns(table)
    guess = Guess(columns=columns, said=said)
    _time_form(table, guess)
    _check_degrees(table, guess)
    raw = _first_rows(path, guess.spec())
    _clock(table, raw, guess)
    _lengths(table, raw, guess)
    _heading_and_speed(table, raw, guess)
    _texts(raw, guess)
    rows, meaning, mapping = _without_wrong_headings(path, guess)
    lines = [
        *recognised(table, guess, mapping, meaning),
        *unknown(table, guess),
        "",
        "the first rows as understood:",
        *shown(rows),
    ]
    return Suggestion(toml=toml_of(path, guess, meaning), lines=tuple(lines))


def _columns(table: Table) -> tuple[dict[str, str], list[str]]:
    """Field -> column, and how a table with a row per frame was told."""
    found, said = fields_by_name(table.header), []
    wide = _wide(table)
    alone = {field for field in found if _alone(table, found[field])}
    if wide and not {"id", "x", "y"} <= alone:
        found = {k: v for k, v in found.items() if k == "t"} | wide
        said.append(f"a row per frame: {wide['x']}, {wide['y']} for each road user")
    places = ("lat", "lon") if "lat" in found else ("x", "y")
    needed = ("t", *places) if HOLE in found.get("x", "") else ("t", "id", *places)
    missing = [field for field in needed if field not in found]
    if missing:
        raise InputError(
            f"{table.path}: no column looks like {', '.join(missing)}: expected them "
            f"among {[n for n in table.header if n][:40]}; write the TOML by hand"
        )
    return found, said


def _alone(table: Table, column: str) -> bool:
    """Whether no other column differs by a number only."""
    plain = re.sub(r"\d+", "", column)
    alike = [name for name in table.header if re.sub(r"\d+", "", name) == plain]
    return len(alike) == 1


def _wide(table: Table) -> dict[str, str]:
    """Columns x, y and more with {id} for the number in their names; {} if none."""
    forms: dict[str, int] = {}
    for name in table.header:
        match = re.fullmatch(r"(\D*)(\d+)(\D*)", name)
        if match and (match[1] or match[3]):
            form = f"{match[1]}{HOLE}{match[3]}"
            forms[form] = forms.get(form, 0) + 1
    several = [form for form, count in forms.items() if count > 1]
    bare = {form.replace(HOLE, "_"): form for form in several}
    fields = fields_by_name(list(bare))
    found = {field: bare[name] for field, name in fields.items()}
    found = {k: v for k, v in found.items() if k in (*NEEDED, *OPTIONAL) and k != "id"}
    found.pop("t", None)
    return found if {"x", "y"} <= found.keys() else {}


def _first_rows(path: Path, spec: AnyMapping) -> dict[str, np.ndarray]:
    """Rows of the first MiB as a source TOML takes them, texts as text."""
    log = opened(path, dict(spec))
    for batch in batches(log.table, log.mapping.fields, log.stats):
        rows = {
            name: np.array(column[1])[column[0]]
            if isinstance(column, tuple)
            else column
            for name, column in batch.items()
        }
        if rows[LINE].size:
            return rows
    log.stats.check()
    raise InputError(f"{path}: rows: none: expected rows below the header")


def _time_form(table: Table, guess: Guess) -> None:
    """Unit of times that are no seconds, milliseconds or frames: by the first cell."""
    first = first_cell(table, guess.columns["t"])
    if re.match(r"\d{4}[-/]\d|\d{8}T\d|\d{1,2}:\d", first):
        guess.units["t"] = "iso"
    elif NUMBER.fullmatch(first) and abs(float(first)) > MAX_TIME:
        guess.units["t"] = "ns" if float(first) > 1e3 * MAX_TIME else "us"
    elif pattern := date_pattern(known_cells(table, guess.columns["t"])):
        guess.units["t"] = pattern


def _check_degrees(table: Table, guess: Guess) -> None:
    """Latitudes are degrees; of raw numbers nobody knows how many make one.

    Raises:
      InputError: they are too large.
    """
    found = sampled(table, guess.columns["lat"]) if "lat" in guess.columns else None
    if found is not None and found.size and np.abs(found).min() > DEGREES["y"]:
        raise InputError(
            f"{table.path}: {guess.columns['lat']}: {found[0]:.12g}: expected degrees; "
            "if these are raw numbers, write the TOML by hand, with their [scale], "
            "such as lat = 1e-7, lon = 1e-7"
        )


def _clock(table: Table, raw: AnyMapping[str, np.ndarray], guess: Guess) -> None:
    """Unit of the time and rows per second, by the step of the road users' times."""
    ids = np.unique(raw["id"], return_inverse=True)[1]
    order = np.lexsort((raw["t"], ids))
    steps = np.diff(raw["t"][order])[np.diff(ids[order]) == 0]
    steps = steps[steps > 0.0]
    step = float(np.median(steps)) if steps.size else math.nan
    if "t" not in guess.units:
        name = guess.columns["t"]
        unit = _said(table, name, ("ms", "us", "ns", "s")) or _unit_by_step(name, step)
        if unit == "frame" and step > 1.0:
            guess.scale["t"] = 1.0 / step
            guess.said.append(f"scale.t: every {step:g}th frame has rows")
        guess.units["t"], step = unit, step * UNITS.get(unit, math.nan)
    if not math.isfinite(step):
        guess.open.append(NO_RATE)
        return
    rate = 1.0 / step
    near = min(USUAL_RATES, key=lambda usual: abs(rate / usual - 1.0))
    guess.rate_hz = near if abs(rate / near - 1.0) < RATE_FITS else float(f"{rate:.4g}")
    guess.said.append(
        f"rate_hz = {guess.rate_hz:g}: a row of a road user every {1 / rate:.4g} s"
    )


def _said(table: Table, column: str, allowed: Sequence[str]) -> str:
    """The unit that a column's name says, or the line below the header."""
    bare = column.removeprefix("-")
    own = "" if HOLE in bare else table.unit_of(bare)
    return unit_of(column, allowed) or unit_of(f"[{own}]", allowed)


def _unit_by_step(name: str, step: float) -> str:
    """Unit of a clock whose rows are so far apart."""
    if "frame" in name.lower() and step == round(step) < 10:
        return "frame"
    for unit in ("s", "ms", "us", "ns", "day"):
        if 0.005 <= step * UNITS[unit] <= 2.0:
            return unit
    return "s"


def _lengths(table: Table, raw: AnyMapping[str, np.ndarray], guess: Guess) -> None:
    """Units of places and sizes: as their names say, else metres if cars fit them."""
    if "lat" in guess.columns:
        guess.units.update({"lat": "deg", "lon": "deg"})
    known = raw.get("length", np.zeros(0))
    known = known[np.isfinite(known)]
    long = bool(known.size) and float(np.median(known)) > LONG_CAR_M
    for field in ("x", "y", "length", "width"):
        if field in guess.columns:
            said = _said(table, guess.columns[field], ALLOWED_UNITS["length"])
            guess.units[field] = said or ("ft" if long else "m")
    if long:
        guess.said.append(f"length: {np.median(known):.3g} in the median: feet")


def _heading_and_speed(
    table: Table, raw: AnyMapping[str, np.ndarray], guess: Guess
) -> None:
    """Units of angles by their size; of speeds by the speed of the positions."""
    if "heading" in guess.columns:
        large = is_large(raw["heading"][np.isfinite(raw["heading"])])
        said = _said(table, guess.columns["heading"], ("deg", "rad"))
        guess.units["heading"] = said or ("deg" if large else "rad")
    speeds = [field for field in ("speed", "vx", "vy") if field in guess.columns]
    said = {f: _said(table, guess.columns[f], ALLOWED_UNITS["speed"]) for f in speeds}
    guess.units.update({field: said[field] or "m/s" for field in speeds})
    told = ["speed"] if "speed" in speeds else speeds  # by which the speed is known
    if told == ["vy"] or told == ["vx"] or not told:
        return
    if guess.rate_hz is None:
        _rate_of_frames(table.path, guess)
    if not any(said[field] for field in told):
        unit = _speed_unit(table.path, guess) or "m/s"
        guess.units.update(dict.fromkeys(told, unit))


def _speed_unit(path: Path, guess: Guess) -> str:
    """The unit in which speeds are those of the positions; "" if none is."""
    ratio = _speed_ratio(path, guess)
    if ratio is None:
        return ""
    unit = min(SPEED_RATIOS, key=lambda name: abs(ratio / SPEED_RATIOS[name] - 1.0))
    if abs(ratio / SPEED_RATIOS[unit] - 1.0) > 0.06:
        guess.open.append(f"units.speed: {ratio:.3g} times the speed of the positions")
        return ""
    guess.said.append(f"units.speed = {unit}: {ratio:.3g} times the positions' m/s")
    return unit


def _speed_ratio(path: Path, guess: Guess) -> float | None:
    """Recorded speed over that of the positions; None: too few road users move."""
    rows, _, mapping = _without_wrong_headings(path, guess)
    first, _, last = half_seconds(rows, mapping.rate_hz)
    dx, dy, dt = (rows[name][last] - rows[name][first] for name in ("x", "y", "t"))
    real, found = np.hypot(dx, dy) / np.maximum(dt, 1e-9), rows["speed"][first]
    used = (real > 2.0) & np.isfinite(found)
    return (
        float(np.median(np.abs(found[used]) / real[used])) if used.sum() > 9 else None
    )


def _rate_of_frames(path: Path, guess: Guess) -> None:
    """The usual rate at which frames are apart as recorded speeds say, if one is."""
    ratio = _speed_ratio(path, guess)
    if ratio is None:
        return
    for unit, times in SPEED_RATIOS.items():
        rate = RATE_HZ * ratio / times
        near = min(USUAL_RATES, key=lambda usual: abs(rate / usual - 1.0))
        if abs(rate / near - 1.0) < FRAMES_FIT:
            guess.rate_hz = near
            guess.open.remove(NO_RATE)
            guess.said.append(
                f"rate_hz = {near:g}: by the speeds, if they are in {unit}"
            )
            return


def _texts(raw: AnyMapping[str, np.ndarray], guess: Guess) -> None:
    """Kinds by their names; flags only where they are yes or no."""
    if "kind" in guess.columns:
        for text in np.unique(raw["kind"]).tolist():
            if text and text not in KINDS:
                guess.kinds[text] = kind_by_name(text) or "vehicle"
                if not kind_by_name(text):
                    guess.open.append(f"kinds: {text}: taken for a vehicle")
    if "automated" in guess.columns:
        texts = {text.lower() for text in np.unique(raw["automated"]).tolist()}
        if not texts <= {"", "0", "1", *YES, *NO}:
            del guess.columns["automated"]


def _without_wrong_headings(
    path: Path, guess: Guess
) -> tuple[dict[str, np.ndarray], Meaning, Mapping]:
    """What is understood, by the positions where headings contradict them."""
    try:
        return _understood(path, guess.spec())
    except InputError as error:
        if "heading" not in guess.columns:
            raise
        guess.open.append(str(error).removeprefix(f"{path}: "))
        for part in (guess.columns, guess.units):
            part.pop("heading", None)
        return _understood(path, guess.spec())


def _understood(
    path: Path, spec: AnyMapping
) -> tuple[dict[str, np.ndarray], Meaning, Mapping]:
    """First rows in SI units, as an import takes them."""
    log = opened(path, dict(spec))
    rows = _first_rows(path, spec)
    points = log.metres(np.stack([rows["x"], rows["y"]], axis=1))
    rows = {**rows, "x": points[:, 0], "y": points[:, 1]}
    texts = np.unique(rows.get("automated", np.zeros(0, str))).tolist()
    meaning = meaning_of(path, [rows], texts, log.mapping, dict(spec))
    return with_velocity(meaning.applied(rows)), meaning, log.mapping
