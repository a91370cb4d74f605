"""What losses know of a candidate besides its features: distances, faults, density."""

import jax
import jax.numpy as jnp

from rcirl_jax.features.columns import Frame
from rcirl_jax.train.state import Facts, TrainConfig
from rcirl_jax.types import Candidates, Trajectory

OVER_LIMIT_MPS = 0.5  # m/s above the limit that counts as breaking it
KERNEL_M = 2.0  # m, bandwidth of the proposal's density


def facts_of(
    driven: Trajectory,
    candidates: Candidates,
    frames: Frame,
    valid: jax.Array,
    config: TrainConfig,
) -> Facts:
    """Distances, collisions, broken rules and densities of one scene, leaves [K].

    Over the times in `valid` [T]; the human's own are of the recorded curve.
    `frames` are those of the candidates, [T, K].
    """
    x = candidates.trajectory
    count = jnp.sum(valid)

    def apart(a: Trajectory, b: Trajectory) -> jax.Array:
        """Mean distance [m] over valid times."""
        distance = jnp.sqrt((a.s - b.s) ** 2 + (a.l - b.l) ** 2 + 1e-9)
        return jnp.sum(jnp.where(valid, distance, 0.0), axis=-1) / count

    seen = valid[:, None]
    fast = frames.point.v > frames.path.speed_limit + OVER_LIMIT_MPS
    unlawful = (fast | (frames.relations.line_overrun > 0.0)) & seen
    human_density, density = jnp.zeros(()), jnp.zeros(x.s.shape[:1])
    if config.loss == "listwise":
        row = jax.vmap(lambda one: apart(x, one))
        others = candidates.feasible & ~jnp.eye(density.size, dtype=bool)
        density = log_density(row(x), others)
        human_density = log_density(apart(x, driven), candidates.feasible)
    return Facts(
        human_distance=jnp.zeros(()),
        human_collides=jnp.zeros((), bool),
        distance=apart(x, driven),
        collides=jnp.any((frames.relations.body < 0.0) & seen, axis=0),
        breaks_rule=jnp.sum(unlawful, axis=0) / count,
        human_density=human_density,
        density=density,
    )


def log_density(distance: jax.Array, others: jax.Array) -> jax.Array:
    """Log of the kernel density of the candidates [...].

    Each trajectory counts as one sample of its own, so that none has density 0.

    Args:
      distance: [..., K] in m, to every candidate.
      others: [..., K] bool, candidates that count besides it; a twin of it does.
    """
    kernel = -0.5 * (distance / KERNEL_M) ** 2
    own = jnp.zeros_like(distance[..., :1])
    logits = jnp.where(others, kernel, -jnp.inf)
    return jax.nn.logsumexp(jnp.concatenate([own, logits], axis=-1), axis=-1)
