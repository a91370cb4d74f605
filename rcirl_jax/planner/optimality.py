"""How far a plan is from the best one of its own reward.

    G = V(tau*) - V(tau),   g = G / (V(tau*) - V(emergency stop))

tau* is the best that passes the safety filter of the plan itself, the plan of a finer
lattice (`dp`) and the emergency stop. V has no unit, so g sets the scale: 0 is the
best plan known, 1 is as bad as braking for no reason.
"""

import jax
import jax.numpy as jnp

from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.dp import plan_dp
from rcirl_jax.planner.grid import DpConfig, Weights
from rcirl_jax.planner.rank import learned_score
from rcirl_jax.planner.safety import SafetyConfig, check
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.sampling.sampler import SamplerConfig, emergency
from rcirl_jax.types import Candidates, Scene, Trajectory

MIN_SPREAD = 1e-6  # V, difference below which g is not defined
FINE = DpConfig(step=1.0)  # double the resolution of the planner's default


def emergency_stop(scene: Scene) -> Trajectory:
    """The hardest braking that the sampler offers, on the scene's path."""
    return trajectory_on_path(scene, emergency(scene, SamplerConfig())[-1])


def optimality_gap(
    scene: Scene,
    trajectory: Trajectory,
    weights: Weights,
    features: FeatureMap,
    activation: str,
    lattice: DpConfig = FINE,
) -> dict[str, jax.Array]:
    """How much less the plan `trajectory` is worth than the best plan of the scene.

    Args:
      scene: one scene.
      trajectory: the plan to judge, on the scene's path.
      weights: effective parameters and normaliser.
      features: static.
      activation: static, key of ACTIVATIONS.
      lattice: static, of the finer solver.

    Returns:
      Scalars: `admissible`, whether the plan passes the safety filter; `gap` G >= 0,
      NaN where it does not; `normalised` g, NaN too where braking is as good.
    """
    plan = plan_dp(scene, weights, features, activation, lattice)
    # a lattice without a plan gives a trajectory that means nothing
    finer = jax.tree.map(
        lambda a, b: jnp.where(plan.feasible, a, b), plan.trajectory, trajectory
    )
    stop = emergency_stop(scene)
    many = Candidates(
        trajectory=jax.tree.map(lambda *x: jnp.stack(x), trajectory, finer, stop),
        feasible=jnp.ones((3,), bool),
        family=jnp.zeros((3,), jnp.int32),
    )
    values = learned_score(features, activation)(weights, scene, many)
    admissible = check(scene, many, SafetyConfig()).admissible
    best = jnp.max(jnp.where(admissible, values, -jnp.inf))
    gap = jnp.where(admissible[0], best - values[0], jnp.nan)
    spread = best - values[2]
    wide = spread > MIN_SPREAD
    normalised = jnp.where(wide, gap / jnp.where(wide, spread, 1.0), jnp.nan)
    return {"admissible": admissible[0], "gap": gap, "normalised": normalised}
