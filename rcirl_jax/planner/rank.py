"""The ranking planner: sample, filter, value all candidates at once, take the best.

Every policy here is a pure function `(params, scene, key) -> Plan`; a policy
differs from another by its score only, so the safety filter, the candidates
and the tracking are the same for a learned, a hand-set and a random reward.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.baselines import Idm, idm_acceleration
from rcirl_jax.planner.plan import Plan
from rcirl_jax.planner.safety import SafetyConfig, check, choose
from rcirl_jax.planner.yielding import held
from rcirl_jax.reward.hand import LatticeCost, lattice_cost
from rcirl_jax.reward.network import ACTIVATIONS, rows_value
from rcirl_jax.reward.speed_dp import speed_dp_cost
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.sampling.speed import family_index
from rcirl_jax.types import (
    Candidates,
    Kind,
    Normaliser,
    RewardParams,
    Scene,
    Trajectory,
)
from rcirl_jax.units import DT_S

Params = Any  # a score's weights: any pytree
Score = Callable[[Params, Scene, Candidates], jax.Array]  # -> [K], higher is better
Policy = Callable[[Params, Scene, jax.Array], Plan]

EASED_MPS2 = 0.3  # m/s^2, braking left at standstill in an ordinary stop
EASING_S = 0.5  # s, time constant of the last part of an ordinary stop
MIN_WAY_M = 0.01  # m, keeps v^2 / 2s finite at rest
ACTUATOR_LAG_S = 0.2  # s, of the drive train; the command leads the plan by it


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
    # s a command stays in force
    period: float = 0.1


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
    cost = jax.vmap(lambda x: lattice_cost(scene, x, weights))(candidates.trajectory)
    return -cost


def speed_dp_score(params: None, scene: Scene, candidates: Candidates) -> jax.Array:
    """Minus the cost of Apollo's speed DP, published weights; see `speed_dp_cost`."""
    del params
    return -jax.vmap(lambda x: speed_dp_cost(scene, x))(candidates.trajectory)


def lead_time(period: float) -> float:
    """How far ahead [s] of now the plan's acceleration is commanded.

    Under a lag tau a command held for h moves the acceleration by
    (1 - exp(-h / tau)) of the way, so a plan with jerk j is met after h when
    the command leads by j h / (1 - exp(-h / tau)).
    """
    return period / (1.0 - math.exp(-period / ACTUATOR_LAG_S))


def command(chosen: Trajectory, braking_now: jax.Array, period: float) -> jax.Array:
    """Acceleration command m/s^2 that starts a planned trajectory.

    The lag is led as in `lead_time`; an emergency asks for its braking at once.
    A plan that comes to rest within the first interval shows only a part of its
    braking in second differences: there the braking is the one that stops on
    the planned way, v^2 / 2s, eased off towards standstill unless it is urgent.
    """
    a, v, way = chosen.a, chosen.v[0], chosen.s[1] - chosen.s[0]
    share = min(lead_time(period) / DT_S, 1.0)
    wanted = jnp.where(braking_now, a[1], a[0] + share * (a[1] - a[0]))
    rests = way < 0.5 * v * DT_S
    stopping = -(v**2) / (2.0 * jnp.maximum(way, MIN_WAY_M))
    eased = jnp.maximum(stopping, -(EASED_MPS2 + v / EASING_S))
    stopping = jnp.where(braking_now, stopping, eased)
    return jnp.where(rests, jnp.minimum(wanted, stopping), wanted)


def best_plan(
    scene: Scene, candidates: Candidates, scores: jax.Array, config: RankConfig
) -> Plan:
    """The candidate that `safety.choose` takes, as a plan.

    A feasible candidate whose score is not finite is a fault that no choice may hide:
    the command is NaN then, and so are the drive's numbers, by which a suite names
    the case. (The guard of the onboard side answers it before; see `guard`.)

    Args:
      scene: of the candidates.
      candidates: K of them.
      scores: [K].
      config: filter and period.
    """
    verdict = check(scene, candidates, config.safety)
    index, fallback = choose(verdict, candidates, scores)
    chosen = jax.tree.map(lambda x: x[index], candidates.trajectory)
    hard = fallback | (candidates.family[index] == family_index("emergency"))
    known = jnp.all(jnp.isfinite(scores) | ~candidates.feasible)
    return Plan(
        acceleration=jnp.where(known, command(chosen, hard, config.period), jnp.nan),
        s=chosen.s,
        fallback=fallback,
        admissible=jnp.sum(verdict.admissible, dtype=jnp.int32),
    )


@functools.lru_cache(maxsize=64)
def rank_policy(score: Score, config: RankConfig) -> Policy:
    """The planner that drives the admissible candidate of the highest score."""

    def policy(params: Params, scene: Scene, key: jax.Array) -> Plan:
        candidates = sample(key, scene, config.sampler)
        scores = score(params, scene, candidates)
        return best_plan(scene, candidates, scores, config)

    return policy


@functools.lru_cache(maxsize=8)
def idm_policy(idm: Idm) -> Policy:
    """IDM behind the nearest body or line in the ego's corridor now."""

    def policy(params: Params, scene: Scene, key: jax.Array) -> Plan:
        del params, key
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
        return held(scene, a)

    return policy


def constant_speed_policy(params: Params, scene: Scene, key: jax.Array) -> Plan:
    """Nobody drives: the acceleration stays 0."""
    del params, key
    return held(scene, jnp.zeros(()))
