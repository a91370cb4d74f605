"""How a reward's value follows each feature: response curves in physical units.

    R_i(u) = mean over scenes of V(x with x_ti = u at all t), minus its value at the
             median of what people drove, over the standard deviation of V among the
             candidates of a scene

x are the features of held-out humans. A reward's scale is free, so the unit is the
spread among candidates: what one more standard deviation is worth.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes

from rcirl_jax.export.reader import Reward
from rcirl_jax.report.charts import LOOKS, style_of
from rcirl_jax.report.style import CANDIDATE, figure, svg
from rcirl_jax.report.tuning.contributions import Contributions

POINTS = 33  # of a curve
BINS = 24  # of the density
SCENES = 24  # of the contributions' that curves are the mean of
OUTER = (0.005, 0.995)  # quantiles of the data between which curves are drawn
COLUMNS = 4  # panels beside each other
PANEL = 2.7, 1.8  # inches


@dataclasses.dataclass(frozen=True, kw_only=True)
class Response:
    """One feature's curve for one reward."""

    at: np.ndarray  # [POINTS] in the feature's unit
    value: np.ndarray  # [POINTS] in standard deviations of V among candidates
    supported: tuple[float, float]  # outside, the reward does not change


def responses(
    reward: Reward, mine: np.ndarray, theirs: np.ndarray, valid: np.ndarray
) -> dict[str, Response]:
    """Curves of all features that the reward uses.

    Args:
      reward: V is its `value`, also where it is anchored.
      mine: [S, T, F] raw features of humans.
      theirs: [S, K, T, F] of candidates of the same scenes.
      valid: [S, T] bool; elsewhere features do not count.
    """
    few = slice(None, None, max(len(mine) // SCENES, 1))
    spread = float(np.mean(np.std(reward.value(theirs, valid[:, None]), axis=1)))
    human, mask = mine[few], valid[few]
    found = {}
    for i, name in enumerate(reward.names):
        if reward.lower[i] >= reward.upper[i]:
            continue
        seen = (
            mine[..., i][valid],
            theirs[..., i][np.broadcast_to(valid[:, None], theirs.shape[:-1])],
        )
        low, high = np.quantile(np.concatenate(seen), OUTER)
        low, high = min(low, reward.lower[i]), max(high, reward.upper[i])
        low, high = np.clip((low, high), *_around(reward, i))
        at = np.linspace(low, high, POINTS)
        held = np.repeat(human[None], POINTS + 1, axis=0)
        held[..., i] = np.append(at, np.median(seen[0]))[:, None, None]
        values = np.mean(reward.value(held, mask), axis=1)
        found[name] = Response(
            at=at,
            value=(values[:-1] - values[-1]) / max(spread, 1e-9),
            supported=(float(reward.lower[i]), float(reward.upper[i])),
        )
    return found


def _around(reward: Reward, i: int) -> tuple[float, float]:
    """A feature's range in training, and a quarter of it more on either side."""
    low, high = float(reward.lower[i]), float(reward.upper[i])
    more = 0.25 * (high - low)
    return low - more, high + more


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
        title = f"{row.feature.replace('_', ' ')}, {row.unit}"
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
