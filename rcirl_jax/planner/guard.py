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
from rcirl_jax.reward.network import rows_value
from rcirl_jax.types import Candidates, Normaliser, RewardParams, Scene


class Guarded(flax.struct.PyTreeNode, kw_only=True):
    """Weights of a guarded score."""

    reward: RewardParams  # effective
    normaliser: Normaliser
    low: jax.Array  # [F] of `export.guard.bounds`, in the feature's unit; may be -inf
    high: jax.Array  # [F]; may be +inf
    share: jax.Array  # [] largest share of a feature's entries outside
    incumbent: Params  # the other score's weights


def in_distribution(params: Guarded, rows: jax.Array, counts: jax.Array) -> jax.Array:
    """Whether a plan is like what the reward was trained on.

        share_i = share of the raw entries of feature i outside [low_i, high_i]

    in distribution: no share above the limit, every entry finite.

    Args:
      params: ranges and limit.
      rows: [F, T, K] raw features of its candidates.
      counts: [T, K] bool, valid times of feasible candidates.

    Returns:
      [] bool; False where nothing counts, or something that does is not finite.
    """
    low, high = (side[:, None, None] for side in (params.low, params.high))
    inside = (rows >= low) & (rows <= high)
    outside = jnp.sum(~inside & counts, axis=(1, 2))
    shares = outside / jnp.maximum(jnp.sum(counts), 1)
    known = jnp.any(counts) & ~jnp.any(~jnp.isfinite(rows) & counts)
    return known & jnp.all(shares <= params.share)


@functools.lru_cache(maxsize=16)
def guarded_score(features: FeatureMap, activation: str, incumbent: Score) -> Score:
    """Score of `Guarded`: the reward's V, or the incumbent's out of distribution."""

    def score(params: Guarded, scene: Scene, candidates: Candidates) -> jax.Array:
        rows, valid = features.rows(scene, candidates), scene.time_valid
        values = rows_value(params.reward, params.normaliser, rows, valid, activation)
        counts = valid[:, None] & candidates.feasible
        fine = in_distribution(params, jnp.stack(rows), counts)
        other = incumbent(params.incumbent, scene, candidates)
        return jnp.where(fine, values, other)

    return score
