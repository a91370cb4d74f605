"""How optimal and how steady a planner is: gaps and flips over many scenes.

Optimality, as the paper names it: the chosen plan against the best one that a
finer solver finds (`planner.optimality`). Robustness: the same scene with its
perception disturbed M times,

    delta s ~ N(0, sigma_s^2), delta l ~ N(0, sigma_l^2) per body (all times),
    delta v_body ~ N(0, sigma_v^2) (its predicted stations shift by delta v t),
    delta v_ego ~ N(0, sigma_ego^2),

gives M plans; reported are the spread of what is driven next and how often the
decision (which side of each body the plan passes) differs from the undisturbed
plan's, both judged in the scene as it is.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.statistics import combine_seeds
from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.grid import Weights
from rcirl_jax.planner.optimality import GapConfig, optimality_gap
from rcirl_jax.planner.plan import Plan, command
from rcirl_jax.planner.rank import Policy
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.simulation.cases import STEP_S, Case
from rcirl_jax.simulation.rollout import RolloutConfig, drive_cases
from rcirl_jax.types import Kind, Scene
from rcirl_jax.units import TIMES_S

# of `optimality_gap`, in the order in which they are shown
GAPS = ("normalised", "jerk_regret", "progress_regret")

Table = dict[str, dict[str, dict[str, float]]]  # row -> metric -> numbers


@dataclasses.dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Perception errors; hashable. A good lidar tracker at 40 m."""

    samples: int = 32
    sigma_s: float = 0.3  # m
    sigma_l: float = 0.1  # m
    sigma_v: float = 0.3  # m/s, of bodies
    sigma_ego: float = 0.1  # m/s


def disturbed(key: jax.Array, scene: Scene, config: Disturbance) -> Scene:
    """One disturbed copy; lines, road and path stay as they are."""
    o = scene.obstacles
    draws = jax.random.normal(key, (4, o.kind.shape[0]))
    body = (o.kind >= Kind.VEHICLE) & (o.kind <= Kind.STATIC)
    moves = body & (o.kind != Kind.STATIC)
    zero = jnp.zeros_like(draws[0])
    ds = jnp.where(body, config.sigma_s * draws[0], zero)[:, None]
    dl = jnp.where(body, config.sigma_l * draws[1], zero)[:, None]
    dv = jnp.where(moves, config.sigma_v * draws[2], zero)[:, None]
    along = ds + dv * jnp.asarray(TIMES_S)
    v = jnp.maximum(scene.ego.v + config.sigma_ego * draws[3, 0], 0.0)
    return scene.replace(
        ego=scene.ego.replace(v=v),
        obstacles=o.replace(
            s_lower=o.s_lower + along,
            s_upper=o.s_upper + along,
            l_lower=o.l_lower + dl,
            l_upper=o.l_upper + dl,
            speed=o.speed + dv,
        ),
    )


def decision(scene: Scene, s: jax.Array) -> jax.Array:
    """[N] int32 by body in the path: -1 the plan stays behind, 1 passes, 0 neither.

    Judged at the last time at which the body is known.
    """
    o = scene.obstacles
    last = jnp.sum(o.valid, axis=1) - 1
    at = lambda table: jnp.take_along_axis(  # noqa: E731
        table, jnp.maximum(last, 0)[:, None], axis=1
    )[:, 0]
    middle = 0.5 * (at(o.s_lower) + at(o.s_upper))
    own = s[jnp.clip(last, 0, s.shape[0] - 1)]
    wide = (at(o.l_lower) < 1.5) & (at(o.l_upper) > -1.5)
    known = (last >= 0) & (o.kind != Kind.NONE) & wide
    return jnp.where(known, jnp.sign(own - middle), 0.0).astype(jnp.int32)


@functools.lru_cache(maxsize=8)
def _steadiness(policy: Policy, config: Disturbance) -> Callable:
    def measure(params: Weights, scene: Scene, key: jax.Array) -> dict[str, jax.Array]:
        draw, plan_key = jax.random.split(key)
        keys = jax.random.split(draw, config.samples)
        many = jax.vmap(lambda k: disturbed(k, scene, config))(keys)
        # the scene as it is comes first; one call of the policy for all
        first = lambda one, rest: jnp.concatenate([one[None], rest])  # noqa: E731
        scenes = jax.tree.map(first, scene, many)
        plans: Plan = jax.vmap(lambda x: policy(params, x, plan_key))(scenes)
        # judged in the true scene: a body that was seen elsewhere is no decision
        taken = jax.vmap(lambda s: decision(scene, s))(plans.s)
        return {
            "acceleration_std": jnp.std(jax.vmap(command)(plans, scenes.ego.v)[1:]),
            "end_station_std": jnp.std(plans.s[1:, -1]),
            "flip_rate": 1.0 - jnp.mean(jnp.all(taken[1:] == taken[0], axis=1)),
            "fallback_rate": jnp.mean(plans.fallback[1:]),
        }

    return jax.jit(measure)


def steadiness(
    policy: Policy,
    params: Weights,
    scenes: Scene,
    config: Disturbance,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """What disturbances do to the plan of each scene [B].

    Returns:
      Spread of the next acceleration (m/s^2) and of the end station (m), share
      of disturbed plans with another decision, and without an admissible
      candidate.
    """
    measure, key = _steadiness(policy, config), jax.random.key(seed)
    of_scene = lambda i, x: measure(params, x, jax.random.fold_in(key, i))  # noqa: E731
    return _one_by_one(of_scene, scenes)


def _one_by_one(measure: Callable, scenes: Scene) -> dict[str, np.ndarray]:
    """`measure(i, scene)` of every scene, stacked: a lattice's tables are large."""
    found = []
    for i in range(scenes.ego.v.shape[0]):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], scenes)
        found.append(jax.tree.map(np.asarray, measure(i, one)))
    return {name: np.stack([one[name] for one in found]) for name in found[0]}


@functools.lru_cache(maxsize=8)
def _planned(policy: Policy) -> Callable:
    return jax.jit(lambda params, scene, key: policy(params, scene, key).s)


@functools.lru_cache(maxsize=8)
def _gaps(features: FeatureMap, activation: str, config: GapConfig) -> Callable:
    """Of several plans [P, T]: the finer lattice's does not depend on them."""

    def measure(params: Weights, scene: Scene, s: jax.Array) -> dict[str, jax.Array]:
        plan = trajectory_on_path(scene, s)
        return optimality_gap(scene, plan, params, features, activation, config)

    return jax.jit(jax.vmap(measure, in_axes=(None, None, 0)))


def gaps(
    policies: Mapping[str, Policy],
    params: Weights,
    scenes: Scene,
    features: FeatureMap,
    activation: str,
    config: GapConfig,
) -> dict[str, dict[str, np.ndarray]]:
    """`optimality_gap` of the policies' plans: policy -> number -> [B].

    The policies must plan along the scene's path, as all of ours do.
    """
    key, measure = jax.random.key(0), _gaps(features, activation, config)
    planned = [_planned(policy) for policy in policies.values()]

    def of_scene(_: int, scene: Scene) -> dict[str, jax.Array]:
        plans = jnp.stack([plan(params, scene, key) for plan in planned])
        return measure(params, scene, plans)

    found = _one_by_one(of_scene, scenes)  # number -> [B, P]
    return {
        name: {key: x[:, number] for key, x in found.items()}
        for number, name in enumerate(policies)
    }


def frames(
    policy: Policy,
    params: Weights,
    cases: Case,
    duration_s: float,
    *,
    period_s: float,
    every_s: float,
) -> tuple[Scene, np.ndarray]:
    """Scenes [B] that a policy meets when it drives cases.

    Args:
      policy: plans every `period_s`, as it is built for.
      params: of the policy.
      cases: what it drives.
      duration_s: of each drive.
      period_s: s between two plans.
      every_s: s between two scenes that are kept, a multiple of it.

    Returns:
      The scenes, and the number of the case that each comes from.
    """
    steps, every = round(duration_s / STEP_S), round(every_s / period_s)
    plan_every = round(period_s / STEP_S)
    config = RolloutConfig(steps=steps, plan_every=plan_every, scenes=True)
    record, _, scenes = drive_cases(policy, params, cases, config)
    valid = np.asarray(record.valid)[:, :: plan_every * every]
    met = jax.tree.map(lambda x: np.asarray(x)[:, ::every][valid], scenes)
    return met, np.nonzero(valid)[0]


def spread_over(
    count: int, scenes: Scene, case: np.ndarray
) -> tuple[Scene, np.ndarray]:
    """At most `count` of the frames, evenly spread."""
    chosen = np.unique(np.linspace(0, case.size - 1, count).astype(int))
    return jax.tree.map(lambda leaf: leaf[chosen], scenes), case[chosen]


def optimality_rows(
    policies: Mapping[str, Policy],
    params: Weights,
    scenes: Scene,
    case: np.ndarray,
    features: FeatureMap,
    activation: str,
    config: GapConfig,
) -> Table:
    """Gaps of several policies on the frames where all of them may be judged.

    `admissible` is the share of all frames in which a policy's own plan passes the
    safety filter; gaps are of the frames in which every policy's does and the best
    known plan is admissible too, so that all rows speak of the same frames.
    """
    found = gaps(policies, params, scenes, features, activation, config)
    judged = np.all([x["known"] & x["admissible"] for x in found.values()], axis=0)
    if np.unique(case[judged]).size < 2:
        raise InputError(
            f"frames: {judged.sum()} in which every policy has an admissible plan:"
            " expected some in at least two cases"
        )
    rows: Table = {}
    for name, x in found.items():
        rows[name] = {"admissible": summary(x["admissible"].astype(float), case)}
        for key in ("gap", *GAPS):
            defined = judged & np.isfinite(x[key])
            rows[name][key] = summary(x[key][defined], case[defined])
    return rows


def summary(values: np.ndarray, case: np.ndarray) -> dict[str, float]:
    """Mean over frames [B] with its 95 % interval over cases, and quantiles."""
    found = combine_seeds(values, case)
    median, p95 = np.quantile(values, [0.5, 0.95])
    return {
        "frames": float(values.size),
        "mean": found.value,
        "low": found.low,
        "high": found.high,
        "median": float(median),
        "p95": float(p95),
    }
