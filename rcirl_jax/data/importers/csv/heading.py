"""Headings of a user's table: in which convention they are, against the positions.

    heading = sign * (heading in the file) + zero

The convention and unit that agree best with the directions of travel are taken, unless
the TOML says them; what contradicts the positions is refused.
"""

import dataclasses
import itertools
import math
from collections.abc import Mapping as AnyMapping
from pathlib import Path

import numpy as np

from rcirl_jax.data.importers.options import UNITS
from rcirl_jax.errors import InputError

# name -> sign and zero [rad]; north is +y
CONVENTIONS = {
    "ccw_from_x": (1.0, 0.0),
    "cw_from_north": (-1.0, 0.5 * math.pi),
    "cw_from_x": (-1.0, 0.0),
    "ccw_from_north": (1.0, 0.5 * math.pi),
}
OPTION = "heading_convention"
SPAN_S = 0.5  # s over which a direction of travel is taken
MOVED_M = 1.0  # m in that time; slower road users have none
ENOUGH = 20  # directions of travel by which a convention is judged
FITS = math.radians(20.0)  # rad from the direction of travel, in the median
FITS_WELL = math.radians(8.0)  # rad; what another convention than the usual has to
SURE = math.radians(3.0)  # rad; nearer than this the usual convention is kept


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeadingForm:
    """How a file's headings become radians counter-clockwise from +x."""

    name: str = "ccw_from_x"
    unit: str = "rad"
    note: str = ""

    def radians(self, headings: np.ndarray) -> np.ndarray:
        """Headings [n] of the file in radians, counter-clockwise from +x."""
        sign, zero = CONVENTIONS[self.name]
        return sign * UNITS[self.unit] * headings + zero


def declared(spec: AnyMapping) -> str:
    """The option `heading_convention`; "": recognised."""
    name = spec.get(OPTION, "")
    if name and name not in CONVENTIONS:
        raise InputError(
            f"source TOML: {OPTION}: {name}: expected one of {', '.join(CONVENTIONS)}"
        )
    return name


def recognised_form(
    path: Path,
    values: AnyMapping[str, np.ndarray],
    unit: str,
    spec: AnyMapping,
    rate_hz: float,
) -> HeadingForm | None:
    """The form of a file's headings by some of its rows; None: they are too few.

    Args:
      path: named in errors.
      values: id, t [s], x, y [m], heading as in the file, [n] each.
      unit: rad or deg; "": whichever fits.
      spec: source TOML.
      rate_hz: rows per second of a road user.

    Raises:
      InputError: no convention, or not the declared one, agrees with the positions.
    """
    said = declared(spec)
    travel, headings = directions(values, rate_hz)
    if travel.size < ENOUGH:
        return None
    names = [said] if said else list(CONVENTIONS)
    units = [unit] if unit else ["deg"] if _is_large(headings) else ["rad", "deg"]
    apart = {
        (name, one): _apart(HeadingForm(name=name, unit=one), headings, travel)
        for one, name in itertools.product(units, names)
    }
    usual = next(iter(apart))
    best = min(apart, key=lambda form: apart[form])
    if apart[usual] <= max(SURE, 2.0 * apart[best]) or apart[best] > FITS_WELL:
        best = usual
    if apart[best] > FITS:
        raise InputError(_contradiction(path, apart[best], headings, travel))
    note = (
        f"headings read as {best[0]} in {best[1]}, which fits the direction of travel"
    )
    is_usual = best[0] == (said or "ccw_from_x") and best[1] == (unit or "rad")
    return HeadingForm(name=best[0], unit=best[1], note="" if is_usual else note)


def unjudged_form(headings: np.ndarray, unit: str, spec: AnyMapping) -> HeadingForm:
    """The form where too few road users move: as declared, else the usual one."""
    by_size = "deg" if _is_large(headings[np.isfinite(headings)]) else "rad"
    return HeadingForm(name=declared(spec) or "ccw_from_x", unit=unit or by_size)


def _is_large(headings: np.ndarray) -> bool:
    """Whether angles are too large for radians of one turn."""
    return bool(headings.size) and bool(np.max(np.abs(headings)) > 2.0 * math.pi + 0.1)


def _apart(form: HeadingForm, headings: np.ndarray, travel: np.ndarray) -> float:
    """Median angle [rad] between headings and directions of travel."""
    turn = form.radians(headings) - travel
    return float(np.median(np.abs(np.angle(np.exp(1j * turn)))))


def _contradiction(
    path: Path, apart: float, headings: np.ndarray, travel: np.ndarray
) -> str:
    """What is wrong with the headings, and what would be right, if anything."""
    units = ("deg",) if _is_large(headings) else ("rad", "deg")
    forms = [
        HeadingForm(name=name, unit=unit)
        for unit, name in itertools.product(units, CONVENTIONS)
    ]
    found = {form: _apart(form, headings, travel) for form in forms}
    best = min(forms, key=lambda form: found[form])
    hint = "leave columns.heading out to take the direction of travel"
    if found[best] <= FITS_WELL:
        hint = f'{OPTION} = "{best.name}" with units.heading = "{best.unit}" fits'
    return (
        f"{path}: heading: {math.degrees(apart):.0f} degrees from the direction of "
        f"travel in the median: expected up to {math.degrees(FITS):.0f}; {hint}"
    )


def directions(
    values: AnyMapping[str, np.ndarray], rate_hz: float
) -> tuple[np.ndarray, np.ndarray]:
    """Directions of travel [m] rad over half a second, and the headings amid them."""
    codes = np.unique(values["id"], return_inverse=True)[1]
    order = np.lexsort((values["t"], codes))
    t, x, y, heading = (values[name][order] for name in ("t", "x", "y", "heading"))
    step = max(round(SPAN_S * rate_hz), 1)
    if t.size <= step:
        return np.zeros(0), np.zeros(0)
    dx, dy, dt = (v[step:] - v[:-step] for v in (x, y, t))
    same = codes[order][step:] == codes[order][:-step]
    middle = heading[step // 2 : step // 2 + dx.size]
    moving = same & (np.hypot(dx, dy) > MOVED_M) & (dt < 4.0 * SPAN_S)
    used = moving & np.isfinite(middle)
    return np.arctan2(dy[used], dx[used]), middle[used]
