"""What the rows of a file say about how they are meant, found once for all of them."""

import dataclasses
from collections.abc import Iterable
from collections.abc import Mapping as AnyMapping
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.csv.flags import flags_of
from rcirl_jax.data.formats.csv.heading import (
    HeadingForm,
    recognised_form,
    unjudged_form,
)
from rcirl_jax.data.formats.csv.mapping import Mapping
from rcirl_jax.errors import InputError

MOVING_MPS = 0.5  # m/s; the direction of a slower velocity is noise


@dataclasses.dataclass(frozen=True, kw_only=True)
class Meaning:
    """How headings, velocities and flags of a file are read."""

    form: HeadingForm | None = None  # None: no headings, or not to be believed
    flags: AnyMapping[str, bool] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def applied(self, values: AnyMapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Rows with speed, and heading in radians counter-clockwise from +x."""
        made = {**with_velocity(values)}
        if "heading" in made and self.form is None:
            del made["heading"]
        elif self.form is not None and "heading" in made:
            made["heading"] = self.form.radians(made["heading"])
        return made

    def automated(self, texts: np.ndarray) -> np.ndarray:
        """Whether an automation drives [n], by the texts of its column."""
        names, codes = np.unique(texts, return_inverse=True)
        return np.array([self.flags[name] for name in names.tolist()], bool)[codes]


def with_velocity(values: AnyMapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Rows whose vx and vy stand for the speed and the heading that they lack."""
    if "vx" not in values or "vy" not in values:
        return dict(values)
    speed = np.hypot(values["vx"], values["vy"])
    way = np.where(speed > MOVING_MPS, np.arctan2(values["vy"], values["vx"]), np.nan)
    return {"speed": speed, "heading": way, **values}


def meaning_of(
    path: Path,
    rows: Iterable[AnyMapping[str, np.ndarray]],
    automated: Iterable[str],
    mapping: Mapping,
    spec: AnyMapping,
) -> Meaning:
    """The meaning of a file.

    Args:
      path: named in errors.
      rows: in portions, x and y in metres; no more are taken than are needed.
      automated: all that the column of this field holds.
      mapping: of the file's columns.
      spec: source TOML.

    Raises:
      InputError: headings that contradict the positions, a flag neither yes nor no.
    """
    flags = flags_of(path, automated, spec)
    names = {field.name for field in mapping.fields}
    if "heading" in names:
        form = _form(path, rows, mapping.heading_unit, mapping, spec)
        return Meaning(form=form, flags=flags, notes=(form.note,) if form.note else ())
    if {"vx", "vy"} <= names:
        try:
            form = _form(path, map(with_velocity, rows), "rad", mapping, VELOCITY)
        except InputError:
            note = "vx, vy contradict the direction of travel; headings by positions"
            return Meaning(flags=flags, notes=(note,))
        return Meaning(form=form, flags=flags)
    return Meaning(flags=flags)


VELOCITY = {"heading_convention": "ccw_from_x"}  # of vx and vy, in the frame of x, y


def _form(
    path: Path,
    rows: Iterable[AnyMapping[str, np.ndarray]],
    unit: str,
    mapping: Mapping,
    spec: AnyMapping,
) -> HeadingForm:
    """By the first rows in which enough move; else as declared, or as usual."""
    first: np.ndarray | None = None
    for values in rows:
        found = recognised_form(path, values, unit, spec, mapping.rate_hz)
        if found is not None:
            return found
        if first is None:
            first = values["heading"]
    return unjudged_form(np.zeros(0) if first is None else first, unit, spec)
