"""The report of `identify` as text for a terminal."""

import textwrap
from collections.abc import Sequence

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.insight.identify import (
    Direction,
    FeatureWeight,
    IdentifiabilityReport,
)
from rcirl_jax.evaluation.ranking.table import FEW_VEHICLES

MIN_WIDTH = 90  # characters of a printed line


def format_report(report: IdentifiabilityReport, width: int = 100) -> str:
    """The report as aligned plain text, features in their declared order.

    Args:
      report: of `identify`.
      width: characters per line, at least MIN_WIDTH; long names are cut to fit.

    Raises:
      InputError: width too small.
    """
    if width < MIN_WIDTH:
        raise InputError(
            f"format_report: width: {width}: expected at least {MIN_WIDTH}"
        )
    level = f"{100.0 * report.confidence:g} %"
    header = ["feature", "unit", "per unit", f"{level} interval", "VIF", "data"]
    table = [[*header, "verdict"], *(_cells(row) for row in report.features)]
    room = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    room[0] = max(min(room[0], width - sum(room[1:]) - 2 * len(room[1:])), 7)
    lines = [_line(row, room, width) for row in table]
    lines.insert(1, "-" * min(width, max(len(line) for line in lines)))
    above = [line for text in _heading(report) for line in textwrap.wrap(text, width)]
    below = [line for text in _notes(report) for line in textwrap.wrap(text, width)]
    return "\n".join([*above, "", *lines, "", *below]) + "\n"


def _cells(row: FeatureWeight) -> list[str]:
    inflation = row.variance_inflation
    return [
        row.name,
        row.unit,
        f"{row.weight:+.3g}",
        f"[{row.low:+.3g}, {row.high:+.3g}]",
        "-" if inflation is None else f"{inflation:.3g}",
        f"{100.0 * row.resolution:.0f} %",
        row.verdict,
    ]


def _line(cells: Sequence[str], room: Sequence[int], width: int) -> str:
    """Name, unit and verdict to the left, numbers to the right."""
    left = [cell[:wide].ljust(wide) for cell, wide in zip(cells, room, strict=True)]
    right = [cell.rjust(wide) for cell, wide in zip(cells, room, strict=True)]
    return "  ".join([*left[:2], *right[2:6], left[6]]).rstrip()[:width]


def _heading(report: IdentifiabilityReport) -> list[str]:
    supported = sum(row.supported for row in report.features)
    return [
        f"Linear reward: the data support {supported} of {len(report.features)} weights"
        f" ({report.pairs:,} pairs, {report.clusters:,} vehicles, mean loss"
        f" {report.loss:.4f}; without a reward 0.6931).",
        f"Condition number of the curvature: {report.condition_number:.3g}.",
        *(
            f"{'Weakest direction' if i == 0 else 'Next'}: {_combination(direction)}"
            f" (curvature {direction.curvature:.2g}, ridge {report.ridge:g})."
            for i, direction in enumerate(report.weak_directions)
        ),
    ]


def _combination(direction: Direction) -> str:
    """Such as +0.71 speed -0.71 gap."""
    parts = zip(direction.loadings, direction.features, strict=True)
    return " ".join(f"{loading:+.2f} {name}" for loading, name in parts)


def _notes(report: IdentifiabilityReport) -> list[str]:
    notes = [
        "per unit: value per unit of the feature at time weight 1. VIF: variance over"
        " that without correlation with other features. data: share of the weight that"
        " the data decide; where the ridge has a say in it, because features move"
        " together or the human always wins by one, it is not identified. Intervals"
        " hold for one weight at a time; scenes of one vehicle are not taken for"
        " independent."
    ]
    if report.separated:
        notes.append("The human wins every pair: no weight has a size of its own.")
    if report.clusters < FEW_VEHICLES:
        notes.append(
            f"Fewer than {FEW_VEHICLES} vehicles: the intervals are too short."
        )
    return notes
