"""The hand-set baseline: Apollo's lattice cost with its published weights.

Source: Apollo's TrajectoryEvaluator; six terms whose weights have stood as
command-line constants since 2018. It is a functional of the whole trajectory
(ratios of sums), so it is computed from features, not per point.

The weights may be traced: `lattice_terms` is what does not depend on them, and
`tuned` reads them from a vector, so one compiled program scores any weights.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from rcirl_jax.features.columns import (
    COLUMNS,
    LINE_CAP_M,
    Frame,
)
from rcirl_jax.features.mapping import candidate_frames, make_frame
from rcirl_jax.types import Scene, Trajectory
from rcirl_jax.units import DT_S, TIMES_S

TUNED_ROW = "hand-set, tuned"  # name of the tuned cost's row in all tables
LONG_ROW = "hand-set, tuned long"  # of one tuned with many more queries

# What a tuner may change, in the order of its vector; all but the last two
# stand before a term of the sum.
TUNABLE = (
    "objective",
    "jerk",
    "collision",
    "centripetal",
    "lateral_offset",
    "lateral_comfort",
    "objective_speed",
    "speed_share",
)
NUM_TERMS = 6  # 1, of TUNABLE, weights of terms
LARGEST_LOG = 10.0  # a tuned weight is within a factor exp(10) = 22,026 of Apollo's
SPEED_SHARES = (0.05, 2.0)  # 1, least and largest tuned speed_share


@dataclasses.dataclass(frozen=True, kw_only=True)
class LatticeCost:
    """Weights and constants of Apollo's lattice cost; any field may be traced."""

    objective: ArrayLike = 10.0
    jerk: ArrayLike = 1.0
    collision: ArrayLike = 5.0
    centripetal: ArrayLike = 1.5
    lateral_offset: ArrayLike = 2.0
    lateral_comfort: ArrayLike = 10.0
    # inside the objective: speed against distance travelled
    objective_speed: ArrayLike = 1.0
    objective_distance: ArrayLike = 10.0
    # the speed wanted on a free road, as a share of the limit (Apollo: the limit)
    speed_share: ArrayLike = 1.0
    jerk_bound: ArrayLike = 4.0  # m/s^3
    collision_sigma: ArrayLike = 0.5  # m
    yield_buffer: ArrayLike = 1.0  # m
    overtake_buffer: ArrayLike = 5.0  # m
    offset_scale: ArrayLike = 3.0  # m
    comfort_braking: ArrayLike = 3.0  # m/s^2, half of the 6 m/s^2 limit
    # Apollo drops colliding trajectories after sorting; here they cost this much
    # more, which sorts them last
    collision_check: ArrayLike = 1000.0

    def fields(self) -> dict[str, jax.Array]:
        """Field -> float32 [], a pytree; `LatticeCost(**fields)` is the inverse."""
        pairs = dataclasses.asdict(self).items()
        return {name: jnp.asarray(value, jnp.float32) for name, value in pairs}


class LatticeTerms(NamedTuple):
    """The terms of the cost of one trajectory (or of K, last axis), unweighted."""

    limit: Float[Array, "t ..."]  # m/s, speed limit where the ego is
    approach: Float[Array, "t ..."]  # m/s, from which it can stop in time; or inf
    speed: Float[Array, "t ..."]  # m/s
    early: Float[Array, "t ..."]  # s^2, t^2 at valid times, else 0
    travelled: Float[Array, "..."]  # m
    jerk: Float[Array, "..."]  # 1, and so are the next three
    collision: Float[Array, "..."]
    centripetal: Float[Array, "..."]  # m/s^2
    lateral_offset: Float[Array, "..."]
    lateral_comfort: Float[Array, "..."]  # m/s^2
    collides: Bool[Array, "..."]


def tuned(vector: Float[Array, " d"]) -> LatticeCost:
    """The cost of a tuner's vector of log-weights; zeros are Apollo's, exactly.

        weight_i = Apollo's_i exp(clip(x_i, -10, 10)),  speed_share in [0.05, 2]

    The charge of a collision grows with the largest weight of a term, so that
    colliding trajectories stay last.

    Args:
      vector: [8] x, in the order of `TUNABLE`; may be traced.
    """
    if vector.shape != (len(TUNABLE),):
        raise ValueError(f"vector: shape {vector.shape}: expected {len(TUNABLE)}")
    apollo = LatticeCost()
    factor = jnp.exp(jnp.clip(vector, -LARGEST_LOG, LARGEST_LOG))
    fields = {name: getattr(apollo, name) * factor[i] for i, name in enumerate(TUNABLE)}
    fields["speed_share"] = jnp.clip(fields["speed_share"], *SPEED_SHARES)
    largest = jnp.maximum(jnp.max(factor[:NUM_TERMS]), 1.0)
    return LatticeCost(**fields, collision_check=apollo.collision_check * largest)


def _ratio(x: jax.Array, valid: jax.Array) -> jax.Array:
    """Sum x^2 / sum |x| over valid times (first axis), 0 for x = 0."""
    square = jnp.sum(jnp.where(valid, x**2, 0.0), axis=0)
    size = jnp.sum(jnp.where(valid, jnp.abs(x), 0.0), axis=0)
    return square / (size + 1e-6)


def approach_speed(
    stop: Float[Array, "..."], virtual: Float[Array, "..."], weights: LatticeCost
) -> Float[Array, "..."]:
    """Returns the speed m/s from which the nearer of two lines, m away, is met gently.

    sqrt(2 comfort_braking distance), inf where there is none; broadcast
    """
    to_stop = jnp.minimum(stop, virtual)
    braking = jnp.sqrt(jnp.multiply(2.0, weights.comfort_braking) * to_stop)
    return jnp.where(to_stop >= LINE_CAP_M, jnp.inf, braking)


def nearness(
    ahead: Float[Array, "..."], behind: Float[Array, "..."], weights: LatticeCost
) -> Float[Array, "..."]:
    """Returns 1 within the buffers to who is ahead and behind, less beyond; gaps in m.

    exp(-distance^2 / (2 sigma^2)), broadcast
    """
    distance = jnp.minimum(
        jnp.maximum(ahead - weights.yield_buffer, 0.0),
        jnp.maximum(behind - weights.overtake_buffer, 0.0),
    )
    return jnp.exp(-0.5 * (distance / weights.collision_sigma) ** 2)


def lattice_terms(
    scene: Scene, trajectory: Trajectory, weights: LatticeCost = LatticeCost()
) -> LatticeTerms:
    """The terms of one trajectory; reads only fields that `TUNABLE` does not name."""
    return _terms(make_frame(scene, trajectory), scene.time_valid, weights)


def _terms(frame: Frame, valid: jax.Array, weights: LatticeCost) -> LatticeTerms:
    """From frames [T] of one trajectory, or [T, K] of K with `valid` [T, 1]."""
    x = frame.point
    column = {name: COLUMNS[name](frame) for name in _READ}
    times = jnp.asarray(TIMES_S).reshape(valid.shape)
    near = nearness(column["follow_distance"], column["overtake_distance"], weights)
    near = jnp.where(column["collision"] > 0.0, 1.0, near)
    comfort = jnp.abs(x.ddl * x.v**2 + x.dl * x.a)
    return LatticeTerms(
        limit=column["speed_limit"],
        approach=approach_speed(
            column["stop_distance"], column["virtual_distance"], weights
        ),
        speed=x.v,
        early=jnp.where(valid, times**2, 0.0),
        travelled=jnp.max(jnp.where(valid, x.s, 0.0), axis=0),
        jerk=_ratio(x.j / weights.jerk_bound, valid),
        collision=_ratio(near, valid),
        centripetal=_ratio(column["lateral_acceleration"], valid),
        lateral_offset=_ratio(x.l / weights.offset_scale, valid),
        lateral_comfort=jnp.max(jnp.where(valid, comfort, 0.0), axis=0),
        collides=jnp.any((column["collision"] > 0.0) & valid, axis=0),
    )


def weighted_cost(terms: LatticeTerms, weights: LatticeCost) -> Float[Array, "..."]:
    """The cost of one trajectory's terms under some weights; see `lattice_cost`."""
    reference = jnp.minimum(terms.limit * weights.speed_share, terms.approach)
    off_speed = jnp.sum(terms.early * jnp.abs(reference - terms.speed), axis=0)
    # nothing is early where t = 0 is the only valid time
    off_speed = off_speed / jnp.maximum(jnp.sum(terms.early), DT_S**2)
    far = weights.objective_distance / (1.0 + terms.travelled)
    total = jnp.add(weights.objective_speed, weights.objective_distance)
    objective = (off_speed * weights.objective_speed + far) / total
    return (
        terms.collides * weights.collision_check
        + objective * weights.objective
        + terms.jerk * weights.jerk
        + terms.collision * weights.collision
        + terms.centripetal * weights.centripetal
        + terms.lateral_offset * weights.lateral_offset
        + terms.lateral_comfort * weights.lateral_comfort
    )


def lattice_cost(
    scene: Scene, trajectory: Trajectory, weights: LatticeCost = LatticeCost()
) -> jax.Array:
    """Apollo's lattice cost of one trajectory; lower is better, no unit.

        cost = 10 objective + 1 jerk + 5 collision + 1.5 centripetal
               + 2 lateral_offset + 10 lateral_comfort

    with v_ref = min(speed_share * limit, sqrt(2 * 3 * distance to a stop)); a
    trajectory that collides costs 1000 more, so that it comes last as in Apollo.
    """
    return weighted_cost(lattice_terms(scene, trajectory, weights), weights)


def lattice_costs(
    scene: Scene, trajectories: Trajectory, weights: LatticeCost = LatticeCost()
) -> Float[Array, " k"]:
    """`lattice_cost` of K trajectories [K, T] in long loops, over features' frames."""
    frames = candidate_frames(scene, trajectories)
    return weighted_cost(_terms(frames, scene.time_valid[:, None], weights), weights)


_READ = (
    "stop_distance",
    "virtual_distance",
    "speed_limit",
    "follow_distance",
    "overtake_distance",
    "collision",
    "lateral_acceleration",
)
