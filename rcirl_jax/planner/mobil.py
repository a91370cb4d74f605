"""A driver that changes lanes: the IDM along the road, MOBIL across it.

MOBIL (Kesting, Treiber, Helbing 2007) takes, of the lanes beside, the one of largest

    gain = a~_c - a_c + p [(a~_n - a_n) + (a~_o - a_o)] > threshold
    where a~_n > -b_safe and a~_c > -b_safe

All are accelerations of the IDM: c is the ego, n who would follow it in the new lane, o
who follows it now; ~ is after the change. Where a lane ends stands a leader. Who has
begun a change ends it before the next decision.
"""

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.planner.baselines import (
    IN_WAY_M,
    Idm,
    Yielding,
    behind_the_nearest,
    idm_acceleration,
    idm_stations,
)
from rcirl_jax.planner.plan import Plan, held
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.sampling.kinematics import trajectory_from_positions
from rcirl_jax.sampling.sampler import Moves, lateral_moves, lateral_offset
from rcirl_jax.types import Kind, Scene, Trajectory
from rcirl_jax.units import STATION_STEP_M

MOBIL_ROW = "IDM + MOBIL"  # name of its row in all tables
SETTLED_M = 0.3  # m from the lane's middle below which a lane change is over
NOBODY_M = 1e3  # m, gap to a leader where there is none
# lateral profiles: hold, then to the middle of the lane, of the left and the right one
LANES = SamplerConfig(
    mode="path_speed",
    lateral_times=(4.0,),
    min_lateral_length=12.0,
    nudge_offsets=(),
)


class Mobil(flax.struct.PyTreeNode, kw_only=True):
    """Parameters of the driver: b_safe of the paper, p and threshold of the agents."""

    idm: Idm = Idm()
    politeness: float | jax.Array = 0.2  # 1, p
    threshold: float | jax.Array = 0.2  # m/s^2
    safe_braking: float | jax.Array = 4.0  # m/s^2, b_safe


def chosen_lane(scene: Scene, driver: Mobil, aim: jax.Array) -> tuple[Moves, jax.Array]:
    """Returns the way to the lane that MOBIL takes, and the ego's acceleration there.

    Args:
      scene: one planning frame.
      driver: its parameters.
      aim: [] m, offset of the lane that the ego is on or on its way to.

    Returns:
      A lateral profile, leaves [], and [] m/s^2.
    """
    o, ego, path = scene.obstacles, scene.ego, scene.path
    moves = Moves(*jnp.stack(lateral_moves(scene, LANES))[:, 1:])  # [3] each
    lanes = moves.target[:, None]
    front, rear = ego.s + 0.5 * ego.length, ego.s - 0.5 * ego.length
    desired = path.speed_limit[0]

    def respond(v: jax.Array, gap: jax.Array, lead: jax.Array) -> jax.Array:
        return idm_acceleration(v, gap, v - lead, jnp.maximum(desired, v), driver.idm)

    known = o.valid[:, 0] & (o.kind != Kind.NONE)
    aside = jnp.maximum(o.l_lower[:, 0] - lanes, lanes - o.l_upper[:, 0])  # [3, N]
    there = known & (aside < 0.5 * ego.width + IN_WAY_M)
    ahead = 0.5 * (o.s_lower[:, 0] + o.s_upper[:, 0]) > ego.s
    drives = (o.speed[:, 0] > 0.0) & (o.kind <= Kind.CYCLIST)
    # the leader of each lane; a lane that ends is led by its end
    gaps = jnp.where(there & ahead, o.s_lower[:, 0] - front, NOBODY_M)
    leader = jnp.argmin(gaps, axis=1)
    gap, lead = jnp.min(gaps, axis=1), o.speed[leader, 0]
    inside = (lanes <= path.road_left - 0.5 * ego.width) & (
        lanes >= path.road_right + 0.5 * ego.width
    )
    inside = inside.at[0].set(True)  # the lane that goes on
    stations = jnp.arange(path.l.size) * STATION_STEP_M
    end = jnp.min(jnp.where(inside, NOBODY_M, stations - front), axis=1)
    lead = jnp.where(gap < NOBODY_M, lead, ego.v)
    lead, gap = jnp.where(end < gap, 0.0, lead), jnp.minimum(end, gap)
    own = respond(ego.v, gap, lead)  # [3]
    # who follows in each lane, behind its leader and behind the ego
    far = jnp.where(there & ~ahead & drives, rear - o.s_upper[:, 0], jnp.inf)
    follower, distance = jnp.argmin(far, axis=1), jnp.min(far, axis=1)
    follows, theirs = jnp.isfinite(distance), o.speed[follower, 0]
    distance = jnp.where(follows, distance, NOBODY_M)
    alone = respond(theirs, distance + ego.length + gap, lead)
    behind = respond(theirs, distance, ego.v)
    imposed = jnp.where(follows, behind - alone, 0.0)  # m/s^2, by the ego before them

    now = jnp.argmin(jnp.abs(moves.target - aim))
    gain = own - own[now] + driver.politeness * (imposed - imposed[now])
    beside = jnp.abs(moves.target - moves.target[now]) < 1.5 * (
        path.lane_left[0] - path.lane_right[0]
    )
    safe = (own > -driver.safe_braking) & inside[:, 0] & beside
    safe = safe & (~follows | (behind > -driver.safe_braking))
    settled = jnp.abs(ego.l - moves.target[now]) < SETTLED_M
    better = settled & safe & (gain > driver.threshold)
    best = jnp.argmax(jnp.where(better, gain, -jnp.inf))
    lane = jnp.where(jnp.any(better), best, now)
    return Moves(*(x[lane] for x in moves)), own[lane]


def mobil_policy(
    params: Mobil, scene: Scene, key: jax.Array, before: Plan | None = None
) -> Plan:
    """The driver as a policy of the simulator; its plans have a path."""
    del key
    aim = scene.ego.l
    if before is not None:
        assert before.path is not None
        aim = jnp.where(before.lasts, before.path[0, -1], aim)
    way, a = chosen_lane(scene, params, aim)
    here = behind_the_nearest(scene, Yielding(idm=params.idm))
    plan = held(scene.ego.v, jnp.minimum(a, here))
    s = scene.ego.s + plan.s
    x = trajectory_from_positions(scene, s, lateral_offset(scene, way, s))
    return plan.replace(path=jnp.stack([x.l, x.dl, x.ddl]), lasts=jnp.asarray(True))


vars(mobil_policy)["steers"] = True


def mobil_trajectory(scene: Scene, driver: Mobil) -> Trajectory:
    """The Trajectory [T] of one decision: behind the leader of the lane it takes."""
    way, _ = chosen_lane(scene, driver, scene.ego.l)
    lane = scene.path.replace(l=jnp.full_like(scene.path.l, way.target))
    s = idm_stations(scene.replace(path=lane), True, driver.idm)
    return trajectory_from_positions(scene, s, lateral_offset(scene, way, s))
