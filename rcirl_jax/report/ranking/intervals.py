"""Charts of numbers with intervals: rows of a table, curves with bands."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from rcirl_jax.evaluation.closed_loop.output import SHORT
from rcirl_jax.evaluation.closed_loop.summary import SuiteReport
from rcirl_jax.evaluation.ranking.table import BASELINE_ROWS, RankingReport
from rcirl_jax.report.style import CLASS_COLOURS, figure, label, save
from rcirl_jax.simulation.metrics import COLUMNS
from rcirl_jax.simulation.rows import BASELINES

LEARNED = CLASS_COLOURS["follow"]
BASELINE = "#777777"
CURVES = (
    CLASS_COLOURS["follow"],
    "#D55E00",
    CLASS_COLOURS["overtake"],
    CLASS_COLOURS["virtual"],
    CLASS_COLOURS["nudge"],
    "#000000",
    CLASS_COLOURS["other"],
    "#777777",
)
NOT_LEARNED = {*BASELINE_ROWS, *BASELINES}
PANELS = {
    "top1_fde": ("distance of the chosen at the horizon", "m, lower is better"),
    "top3_fde": ("best of the three highest", "m, lower is better"),
    "percentile_rank": ("rank of the human's curve", "share below, higher is better"),
}

Interval = tuple[float, float, float]  # value, low, high


def interval_panel(axis: Axes, rows: Mapping[str, Interval]) -> None:
    """One dot with its interval per row, first row on top, value written out."""
    for place, (name, (value, low, high)) in enumerate(rows.items()):
        colour = BASELINE if name in NOT_LEARNED else LEARNED
        axis.plot([low, high], [-place, -place], color=colour, lw=2)
        axis.plot([value], [-place], "o", color=colour, ms=5)
        axis.annotate(
            f"{value:.3g}", (value, -place), (0, 4), textcoords="offset points",
            fontsize=7, ha="center",
        )  # fmt: skip
    axis.set_yticks(-np.arange(len(rows)), list(rows))
    axis.set_ylim(-len(rows) + 0.4, 0.7)


def ranking_chart(path: Path, report: RankingReport) -> Path:
    """PNG of the main columns of a ranking report, all rows, 95 % intervals."""
    rows = {
        name: {m: (row[m].value, row[m].low, row[m].high) for m in PANELS}
        for name, row in report.rows.items()
    }
    return interval_chart(path, PANELS, rows, 4.5)


def suite_chart(path: Path, report: SuiteReport) -> Path:
    """PNG of the closed-loop table per case, all rows, 95 % intervals."""
    panels = {name: (SHORT[name], "% of cases") for name in COLUMNS}
    panels["nuplan"] = ("nuPlan score", "of 100, higher is better")

    def percent(value: float, low: float, high: float) -> Interval:
        return 100 * value, 100 * low, 100 * high

    rows = {
        name: {
            **{m: percent(x.rate, x.low, x.high) for m, x in row.per_case.items()},
            "nuplan": percent(row.nuplan, row.nuplan_low, row.nuplan_high),
        }
        for name, row in report.rows.items()
    }
    return interval_chart(path, panels, rows, 2.9)


def interval_chart(
    path: Path,
    panels: Mapping[str, tuple[str, str]],
    rows: Mapping[str, Mapping[str, Interval]],
    width: float,
) -> Path:
    """PNG of metrics (title, unit) side by side, `width` inches each.

    Every row has every metric as (value, low, high); the rows are named once.
    """
    made, axes = figure(1, len(panels), width * len(panels), 1.2 + 0.34 * len(rows))
    for axis, (metric, (title, unit)) in zip(axes[0], panels.items(), strict=True):
        interval_panel(axis, {name: row[metric] for name, row in rows.items()})
        label(axis, title, unit, "")
        if axis is not axes[0, 0]:
            axis.set_yticklabels([])
    return save(made, path)


def curves_panel(axis: Axes, x: ArrayLike, curves: Mapping[str, np.ndarray]) -> None:
    """Mean of each curve's runs [R, X] with a band of two standard errors."""
    at = np.asarray(x, float)
    for number, (name, runs) in enumerate(curves.items()):
        colour = CURVES[number % len(CURVES)]
        runs = np.atleast_2d(np.asarray(runs, float))
        mean = np.nanmean(runs, axis=0)
        axis.plot(at, mean, "o-", color=colour, ms=3, lw=1.6, label=name)
        if runs.shape[0] > 1:
            error = 2.0 * np.nanstd(runs, axis=0, ddof=1) / np.sqrt(runs.shape[0])
            axis.fill_between(
                at, mean - error, mean + error, color=colour, alpha=0.18, lw=0
            )
    axis.legend(fontsize=8, frameon=False)
