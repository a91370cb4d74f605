"""A learned score behind the out-of-distribution check of docs/guard.md.

The rule of `export/guard.py`, compiled: where a plan's features leave what the reward
was trained on, all its candidates are valued by the incumbent's score instead.
"""

import functools

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.rank import Params, Score
from rcirl_jax.reward.fast import rows_value
from rcirl_jax.types import Candidates, Normaliser, RewardParams, Scene


class Ranges(flax.struct.PyTreeNode, kw_only=True):
    """What the training saw of every feature: `export.guard.bounds`."""

    low: jax.Array  # [F] in the feature's unit; may be -inf
    high: jax.Array  # [F]; may be +inf


class Guarded(flax.struct.PyTreeNode, kw_only=True):
    """Weights of a guarded score."""

    reward: RewardParams  # effective
    normaliser: Normaliser
    ranges: Ranges
    share: jax.Array  # [] largest share of a feature's entries outside
    incumbent: Params  # the other score's weights


def worst_share(ranges: Ranges, rows: jax.Array, counts: jax.Array) -> jax.Array:
    """Largest share of a feature's entries outside the training's: max_i share_i.

        share_i = share of the raw entries of feature i outside [low_i, high_i]

    Args:
      ranges: of every feature.
      rows: [F, T, K] raw features of the plan's candidates.
      counts: [T, K] bool, valid times of feasible candidates.

    Returns:
      [] in [0, 1]; inf where nothing counts, or something that does is not finite.
    """
    low, high = (side[:, None, None] for side in (ranges.low, ranges.high))
    inside = (rows >= low) & (rows <= high)
    outside = jnp.sum(~inside & counts, axis=(1, 2))
    share = jnp.max(outside / jnp.maximum(jnp.sum(counts), 1))
    known = jnp.any(counts) & ~jnp.any(~jnp.isfinite(rows) & counts)
    return jnp.where(known, share, jnp.inf)


@functools.lru_cache(maxsize=16)
def guarded_score(features: FeatureMap, activation: str, incumbent: Score) -> Score:
    """Score of `Guarded`: the reward's V, or the incumbent's out of distribution."""

    def score(params: Guarded, scene: Scene, candidates: Candidates) -> jax.Array:
        rows, valid = features.rows(scene, candidates), scene.time_valid
        values = rows_value(params.reward, params.normaliser, rows, valid, activation)
        counts = valid[:, None] & candidates.feasible
        fine = worst_share(params.ranges, jnp.stack(rows), counts) <= params.share
        other = incumbent(params.incumbent, scene, candidates)
        return jnp.where(fine, values, other)

    return score
