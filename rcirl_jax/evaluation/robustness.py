"""How optimal and how steady a planner is: gaps and flips over many scenes.

Optimality, as the paper names it: the chosen plan against the best one that a
finer solver finds (`planner.optimality`). Robustness: the same scene with its
perception disturbed M times,

    delta s ~ N(0, sigma_s^2), delta l ~ N(0, sigma_l^2) per body (all times),
    delta v_body ~ N(0, sigma_v^2) (its predicted stations shift by delta v t),
    delta v_ego ~ N(0, sigma_ego^2),

gives M plans; reported are the spread of what is driven next and how often the
decision (which side of each body the plan passes) differs from the undisturbed.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.grid import Weights
from rcirl_jax.planner.optimality import GapConfig, optimality_gap
from rcirl_jax.planner.plan import Plan
from rcirl_jax.planner.rank import Policy
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.simulation.cases import STEP_S, Case
from rcirl_jax.simulation.rollout import RolloutConfig, drive_cases
from rcirl_jax.types import Kind, Scene
from rcirl_jax.units import TIMES_S


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
        calm: Plan = policy(params, scene, plan_key)
        keys = jax.random.split(draw, config.samples)
        many = jax.vmap(lambda k: disturbed(k, scene, config))(keys)
        plans = jax.vmap(lambda x: policy(params, x, plan_key))(many)
        same = jax.vmap(decision)(many, plans.s) == decision(scene, calm.s)[None]
        apart = plans.s[:, -1] - calm.s[-1]
        return {
            "acceleration_std": jnp.std(plans.acceleration),
            "end_station_std": jnp.std(apart),
            "flip_rate": 1.0 - jnp.mean(jnp.all(same, axis=1)),
            "fallback_rate": jnp.mean(plans.fallback),
        }

    return jax.jit(jax.vmap(measure, in_axes=(None, 0, 0)))


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
    keys = jax.random.split(jax.random.key(seed), scenes.ego.v.shape[0])
    found = _steadiness(policy, config)(params, scenes, keys)
    return {name: np.asarray(value) for name, value in found.items()}


@functools.lru_cache(maxsize=8)
def _gaps(
    policy: Policy, features: FeatureMap, activation: str, config: GapConfig
) -> Callable:
    def measure(params: Weights, scene: Scene, key: jax.Array) -> dict[str, jax.Array]:
        plan = policy(params, scene, key)
        trajectory = trajectory_on_path(scene, plan.s)
        return optimality_gap(scene, trajectory, params, features, activation, config)

    return jax.jit(measure)


def gaps(
    policy: Policy,
    params: Weights,
    scenes: Scene,
    features: FeatureMap,
    activation: str,
    config: GapConfig,
) -> dict[str, np.ndarray]:
    """`optimality_gap` of a policy's plan in each scene, stacked [B].

    The policy must plan along the scene's path, as all of ours do.
    """
    run = _gaps(policy, features, activation, config)
    key = jax.random.key(0)
    found = []
    for i in range(scenes.ego.v.shape[0]):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], scenes)
        found.append(jax.tree.map(np.asarray, run(params, one, key)))
    return {name: np.stack([one[name] for one in found]) for name in found[0]}


def frames(
    policy: Policy,
    params: Weights,
    cases: Case,
    duration_s: float,
    every_s: float,
) -> Scene:
    """Planning frames [B] that a policy meets in cases, one each `every_s`."""
    steps = round(duration_s / STEP_S)
    config = RolloutConfig(steps=steps, plan_every=round(every_s / STEP_S), scenes=True)
    record, _, scenes = drive_cases(policy, params, cases, config)
    valid = np.asarray(record.valid)[:, :: config.plan_every].reshape(-1)
    flat = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), scenes)
    return jax.tree.map(lambda x: x[valid], flat)
