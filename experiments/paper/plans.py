"""Optimality and robustness of a planner, in the paper's terms, over many scenes.

Optimality: the value of the chosen plan against that of the best one that a finer
solver finds (`planner.dp`). Robustness: the variance of the plan where the
same scene is seen with other errors, M times,

    delta s ~ N(0, sigma_s^2), delta l ~ N(0, sigma_l^2) per body (all times),
    delta v_body ~ N(0, sigma_v^2) (its predicted stations shift by delta v t),
    delta v_ego ~ N(0, sigma_ego^2).
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.statistics import combine_seeds
from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.dp import DpConfig, Weights, optimality_gap
from rcirl_jax.planner.plan import Plan, command
from rcirl_jax.planner.rank import Params, Policy
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.simulation.cases import STEP_S, Case
from rcirl_jax.simulation.rollout import RolloutConfig, drive_cases
from rcirl_jax.types import Kind, Scene
from rcirl_jax.units import TIMES_S

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


@functools.lru_cache(maxsize=8)
def _steadiness(policy: Policy, config: Disturbance) -> Callable:
    def measure(params: Params, scene: Scene, key: jax.Array) -> dict[str, jax.Array]:
        draw, plan_key = jax.random.split(key)
        keys = jax.random.split(draw, config.samples)
        scenes = jax.vmap(lambda k: disturbed(k, scene, config))(keys)
        plans: Plan = jax.vmap(lambda x: policy(params, x, plan_key))(scenes)
        return {
            "acceleration_std": jnp.std(jax.vmap(command)(plans, scenes.ego.v)),
            "end_station_std": jnp.std(plans.s[:, -1]),
        }

    return jax.jit(measure)


def steadiness(
    policy: Policy, params: Params, scenes: Scene, config: Disturbance
) -> dict[str, np.ndarray]:
    """Spread [B] of the plan of each scene under disturbances.

    Returns:
      Of the next acceleration (m/s^2) and of the plan's end (m).
    """
    measure, key = _steadiness(policy, config), jax.random.key(0)
    of_scene = lambda i, x: measure(params, x, jax.random.fold_in(key, i))  # noqa: E731
    return _one_by_one(of_scene, scenes)


def _one_by_one(measure: Callable, scenes: Scene) -> dict[str, np.ndarray]:
    """`measure(i, scene)` of every scene, stacked: a lattice's tables are large."""
    found = []
    for i in range(scenes.ego.v.shape[0]):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], scenes)
        found.append(jax.tree.map(np.asarray, measure(i, one)))
    return {name: np.stack([one[name] for one in found]) for name in found[0]}


def gaps(
    policies: Mapping[str, tuple[Policy, Params]],
    weights: Weights,
    scenes: Scene,
    case: np.ndarray,
    features: FeatureMap,
    activation: str,
    lattice: DpConfig,
) -> Table:
    """Gaps of several policies on the frames where all of their plans may be driven.

    The policies must plan along the scene's path, as all of ours do. `admissible` is
    the share of all frames in which a policy's own plan passes the safety filter.

    Raises:
      InputError: there are such frames in one case at most.
    """
    key = jax.random.key(0)

    @jax.jit
    def measure(
        weights: Weights, params: Sequence[Params], scene: Scene
    ) -> dict[str, jax.Array]:
        drivers = zip(policies.values(), params, strict=True)
        plans = [policy(own, scene, key).s for (policy, _), own in drivers]

        def of_plan(s: jax.Array) -> dict[str, jax.Array]:
            plan = trajectory_on_path(scene, s)
            return optimality_gap(scene, plan, weights, features, activation, lattice)

        return jax.vmap(of_plan)(jnp.stack(plans))

    own = [params for _, params in policies.values()]
    found = _one_by_one(lambda _, scene: measure(weights, own, scene), scenes)  # [B, P]
    judged = np.all(found["admissible"], axis=1)
    if np.unique(case[judged]).size < 2:
        raise InputError(
            f"frames: {judged.sum()} in which every policy has an admissible plan:"
            " expected some in at least two cases"
        )
    rows: Table = {}
    for number, name in enumerate(policies):
        of = {key: x[:, number].astype(float) for key, x in found.items()}
        rows[name] = {"admissible": summary(of.pop("admissible"), case)}
        for measured, x in of.items():
            defined = judged & np.isfinite(x)
            rows[name][measured] = summary(x[defined], case[defined])
    return rows


def frames(
    policy: Policy,
    params: Params,
    cases: Case,
    duration_s: float,
    every_s: float,
    count: int,
) -> tuple[Scene, np.ndarray]:
    """Scenes [B] that a policy meets when it drives cases, every `every_s`.

    Returns:
      At most `count` scenes, evenly spread, and the number of the case of each.
    """
    every = round(every_s / STEP_S)
    config = RolloutConfig(steps=round(duration_s / STEP_S), frames_every=every)
    record, _, scenes = drive_cases(policy, params, cases, config)
    valid = np.asarray(record.valid)[:, ::every]
    met = jax.tree.map(lambda x: x[valid], scenes)
    return spread_over(count, met, np.nonzero(valid)[0])


def spread_over(
    count: int, scenes: Scene, case: np.ndarray
) -> tuple[Scene, np.ndarray]:
    """At most `count` of the frames, evenly spread."""
    chosen = np.unique(np.linspace(0, case.size - 1, count).astype(int))
    return jax.tree.map(lambda leaf: leaf[chosen], scenes), case[chosen]


def summary(values: np.ndarray, case: np.ndarray) -> dict[str, float]:
    """Mean over frames [B] with its 95 % interval over cases."""
    found = combine_seeds(values, case)
    return {
        "frames": float(values.size),
        "mean": found.value,
        "low": found.low,
        "high": found.high,
    }
