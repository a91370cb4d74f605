"""A road user of a user's table: its rows, with what they do not say."""

import collections
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.csv.map import LogTable
from rcirl_jax.data.formats.csv.meaning import Meaning
from rcirl_jax.data.formats.options import KINDS, number, section
from rcirl_jax.data.formats.perception import speed_of
from rcirl_jax.data.formats.tracks import spans_of, travel_heading
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Track

# box centre ahead of the recorded position, in box lengths
REFERENCE = {"centre": 0.0, "front": -0.5, "rear": 0.5}
SIZE_M = {"length": 4.5, "width": 1.8}  # m, a car


def track_of(
    name: str, table: LogTable, rows: np.ndarray, spec: dict, meaning: Meaning
) -> Track:
    """A track of some rows of a table; unknown cells are filled.

    Headings and speeds by the positions, sizes and kinds by the road user's other
    rows, else by [defaults].
    """
    values = {field: column[rows] for field, column in table.values.items()}
    t, x, y = values["t"], values["x"], values["y"]
    heading = _filled(values.get("heading"), lambda: travel_heading(t, x, y))
    speed = _filled(values.get("speed"), lambda: speed_of(t, x, y))
    size, is_guessed = _sizes(values, spec)
    reference = spec.get("reference_point", "centre")
    if reference not in REFERENCE:
        raise InputError(
            f"source TOML: reference_point: {reference}: "
            f"expected one of {', '.join(REFERENCE)}"
        )
    ahead = REFERENCE[reference] * size["length"]
    automated = np.zeros(t.size, bool)
    if "automated" in values:
        automated = meaning.automated(values["automated"])
    return Track(
        id=name,
        kind=_kind(table.path, name, values, spec),
        length=size["length"],
        width=size["width"],
        size_assumed=is_guessed,
        t=t,
        x=x + ahead * np.cos(heading),
        y=y + ahead * np.sin(heading),
        heading=heading,
        speed=speed,
        automated=spans_of(t, automated),
    )


def _filled(
    known: np.ndarray | None, otherwise: Callable[[], np.ndarray]
) -> np.ndarray:
    """Values [n] where they are known, else others."""
    if known is None:
        return otherwise()
    unknown = np.isnan(known)
    return np.where(unknown, otherwise(), known) if unknown.any() else known


def _sizes(values: dict[str, np.ndarray], spec: dict) -> tuple[dict[str, float], bool]:
    """Medians of the known lengths and widths [m], and whether any is a default."""
    known = {field: values.get(field, np.zeros(0)) for field in SIZE_M}
    known = {field: sizes[np.isfinite(sizes)] for field, sizes in known.items()}
    usual = section(spec, "defaults")
    size = {
        field: float(np.median(sizes))
        if sizes.size
        else number(usual, field, SIZE_M[field])
        for field, sizes in known.items()
    }
    return size, not all(sizes.size for sizes in known.values())


def _kind(path: Path, name: str, values: dict[str, np.ndarray], spec: dict) -> Kind:
    """The most frequent kind that is known."""
    texts = values.get("kind", np.zeros(1, str))
    found = str(texts[0])
    if np.any(texts != found):
        known = collections.Counter(texts[texts != ""].tolist())
        found = known.most_common(1)[0][0]
    found = found or str(section(spec, "defaults").get("kind", ""))
    kind = str(section(spec, "kinds").get(found, found or "vehicle")).lower()
    if kind not in KINDS:
        raise InputError(
            f"{path}: id {name}: kind: {found}: expected one of {', '.join(KINDS)}, "
            "or an entry in [kinds]"
        )
    return Kind[kind.upper()]
