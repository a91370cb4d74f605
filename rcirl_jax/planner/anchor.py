"""A learned score on top of the incumbent's, as far as the training data reach.

    V = V_incumbent + gain support V_learned
    support = 1 - max_i share_i                  share_i as in docs/guard.md

A reward that people taught on some roads knows nothing of the others. There the
incumbent's score decides, and where the plan's features are like the training's the
learned one has its say. The gain is in units of the incumbent's cost per unit of V.
"""

import functools

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.guard import Ranges, worst_share
from rcirl_jax.planner.rank import Params, Score
from rcirl_jax.reward.network import rows_value
from rcirl_jax.types import Candidates, Normaliser, RewardParams, Scene


class Anchored(flax.struct.PyTreeNode, kw_only=True):
    """Weights of an anchored score."""

    reward: RewardParams  # effective
    normaliser: Normaliser
    ranges: Ranges  # of the training's features
    gain: jax.Array  # []
    incumbent: Params  # the incumbent's weights


@functools.lru_cache(maxsize=16)
def anchored_score(features: FeatureMap, activation: str, incumbent: Score) -> Score:
    """Score of `Anchored`; the equation stands above."""

    def score(params: Anchored, scene: Scene, candidates: Candidates) -> jax.Array:
        rows, valid = features.rows(scene, candidates), scene.time_valid
        values = rows_value(params.reward, params.normaliser, rows, valid, activation)
        counts = valid[:, None] & candidates.feasible
        outside = worst_share(params.ranges, jnp.stack(rows), counts)
        weight = params.gain * jnp.maximum(1.0 - outside, 0.0)
        other = incumbent(params.incumbent, scene, candidates)
        # without support the learned value may be anything, NaN too
        return other + jnp.where(weight > 0.0, weight * values, 0.0)

    return score
