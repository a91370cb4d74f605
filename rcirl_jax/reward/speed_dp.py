"""The second hand-set baseline: Apollo's speed DP cost with its published weights.

Source: Apollo's path-time heuristic optimiser (default_speed_config, unchanged from
5.5 to 10.0). There it is minimised on a grid of stations and times; here it values the
same candidates as every other row, with the derivatives of the trajectory instead of
differences between nodes.

Three things differ from Apollo. The cruise speed is the limit where the ego is. A
trajectory through an obstacle or over a line that demands a stop costs infinitely
much in Apollo and 1e9 more here, so that those can still be ordered. Keep-clear
areas are not known.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rcirl_jax.features.columns import COLUMNS
from rcirl_jax.features.mapping import make_frame
from rcirl_jax.types import Scene, Trajectory
from rcirl_jax.units import DT_S

SPEED_DP_ROW = "hand-set DP"  # name of its row in all tables


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpeedDpCost:
    """Weights and constants of Apollo's speed DP; any field may be traced."""

    speed: ArrayLike = 1e3  # default_speed_cost, before the next three
    exceed: ArrayLike = 1e3
    below: ArrayLike = 10.0  # low_speed_penalty
    cruise: ArrayLike = 10.0  # reference_speed_penalty, s/m
    acceleration: ArrayLike = 1.0  # s^4/m^2
    braking: ArrayLike = 1.0
    jerk: ArrayLike = 1.0  # s^6/m^2, both signs
    max_acceleration: ArrayLike = 2.0  # m/s^2
    max_braking: ArrayLike = 4.0  # m/s^2
    obstacle: ArrayLike = 1e4  # 1/m^2
    safe_distance: ArrayLike = 20.0  # m, ahead and behind
    way: ArrayLike = 100.0  # 1/m, spatial_potential_penalty
    collision_check: ArrayLike = 1e9

    def fields(self) -> dict[str, jax.Array]:
        """Field -> float32 [], a pytree; `SpeedDpCost(**fields)` is the inverse."""
        pairs = dataclasses.asdict(self).items()
        return {name: jnp.asarray(value, jnp.float32) for name, value in pairs}


def point_cost(
    limit: Float[Array, "..."],
    v: Float[Array, "..."],
    s: Float[Array, "..."],
    ahead: Float[Array, "..."],
    behind: Float[Array, "..."],
    weights: SpeedDpCost,
) -> Float[Array, "..."]:
    """The part of `speed_dp_cost` that place and speed decide at one time, per s.

    Arguments are broadcast.

    Args:
      limit: m/s, speed limit.
      v: m/s.
      s: m, station.
      ahead: m, gap to the nearest ahead.
      behind: m, to the nearest behind.
      weights: of the cost.
    """
    limit = jnp.maximum(limit, 0.1)
    over = (v - limit) / limit
    off_speed = (
        weights.exceed * jnp.maximum(over, 0.0) ** 2
        + weights.below * jnp.maximum(-over, 0.0)
        + weights.cruise * jnp.abs(v - limit)
    )
    near = jnp.maximum(weights.safe_distance - ahead, 0.0) ** 2
    near = near + jnp.maximum(weights.safe_distance - behind, 0.0) ** 2
    cost = weights.speed * off_speed + weights.obstacle * near - weights.way * s
    return jnp.asarray(cost)


def effort_cost(a: Float[Array, "..."], weights: SpeedDpCost) -> Float[Array, "..."]:
    """The part of `speed_dp_cost` that acceleration `a` m/s^2 decides, per s."""
    effort = jnp.where(a > 0.0, weights.acceleration, weights.braking)
    soft = weights.acceleration**2 * jax.nn.sigmoid(a - weights.max_acceleration)
    soft = soft + weights.braking**2 * jax.nn.sigmoid(-a - weights.max_braking)
    return jnp.asarray(a**2 * (effort + soft))


def speed_dp_cost(
    scene: Scene, trajectory: Trajectory, weights: SpeedDpCost = SpeedDpCost()
) -> Float[Array, ""]:
    """Cost of one trajectory, the sum over valid times; lower is better, no unit.

        cost = sum_t dt [ 1e3 (1e3 max(e, 0)^2 + 10 max(-e, 0) + 10 |v - v_lim|)
               + a^2 (1 + sigma(a - 2) + sigma(-a - 4)) + j^2
               + 1e4 (max(20 - gap_ahead, 0)^2 + max(20 - gap_behind, 0)^2)
               - 100 s ],   e = (v - v_lim) / v_lim

    Args:
      scene: one scene; times outside its mask and t = 0, which is given, do not count.
      trajectory: one, [T].
      weights: Apollo's by default.
    """
    frame = make_frame(scene, trajectory)
    column = {name: COLUMNS[name](frame) for name in _READ}
    gaps = column["follow_distance"], column["overtake_distance"]
    here = column["speed_limit"], trajectory.v, trajectory.s
    at_time = (
        point_cost(*here, *gaps, weights)
        + effort_cost(trajectory.a, weights)
        + weights.jerk * trajectory.j**2
    )
    counts = scene.time_valid.at[0].set(False)
    hits = jnp.any((column["collision"] > 0.0) & scene.time_valid)
    total = DT_S * jnp.sum(jnp.where(counts, at_time, 0.0))
    return total + hits * weights.collision_check


_READ = ("speed_limit", "follow_distance", "overtake_distance", "collision")
