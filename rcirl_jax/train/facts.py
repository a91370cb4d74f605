"""What losses know of a candidate besides its features: distances, faults, density."""

import jax
import jax.numpy as jnp

from rcirl_jax.features.columns import Frame
from rcirl_jax.planner.safety import check
from rcirl_jax.reward.module import product
from rcirl_jax.train.state import Facts, TrainConfig
from rcirl_jax.types import Candidates, Scene, Tag, Trajectory

OVER_LIMIT_MPS = 0.5  # m/s above the limit that counts as breaking it
KERNEL_M = 2.0  # m, bandwidth of the proposal's density


def facts_of(
    driven: Trajectory,
    candidates: Candidates,
    frames: Frame,
    valid: jax.Array,
) -> Facts:
    """Distances, collisions and broken rules of one scene, leaves [K].

    Over the times in `valid` [T]; the human's own are of the recorded trajectory.
    `frames` are those of the candidates, [T, K].
    """
    x = candidates.trajectory
    count = jnp.sum(valid)
    seen = valid[:, None]
    fast = frames.point.v > frames.path.speed_limit + OVER_LIMIT_MPS
    crossed = frames.relations.line_overrun > 0.0  # at the one time that it happens
    return Facts(
        human_distance=jnp.zeros(()),
        human_collides=jnp.zeros((), bool),
        distance=mean_distance(x, driven, valid),
        collides=jnp.any((frames.relations.body < 0.0) & seen, axis=0),
        breaks_rule=jnp.where(
            jnp.any(crossed & seen, axis=0), 1.0, jnp.sum(fast & seen, axis=0) / count
        ),
        human_density=jnp.zeros(()),
        density=jnp.zeros(x.s.shape[:1]),
    )


def admitted(scene: Scene, candidates: Candidates, config: TrainConfig) -> jax.Array:
    """[K] bool: candidates that the safety filter lets a planner choose.

    An expert in the simulator stops at a line and then drives over it; the planner's
    view at the start of the scene forbids that for all its times.

    Args:
      scene: as the planner sees it.
      candidates: of it, K.
      config: `admissible_in` says in which scenes the filter is asked: in none, in
        those that an expert drove, or in all; elsewhere every candidate is admitted.
    """
    if config.admissible_in == "none":
        return jnp.ones(candidates.feasible.shape, bool)
    passed = check(scene, candidates).admissible
    if config.admissible_in == "simulated":
        passed = passed | ~scene.tags[Tag.SIMULATED]
    return passed


def densities(
    driven: Trajectory, x: Trajectory, counts: jax.Array, valid: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Log densities of the human [] and of the candidates [K] (`log_density`).

    Args:
      driven: the human's curve.
      x: the candidates, [K, T].
      counts: [K] bool, those that the partition function sums over, and the positive.
      valid: [T] bool, times that count.
    """
    # the human's own curve, the origin, stands last
    s, l = (
        jnp.pad(a - b, ((0, 1), (0, 0))) for a, b in ((x.s, driven.s), (x.l, driven.l))
    )
    squared = rms_squared(s, l, valid)
    others = counts & ~jnp.eye(counts.size, dtype=bool)
    human = log_density(squared[-1, :-1], counts)
    return human, log_density(squared[:-1, :-1], others)


def rms_squared(s: jax.Array, l: jax.Array, valid: jax.Array) -> jax.Array:
    """Squared RMS distances [K, K] m^2 of K trajectories over valid times [T].

    d_ij^2 = |p_i|^2 + |p_j|^2 - 2 p_i p_j with each trajectory as a vector p: a matrix
    product, where the differences of all pairs take twenty times as long.

    Args:
      s: [K, T] m, stations from an origin near the curves, for the sake of rounding.
      l: [K, T] m, offsets likewise.
      valid: [T] bool.
    """
    weight = jnp.sqrt(valid / jnp.sum(valid))
    p = jnp.concatenate([s * weight, l * weight], axis=1)
    own = jnp.sum(p * p, axis=1)
    return jnp.maximum(own[:, None] + own - 2.0 * product(p, p.T), 0.0)


def mean_distance(a: Trajectory, b: Trajectory, valid: jax.Array) -> jax.Array:
    """Mean distance [m] over valid times [T]."""
    distance = jnp.sqrt((a.s - b.s) ** 2 + (a.l - b.l) ** 2 + 1e-9)
    return jnp.sum(jnp.where(valid, distance, 0.0), axis=-1) / jnp.sum(valid)


def log_density(squared: jax.Array, others: jax.Array) -> jax.Array:
    """Log of the kernel density of the candidates [...].

    log(1 + sum over others of exp(-d^2 / (2 KERNEL_M^2))): each trajectory counts as
    one sample of its own, so that none has density 0.

    Args:
      squared: [..., K] in m^2, squared distance to every candidate.
      others: [..., K] bool, candidates that count besides it; a twin of it does.
    """
    kernel = jnp.exp(-0.5 * squared / KERNEL_M**2)
    return jnp.log1p(jnp.sum(jnp.where(others, kernel, 0.0), axis=-1))
