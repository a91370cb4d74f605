"""How headings, velocities and flags of a user's table are meant.

    heading = sign * (heading in the file) + zero

The convention and unit that agree best with the directions of travel are taken, unless
the TOML says them; what contradicts the positions is refused.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.csv.columns import LogColumns
from rcirl_jax.data.formats.options import UNITS
from rcirl_jax.data.readers.tables.rows import Rows
from rcirl_jax.data.readers.tables.text import NUMBER
from rcirl_jax.errors import InputError

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeadingForm:
    """How a file's headings become radians counter-clockwise from +x."""

    name: str = "ccw_from_x"
    unit: str = "rad"
    note: str = ""

    def radians(self, headings: np.ndarray) -> np.ndarray:
        """Returns headings [n] of the file in radians, counter-clockwise from +x."""
        sign, zero = CONVENTIONS[self.name]
        return sign * UNITS[self.unit] * headings + zero


@dataclasses.dataclass(frozen=True, kw_only=True)
class Meaning:
    """How headings, velocities and flags of a file are read."""

    form: HeadingForm | None = None  # None: no headings, or not to be believed
    flags: Mapping[str, bool] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def applied(self, values: Rows) -> Rows:
        """Returns rows with speed, and heading in radians counter-clockwise from +x."""
        made = with_velocity(values)
        if "heading" in made and self.form is None:
            del made["heading"]
        elif self.form is not None and "heading" in made:
            made["heading"] = self.form.radians(made["heading"])
        return made

    def automated(self, texts: np.ndarray) -> np.ndarray:
        """Whether an automation drives [n], by the texts of its column."""
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
    names, rate = {field.name for field in columns.fields}, columns.rate_hz
    if "heading" in names:
        form = heading_form(path, rows, columns.heading_unit, spec, rate)
        return Meaning(form=form, flags=flags, notes=(form.note,) if form.note else ())
    if {"vx", "vy"} <= names:  # they are in the frame of x and y
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
    given = spec.get(AUTOMATED, [])
    if not isinstance(given, list) or not all(isinstance(item, str) for item in given):
        raise InputError(f"source TOML: {AUTOMATED}: {given}: expected a list of texts")
    own, found = {item.lower() for item in given}, {}
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
    said = spec.get(CONVENTION, "")
    if said and said not in CONVENTIONS:
        raise InputError(
            f"source TOML: {CONVENTION}: {said}: expected one of "
            f"{', '.join(CONVENTIONS)}"
        )
    headings = None
    for values in rows:
        first, middle, last = half_seconds(values, rate_hz)
        dx, dy, dt = (values[n][last] - values[n][first] for n in ("x", "y", "t"))
        amid = values["heading"][middle]
        used = (np.hypot(dx, dy) > MOVED_M) & (dt < 4.0 * SPAN_S) & np.isfinite(amid)
        if np.sum(used) >= ENOUGH:
            travel = np.arctan2(dy[used], dx[used])
            return _fitting(path, amid[used], travel, unit, said)
        if headings is None:
            headings = values["heading"]
    by_size = "rad" if headings is None or not is_large(headings) else "deg"
    return HeadingForm(name=said or "ccw_from_x", unit=unit or by_size)


def _fitting(
    path: Path, headings: np.ndarray, travel: np.ndarray, unit: str, said: str
) -> HeadingForm:
    """The form that fits headings [n] to directions of travel [n] rad."""
    possible = ["deg"] if is_large(headings) else ["rad", "deg"]

    def fits(units: Sequence[str], names: Sequence[str]) -> dict[HeadingForm, float]:
        """Form -> median angle [rad] between headings and directions of travel."""
        found = {}
        for one, name in itertools.product(units, names):
            form = HeadingForm(name=name, unit=one)
            turn = np.exp(1j * (form.radians(headings) - travel))
            found[form] = float(np.median(np.abs(np.angle(turn))))
        return found

    apart = fits([unit] if unit else possible, [said] if said else [*CONVENTIONS])
    usual, best = next(iter(apart)), min(apart, key=lambda form: apart[form])
    if apart[usual] <= max(SURE, 2.0 * apart[best]) or apart[best] > FITS_WELL:
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
        raise InputError(
            f"{path}: heading: {math.degrees(apart[best]):.0f} degrees from the "
            "direction of travel in the median: expected up to "
            f"{math.degrees(FITS):.0f}; {hint}"
        )
    if best == HeadingForm(name=said or "ccw_from_x", unit=unit or "rad"):
        return best
    note = (
        f"headings read as {best.name} in {best.unit}, which fits the direction of "
        "travel"
    )
    return dataclasses.replace(best, note=note)


def is_large(headings: np.ndarray) -> bool:
    """Whether angles are too large for radians of one turn."""
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
