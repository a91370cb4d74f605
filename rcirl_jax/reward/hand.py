"""The hand-set rival: Apollo's lattice cost with its published weights.

Source: Apollo's TrajectoryEvaluator; six terms whose weights have stood as
command-line constants since 2018. It is a functional of the whole trajectory
(ratios of sums), so it is computed from features, not per point.
"""

import dataclasses

import jax
import jax.numpy as jnp

from rcirl_jax.features.columns import COLUMNS, LINE_CAP_M, make_frame
from rcirl_jax.types import Scene, Trajectory
from rcirl_jax.units import TIMES_S


@dataclasses.dataclass(frozen=True, kw_only=True)
class LatticeCost:
    """Weights and constants of Apollo's lattice cost."""

    objective: float = 10.0
    jerk: float = 1.0
    collision: float = 5.0
    centripetal: float = 1.5
    lateral_offset: float = 2.0
    lateral_comfort: float = 10.0
    # inside the objective: speed against distance travelled
    objective_speed: float = 1.0
    objective_distance: float = 10.0
    jerk_bound: float = 4.0  # m/s^3
    collision_sigma: float = 0.5  # m
    yield_buffer: float = 1.0  # m
    overtake_buffer: float = 5.0  # m
    offset_scale: float = 3.0  # m
    comfort_braking: float = 3.0  # m/s^2, half of the 6 m/s^2 limit
    # Apollo drops colliding trajectories after sorting; here they cost this much
    # more, which sorts them last
    collision_check: float = 1000.0


def _ratio(x: jax.Array, valid: jax.Array) -> jax.Array:
    """Sum x^2 / sum |x| over valid times, 0 for x = 0."""
    square = jnp.sum(jnp.where(valid, x**2, 0.0))
    size = jnp.sum(jnp.where(valid, jnp.abs(x), 0.0))
    return square / (size + 1e-6)


def lattice_cost(
    scene: Scene, trajectory: Trajectory, weights: LatticeCost = LatticeCost()
) -> jax.Array:
    """Apollo's lattice cost of one trajectory; lower is better, no unit.

        cost = 10 objective + 1 jerk + 5 collision + 1.5 centripetal
               + 2 lateral_offset + 10 lateral_comfort

    with v_ref = min(limit, sqrt(2 * 3 * distance to a stop)); a trajectory that
    collides costs 1000 more, so that it comes last as in Apollo.
    """
    frame, valid = make_frame(scene, trajectory), scene.time_valid
    column = {name: COLUMNS[name](frame) for name in _READ}
    times = jnp.asarray(TIMES_S)
    to_stop = jnp.minimum(column["stop_distance"], column["virtual_distance"])
    braking = jnp.sqrt(2.0 * weights.comfort_braking * to_stop)
    free = to_stop >= LINE_CAP_M
    limit = column["speed_limit"]
    reference = jnp.where(free, limit, jnp.minimum(limit, braking))
    early = jnp.where(valid, times**2, 0.0)
    off_speed = jnp.sum(early * jnp.abs(reference - trajectory.v)) / jnp.sum(early)
    travelled = jnp.max(jnp.where(valid, trajectory.s, 0.0))
    total = weights.objective_speed + weights.objective_distance
    objective = (
        weights.objective_speed * off_speed
        + weights.objective_distance / (1.0 + travelled)
    ) / total
    distance = jnp.minimum(
        jnp.maximum(column["follow_distance"] - weights.yield_buffer, 0.0),
        jnp.maximum(column["overtake_distance"] - weights.overtake_buffer, 0.0),
    )
    distance = jnp.where(column["collision"] > 0.0, 0.0, distance)
    near = jnp.exp(-0.5 * (distance / weights.collision_sigma) ** 2)
    comfort = jnp.abs(trajectory.ddl * trajectory.v**2 + trajectory.dl * trajectory.a)
    collides = jnp.any((column["collision"] > 0.0) & valid)
    return (
        weights.collision_check * collides
        + weights.objective * objective
        + weights.jerk * _ratio(trajectory.j / weights.jerk_bound, valid)
        + weights.collision * _ratio(near, valid)
        + weights.centripetal * _ratio(column["lateral_acceleration"], valid)
        + weights.lateral_offset * _ratio(trajectory.l / weights.offset_scale, valid)
        + weights.lateral_comfort * jnp.max(jnp.where(valid, comfort, 0.0))
    )


_READ = (
    "stop_distance",
    "virtual_distance",
    "speed_limit",
    "follow_distance",
    "overtake_distance",
    "collision",
    "lateral_acceleration",
)
