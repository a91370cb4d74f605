"""Inline SVG: intervals and bars for the cells of a table, curves over time.

Cells use percentages, so that they stretch while their strokes and text do not;
what tells two things apart is never colour alone.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from rcirl_jax.report.markup import Markup, number, text
from rcirl_jax.report.style import CHOSEN, CLASS_COLOURS, HUMAN

CELL_HEIGHT = 24  # px
WIDE, HIGH = 400, 240  # units of a curve chart
LEFT, RIGHT, TOP, BOTTOM = 44, 8, 10, 34  # units around its axes


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


def _place(value: float, limit: float) -> str:
    """Percent of the width at which a value in -limit .. limit lies."""
    return f"{50.0 + 48.0 * max(-1.0, min(1.0, value / limit)):.2f}%"


def _cell(body: str, words: str) -> Markup:
    return Markup(
        f'<svg class="cell" height="{CELL_HEIGHT}" role="img" '
        f'aria-label="{text(words)}">{body}</svg>'
    )


def interval_cell(
    value: float,
    low: float,
    high: float,
    *,
    limit: float,
    margin: float | None,
    failed: bool,
    words: str,
) -> Markup:
    """A row of a forest plot: interval, zero line, and the margin as a dashed one.

    Args:
      value: difference, with its interval from `low` to `high`.
      low: lower end.
      high: upper end.
      limit: the axis reaches from -limit to limit.
      margin: largest loss that counts as none; None: no line.
      failed: drawn as a square instead of a dot, in the colour of failures.
      words: the row in words.
    """
    middle = CELL_HEIGHT / 2
    parts = [f'<line class="zero" x1="50%" x2="50%" y1="0" y2="{CELL_HEIGHT}"/>']
    if margin is not None and margin <= limit:
        at = _place(-margin, limit)
        parts.append(f'<line class="margin" x1="{at}" x2="{at}" y1="0" y2="24"/>')
    ends, at = (_place(low, limit), _place(high, limit)), _place(value, limit)
    kind = "failed" if failed else "held"
    parts.append(
        f'<line class="{kind}" x1="{ends[0]}" x2="{ends[1]}" '
        f'y1="{middle}" y2="{middle}"/>'
    )
    if failed:
        parts.append(
            f'<svg class="mark" x="{at}" y="{middle}">'
            f'<rect class="{kind}" x="-5" y="-5" width="10" height="10"/></svg>'
        )
    else:
        parts.append(f'<circle class="{kind}" cx="{at}" cy="{middle}" r="4.5"/>')
    return _cell("".join(parts), words)


def interval_axis(limit: float, unit: str) -> Markup:
    """The axis above `interval_cell`s: -limit, 0, limit."""
    digits = 0 if limit >= 10 else 1
    low, high = (number(x, digits, signed=True) for x in (-limit, limit))
    body = (
        f'<text x="2%" y="16">{low}</text>'
        '<text x="50%" y="16" text-anchor="middle">0</text>'
        f'<text x="98%" y="16" text-anchor="end">{high} {text(unit)}</text>'
    )
    return _cell(body, f"axis from {low} to {high} {unit}")


def bars_cell(values: Sequence[float | None], limit: float, words: str) -> Markup:
    """Bars of 0 .. limit below each other, the first filled, the others outlined."""
    high = CELL_HEIGHT / len(values)
    parts = []
    for place, (value, look) in enumerate(zip(values, LOOKS, strict=False)):
        if value is None:
            continue
        fill = look.colour if place == 0 else "none"
        parts.append(
            f'<rect x="0" y="{place * high + 2:g}" height="{high - 4:g}" '
            f'width="{100.0 * value / limit:.2f}%" fill="{fill}" '
            f'stroke="{look.colour}" stroke-width="1.5"/>'
        )
    return _cell("".join(parts), words)


def curves(
    x: np.ndarray, rows: Mapping[str, np.ndarray], title: str, units: tuple[str, str]
) -> str:
    """Curves over x as one SVG with axes and a legend; one look per curve.

    Args:
      x: [X], increasing.
      rows: name -> [X] finite.
      title: in words, for those who do not see it.
      units: labels of both axes.
    """
    table = np.stack([np.asarray(row, np.float64) for row in rows.values()])
    low, high = min(0.0, float(table.min())), max(0.0, float(table.max()))
    span = max(high - low, 1e-12)
    across = lambda v: LEFT + (WIDE - LEFT - RIGHT) * (v - x[0]) / (x[-1] - x[0])  # noqa: E731
    up = lambda v: TOP + (HIGH - TOP - BOTTOM) * (high - v) / span  # noqa: E731
    parts = [
        f'<svg class="curves" viewBox="0 0 {WIDE} {HIGH}" role="img" '
        f'aria-label="{text(title)}">'
    ]
    for level in sorted({low, 0.0, high}):
        y = up(level)
        parts.append(
            f'<line class="grid" x1="{LEFT}" x2="392" y1="{y:.1f}" y2="{y:.1f}"/>'
        )
        parts.append(
            f'<text x="{LEFT - 5}" y="{y + 4:.1f}" text-anchor="end">'
            f"{number(level, 2)}</text>"
        )
    for at in np.linspace(x[0], x[-1], 5):
        parts.append(
            f'<text x="{across(at):.1f}" y="{HIGH - 18}" text-anchor="middle">'
            f"{at:g}</text>"
        )
    parts.append(
        f'<text x="{WIDE / 2}" y="{HIGH - 3}" text-anchor="middle">'
        f"{text(units[0])}</text>"
    )
    for look, row in zip(LOOKS, table, strict=False):
        points = " ".join(
            f"{across(a):.1f},{up(b):.1f}" for a, b in zip(x, row, strict=True)
        )
        parts.append(
            f'<polyline points="{points}" fill="none" stroke="{look.colour}" '
            f'stroke-width="2.2" stroke-dasharray="{_dashes(look)}"/>'
        )
    return "".join([*parts, "</svg>"]) + legend(rows)


def _dashes(look: Look) -> str:
    return " ".join(map(str, look.dash)) or "none"


def legend(names: Mapping[str, object] | Sequence[str]) -> str:
    """Names in the order of `LOOKS`, each with its line."""
    items = []
    for name, look in zip(names, LOOKS, strict=False):
        items.append(
            '<li><svg width="34" height="10" aria-hidden="true"><line x1="0" x2="34" '
            f'y1="5" y2="5" stroke="{look.colour}" stroke-width="3" '
            f'stroke-dasharray="{_dashes(look)}"/></svg> {text(name)}</li>'
        )
    return f'<ul class="legend">{"".join(items)}</ul>'
