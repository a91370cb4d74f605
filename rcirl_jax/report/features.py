"""Pictures of a reward, feature by feature: response curves and shares.

Contributions split V(human) - V(candidate) over features
(`evaluation.attribution`). A reward's scale is free, so contributions
are shares: per scene, the mean over candidates of |sum_t C_ti|, divided by its sum
over the features.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes

from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.attribution import attribute
from rcirl_jax.evaluation.ranking.score import candidates_key
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    Difference,
    Estimate,
    combine_seeds,
    paired_difference,
)
from rcirl_jax.export.loading import (
    own_sampler_of,
    prior_cost_words,
    reward_params,
)
from rcirl_jax.export.reader import Reward
from rcirl_jax.export.responses import OUTER, Response, responses
from rcirl_jax.features import feature_map
from rcirl_jax.report.pages import Table, interval, part
from rcirl_jax.report.style import CANDIDATE, LOOKS, figure, style_of, svg
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.sampling.sampler import as_candidates
from rcirl_jax.train.featurise import human_of
from rcirl_jax.types import Demonstration, Normaliser, RewardParams

NUM_SCENES = 48  # held-out scenes, spread over the split
NUM_CANDIDATES = 8  # per scene, spread over the feasible ones
STEPS = 32  # of the integral
BINS = 24  # of the density
COLUMNS = 4  # panels beside each other
PANEL = 2.7, 1.8  # inches


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contribution:
    """One feature's share of both rewards; None where a reward lacks it."""

    feature: str
    unit: str
    share: Mapping[str, Estimate | None]  # by reward
    difference: Difference | None  # of the first reward minus the second


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contributions:
    """All features, the largest share of the first reward first."""

    rows: tuple[Contribution, ...]
    scenes: int
    vehicles: int
    # by reward: raw features of the humans [S, T, F] and of candidates [S, K, T, F]
    features: Mapping[str, tuple[np.ndarray, np.ndarray]]
    valid: np.ndarray  # [S, T] bool, inside the recorded future


def contributions(
    dataset: Demonstrations, rewards: Mapping[str, Reward]
) -> Contributions:
    """Return shares of every reward's features, on the same scenes and candidates.

    Args:
      dataset: its test split is read.
      rewards: by name; the first one's sampler mode makes the candidates.

    Raises:
      InputError: fewer than two vehicles in the test split.
    """
    index = dataset.indices("test")
    picked = np.linspace(0, index.size - 1, min(NUM_SCENES, index.size))
    index = index[np.unique(picked.astype(int))]
    rows = dataset.read(index)
    if np.unique(np.asarray(rows.vehicle)).size < 2:
        raise InputError("data: split test: 1 vehicle: expected at least 2")
    bootstrap = ClusterBootstrap(np.asarray(rows.vehicle))
    first = next(iter(rewards.values()))
    sampler = own_sampler_of([first], SamplerConfig(mode=first.mode))
    found = {
        name: _shares_of(reward, rows, index, sampler)
        for name, reward in rewards.items()
    }
    units = {
        f: u for r in rewards.values() for f, u in zip(r.names, r.units, strict=True)
    }
    table = []
    for feature, unit in units.items():
        columns = [one[0].get(feature) for one in found.values()]
        difference = None
        if len(columns) > 1 and columns[0] is not None and columns[1] is not None:
            difference = paired_difference(columns[0], columns[1], bootstrap)
        share = {
            name: None if column is None else combine_seeds(column, bootstrap)
            for name, column in zip(found, columns, strict=True)
        }
        row = Contribution(
            feature=feature, unit=unit, share=share, difference=difference
        )
        leading = next(iter(share.values()))
        table.append((0.0 if leading is None else leading.value, row))
    table.sort(key=lambda item: -item[0])
    return Contributions(
        rows=tuple(row for _, row in table),
        scenes=len(index),
        vehicles=bootstrap.num_clusters,
        features={name: one[1:] for name, one in found.items()},
        valid=np.asarray(rows.scene.time_valid),
    )


def _shares_of(
    reward: Reward, rows: Demonstration, index: np.ndarray, sampler: SamplerConfig
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Return feature -> [S] share of the scene's value differences, 0 if none.

    And the features of the humans [S, T, F] and of the candidates [S, K, T, F].
    """
    each = _absolute(reward.preset, sampler, reward.activation)
    found, mine, theirs = jax.tree.map(
        np.asarray, each(reward_params(reward), index.astype(np.int32), rows)
    )
    found = found.astype(np.float64)
    total = found.sum(axis=1, keepdims=True)
    shares = np.divide(found, total, out=np.zeros_like(found), where=total > 0.0)
    return dict(zip(reward.names, shares.T, strict=True)), mine, theirs


@functools.cache
def _absolute(preset: str, sampler: SamplerConfig, activation: str) -> Callable:
    """Return a program: weights, rows [S], scenes [S] -> mean |contribution| [S, F]."""
    features = feature_map(preset)

    def one(
        weights: tuple[RewardParams, Normaliser], row: jax.Array, given: Demonstration
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        scene = given.scene
        candidates = sample(candidates_key(row), scene, sampler)
        order = jnp.argsort(~candidates.feasible, stable=True)
        count = jnp.maximum(jnp.sum(candidates.feasible), 1)
        places = (jnp.arange(NUM_CANDIDATES) + 0.5) * count / NUM_CANDIDATES
        taken = order[places.astype(jnp.int32)]
        both = jax.tree.map(
            lambda many, one: jnp.concatenate([many[taken], one]),
            candidates,
            as_candidates(human_of(given, sampler)),
        )
        made = features.of_candidates(scene, both)
        theirs, mine = made[:-1], made[-1]
        apart = jax.vmap(
            lambda x: attribute(*weights, mine, x, scene.time_valid, activation, STEPS)
        )(theirs)
        return jnp.mean(jnp.abs(jnp.sum(apart, axis=1)), axis=0), mine, theirs

    return jax.jit(
        lambda weights, index, scenes: jax.lax.map(
            lambda item: one(weights, *item), (index, scenes)
        )
    )


def features_view(
    dataset: Demonstrations, rewards: Mapping[str, Reward], incumbent: str
) -> dict:
    """Return curves, shares, and what has no effect.

    Args:
      dataset: its held-out scenes.
      rewards: by name.
      incumbent: named where it is no weights file.
    """
    found = contributions(dataset, rewards)
    notes = []
    for name, reward in rewards.items():
        if reward.unsupported:
            notes.append(
                f"Without effect in the {name}, because they never vary in its "
                f"training data: {', '.join(reward.unsupported)}."
            )
        if said := prior_cost_words(name, reward):
            notes.append(f"{said} The curves show V.")
    if len(rewards) == 1:
        notes.append(
            f"The incumbent, {incumbent}, is no weights file: it has neither gamma nor "
            "these features, so only the drives show what changed."
        )
    silent = [row.feature for row in found.rows if not _counts(row.share)]
    return {
        "notes": notes,
        "curves": response_curves(rewards, found),
        "table": _shares_table(found, list(rewards)),
        "silent": ", ".join(silent),
    }


def _counts(share: Mapping) -> bool:
    return any(one and one.high > 0.0 for one in share.values())


def _shares_table(found: Contributions, names: Sequence[str]) -> Table:
    """Return the mean absolute contribution to V(human) - V(candidate)."""
    heads = ["feature", *names]
    if len(names) > 1:
        heads += [f"{names[0]} minus {names[1]}, points", ""]
    rows = []
    for row in found.rows:
        if not _counts(row.share):
            continue
        cells: list[object] = [row.feature]
        for name in names:
            one = row.share[name]
            cells.append(
                "not a feature of it"
                if one is None
                else interval((one.value, one.low, one.high), 1, 100.0) + " %"
            )
        if len(names) > 1:
            apart, word, said = row.difference, "", ""
            if apart is not None:
                word = "no difference"
                if not apart.low <= 0.0 <= apart.high:
                    word = "counts more" if apart.mean > 0.0 else "counts less"
                values = (apart.mean, apart.low, apart.high)
                said = interval(values, 1, 100.0, signed=True)
            cells += [said, word]
        share = row.share[names[0]]
        rows.append([*cells, part("bar", 0.0 if share is None else share.value)])
    caption = (
        "Share of each feature in the value difference between the human and "
        f"candidates (integrated gradients), {found.scenes} held-out scenes of "
        f"{found.vehicles} vehicles; 95 % intervals over vehicles"
    )
    return Table(caption=caption, heads=[*heads, ""], rows=rows, kind="bars")


def response_curves(rewards: Mapping[str, Reward], found: Contributions) -> Markup:
    """Draw a panel for each feature, in the order of contributions; "" without any."""
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
    """Draw the curves of one feature, in grey where the reward does not change."""
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
    """Draw how often people had a value, as steps from the bottom of the panel."""
    low, high = np.quantile(values, OUTER)
    if high <= low:
        return
    counts, edges = np.histogram(np.clip(values, low, high), BINS, (low, high))
    top = 0.7 * limit * counts / max(counts.max(), 1) - limit
    axis.stairs(top, edges, baseline=-limit, fill=True, color=CANDIDATE, alpha=0.6)
