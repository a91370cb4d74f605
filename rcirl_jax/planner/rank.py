"""The ranking planner: sample, filter, value all candidates at once, take the best.

Every policy here is a pure function `(params, scene, key, before) -> Plan`; a policy
differs from another by its score only, so the safety filter, the candidates
and the tracking are the same for a learned, a hand-set and a random reward.

A learned score added to the planner's own cost, with a gain for each scene.

    V = V_own + gain V_learned    where V_learned knows the scene, else V_own

A reward learned on some roads knows little of others: the larger the gain, the more it
decides beyond plans that the planner's own cost finds nearly equal. The gain is in
units of the own cost per unit of V, and the same in all scenes but those with what
training never showed (`reward.normaliser.supported`).
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.own_cost import OwnCost, own_cost
from rcirl_jax.planner.plan import Plan, PreviousPlan, committed, either, plan_of
from rcirl_jax.planner.safety import SafetyConfig, check, choose, last_resort
from rcirl_jax.reward.hand import LatticeCost, lattice_costs
from rcirl_jax.reward.network import (
    ACTIVATIONS,
    RewardModel,
    effective_model,
    scene_values,
)
from rcirl_jax.reward.normaliser import supported
from rcirl_jax.reward.speed_dp import SPEED_DP_ROW, speed_dp_cost
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.sampling.sampler import family_index
from rcirl_jax.types import (
    Candidates,
    Normaliser,
    RewardParams,
    Scene,
)

Params = Any  # a score's weights: any pytree
Score = Callable[[Params, Scene, Candidates], jax.Array]  # -> [K], higher is better
Policy = Callable[..., Plan]  # (params, scene, key, plan in force) -> Plan

LONGEST_S = 4.0  # s after which a plan in force gives way to one that is made anew

# The closed loop's grid: 64 candidates, all families of the offline sampler.
ONLINE = SamplerConfig(
    cruise_times=(2.0, 3.0, 5.0, 8.0),
    cruise_levels=(-1.0, -0.6, -0.3, -0.1, 0.0, 0.1, 0.3, 0.6),
    edge_times=(4.0, 8.0),
    follow_headways=(0.8, 1.3, 2.0),
    num_followed=1,
    stop_times=(3.0, 5.0, 8.0),
    stop_gaps=(0.5, 2.0),
    stop_brakings=(0.8, 1.5, 2.5),
    num_random=8,
)
# The same speeds to the middle of the lane, every fifth on other paths: 168 candidates.
ONLINE_PATHS = dataclasses.replace(
    ONLINE,
    mode="path_speed",
    lateral_times=(4.0, 7.0),
    min_lateral_length=12.0,
    nudge_offsets=(),
    pass_gap=0.45,
    lateral_always=(1,),
    lateral_stride=5,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RankConfig:
    """Static parts of a ranking planner; hashable."""

    sampler: SamplerConfig = ONLINE
    safety: SafetyConfig = dataclasses.field(default_factory=SafetyConfig)
    # s for which a plan is kept, once chosen, as long as it is admissible
    commitment: float = 1.0
    # the user's own cost, by which rows of its name drive
    own: OwnCost | None = None

    @property
    def steers(self) -> bool:
        """True if paths are planned."""
        return self.sampler.mode == "path_speed"


def online(
    sampler: SamplerConfig, track: str = "full", own: OwnCost | None = None
) -> RankConfig:
    """Returns the closed loop's settings for the mode of a sampler.

    Args:
      sampler: names the mode, and the user's own candidates if there are any.
      track: of the safety filter.
      own: the user's own cost.
    """
    steers = sampler.mode == "path_speed"
    return RankConfig(
        sampler=sampler.on_own(ONLINE_PATHS if steers else ONLINE),
        safety=SafetyConfig(track=track, entry=steers),
        own=own,
    )


def value_rows(
    model: RewardModel,
    params: RewardParams,
    normaliser: Normaliser,
    rows: Sequence[jax.Array],
    scene: Scene,
) -> jax.Array:
    """V [K] of a scene's candidates from F rows [T, K] of `FeatureMap.rows`."""
    x, valid = jnp.stack(rows), scene.time_valid
    return scene_values(model, params, normaliser, valid, x)[0]


@functools.lru_cache(maxsize=16)
def learned_score(features: FeatureMap, activation: str) -> Score:
    """Score of (effective RewardParams, Normaliser): V, as in `reward.value`."""
    if activation not in ACTIVATIONS:
        raise KeyError(activation)

    def score(
        params: tuple[RewardParams, Normaliser], scene: Scene, candidates: Candidates
    ) -> jax.Array:
        model = effective_model(params[0], activation)
        return value_rows(model, *params, features.rows(scene, candidates), scene)

    return score


@functools.lru_cache(maxsize=16)
def module_score(features: FeatureMap, model: RewardModel) -> Score:
    """Score of (parameters of a training, Normaliser): V of any R_theta."""

    def score(
        params: tuple[RewardParams, Normaliser], scene: Scene, candidates: Candidates
    ) -> jax.Array:
        return value_rows(model, *params, features.rows(scene, candidates), scene)

    return score


def hand_score(
    params: dict[str, jax.Array] | None, scene: Scene, candidates: Candidates
) -> jax.Array:
    """Minus Apollo's lattice cost.

    Args:
      params: `LatticeCost.fields()`; None: the published weights.
      scene: of the candidates.
      candidates: K of them.
    """
    weights = LatticeCost(**(params or {}))
    return -lattice_costs(scene, candidates.trajectory, weights)


def constant_score(params: None, scene: Scene, candidates: Candidates) -> jax.Array:
    """V = 0, a trivial baseline: the first admissible candidate is driven.

    That is constant speed where it is admissible. It shows what filter, sampler and
    given path achieve without a reward.
    """
    del params, scene
    return jnp.zeros(candidates.feasible.shape)


def velocity_score(params: None, scene: Scene, candidates: Candidates) -> jax.Array:
    """V = mean of v over valid times, a trivial baseline: the fastest is driven."""
    del params
    valid = scene.time_valid
    v = jnp.where(valid, candidates.trajectory.v, 0.0)
    return jnp.sum(v, axis=1) / jnp.sum(valid)


def speed_dp_score(params: None, scene: Scene, candidates: Candidates) -> jax.Array:
    """Minus the cost of Apollo's speed DP, published weights; see `speed_dp_cost`."""
    del params
    return -jax.vmap(lambda x: speed_dp_cost(scene, x))(candidates.trajectory)


# what a planner may value candidates by without a learned reward
OWN_SCORES: dict[str, Score] = {
    "constant V": constant_score,
    "hand-set": hand_score,
    SPEED_DP_ROW: speed_dp_score,
    "+velocity": velocity_score,
}


def own_score(name: str) -> Score:
    """The score of one of OWN_SCORES, or of the own cost at a place."""
    return OWN_SCORES[name] if name in OWN_SCORES else own_cost(name).score


class Ranking(flax.struct.PyTreeNode, kw_only=True):
    """The score of candidates, V_own + gain V_learned; `ranking` makes it."""

    own: jax.Array  # [] place in OWN_SCORES; one beyond them: the user's own cost
    gain: jax.Array  # []
    reward: RewardParams  # effective
    normaliser: Normaliser


def ranking(
    weights: tuple[RewardParams, Normaliser],
    own: str = "constant V",
    gain: float = 1.0,
) -> Ranking:
    """Names what ranks; all of one network's shape are valued by one program.

    Args:
      weights: effective parameters and normaliser of the learned reward.
      own: what it is added to: of OWN_SCORES, or the name of the user's own cost.
      gain: of the learned reward; 0 leaves it out.
    """
    params, normaliser = weights
    return Ranking(
        own=jnp.asarray([*OWN_SCORES, own].index(own)),
        gain=jnp.asarray(gain, jnp.float32),
        reward=params,
        normaliser=normaliser,
    )


def gain_in(params: Ranking, first: jax.Array) -> jax.Array:
    """Returns the gain [] in a scene: 0 where V does not know it, unless V is alone.

    Args:
      params: the ranking.
      first: [F], raw features of one trajectory at t = 0.
    """
    alone = params.own == list(OWN_SCORES).index("constant V")
    counts = alone | supported(params.normaliser, first)
    return jnp.where(counts, params.gain, 0.0)


@functools.lru_cache(maxsize=16)
def ranking_score(
    features: FeatureMap, activation: str, user: OwnCost | None = None
) -> Score:
    """Score of a `Ranking`, by the equation of the module.

    Of the own scores and the learned one, only what the ranking names is computed.
    """
    owns = [*OWN_SCORES.values(), *([user.score] if user else [])]

    def learned(params: Ranking, scene: Scene, candidates: Candidates) -> jax.Array:
        rows = features.rows(scene, candidates)
        model = effective_model(params.reward, activation)
        values = value_rows(model, params.reward, params.normaliser, rows, scene)
        first = jnp.stack([row[0, 0] for row in rows])  # as for the gates
        gain = gain_in(params, first)
        return jnp.where(gain == 0.0, 0.0, gain * values)

    def score(params: Ranking, scene: Scene, candidates: Candidates) -> jax.Array:
        seen = scene, candidates
        own = jax.lax.switch(params.own, owns, None, *seen)
        uses = params.gain != 0.0
        nothing = lambda *_: jnp.zeros_like(own)  # noqa: E731
        return own + jax.lax.cond(uses, learned, nothing, params, *seen)

    return score


def with_plan_in_force(
    candidates: Candidates, in_force: PreviousPlan | None
) -> Candidates:
    """The candidates and, last, the rest of the plan in force, if there is one."""
    if in_force is None:
        return candidates
    return jax.tree.map(lambda *x: jnp.concatenate(x), candidates, in_force[1])


def best_plan(
    scene: Scene,
    candidates: Candidates,
    scores: jax.Array,
    config: RankConfig,
    in_force: PreviousPlan | None = None,
) -> Plan:
    """The candidate that `safety.choose` takes, as a plan.

    With a plan in force, the last candidate is its rest. If it is the best, the plan in
    force is followed as before instead of a new plan made from its rest.

    If the score of a feasible candidate is not finite, the plan is NaN, and so are the
    metrics of the drive: the suite then names the case instead of hiding the fault.

    Args:
      scene: of the candidates.
      candidates: K of them.
      scores: [K].
      config: the filter's.
      in_force: the plan in force.
    """
    verdict = check(scene, candidates, config.safety)
    if config.steers:
        verdict = jax.lax.cond(
            jnp.any(verdict.admissible),
            lambda: verdict,
            lambda: last_resort(scene, candidates, verdict, config.safety),
        )
    index, fallback = choose(verdict, candidates, scores)
    chosen = jax.tree.map(lambda x: x[index], candidates.trajectory)
    urgent = fallback | (candidates.family[index] == family_index("emergency"))
    known = jnp.all(jnp.isfinite(scores) | ~candidates.feasible)
    count = jnp.sum(verdict.admissible, dtype=jnp.int32)
    fresh = plan_of(
        jax.tree.map(lambda x: jnp.where(known, x, jnp.nan), chosen),
        lasts=~urgent,
        urgent=urgent,
        fallback=fallback,
        admissible=count,
        steers=config.steers,
    )
    if in_force is None:
        return fresh
    before, _ = in_force
    keeps = known & verdict.admissible[-1] & (scores[-1] >= scores[index])
    keeps = keeps & (before.since < LONGEST_S)
    kept = before.replace(since_choice=jnp.zeros(()), admissible=count)
    return either(keeps, kept, fresh)


@functools.lru_cache(maxsize=64)
def rank_policy(score: Score, config: RankConfig) -> Policy:
    """The planner that drives the admissible candidate of the highest score."""

    def replan(
        params: Params, scene: Scene, key: jax.Array, in_force: PreviousPlan | None
    ) -> Plan:
        sampled = sample(key, scene, config.sampler)
        candidates = with_plan_in_force(sampled, in_force)
        scores = score(params, scene, candidates)
        return best_plan(scene, candidates, scores, config, in_force)

    return committed(replan, config.sampler, config.safety, config.commitment)


def ranking_policy(features: FeatureMap, activation: str, config: RankConfig) -> Policy:
    """The planner that drives by a `Ranking`."""
    score = ranking_score(features, activation, config.own)
    return rank_policy(score, config)
