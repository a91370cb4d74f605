"""Baselines that drive instead of ranking: constant speed and IDM.

They produce one trajectory each; every candidate is then valued by how close
it comes to that trajectory, so that all metrics are defined for them too.
"""

import dataclasses

import jax
import jax.numpy as jnp

from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.sampling.kinematics import trajectory_from_positions, trajectory_on_path
from rcirl_jax.types import Kind, Scene, Trajectory
from rcirl_jax.units import DT_S, NUM_TIMES, STATION_STEP_M, TIMES_S

SUBSTEPS = 5  # integration steps of the IDM between two times (0.094 s)
TUNED_IDM_ROW = "IDM, tuned"  # name of its row in all tables
IN_WAY_M = 0.2  # m, lateral buffer within which an obstacle is a leader


@dataclasses.dataclass(frozen=True, kw_only=True)
class Idm:
    """Intelligent Driver Model (Treiber, Hennecke, Helbing 2000), usual values.

    Any field may be traced.
    """

    headway: float | jax.Array = 1.5  # s
    standstill_gap: float | jax.Array = 2.0  # m
    acceleration: float | jax.Array = 1.4  # m/s^2
    braking: float | jax.Array = 2.0  # m/s^2, comfortable
    exponent: float | jax.Array = 4.0
    max_braking: float | jax.Array = 8.0  # m/s^2, physical cap
    # the speed wanted on a free road, as a share of the limit
    speed_share: float | jax.Array = 1.0

    def fields(self) -> dict[str, jax.Array]:
        """Field -> float32 [], a pytree; `Idm(**fields)` is the inverse."""
        pairs = dataclasses.asdict(self).items()
        return {name: jnp.asarray(value, jnp.float32) for name, value in pairs}


def idm_acceleration(
    v: jax.Array, gap: jax.Array, closing: jax.Array, desired: jax.Array, idm: Idm
) -> jax.Array:
    """IDM acceleration, m/s^2.

    a [1 - (v / (share v0))^4 - (s* / gap)^2],
    s* = s0 + max(v T + v dv / (2 sqrt(a b)), 0)
    """
    interaction = v * closing / (2.0 * (idm.acceleration * idm.braking) ** 0.5)
    wanted = idm.standstill_gap + jnp.maximum(v * idm.headway + interaction, 0.0)
    free = (v / jnp.maximum(idm.speed_share * desired, 0.1)) ** idm.exponent
    raw = idm.acceleration * (1.0 - free - (wanted / jnp.maximum(gap, 0.1)) ** 2)
    return jnp.clip(raw, -idm.max_braking, idm.acceleration)


def idm_stations(scene: Scene, on_path: bool, idm: Idm) -> jax.Array:
    """Stations [T] m of an IDM driver in the scene; lead vehicles move as recorded."""
    obstacles, ego = scene.obstacles, scene.ego

    def follow(carry: tuple, now: jax.Array) -> tuple:
        s, v = carry
        position = now / DT_S
        low = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, NUM_TIMES - 2)
        share = position - low
        at = lambda x: x[:, low] + share * (x[:, low + 1] - x[:, low])  # noqa: E731
        rear, speed = at(obstacles.s_lower), at(obstacles.speed)
        own = lookup(scene.path.l, s, STATION_STEP_M) if on_path else ego.l
        beside = jnp.maximum(at(obstacles.l_lower) - own, own - at(obstacles.l_upper))
        front = s + 0.5 * ego.length
        ahead = (rear >= front - 0.5) & (obstacles.kind != Kind.NONE)
        in_way = beside < 0.5 * ego.width + IN_WAY_M
        leader = ahead & in_way & obstacles.valid[:, low]
        gaps = jnp.where(leader, rear - front, jnp.inf)
        nearest = jnp.argmin(gaps)
        gap = jnp.minimum(gaps[nearest], 1e3)
        closing = jnp.where(leader[nearest], v - speed[nearest], 0.0)
        desired = lookup(scene.path.speed_limit, s, STATION_STEP_M)
        a = idm_acceleration(v, gap, closing, desired, idm)
        step = DT_S / SUBSTEPS
        v_next = jnp.maximum(v + a * step, 0.0)
        return (s + 0.5 * (v + v_next) * step, v_next), s

    count = (NUM_TIMES - 1) * SUBSTEPS + 1
    clock = jnp.arange(count) * (DT_S / SUBSTEPS)
    _, stations = jax.lax.scan(follow, (ego.s, ego.v), clock)
    return stations[::SUBSTEPS]


def idm_trajectory(scene: Scene, on_path: bool, idm: Idm) -> Trajectory:
    """The IDM driver's Trajectory, along the given path or holding its offset."""
    return _trajectory(scene, idm_stations(scene, on_path, idm), on_path)


def constant_speed_trajectory(scene: Scene, on_path: bool) -> Trajectory:
    """S = v0 t, along the given path or holding the offset."""
    return _trajectory(scene, scene.ego.v * jnp.asarray(TIMES_S), on_path)


def _trajectory(scene: Scene, s: jax.Array, on_path: bool) -> Trajectory:
    if on_path:
        return trajectory_on_path(scene, s)
    return trajectory_from_positions(scene, s, jnp.full_like(s, scene.ego.l))


def closeness(trajectory: Trajectory, other: Trajectory, valid: jax.Array) -> jax.Array:
    """Minus the mean distance [m] between two trajectories over valid times."""
    apart = jnp.sqrt((trajectory.s - other.s) ** 2 + (trajectory.l - other.l) ** 2)
    return -jnp.sum(jnp.where(valid, apart, 0.0)) / jnp.sum(valid)
