"""What each feature contributes to a reward on held-out scenes.

Contributions split V(human) - V(candidate) over features
(`evaluation.attribution`). A reward's scale is free, so contributions
are shares: per scene, the mean over candidates of |sum_t C_ti|, divided by its sum
over the features.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store.joined import Demonstrations
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
from rcirl_jax.export.loading import reward_params
from rcirl_jax.export.reader import Reward
from rcirl_jax.features import feature_map
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.train.featurise import human_of
from rcirl_jax.types import Demonstration, Normaliser, RewardParams

NUM_SCENES = 48  # held-out scenes, spread over the split
NUM_CANDIDATES = 8  # per scene, spread over the feasible ones
STEPS = 32  # of the integral


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
    """Shares of every reward's features on the same scenes and candidates.

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
    sampler = SamplerConfig(mode=str(first.provenance.get("mode", "speed")))
    found = {
        name: _shares(reward, rows, index, sampler) for name, reward in rewards.items()
    }
    shares = {name: one[0] for name, one in found.items()}
    units = {
        f: u for r in rewards.values() for f, u in zip(r.names, r.units, strict=True)
    }
    table = [_row(name, unit, shares, bootstrap) for name, unit in units.items()]
    leading = next(iter(rewards))

    def size(row: Contribution) -> float:
        share = row.share[leading]
        return 0.0 if share is None else share.value

    return Contributions(
        rows=tuple(sorted(table, key=lambda row: -size(row))),
        scenes=len(index),
        vehicles=bootstrap.num_clusters,
        features={name: one[1:] for name, one in found.items()},
        valid=np.asarray(rows.scene.time_valid),
    )


def _row(
    feature: str,
    unit: str,
    shares: Mapping[str, Mapping[str, np.ndarray]],
    bootstrap: ClusterBootstrap,
) -> Contribution:
    columns = [table.get(feature) for table in shares.values()]
    difference = None
    if len(columns) > 1 and columns[0] is not None and columns[1] is not None:
        difference = paired_difference(columns[0], columns[1], bootstrap)
    return Contribution(
        feature=feature,
        unit=unit,
        share={
            name: None if column is None else combine_seeds(column, bootstrap)
            for name, column in zip(shares, columns, strict=True)
        },
        difference=difference,
    )


def _shares(
    reward: Reward, rows: Demonstration, index: np.ndarray, sampler: SamplerConfig
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Feature -> [S] share of the scene's value differences; 0 where there are none.

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
    """(weights, rows [S], scenes [S]) -> mean |contribution| [S, F], and features."""
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
        chosen = jax.tree.map(lambda x: x[taken], candidates)
        mine = features(scene, human_of(given, sampler))
        theirs = features.of_candidates(scene, chosen)
        apart = jax.vmap(
            lambda x: attribute(*weights, mine, x, scene.time_valid, activation, STEPS)
        )(theirs)
        return jnp.mean(jnp.abs(jnp.sum(apart, axis=1)), axis=0), mine, theirs

    return jax.jit(
        lambda weights, index, scenes: jax.lax.map(
            lambda item: one(weights, *item), (index, scenes)
        )
    )
