"""The picture of a sweep: held-out metric against the leaky rate or the step size."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from rcirl_jax.report.ranking.intervals import curves_panel
from rcirl_jax.report.style import CHOSEN, figure, label, save

AXES = {"leaky_rate": "leaky rate a", "learning_rate": "step size"}
WIDTH, HEIGHT = 5.5, 4.2  # inches of one panel


def sweep_picture(path: Path, report: Mapping) -> Path:
    """PNG: mean over seeds with a band of two standard errors, a line per network.

    Along the leaky rate, one panel per step size; along the step size where there is
    one leaky rate. The chosen configuration is ringed.

    Args:
      path: file to write.
      report: of `export.sweep.run.run_sweep`.
    """
    rows = list(report["configurations"].values())
    of = {name: sorted({row[name] for row in rows}) for name in AXES}
    one_rate = len(of["leaky_rate"]) == 1 and len(of["learning_rate"]) > 1
    x, other = sorted(AXES, key=lambda n: n == "leaky_rate", reverse=not one_rate)
    made, axes = figure(1, len(of[other]), WIDTH * len(of[other]), HEIGHT)
    how = report["choose_by"]
    better = "higher" if how["higher_is_better"] else "lower"
    for axis, at in zip(axes[0], of[other], strict=True):
        _panel(axis, report, x, of[x], [row for row in rows if row[other] == at])
        title = f"validation, {AXES[other]} {at:g}"
        label(
            axis, title, AXES[x], f"{how['title']}, {how['unit']}, {better} is better"
        )
        axis.sharey(axes[0, 0])
    return save(made, path)


def _panel(
    axis: Axes, report: Mapping, x: str, values: Sequence[float], rows: list[Mapping]
) -> None:
    """Curves of all networks over the values of x."""
    metric, members = report["choose_by"]["metric"], report["members"]
    scale = 100.0 if report["choose_by"]["unit"] == "%" else 1.0

    def seeds(row: Mapping) -> list[float]:
        return [scale * members[m]["validation"][metric] for m in row["members"]]

    curves = {}
    for shape in dict.fromkeys(row["hidden"] for row in rows):
        at = {row[x]: seeds(row) for row in rows if row["hidden"] == shape}
        name = shape if shape == "linear" else f"{shape} hidden"
        curves[name] = np.array([at[value] for value in values]).T
    curves_panel(axis, np.asarray(values), curves)
    chosen = report["configurations"][report["chosen"]["configuration"]]
    if chosen in rows:
        mean = float(np.mean(seeds(chosen)))
        axis.plot([chosen[x]], [mean], "o", ms=11, mfc="none", mec=CHOSEN, mew=1.6)
    axis.set_xscale("log")
    axis.set_xticks(list(values), [f"{value:g}" for value in values], minor=False)
    axis.minorticks_off()
