"""A learned score added to the planner's own cost, with a gain for each scene.

    V = V_own + gain V_learned
    gain = low + (high - low) familiarity      familiarity as in `reward.familiarity`

A reward learned on some roads knows little of others. There the gain is `low`, and the
learned value decides only between plans that the planner's own cost finds nearly equal.
In traffic like the recorded traffic the gain is `high`. Gains are in units of the own
cost per unit of V.
"""

import functools
from collections.abc import Sequence

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.rank import Params, Score, value_rows
from rcirl_jax.reward import effective_model
from rcirl_jax.reward.familiarity import Familiarity, familiarity
from rcirl_jax.types import Candidates, Normaliser, RewardParams, Scene


class WithPriorCost(flax.struct.PyTreeNode, kw_only=True):
    """Weights of a score with a prior cost."""

    reward: RewardParams  # effective
    normaliser: Normaliser
    familiarity: Familiarity
    low: jax.Array  # [] gain where nothing is known
    high: jax.Array  # [] gain where all is
    own: Params  # weights of the own cost


def gain(params: WithPriorCost, rows: Sequence[jax.Array]) -> jax.Array:
    """The gain [] of a scene from its candidates' raw features, F of [T, K]."""
    x0 = jnp.stack([row[0, 0] for row in rows])
    return params.low + (params.high - params.low) * familiarity(params.familiarity, x0)


@functools.lru_cache(maxsize=16)
def prior_cost_score(features: FeatureMap, activation: str, own: Score) -> Score:
    """Score of `WithPriorCost`, by the equation of the module."""

    def score(params: WithPriorCost, scene: Scene, candidates: Candidates) -> jax.Array:
        rows, model = (
            features.rows(scene, candidates),
            effective_model(params.reward, activation),
        )
        values = value_rows(model, params.reward, params.normaliser, rows, scene)
        return own(params.own, scene, candidates) + gain(params, rows) * values

    return score
