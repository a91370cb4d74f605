"""Own costs as sums over times, which is what dynamic programming can search.

    V_own = sum_t [ point_t(s_t, v_t) + action(a_t) + jerk(j_t) ]

+velocity and Apollo's speed DP cost are such sums. Apollo's lattice cost is not: its
terms are ratios N / D of sums. At a reference trajectory with r_0 = N_0 / D_0

    N / D  ~  r_0 + (N - r_0 D) / D_0

where the right side is a sum with the same value and the same slope. A search over it
proposes plans; what they are worth, the cost itself says. Constants and lateral terms
are left out, since the path is given.
"""

from collections.abc import Callable
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.features.columns import COLUMNS
from rcirl_jax.features.mapping import candidate_frames, make_frame
from rcirl_jax.reward.hand import (
    LatticeCost,
    approach_speed,
    lattice_terms,
    nearness,
)
from rcirl_jax.reward.speed_dp import (
    SPEED_DP_ROW,
    SpeedDpCost,
    effort_cost,
    point_cost,
)
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.types import Scene, Trajectory
from rcirl_jax.units import DT_S, NUM_TIMES

LEAST_SUM = 1.0  # of D_0: a reference without jerk would forbid any


class Grid(NamedTuple):
    """The places at which a sum is wanted."""

    stations: jax.Array  # [N] m
    speeds: jax.Array  # [U] m/s
    actions: jax.Array  # [K] m/s^2


class TimeSum(flax.struct.PyTreeNode, kw_only=True):
    """V_own of the module's equation on a grid; higher is better.

    At t = 0 station, speed and acceleration are given, so only jerk counts there.
    """

    point: jax.Array  # [T, U, N] of speed and station, 0 at times that do not count
    action: jax.Array  # [K] of acceleration
    square: jax.Array  # [] of jerk squared, s^6/m^2
    size: jax.Array  # [] of |jerk|, s^3/m
    counts: jax.Array  # [T] 1.0 at times that count, else 0.0

    def of_jerk(self, j: jax.Array) -> jax.Array:
        """The share of jerk `j` [...] m/s^3."""
        return self.square * j**2 + self.size * jnp.abs(j)


def _columns(
    scene: Scene, stations: jax.Array, names: tuple[str, ...]
) -> dict[str, jax.Array]:
    """Columns of F [T, 1, N] at stations [N] m, at 1 m/s and without acceleration."""
    s = jnp.broadcast_to(stations[:, None], (stations.shape[0], NUM_TIMES))
    on_path = jax.vmap(trajectory_on_path, in_axes=(None, 0))(scene, s)
    still = jnp.zeros_like(s)
    frame = candidate_frames(scene, on_path.replace(v=still + 1.0, a=still, j=still))
    return {name: COLUMNS[name](frame)[:, None] for name in names}


def _nothing(scene: Scene, grid: Grid, reference: Trajectory | None) -> TimeSum:
    del reference
    zero = jnp.zeros(())
    return TimeSum(
        point=jnp.zeros((NUM_TIMES, grid.speeds.size, grid.stations.size)),
        action=jnp.zeros(grid.actions.shape),
        square=zero,
        size=zero,
        counts=scene.time_valid.astype(jnp.float32),
    )


def _velocity(scene: Scene, grid: Grid, reference: Trajectory | None) -> TimeSum:
    nothing = _nothing(scene, grid, reference)
    mean = nothing.counts / jnp.sum(nothing.counts)
    return nothing.replace(
        point=nothing.point + mean[:, None, None] * grid.speeds[:, None]
    )


def _speed_dp(scene: Scene, grid: Grid, reference: Trajectory | None) -> TimeSum:
    """Minus `speed_dp_cost`, whose collisions are the search's to forbid."""
    del reference
    weights = SpeedDpCost()
    names = ("speed_limit", "follow_distance", "overtake_distance")
    limit, ahead, behind = _columns(scene, grid.stations, names).values()
    here = limit, grid.speeds[:, None], grid.stations
    counts = scene.time_valid.at[0].set(False).astype(jnp.float32)
    cost = point_cost(*here, ahead, behind, weights)
    return TimeSum(
        point=-DT_S * counts[:, None, None] * cost,
        action=-DT_S * effort_cost(grid.actions, weights),
        square=jnp.asarray(-DT_S * weights.jerk),
        size=jnp.zeros(()),
        counts=counts,
    )


def _lattice(scene: Scene, grid: Grid, reference: Trajectory) -> TimeSum:
    """Minus `lattice_cost`, its ratios linear about the reference."""
    weights, valid = LatticeCost(), scene.time_valid
    terms = lattice_terms(scene, reference)
    names = (
        *("speed_limit", "stop_distance", "virtual_distance", "follow_distance"),
        *("overtake_distance", "lateral_acceleration"),
    )
    found = _columns(scene, grid.stations, names)
    limit, stop, virtual, ahead, behind, bend = found.values()
    frame = make_frame(scene, reference)
    there = {name: COLUMNS[name](frame) for name in names}

    def slopes(at_reference: jax.Array, ratio: jax.Array) -> tuple:
        """Weights of x^2 and |x| in a ratio about its value [] at the reference [T]."""
        total = jnp.sum(jnp.where(valid, jnp.abs(at_reference), 0.0))
        total = jnp.maximum(total, LEAST_SUM)
        return 1.0 / total, -ratio / total

    def linear(x: jax.Array, at_reference: jax.Array, ratio: jax.Array) -> jax.Array:
        square, size = slopes(at_reference, ratio)
        return square * x**2 + size * jnp.abs(x)

    v = grid.speeds[:, None]
    approach = approach_speed(stop, virtual, weights)
    wanted = jnp.minimum(limit * weights.speed_share, approach)
    early = (terms.early / jnp.maximum(jnp.sum(terms.early), DT_S**2))[:, None, None]
    # the way travelled is the station at the last time that counts
    last = (valid & ~jnp.append(valid[1:], False))[:, None, None]
    far = weights.objective_distance / (1.0 + grid.stations)
    objective = weights.objective_speed * early * jnp.abs(wanted - v) + last * far
    objective = objective / (weights.objective_speed + weights.objective_distance)
    near = nearness(ahead, behind, weights)
    near_there = nearness(there["follow_distance"], there["overtake_distance"], weights)
    cost = (
        weights.objective * objective
        + weights.collision * linear(near, near_there, terms.collision)
        + weights.centripetal
        * linear(bend * v**2, there["lateral_acceleration"], terms.centripetal)
    )
    square, size = slopes(reference.j / weights.jerk_bound, terms.jerk)
    return TimeSum(
        point=jnp.where(valid[:, None, None], -cost, 0.0),
        action=jnp.zeros(grid.actions.shape),
        square=jnp.negative(weights.jerk * square / weights.jerk_bound**2),
        size=jnp.negative(weights.jerk * size / weights.jerk_bound),
        counts=valid.astype(jnp.float32),
    )


# own costs that can be searched -> their sum; others are no sums over times
TIME_SUMS: dict[str, Callable[..., TimeSum]] = {
    "constant V": _nothing,
    "+velocity": _velocity,
    SPEED_DP_ROW: _speed_dp,
    "hand-set": _lattice,
}
