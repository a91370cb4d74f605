"""Lateral profiles l(s): what the ego may do across the road."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.geometry.polynomial import evaluate, quintic
from rcirl_jax.sampling.config import SamplerConfig
from rcirl_jax.types import Scene
from rcirl_jax.units import STATION_STEP_M


def num_lateral(config: SamplerConfig) -> int:
    """Number of lateral profiles: hold, centre, two neighbours each time, nudges."""
    return 1 + 3 * len(config.lateral_times) + len(config.nudge_offsets)


def lateral_targets(
    scene: Scene, config: SamplerConfig
) -> tuple[Float[Array, " m"], Float[Array, " m"], Float[Array, " m"]]:
    """Target offset [m], length of the move [m] and its validity per profile.

    Profile 0 holds the offset of t = 0, profile 1 goes to the lane's centre;
    the others are neighbouring lanes (valid inside the road's edges) and
    nudges. A move takes `lateral_times` at the present speed.
    """
    ego, path = scene.ego, scene.path
    left = lookup(path.lane_left, ego.s, STATION_STEP_M)
    right = lookup(path.lane_right, ego.s, STATION_STEP_M)
    centre, width = 0.5 * (left + right), left - right
    road = (
        lookup(path.road_right, ego.s, STATION_STEP_M) + 0.5 * ego.width,
        lookup(path.road_left, ego.s, STATION_STEP_M) - 0.5 * ego.width,
    )
    targets, times = [ego.l], [max(config.lateral_times)]
    for shift in (0.0, 1.0, -1.0):
        for time in config.lateral_times:
            targets.append(centre + shift * width)
            times.append(time)
    for offset in config.nudge_offsets:
        targets.append(ego.l + offset)
        times.append(max(config.lateral_times))
    target = jnp.stack([jnp.asarray(value, jnp.float32) for value in targets])
    lengths = jnp.asarray(times, jnp.float32) * ego.v
    inside = (target >= road[0]) & (target <= road[1])
    free = jnp.arange(target.size) < 1 + len(config.lateral_times)
    return (
        target,
        jnp.maximum(lengths, config.min_lateral_length),
        (inside | free).astype(jnp.float32),
    )


def lateral_offset(
    scene: Scene, target: jax.Array, length: jax.Array, s: Float[Array, " t"]
) -> Float[Array, " t"]:
    """L [T] m along stations s: a quintic in s to the target, then constant."""
    ego = scene.ego
    curve = quintic(ego.l, ego.dl, ego.ddl, target, 0.0, 0.0, length)
    way = jnp.clip(s - ego.s, 0.0, length)
    return jax.vmap(evaluate, in_axes=(None, 0))(curve, way)[0]
