"""Headings of a user's table: in which convention they are, against the positions.

    heading = sign * (heading in the file) + zero

The convention and unit that agree best with the directions of travel are taken, unless
the TOML says them; what contradicts the positions is refused.
"""

import dataclasses
import itertools
import math
from collections.abc import Mapping as AnyMapping
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.options import UNITS
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

    def apart(self, headings: np.ndarray, travel: np.ndarray) -> float:
        """Median angle [rad] between headings and directions of travel."""
        turn = self.radians(headings) - travel
        return float(np.median(np.abs(np.angle(np.exp(1j * turn)))))


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
    possible = ["deg"] if is_large(headings) else ["rad", "deg"]

    def forms(units: Sequence[str], names: Sequence[str]) -> dict[HeadingForm, float]:
        pairs = itertools.product(units, names)
        found = (HeadingForm(name=name, unit=one) for one, name in pairs)
        return {form: form.apart(headings, travel) for form in found}

    apart = forms([unit] if unit else possible, [said] if said else [*CONVENTIONS])
    usual, best = next(iter(apart)), min(apart, key=lambda form: apart[form])
    if apart[usual] <= max(SURE, 2.0 * apart[best]) or apart[best] > FITS_WELL:
        best = usual
    if apart[best] > FITS:
        every = forms(possible, [*CONVENTIONS])
        right = min(every, key=lambda form: every[form])
        hint = "leave columns.heading out to take the direction of travel"
        if every[right] <= FITS_WELL:
            hint = f'{OPTION} = "{right.name}" with units.heading = "{right.unit}" fits'
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


def unjudged_form(headings: np.ndarray, unit: str, spec: AnyMapping) -> HeadingForm:
    """The form where too few road users move: as declared, else the usual one."""
    by_size = "deg" if is_large(headings[np.isfinite(headings)]) else "rad"
    return HeadingForm(name=declared(spec) or "ccw_from_x", unit=unit or by_size)


def is_large(headings: np.ndarray) -> bool:
    """Whether angles are too large for radians of one turn."""
    return bool(headings.size) and bool(np.max(np.abs(headings)) > 2.0 * math.pi + 0.1)


def directions(
    values: AnyMapping[str, np.ndarray], rate_hz: float
) -> tuple[np.ndarray, np.ndarray]:
    """Directions of travel [m] rad over half a second, and the headings amid them."""
    first, middle, last = half_seconds(values, rate_hz)
    dx, dy, dt = (values[name][last] - values[name][first] for name in ("x", "y", "t"))
    headings = values["heading"][middle]
    used = (np.hypot(dx, dy) > MOVED_M) & (dt < 4.0 * SPAN_S) & np.isfinite(headings)
    return np.arctan2(dy[used], dx[used]), headings[used]


def half_seconds(
    values: AnyMapping[str, np.ndarray], rate_hz: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows [m] of one road user each, half a second apart: first, middle and last."""
    codes = np.unique(values["id"], return_inverse=True)[1]
    order = np.lexsort((values["t"], codes))
    step = max(round(SPAN_S * rate_hz), 1)
    first, last = order[:-step], order[step:]
    middle = order[step // 2 : step // 2 + first.size]
    same = codes[first] == codes[last]
    return first[same], middle[same], last[same]
