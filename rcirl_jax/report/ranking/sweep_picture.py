"""The picture of a sweep: held-out metric against the leaky rate or the step size."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from rcirl_jax.report.ranking.intervals import CURVES, curves_panel
from rcirl_jax.report.style import CHOSEN, figure, label, save

AXES = {"leaky_rate": "leaky rate a", "learning_rate": "step size"}
WIDTH, HEIGHT = 5.5, 4.2  # inches of one panel


def sweep_picture(path: Path, report: Mapping) -> Path:
    """PNG: mean over seeds with a band of two standard errors, a line per network.

    Along the leaky rate, one panel per step size; along the step size where there is
    one leaky rate. The chosen configuration is ringed. A search is drawn as dots.

    Args:
      path: file to write.
      report: of `export.sweep.run.run_sweep`.
    """
    rows = list(report["configurations"].values())
    of = {name: sorted({row[name] for row in rows}) for name in AXES}
    if report.get("search") == "optuna":
        return _search_picture(path, report, [n for n in AXES if len(of[n]) > 1])
    one_rate = len(of["leaky_rate"]) == 1 and len(of["learning_rate"]) > 1
    x, other = sorted(AXES, key=lambda n: n == "leaky_rate", reverse=not one_rate)
    made, axes = figure(1, len(of[other]), WIDTH * len(of[other]), HEIGHT)
    for axis, at in zip(axes[0], of[other], strict=True):
        _panel(axis, report, x, of[x], [row for row in rows if row[other] == at])
        title = f"validation, {AXES[other]} {at:g}"
        label(axis, title, AXES[x], _metric(report))
        axis.sharey(axes[0, 0])
    return save(made, path)


def _metric(report: Mapping) -> str:
    """What is chosen by, with its unit."""
    how = report["choose_by"]
    better = "higher" if how["higher_is_better"] else "lower"
    return f"{how['title']}, {how['unit']}, {better} is better"


def _seeds(report: Mapping, row: Mapping) -> list[float]:
    """The values of a configuration's members."""
    metric, members = report["choose_by"]["metric"], report["members"]
    scale = 100.0 if report["choose_by"]["unit"] == "%" else 1.0
    return [scale * members[m]["validation"][metric] for m in row["members"]]


def _ring(axis: Axes, report: Mapping, x: str) -> None:
    """Around the chosen configuration."""
    chosen = report["configurations"][report["chosen"]["configuration"]]
    at = [chosen[x]], [float(np.mean(_seeds(report, chosen)))]
    axis.plot(*at, "o", ms=11, mfc="none", mec=CHOSEN, mew=1.6)


def _search_picture(path: Path, report: Mapping, searched: Sequence[str]) -> Path:
    """A panel for each rate that was searched; a dot is a configuration."""
    names = searched or ["learning_rate"]
    rows = list(report["configurations"].values())
    made, axes = figure(1, len(names), WIDTH * len(names), HEIGHT)
    for axis, x in zip(axes[0], names, strict=True):
        for number, shape in enumerate(dict.fromkeys(row["hidden"] for row in rows)):
            some = [row for row in rows if row["hidden"] == shape]
            means = [float(np.mean(_seeds(report, row))) for row in some]
            colour = CURVES[number % len(CURVES)]
            dots = [row[x] for row in some], means
            axis.plot(*dots, "o", color=colour, ms=5, label=_network(shape))
        label(axis, "validation, mean over seeds", AXES[x], _metric(report))
        _ring(axis, report, x)
        axis.set_xscale("log")
        axis.legend(fontsize=8, frameon=False)
    return save(made, path)


def _network(shape: str) -> str:
    return shape if shape == "linear" else f"{shape} hidden"


def _panel(
    axis: Axes, report: Mapping, x: str, values: Sequence[float], rows: list[Mapping]
) -> None:
    """Curves of all networks over the values of x."""
    curves = {}
    for shape in dict.fromkeys(row["hidden"] for row in rows):
        at = {row[x]: _seeds(report, row) for row in rows if row["hidden"] == shape}
        curves[_network(shape)] = np.array([at[value] for value in values]).T
    curves_panel(axis, np.asarray(values), curves)
    chosen = report["configurations"][report["chosen"]["configuration"]]
    if chosen in rows:
        _ring(axis, report, x)
    axis.set_xscale("log")
    axis.set_xticks(list(values), [f"{value:g}" for value in values], minor=False)
    axis.minorticks_off()
