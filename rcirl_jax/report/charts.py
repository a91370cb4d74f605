"""Charts of pages: rows of a forest plot, curves over time; one look per driver.

Curves are drawn by matplotlib and stand in the page as SVG, black in the colour of the
text, so that they follow a dark page; a forest plot's rows use percentages, so that
they stretch with their table. What tells two things apart is never colour alone.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from markupsafe import Markup

from rcirl_jax.report.pages import number, part
from rcirl_jax.report.style import CHOSEN, CLASS_COLOURS, HUMAN, figure, label, svg


@dataclasses.dataclass(frozen=True, kw_only=True)
class Look:
    """How one driver or reward is drawn everywhere in a page."""

    colour: str
    dash: tuple[int, ...]  # px on, px off; empty: solid


LOOKS = (
    Look(colour=CHOSEN, dash=()),
    Look(colour=CLASS_COLOURS["follow"], dash=(7, 4)),
    Look(colour=CLASS_COLOURS["overtake"], dash=(2, 3)),
    Look(colour=CLASS_COLOURS["virtual"], dash=(9, 3, 2, 3)),
)
HUMAN_LOOK = Look(colour=HUMAN, dash=(2, 2))


def style_of(look: Look) -> dict:
    """The look as matplotlib's arguments."""
    return {"color": look.colour, "linestyle": (0, look.dash) if look.dash else "-"}


def _place(value: float, limit: float) -> str:
    """Percent of the width at which a value in -limit .. limit lies."""
    return f"{50.0 + 48.0 * max(-1.0, min(1.0, value / limit)):.2f}"


def forest_cell(
    found: tuple[float, float, float],
    *,
    limit: float,
    margin: float | None,
    failed: bool,
    words: str,
) -> Markup:
    """A row of a forest plot: interval, zero line, and the margin as a dashed one.

    Args:
      found: difference, and the ends of its interval.
      limit: the axis reaches from -limit to limit.
      margin: largest loss that counts as none; None: no line.
      failed: drawn as a square instead of a dot, in the colour of failures.
      words: the row in words.
    """
    at, low, high = (_place(x, limit) for x in found)
    shown = margin is not None and margin <= limit
    line = _place(-margin, limit) if shown and margin is not None else None
    return part("forest_cell", at, low, high, line, failed, words)


def interval_cell(
    found: tuple[float, float, float], ends: tuple[float, float], words: str
) -> Markup:
    """A row of intervals on an axis of their own, without a zero line.

    Args:
      found: a number, and the ends of its interval.
      ends: of the axis.
      words: the row in words.
    """
    middle, half = (ends[0] + ends[1]) / 2.0, max((ends[1] - ends[0]) / 2.0, 1e-12)
    places = (_place(x - middle, half) for x in found)
    return part("forest_cell", *places, None, False, words, False)


def interval_axis(ends: tuple[float, float], digits: int, unit: str) -> Markup:
    """The axis above `interval_cell`s: its two ends."""
    low, high = (number(x, digits) for x in ends)
    return part("forest_axis", low, high, unit, "")


def forest_axis(limit: float, unit: str) -> Markup:
    """The axis above `forest_cell`s: -limit, 0, limit."""
    digits = 0 if limit >= 10 else 1
    low, high = (number(x, digits, signed=True) for x in (-limit, limit))
    return part("forest_axis", low, high, unit)


def time_curves(
    name: str, times: np.ndarray, rows: Mapping[str, np.ndarray], unit: str
) -> Markup:
    """Curves over time, one look each.

    Args:
      name: of the drawing, part of its ids.
      times: [T] s, increasing.
      rows: label -> [T] finite.
      unit: of the values, with what they are.
    """
    made, axes = figure(1, 1, 5.2, 2.8)
    for look, (label_, row) in zip(LOOKS, rows.items(), strict=False):
        axes[0, 0].plot(times, row, label=label_, linewidth=2.0, **style_of(look))
    label(axes[0, 0], "", "t, s", unit)
    axes[0, 0].legend(frameon=False, fontsize=8)
    return svg(made, name)
