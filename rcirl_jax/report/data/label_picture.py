"""Precision and recall of the labels, with their intervals."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rcirl_jax.evaluation.labels.scores import ClassScore
from rcirl_jax.report.ranking.intervals import Interval, interval_panel
from rcirl_jax.report.style import figure, label, save

ROW_INCH = 0.25  # height of one class


def label_chart(path: Path, tables: Mapping[str, Sequence[ClassScore]]) -> Path:
    """PNG: one row of panels per table, precision beside recall, in percent.

    Args:
      path: of the PNG.
      tables: scores by the table's title.
    """
    rows = max(len(scores) for scores in tables.values())
    height = len(tables) * (1.0 + ROW_INCH * rows)
    made, axes = figure(len(tables), 2, 11.0, height)
    for (title, scores), pair in zip(tables.items(), axes, strict=True):
        for axis, what in zip(pair, ("precision", "recall"), strict=True):
            found = {s.name: getattr(s, what)() for s in scores}
            shown = {
                name: _percent(rate) for name, rate in found.items() if rate is not None
            }
            interval_panel(axis, shown)
            axis.set_xlim(-3.0, 106.0)
            label(axis, f"{title}: {what}", "%, 95 % interval", "")
    return save(made, path)


def _percent(rate: Interval) -> Interval:
    value, low, high = rate
    return 100.0 * value, 100.0 * low, 100.0 * high
