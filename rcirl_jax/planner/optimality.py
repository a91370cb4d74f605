"""How far a plan is from the best one of its own reward.

    G = V(tau*) - V(tau),   g = G / (V(tau*) - V(emergency stop))

tau* is the best of what a finer lattice (`dp`), local ascent on it and local
ascent on the plan itself find among the plans that pass the safety filter. V has
no unit, so g sets the scale: 0 is the best plan known, 1 is as bad as braking
for no reason. Next to it the regret in physical units: jerk and way.
"""

import dataclasses

import jax
import jax.numpy as jnp

from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.dp import plan_dp
from rcirl_jax.planner.grid import DpConfig, Weights
from rcirl_jax.planner.rank import learned_score
from rcirl_jax.planner.refine import RefineConfig, refine
from rcirl_jax.planner.safety import SafetyConfig, check
from rcirl_jax.sampling.config import SamplerConfig
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.sampling.speed import emergency
from rcirl_jax.types import Candidates, Scene, Trajectory

MIN_SPREAD = 1e-6  # V, difference below which g is not defined


@dataclasses.dataclass(frozen=True, kw_only=True)
class GapConfig:
    """The finer solver; hashable."""

    # lattice at double the resolution of the planner's default
    lattice: DpConfig = dataclasses.field(default_factory=lambda: DpConfig(step=1.0))
    refinement: RefineConfig = dataclasses.field(default_factory=RefineConfig)
    safety: SafetyConfig = dataclasses.field(default_factory=SafetyConfig)


def best_known(
    scene: Scene,
    trajectory: Trajectory,
    weights: Weights,
    features: FeatureMap,
    activation: str,
    config: GapConfig = GapConfig(),
) -> tuple[Trajectory, jax.Array, jax.Array]:
    """(tau*, V(tau*), known): the best admissible plan that the solvers find.

    Candidates are the finer lattice's plan and the given one, each as it is and
    after local ascent, and the emergency stop. Where none of them passes the
    safety filter `known` is False and tau* is the given plan.
    """
    score = learned_score(features, activation)
    plan = plan_dp(scene, weights, features, activation, config.lattice)
    # a lattice plan that breaks something must not be the start of an ascent
    start = _where(plan.feasible, plan.trajectory, trajectory)
    climb = lambda x: refine(scene, x, score, weights, config.refinement)[0]  # noqa: E731
    starts = jax.tree.map(lambda *x: jnp.stack(x), trajectory, start)
    found = (starts, jax.vmap(climb)(starts))
    stop = jax.tree.map(lambda x: x[None], emergency_stop(scene))
    many = _candidates(jax.tree.map(lambda *x: jnp.concatenate(x), *found, stop))
    values = score(weights, scene, many)
    admissible = check(scene, many, config.safety).admissible
    best = jnp.argmax(jnp.where(admissible, values, -jnp.inf))
    best = jnp.where(jnp.any(admissible), best, 0)
    chosen = jax.tree.map(lambda x: x[best], many.trajectory)
    return chosen, values[best], jnp.any(admissible)


def emergency_stop(scene: Scene) -> Trajectory:
    """The hardest braking that the sampler offers, on the scene's path."""
    return trajectory_on_path(scene, emergency(scene, SamplerConfig())[-1])


def optimality_gap(
    scene: Scene,
    trajectory: Trajectory,
    weights: Weights,
    features: FeatureMap,
    activation: str,
    config: GapConfig = GapConfig(),
) -> dict[str, jax.Array]:
    """How much the plan `trajectory` leaves on the table in this scene.

    Args:
      scene: one scene.
      trajectory: the plan to judge, on the scene's path.
      weights: effective parameters and normaliser.
      features: static.
      activation: static, key of ACTIVATIONS.
      config: static.

    Returns:
      Scalars: `gap` G >= 0 where the plan is admissible (below 0: the plan earns
      more than any admissible one, by breaking something), `normalised` G over
      V(tau*) - V(emergency stop), NaN where that is not positive; `value`,
      `best_value`, `emergency_value`; `jerk_regret` m/s^3, RMS jerk of the plan
      minus that of tau*; `progress_regret` m, way of tau* minus that of the plan,
      both over the valid times; `admissible` and `known` as bool.
    """
    score = learned_score(features, activation)
    best, best_value, known = best_known(
        scene, trajectory, weights, features, activation, config
    )
    pair = jax.tree.map(
        lambda *x: jnp.stack(x), trajectory, emergency_stop(scene), best
    )
    values = score(weights, scene, _candidates(pair))
    gap, spread = best_value - values[0], best_value - values[1]
    usable = known & (spread > MIN_SPREAD)
    one = _candidates(jax.tree.map(lambda x: x[None], trajectory))
    rms, way = (
        jax.vmap(f, in_axes=(None, 0))(scene, pair) for f in (rms_jerk, progress)
    )
    return {
        "gap": gap,
        "normalised": jnp.where(usable, gap / jnp.where(usable, spread, 1.0), jnp.nan),
        "value": values[0],
        "best_value": best_value,
        "emergency_value": values[1],
        "jerk_regret": rms[0] - rms[2],
        "progress_regret": way[2] - way[0],
        "admissible": check(scene, one, config.safety).admissible[0],
        "known": known,
    }


def rms_jerk(scene: Scene, trajectory: Trajectory) -> jax.Array:
    """Root mean square jerk m/s^3 over the valid times."""
    square = jnp.where(scene.time_valid, trajectory.j**2, 0.0)
    return jnp.sqrt(jnp.sum(square) / jnp.sum(scene.time_valid))


def progress(scene: Scene, trajectory: Trajectory) -> jax.Array:
    """Way m from the ego to the plan's station at the last valid time."""
    last = jnp.sum(scene.time_valid) - 1
    return trajectory.s[last] - scene.ego.s


def _where(test: jax.Array, yes: Trajectory, no: Trajectory) -> Trajectory:
    return jax.tree.map(lambda a, b: jnp.where(test, a, b), yes, no)


def _candidates(many: Trajectory) -> Candidates:
    """[K] trajectories as candidates that nobody has ruled out."""
    count = many.s.shape[0]
    return Candidates(
        trajectory=many,
        feasible=jnp.ones((count,), bool),
        family=jnp.zeros((count,), jnp.int32),
    )
