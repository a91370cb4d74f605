"""Charts: rows of a forest plot, intervals of tables, curves, sweeps.

Curves of pages are drawn by matplotlib and stand in the page as SVG, black in the
colour of the text, so that they follow a dark page; a forest plot's rows use
percentages, so that they stretch with their table. What tells two things apart is
never colour alone.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from rcirl_jax.evaluation.closed_loop.dial import MEASURES
from rcirl_jax.evaluation.closed_loop.summary import SHORT, SuiteReport
from rcirl_jax.evaluation.ranking.report import BASELINE_ROWS, RankingReport
from rcirl_jax.report.pages import number, part
from rcirl_jax.report.style import (
    CHOSEN,
    CLASS_COLOURS,
    LOOKS,
    figure,
    label,
    save,
    style_of,
    svg,
)
from rcirl_jax.simulation.metrics import COLUMNS
from rcirl_jax.simulation.rows import KNOWN_BASELINES

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
NOT_LEARNED = {*BASELINE_ROWS, *KNOWN_BASELINES}
PANELS = {
    "top1_fde": ("distance of the chosen at the horizon", "m, lower is better"),
    "top3_fde": ("best of the three highest", "m, lower is better"),
    "percentile_rank": ("rank of the human's curve", "share below, higher is better"),
}
# rates of a sweep
AXES = {"leaky_rate": "leaky rate a", "learning_rate": "step size"}
WIDTH, HEIGHT = 5.5, 4.2  # inches of one panel

Interval = tuple[float, float, float]  # value, low, high


def _place(value: float, limit: float) -> str:
    """Return the percent of the width at which a value in -limit .. limit lies."""
    return f"{50.0 + 48.0 * max(-1.0, min(1.0, value / limit)):.2f}"


def forest_cell(
    found: Interval,
    *,
    limit: float,
    margin: float | None,
    failed: bool,
    words: str,
) -> Markup:
    """Draw a row of a forest plot: interval, zero line, and the margin, dashed.

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


def interval_cell(found: Interval, ends: tuple[float, float], words: str) -> Markup:
    """Draw a row of intervals on an axis of their own, without a zero line.

    Args:
      found: a number, and the ends of its interval.
      ends: of the axis.
      words: the row in words.
    """
    middle, half = (ends[0] + ends[1]) / 2.0, max((ends[1] - ends[0]) / 2.0, 1e-12)
    places = (_place(x - middle, half) for x in found)
    return part("forest_cell", *places, None, False, words, False)


def interval_axis(ends: tuple[float, float], digits: int, unit: str) -> Markup:
    """Draw the axis above `interval_cell`s: its two ends."""
    low, high = (number(x, digits) for x in ends)
    return part("forest_axis", low, high, unit, "")


def forest_axis(limit: float, unit: str) -> Markup:
    """Draw the axis above `forest_cell`s: -limit, 0, limit."""
    digits = 0 if limit >= 10 else 1
    low, high = (number(x, digits, signed=True) for x in (-limit, limit))
    return part("forest_axis", low, high, unit)


def time_curves(
    name: str, times: np.ndarray, rows: Mapping[str, np.ndarray], unit: str
) -> Markup:
    """Draw curves over time, one look each.

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


def interval_panel(axis: Axes, rows: Mapping[str, Interval]) -> None:
    """Draw a dot with its interval per row, the first on top, value written out."""
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
    """Draw the main columns of a ranking report, all rows, 95 % intervals."""
    rows = {
        name: {m: (row[m].value, row[m].low, row[m].high) for m in PANELS}
        for name, row in report.rows.items()
    }
    return interval_chart(path, PANELS, rows, 4.5)


def suite_chart(path: Path, report: SuiteReport) -> Path:
    """Draw the closed-loop table per case, all rows, 95 % intervals."""
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
    """Draw metrics (title, unit) side by side, `width` inches each.

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
    """Draw the mean of each curve's runs [R, X] with two standard errors."""
    at = np.asarray(x, float)
    for colour, (name, runs) in zip(itertools.cycle(CURVES), curves.items()):
        runs = np.atleast_2d(np.asarray(runs, float))
        mean = np.nanmean(runs, axis=0)
        axis.plot(at, mean, "o-", color=colour, ms=3, lw=1.6, label=name)
        if runs.shape[0] > 1:
            error = 2.0 * np.nanstd(runs, axis=0, ddof=1) / np.sqrt(runs.shape[0])
            axis.fill_between(
                at, mean - error, mean + error, color=colour, alpha=0.18, lw=0
            )
    axis.legend(fontsize=8, frameon=False)


def dial_picture(settings: Sequence[Mapping]) -> Markup:
    """Draw each measure's difference to the own cost alone, with its interval.

    Args:
      settings: of a run's dial.json.
    """
    made, axes = figure(len(MEASURES) // 2, 2, 6.4, 6.6)
    at = np.arange(len(settings))
    for axis, (name, how) in zip(axes.ravel(), MEASURES.items(), strict=True):
        apart = [one["measures"][name]["minus_own"] for one in settings]
        mean, low, high = (
            np.array([x[end] for x in apart], float) for end in ("mean", "low", "high")
        )
        axis.axhline(0.0, color=BASELINE, lw=1.0, dashes=(3, 3))
        axis.vlines(at, low, high, color="#000000", lw=2.0)
        axis.plot(at, mean, "o-", color="#000000", lw=1.0, ms=5)
        axis.set_xticks(at, [f"{one['dial']:g}" for one in settings])
        if not np.any(low) and not np.any(high):  # the same in every case
            axis.set_ylim(-1.0, 1.0)
        better = "↑" if how.better == "higher" else "↓"
        label(axis, f"{how.title} {better}", "dial", how.unit)
    return svg(made, "dial")


def sweep_picture(path: Path, report: Mapping) -> Path:
    """Draw a sweep: mean over seeds with two standard errors, a line per network.

    Along the leaky rate, one panel per step size; along the step size where there is
    one leaky rate. The chosen configuration is ringed. A search is drawn as dots, a
    panel for each rate that was searched.

    Args:
      path: PNG to write.
      report: of a sweep, contents of sweep.json.
    """
    rows, how = list(report["configurations"].values()), report["choose_by"]
    chosen = report["configurations"][report["chosen"]["configuration"]]
    better = "higher" if how["higher_is_better"] else "lower"
    metric = f"{how['title']}, {how['unit']}, {better} is better"
    shapes = list(dict.fromkeys(row["hidden"] for row in rows))

    def seeds(row: Mapping) -> list[float]:
        scale = 100.0 if how["unit"] == "%" else 1.0
        values = (report["members"][m]["validation"] for m in row["members"])
        return [scale * value[how["metric"]] for value in values]

    def network(shape: str) -> str:
        return shape if shape == "linear" else f"{shape} hidden"

    def ring(axis: Axes, x: str) -> None:
        at = [chosen[x]], [float(np.mean(seeds(chosen)))]
        axis.plot(*at, "o", ms=11, mfc="none", mec=CHOSEN, mew=1.6)

    of = {name: sorted({row[name] for row in rows}) for name in AXES}
    if report.get("search") == "optuna":
        searched = [name for name in AXES if len(of[name]) > 1] or ["learning_rate"]
        made, axes = figure(1, len(searched), WIDTH * len(searched), HEIGHT)
        for axis, x in zip(axes[0], searched, strict=True):
            for colour, shape in zip(itertools.cycle(CURVES), shapes):
                some = [row for row in rows if row["hidden"] == shape]
                means = [float(np.mean(seeds(row))) for row in some]
                dots = [row[x] for row in some], means
                axis.plot(*dots, "o", color=colour, ms=5, label=network(shape))
            label(axis, "validation, mean over seeds", AXES[x], metric)
            ring(axis, x)
            axis.set_xscale("log")
            axis.legend(fontsize=8, frameon=False)
        return save(made, path)
    one_rate = len(of["leaky_rate"]) == 1 and len(of["learning_rate"]) > 1
    x, other = sorted(AXES, key=lambda n: n == "leaky_rate", reverse=not one_rate)
    made, axes = figure(1, len(of[other]), WIDTH * len(of[other]), HEIGHT)
    for axis, at in zip(axes[0], of[other], strict=True):
        curves = {}
        for shape in shapes:
            some = [r for r in rows if r[other] == at and r["hidden"] == shape]
            by_x = {row[x]: seeds(row) for row in some}
            if by_x:
                curves[network(shape)] = np.array([by_x[value] for value in of[x]]).T
        curves_panel(axis, np.asarray(of[x]), curves)
        if chosen[other] == at:
            ring(axis, x)
        axis.set_xscale("log")
        axis.set_xticks(of[x], [f"{value:g}" for value in of[x]], minor=False)
        axis.minorticks_off()
        label(axis, f"validation, {AXES[other]} {at:g}", AXES[x], metric)
        axis.sharey(axes[0, 0])
    return save(made, path)
