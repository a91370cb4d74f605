"""The ranking planner: sample, filter, value all candidates at once, take the best.

Every policy here is a pure function `(params, scene, key, before) -> Plan`; a policy
differs from another by its score only, so the safety filter, the candidates
and the tracking are the same for a learned, a hand-set and a random reward.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rcirl_jax.features import FeatureMap
from rcirl_jax.geometry.running import running_max
from rcirl_jax.planner.baselines import Idm, idm_acceleration
from rcirl_jax.planner.plan import Plan, held, plan_of, stations_from_now
from rcirl_jax.planner.safety import SafetyConfig, check, choose
from rcirl_jax.reward.hand import LatticeCost, lattice_costs
from rcirl_jax.reward.network import ACTIVATIONS, rows_value
from rcirl_jax.reward.speed_dp import speed_dp_cost
from rcirl_jax.sampling import SamplerConfig, sample, trajectory_on_path
from rcirl_jax.sampling.sampler import within_limits
from rcirl_jax.sampling.speed import family_index
from rcirl_jax.types import (
    Candidates,
    Kind,
    Normaliser,
    RewardParams,
    Scene,
)

Params = Any  # a score's weights: any pytree
Score = Callable[[Params, Scene, Candidates], jax.Array]  # -> [K], higher is better
Policy = Callable[..., Plan]  # (params, scene, key, plan in force) -> Plan

LONGEST_S = 4.0  # s after which a plan in force is no longer kept for its own sake

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class RankConfig:
    """Static parts of a ranking planner; hashable."""

    sampler: SamplerConfig = ONLINE
    safety: SafetyConfig = dataclasses.field(default_factory=SafetyConfig)
    # s for which a plan is kept as long as it is admissible
    commitment: float = 1.0
    # 1, lead of a new plan, in standard deviations of the scores, that replaces it
    hysteresis: float = 0.0


@functools.lru_cache(maxsize=16)
def learned_score(features: FeatureMap, activation: str) -> Score:
    """Score of (effective RewardParams, Normaliser): V, as in `reward.value`."""
    if activation not in ACTIVATIONS:
        raise KeyError(activation)

    def score(
        params: tuple[RewardParams, Normaliser], scene: Scene, candidates: Candidates
    ) -> jax.Array:
        effective, normaliser = params
        rows = features.rows(scene, candidates)
        return rows_value(effective, normaliser, rows, scene.time_valid, activation)

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
    """V = 0, a null: the first admissible candidate is driven.

    That is constant speed where it is admissible: what the filter, the sampler's order
    and the given path do by themselves.
    """
    del params, scene
    return jnp.zeros(candidates.feasible.shape)


def velocity_score(params: None, scene: Scene, candidates: Candidates) -> jax.Array:
    """V = mean of v over valid times, a null: as fast as the filter allows."""
    del params
    valid = scene.time_valid
    v = jnp.where(valid, candidates.trajectory.v, 0.0)
    return jnp.sum(v, axis=1) / jnp.sum(valid)


def speed_dp_score(params: None, scene: Scene, candidates: Candidates) -> jax.Array:
    """Minus the cost of Apollo's speed DP, published weights; see `speed_dp_cost`."""
    del params
    return -jax.vmap(lambda x: speed_dp_cost(scene, x))(candidates.trajectory)


def with_plan_in_force(
    scene: Scene, candidates: Candidates, before: Plan, config: SamplerConfig
) -> Candidates:
    """The candidates and, last, the rest of the plan in force (infeasible if none)."""
    stations = running_max(scene.ego.s + stations_from_now(before))
    rest = trajectory_on_path(scene, stations)
    join = lambda many, one: jnp.concatenate([many, one[None]])  # noqa: E731
    return Candidates(
        trajectory=jax.tree.map(join, candidates.trajectory, rest),
        feasible=join(
            candidates.feasible, before.lasts & within_limits(scene, rest, config)
        ),
        family=join(candidates.family, jnp.asarray(family_index("in_force"))),
    )


def best_plan(
    scene: Scene,
    candidates: Candidates,
    scores: jax.Array,
    config: RankConfig,
    before: Plan | None = None,
) -> Plan:
    """The candidate that `safety.choose` takes, as a plan.

    With `before`, the last candidate is the rest of the plan in force. It is kept while
    it is admissible and either younger than `commitment` or hardly worse than the best:

        V_best - V_in_force <= hysteresis * std of the admissible scores

    A feasible candidate whose score is not finite is a fault that no choice may hide:
    the plan is NaN then, and so are the drive's numbers, by which a suite names
    the case. (The guard of the onboard side answers it before; see `guard`.)

    Args:
      scene: of the candidates.
      candidates: K of them.
      scores: [K].
      config: filter and commitment.
      before: the plan in force.
    """
    verdict = check(scene, candidates, config.safety)
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
    )
    if before is None:
        return fresh
    allowed = verdict.admissible
    share = allowed / jnp.maximum(count, 1)
    finite = jnp.where(allowed, scores, 0.0)
    mean = jnp.sum(share * finite)
    spread = jnp.sqrt(jnp.sum(share * (finite - mean) ** 2))
    near = scores[index] - scores[-1] <= config.hysteresis * spread
    young = before.since < config.commitment
    keeps = known & allowed[-1] & (near | young) & (before.since < LONGEST_S)
    kept = before.replace(admissible=count)
    return jax.tree.map(lambda old, new: jnp.where(keeps, old, new), kept, fresh)


@functools.lru_cache(maxsize=64)
def rank_policy(score: Score, config: RankConfig) -> Policy:
    """The planner that drives the admissible candidate of the highest score."""

    def policy(
        params: Params, scene: Scene, key: jax.Array, before: Plan | None = None
    ) -> Plan:
        candidates = sample(key, scene, config.sampler)
        if before is not None:
            candidates = with_plan_in_force(scene, candidates, before, config.sampler)
        scores = score(params, scene, candidates)
        return best_plan(scene, candidates, scores, config, before)

    return policy


@functools.lru_cache(maxsize=8)
def idm_policy(idm: Idm) -> Policy:
    """IDM behind the nearest body or line in the ego's corridor now."""

    def policy(
        params: Params, scene: Scene, key: jax.Array, before: Plan | None = None
    ) -> Plan:
        del params, key, before
        obstacles, ego = scene.obstacles, scene.ego
        front = ego.s + 0.5 * ego.length
        aside = jnp.maximum(
            obstacles.l_lower[:, 0] - ego.l, ego.l - obstacles.l_upper[:, 0]
        )
        gap = obstacles.s_lower[:, 0] - front
        in_way = aside < 0.5 * ego.width + 0.2
        known = obstacles.valid[:, 0] & (obstacles.kind != Kind.NONE)
        leads = known & in_way & (obstacles.s_upper[:, 0] > ego.s)
        nearest = jnp.argmin(jnp.where(leads, gap, jnp.inf))
        found = leads[nearest]
        a = idm_acceleration(
            ego.v,
            jnp.where(found, gap[nearest], 1e3),
            jnp.where(found, ego.v - obstacles.speed[nearest, 0], 0.0),
            scene.path.speed_limit[0],
            idm,
        )
        return held(ego.v, a)

    return policy


def constant_speed_policy(
    params: Params, scene: Scene, key: jax.Array, before: Plan | None = None
) -> Plan:
    """Nobody drives: the acceleration stays 0."""
    del params, key, before
    return held(scene.ego.v, jnp.zeros(()))
