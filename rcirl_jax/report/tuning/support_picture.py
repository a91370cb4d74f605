"""The picture of `experiments.paper.data_support`: weights, doubts, reasons."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from rcirl_jax.evaluation.insight.identify import IdentifiabilityReport
from rcirl_jax.report.ranking.intervals import CURVES, LEARNED, RIVAL
from rcirl_jax.report.style import figure, label, save

NUM_REASONS = 12  # features with the largest shares


def support_picture(
    path: Path,
    *,
    weights: IdentifiabilityReport,
    spreads: Mapping[str, np.ndarray],
    error: np.ndarray,
    reasons: Mapping[str, np.ndarray],
) -> Path:
    """PNG of three panels.

    Args:
      path: file to write.
      weights: of the linear reward.
      spreads: name -> [S] m, how far apart choices end.
      error: [S] m, of the choice.
      reasons: feature -> [S] share in the value gap of chosen and nearest.
    """
    made, axes = figure(1, 3, 15.0, 6.4)
    _weights(axes[0, 0], weights)
    _doubts(axes[0, 1], spreads, error)
    _reasons(axes[0, 2], reasons)
    return save(made, path)


def _weights(axis: Axes, weights: IdentifiabilityReport) -> None:
    """Weight per scale of the feature, with intervals; grey if not supported."""
    for place, row in enumerate(weights.features):
        share = row.normalised / row.weight if row.weight else 0.0
        colour = LEARNED if row.supported else RIVAL
        low, high = sorted((row.low * share, row.high * share))
        axis.plot([low, high], [-place, -place], color=colour, lw=2)
        axis.plot([row.normalised], [-place], "o", color=colour, ms=5)
    names = [f"{row.name} ({row.verdict})" for row in weights.features]
    axis.set_yticks(-np.arange(len(names)), names, fontsize=8)
    axis.axvline(0.0, color="black", lw=0.6)
    # a weight that only the ridge bounds would push all others together
    shown = [abs(row.normalised) for row in weights.features if row.identified]
    if shown:
        axis.set_xlim(-1.6 * max(shown), 1.6 * max(shown))
    label(axis, "linear reward: what the data support", "value per scale", "")


def _doubts(axis: Axes, spreads: Mapping[str, np.ndarray], error: np.ndarray) -> None:
    """Spread of the choice against its error."""
    for number, (name, spread) in enumerate(spreads.items()):
        axis.plot(spread, error, "o", ms=3, alpha=0.6, color=CURVES[number], label=name)
    axis.legend(fontsize=8, frameon=False)
    label(axis, "doubt and error", "spread of the chosen end, m", "error, m")


def _reasons(axis: Axes, reasons: Mapping[str, np.ndarray]) -> None:
    """Shares of the features, the largest on top; median and middle half."""
    order = sorted(reasons, key=lambda n: -float(np.abs(reasons[n]).mean()))
    for place, name in enumerate(order[:NUM_REASONS]):
        low, middle, high = np.quantile(reasons[name], [0.25, 0.5, 0.75])
        axis.plot([low, high], [-place, -place], color=LEARNED, lw=3)
        axis.plot([middle], [-place], "o", color=LEARNED, ms=5)
    axis.set_yticks(-np.arange(len(order[:NUM_REASONS])), order[:NUM_REASONS])
    axis.axvline(0.0, color="black", lw=0.6)
    label(axis, "why the chosen, not the nearest to the human", "share of the gap", "")
