"""Response curves as a picture: a panel for each feature."""

from collections.abc import Mapping

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes

from rcirl_jax.export.reader import Reward
from rcirl_jax.export.responses import OUTER, Response, responses
from rcirl_jax.report.charts import LOOKS, style_of
from rcirl_jax.report.style import CANDIDATE, figure, svg
from rcirl_jax.report.tuning.contributions import Contributions

BINS = 24  # of the density
COLUMNS = 4  # panels beside each other
PANEL = 2.7, 1.8  # inches


def response_curves(rewards: Mapping[str, Reward], found: Contributions) -> Markup:
    """A panel for each feature, in the order of the contributions; "" without any."""
    curves = {
        name: responses(reward, *found.features[name], found.valid)
        for name, reward in rewards.items()
    }
    rows = [r for r in found.rows if any(r.feature in one for one in curves.values())]
    if not rows:
        return Markup("")
    count = -(-len(rows) // COLUMNS)
    made, axes = figure(count, COLUMNS, COLUMNS * PANEL[0], count * PANEL[1])
    for axis in axes.ravel()[len(rows) :]:
        axis.set_visible(False)
    limit = 1.1 * max(
        float(np.abs(one.value).max())
        for each in curves.values()
        for one in each.values()
    )
    first = next(iter(rewards))
    names = list(rewards[first].names)
    for axis, row in zip(axes.ravel(), rows, strict=False):
        if row.feature in names:
            mine, _ = found.features[first]
            _density(axis, mine[..., names.index(row.feature)][found.valid], limit)
        _panel(axis, {name: each.get(row.feature) for name, each in curves.items()})
        axis.set_ylim(-limit, limit)
        unit = row.unit.replace("^2", "²").replace("^3", "³")
        title = row.feature.replace("_", " ") + (f", {unit}" if unit != "1" else "")
        axis.set_title(title, fontsize=8, loc="left")
    axes[0, 0].legend(frameon=False, fontsize=7)
    axes[0, 0].set_ylabel("value", fontsize=8)
    return svg(made, "responses")


def _panel(axis: Axes, rows: Mapping[str, Response | None]) -> None:
    """The curves of one feature, and in grey where the reward does not change."""
    for look, (name, one) in zip(LOOKS, rows.items(), strict=False):
        if one is None:
            continue
        axis.plot(one.at, one.value, label=name, linewidth=1.8, **style_of(look))
        low, high = one.supported
        for ends in ((one.at[0], low), (high, one.at[-1])):
            if ends[0] < ends[1]:
                axis.axvspan(*ends, color=CANDIDATE, alpha=0.25, linewidth=0)
    axis.tick_params(labelsize=7)
    axis.axhline(0.0, color="#000000", linewidth=0.6)


def _density(axis: Axes, values: np.ndarray, limit: float) -> None:
    """How often people had a value, as steps from the bottom of the panel."""
    low, high = np.quantile(values, OUTER)
    if high <= low:
        return
    counts, edges = np.histogram(np.clip(values, low, high), BINS, (low, high))
    top = 0.7 * limit * counts / max(counts.max(), 1) - limit
    axis.stairs(top, edges, baseline=-limit, fill=True, color=CANDIDATE, alpha=0.6)
