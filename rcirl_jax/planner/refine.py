"""Local refinement: gradient ascent on the accelerations of a plan.

A lattice plan is optimal among lattice plans. Between them V is smooth almost
everywhere, so a few steps uphill find what the grid's step left: stations are
rebuilt from clipped accelerations, a step is kept only if V rises and the
safety filter still passes, and the step shrinks where it is not.
"""

import dataclasses

import jax
import jax.numpy as jnp

from rcirl_jax.planner.rank import Score
from rcirl_jax.planner.safety import SafetyConfig, check
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.types import Candidates, Scene, Trajectory
from rcirl_jax.units import DT_S


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefineConfig:
    """Steps and limits; hashable."""

    steps: int = 40
    # m/s^2, length of the first step (of the largest component)
    first_step: float = 0.5
    # a refused step is followed by one this much shorter
    shrink: float = 0.5
    min_acceleration: float = -6.0  # m/s^2
    max_acceleration: float = 4.0  # m/s^2
    safety: SafetyConfig = dataclasses.field(default_factory=SafetyConfig)


def _stations(scene: Scene, w1: jax.Array, a: jax.Array) -> jax.Array:
    """Stations [T] from the first mean speed and accelerations [T - 2]; never back."""
    w = jnp.maximum(jnp.concatenate([w1[None], w1 + DT_S * jnp.cumsum(a)]), 0.0)
    return scene.ego.s + jnp.concatenate([jnp.zeros((1,)), DT_S * jnp.cumsum(w)])


def _one(trajectory: Trajectory) -> Candidates:
    return Candidates(
        trajectory=jax.tree.map(lambda x: x[None], trajectory),
        feasible=jnp.ones((1,), bool),
        family=jnp.zeros((1,), jnp.int32),
    )


def refine(
    scene: Scene,
    start: Trajectory,
    score: Score,
    params: object,
    config: RefineConfig = RefineConfig(),
) -> tuple[Trajectory, jax.Array]:
    """(trajectory, V) after local ascent; never below the start's V.

    Args:
      scene: one scene.
      start: the plan to refine, on the scene's path.
      score: of candidates, differentiable almost everywhere.
      params: the score's weights.
      config: static.
    """
    w = (start.s[1:] - start.s[:-1]) / DT_S
    begin = jnp.concatenate([w[:1], (w[1:] - w[:-1]) / DT_S])

    def value(x: jax.Array) -> jax.Array:
        plan = trajectory_on_path(scene, _stations(scene, x[0], x[1:]))
        return score(params, scene, _one(plan))[0]

    def climb(carry: tuple, _: None) -> tuple[tuple, None]:
        x, best, step = carry
        slope = jax.grad(value)(x)
        slope = jnp.where(jnp.isfinite(slope), slope, 0.0)
        move = step * slope / (jnp.max(jnp.abs(slope)) + 1e-9)
        limited = jnp.clip(
            x[1:] + move[1:], config.min_acceleration, config.max_acceleration
        )
        near = jnp.clip(x[0] + move[0], begin[0] - 0.5, begin[0] + 0.5)
        tried = jnp.concatenate([jnp.maximum(near, 0.0)[None], limited])
        plan = trajectory_on_path(scene, _stations(scene, tried[0], tried[1:]))
        found = value(tried)
        safe = check(scene, _one(plan), config.safety).admissible[0]
        better = (found > best) & safe
        x = jnp.where(better, tried, x)
        best = jnp.where(better, found, best)
        return (x, best, jnp.where(better, step * 1.2, step * config.shrink)), None

    initial = (begin, value(begin), jnp.asarray(config.first_step))
    (x, best, _), _ = jax.lax.scan(climb, initial, None, length=config.steps)
    refined = trajectory_on_path(scene, _stations(scene, x[0], x[1:]))
    given = score(params, scene, _one(start))[0]
    keep = best > given
    pick = lambda a, b: jnp.where(keep, a, b)  # noqa: E731
    return jax.tree.map(pick, refined, start), jnp.maximum(best, given)
