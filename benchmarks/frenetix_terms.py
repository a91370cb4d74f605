"""The cost terms that Frenetix drives with by default, written anew, with its weights.

    rcirl autotune --data=out/us101,out/urban,out/i80 --output=RUN \
      --terms=benchmarks/frenetix_terms.py:TERMS --cases=10 --duration=60

Names and weights are those of its `cost.yaml`. There a term is a sum over samples 0.1 s
apart, or an integral over seconds; a mean over times is as much of a second, so a sum
counts ten times. Its collision probability takes covariances from its own prediction;
here they grow with time.
"""

import jax
import jax.numpy as jnp
from jax.scipy.stats import norm

from rcirl_jax.types import Scene, Trajectory
from rcirl_jax.units import TIMES_S

SAMPLES_PER_S = 10.0


def longitudinal_jerk(scene: Scene, x: Trajectory) -> jax.Array:
    """Returns the squared jerk along the path [T], m^2/s^6."""
    del scene
    return x.j**2


def lateral_jerk(scene: Scene, x: Trajectory) -> jax.Array:
    """Returns the square of ddl v^2 [T], m^2/s^4: what bends away from the path."""
    del scene
    return (x.ddl * x.v**2) ** 2


def velocity_offset(scene: Scene, x: Trajectory) -> jax.Array:
    """Returns the distance to the limit's speed [T], m/s, summed over samples."""
    return SAMPLES_PER_S * jnp.abs(x.v - scene.path.speed_limit[0])


def distance_to_reference_path(scene: Scene, x: Trajectory) -> jax.Array:
    """Returns the distance to the path [T], m, summed over samples."""
    del scene
    return SAMPLES_PER_S * jnp.abs(x.l)


def prediction(scene: Scene, x: Trajectory) -> jax.Array:
    """Returns 1,000 times the probability [T] that a body is where the ego is.

    A body's rear, middle and front are normally distributed along and across the path.
    """
    bodies, t = scene.obstacles, jnp.asarray(TIMES_S)

    def inside(
        at: jax.Array, middle: jax.Array, half: jax.Array, deviation: jax.Array
    ) -> jax.Array:
        ends = (middle + half - at) / deviation, (middle - half - at) / deviation
        return norm.cdf(ends[0]) - norm.cdf(ends[1])

    side = 0.5 * (bodies.l_lower + bodies.l_upper)
    across = inside(side, x.l, 0.5 * scene.ego.width, 0.2 + 0.05 * t)
    middle = 0.5 * (bodies.s_lower + bodies.s_upper)
    points = (bodies.s_lower, middle, bodies.s_upper)
    along = sum(inside(at, x.s, 0.5 * scene.ego.length, 0.3 + 0.4 * t) for at in points)
    probability = jnp.where(bodies.valid, along * across, 0.0).sum(axis=0)
    return SAMPLES_PER_S * 1000.0 * probability


TERMS = {
    "longitudinal_jerk": (longitudinal_jerk, 1.0),
    "lateral_jerk": (lateral_jerk, 1.0),
    "velocity_offset": (velocity_offset, 1.0),
    "distance_to_reference_path": (distance_to_reference_path, 3.0),
    "prediction": (prediction, 200.0),
}
