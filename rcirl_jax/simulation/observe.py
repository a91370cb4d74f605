"""From the world to the planner's Scene: perception, prediction, map view.

The planner sees what the offline pipeline stores: obstacles as boxes in the
Frenet frame at the 18 times. The future is predicted, never read: constant
speed, braking goes on until standing, a lane keeper that moves sideways ends
in the middle of the lane it moves to.
"""

import jax
import jax.numpy as jnp

from rcirl_jax.geometry.boxes import frenet_extent
from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.simulation import lines as signals
from rcirl_jax.simulation.agents import LANE_TILT
from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    NUM_HISTORY,
    ROAD_STEP_M,
    STEP_S,
    AgentState,
    Case,
    LineKind,
    Road,
    Seen,
    World,
)
from rcirl_jax.types import NUM_TAGS, Ego, Kind, Obstacles, Path, Scene
from rcirl_jax.units import NUM_STATIONS, NUM_TIMES, TIMES_S

NUM_BODIES = 8  # agents handed to the planner, nearest first
BEHIND_WEIGHT = 2.0  # 1, how much farther a body behind counts
LANE_CHANGE_MPS = 0.3  # m/s, lateral speed taken as a lane change
BRAKING_MPS2 = -0.5  # m/s^2 below which braking is predicted to go on
COMFORT_BRAKING_MPS2 = 1.0  # m/s^2, with which a lower limit is approached
CENTRIPETAL_MPS2 = 2.0  # m/s^2, Apollo's bound for speed limits in curves
LINE_DEPTH_M = 0.1  # m, thickness of a stop wall (Apollo's virtual obstacle)
STOP_SIGN_GAP_M = 1.0  # m, how far a served line stays open


def planning_limit(road: Road) -> jax.Array:
    """Speed limit [R] m/s as the planner gets it, looking ahead.

        v(s) = min over s' >= s of sqrt(limit(s')^2 + 2 b (s' - s)),  b = 1 m/s^2,
        limit(s) = min(posted, sqrt(2 / |kappa|))          (Apollo, 2 m/s^2)

    One reverse running minimum of limit^2 + 2 b s. A lower limit counts from
    one grid point before it: between points the planner interpolates.
    """
    slope = jnp.asarray(jnp.gradient(road.path_l, ROAD_STEP_M))
    bend = jnp.asarray(jnp.gradient(slope, ROAD_STEP_M))
    kappa = jnp.abs(road.kappa + bend)
    curve = jnp.sqrt(CENTRIPETAL_MPS2 / jnp.maximum(kappa, 1e-5))
    limit = jnp.minimum(road.speed_limit, curve)
    limit = jnp.minimum(limit, jnp.concatenate([limit[1:], limit[-1:]]))
    stations = jnp.arange(limit.shape[0]) * ROAD_STEP_M
    ramp = 2.0 * COMFORT_BRAKING_MPS2 * stations
    lowest = jax.lax.cummin(limit**2 + ramp, axis=0, reverse=True)
    return jnp.sqrt(jnp.maximum(lowest - ramp, 0.0))


def remember(seen: Seen, state: AgentState) -> Seen:
    """History with the present state in front."""
    now = Seen(
        s=state.s,
        l=state.l,
        heading=state.heading,
        v=state.v,
        a=state.a,
        present=state.present,
    )
    push = lambda old, new: jnp.concatenate([new[None], old[:-1]])  # noqa: E731
    return jax.tree.map(push, seen, now)


def perceive(case: Case, world: World) -> Seen:
    """Leaves [A]: delayed, noisy, with dropouts, as `case.perception` says."""
    noise = case.perception
    age = jnp.round(noise.latency / STEP_S).astype(jnp.int32)
    late = jax.tree.map(lambda x: x[jnp.clip(age, 0, NUM_HISTORY - 1)], world.seen)
    key = jax.random.fold_in(jax.random.key(case.seed), world.step)
    draw = jax.random.normal(key, (3, NUM_AGENTS))
    # a Gaussian below its quantile is a dropout: no second draw is needed
    lost = jax.scipy.special.ndtr(draw[2]) < noise.dropout
    return late.replace(
        s=late.s + noise.sigma_position * draw[0],
        l=late.l + 0.5 * noise.sigma_position * draw[1],
        v=jnp.maximum(late.v * (1.0 + noise.sigma_speed * draw[0]), 0.0),
        present=late.present & ~lost,
    )


def _nearest(
    seen: Seen, ego_s: jax.Array, ego_l: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Indices [NUM_BODIES] of the agents that matter most, and their presence."""
    ds = seen.s - ego_s
    ahead = jnp.where(ds < 0.0, -BEHIND_WEIGHT * ds, ds)
    distance = ahead + 0.5 * jnp.abs(seen.l - ego_l)
    key = jnp.where(seen.present, -distance, -jnp.inf)
    _, index = jax.lax.top_k(key, NUM_BODIES)
    return index, seen.present[index]


def _predict(
    seen: Seen, base_heading: jax.Array, lane_width: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Stations, offsets and speeds along the road, each [M, T]."""
    times = jnp.asarray(TIMES_S)[None]
    v, braking = seen.v[:, None], jnp.where(seen.a < BRAKING_MPS2, seen.a, 0.0)[:, None]
    stop = jnp.where(braking < 0.0, v / jnp.maximum(-braking, 1e-3), jnp.inf)
    moving = jnp.minimum(times, stop)
    way = v * moving + 0.5 * braking * moving**2
    speed = jnp.maximum(v + braking * moving, 0.0)
    heading = seen.heading[:, None]
    keeps = jnp.abs(jnp.sin(base_heading))[:, None] < LANE_TILT
    along = jnp.where(keeps, jnp.sign(jnp.cos(heading)), jnp.cos(heading))
    l_dot = (seen.v * jnp.sin(seen.heading))[:, None]
    l = seen.l[:, None]
    width = jnp.maximum(lane_width, 1.0)
    direction = jnp.sign(l_dot)
    target = width * jnp.round((l + direction * 0.5 * width) / width)
    changes = jnp.abs(l_dot) > LANE_CHANGE_MPS
    room = jnp.where(changes, jnp.maximum((target - l) * direction, 0.0), 0.0)
    in_lane = l + direction * jnp.minimum(jnp.abs(l_dot) * times, room)
    straight = l + jnp.sin(heading) * way
    return (
        seen.s[:, None] + along * way,
        jnp.where(keeps, in_lane, straight),
        (along * speed),
    )


def _stop_wall(
    case: Case, world: World, ego_v: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Station of the nearest line that demands a stop now, and whether any does."""
    lines = case.lines
    front = world.ego.s + 0.5 * case.ego_length
    distance = lines.s - front
    light = signals.demands(lines, world.step * STEP_S, distance, ego_v[None])
    sign = (lines.kind == LineKind.STOP_SIGN) & ~world.served
    demands = (light | sign) & (distance >= 0.0)
    nearest = jnp.min(jnp.where(demands, lines.s, jnp.inf))
    return nearest, jnp.any(demands)


def _obstacles(case: Case, world: World, seen: Seen) -> Obstacles:
    origin = world.ego.s
    index, present = _nearest(seen, origin, world.ego.l)
    chosen: Seen = jax.tree.map(lambda x: x[index], seen)
    base = case.agents.heading[index]
    s, l, speed = _predict(chosen, base, case.road.lane_width)
    half_s, half_l = jax.vmap(frenet_extent)(
        case.agents.length[index], case.agents.width[index], chosen.heading
    )
    wall, stops = _stop_wall(case, world, world.ego.v)
    end = case.road.destination
    lines_s = jnp.stack([jnp.where(stops, wall, 0.0), end]) - origin
    ends = lines_s[1] < (NUM_STATIONS - 1) * 2.0
    row = jnp.ones((2, NUM_TIMES))
    join = lambda body, line: jnp.concatenate([body, line * row])  # noqa: E731
    wide = jnp.full((2, 1), 20.0)
    known = jnp.concatenate([present, jnp.stack([stops, ends])])
    kinds = jnp.array([Kind.STOP, Kind.VIRTUAL], jnp.int32)
    return Obstacles(
        s_lower=join(s - half_s[:, None] - origin, lines_s[:, None]),
        s_upper=join(s + half_s[:, None] - origin, lines_s[:, None] + LINE_DEPTH_M),
        l_lower=join(l - half_l[:, None], -wide),
        l_upper=join(l + half_l[:, None], wide),
        speed=join(speed, jnp.zeros((2, 1))),
        valid=jnp.broadcast_to(known[:, None], (NUM_BODIES + 2, NUM_TIMES)),
        kind=jnp.concatenate([case.agents.kind[index], kinds]),
        is_recorded=jnp.zeros((NUM_BODIES + 2,), bool),
    )


def _window(table: jax.Array, s: jax.Array) -> jax.Array:
    """The road grid from the ego on, at the planner's stations [P]."""
    position = jnp.clip(s / ROAD_STEP_M, 0.0, table.shape[0] - NUM_STATIONS - 1.0)
    low = position.astype(jnp.int32)
    part = jax.lax.dynamic_slice(table, (low,), (NUM_STATIONS + 1,))
    return part[:-1] + (position - low) * (part[1:] - part[:-1])


def observe(case: Case, world: World, limit: jax.Array) -> Scene:
    """The planning frame of one case now.

    Args:
      case: the drive.
      world: its state.
      limit: [R] m/s, `planning_limit(case.road)`, computed once per case.
    """
    ego, road = world.ego, case.road
    kappa = lookup(road.kappa, ego.s, ROAD_STEP_M)
    shrink = jnp.maximum(1.0 - kappa * ego.l, 0.1)
    flat = jnp.ones((NUM_STATIONS,))
    lane = road.lane_width * jnp.round(ego.l / road.lane_width)
    path = Path(
        kappa=_window(road.kappa, ego.s),
        l=_window(road.path_l, ego.s),
        speed_limit=_window(limit, ego.s),
        lane_left=(lane + 0.5 * road.lane_width) * flat,
        lane_right=(lane - 0.5 * road.lane_width) * flat,
        road_left=road.edge_left * flat,
        road_right=road.edge_right * flat,
    )
    return Scene(
        ego=Ego(
            s=jnp.zeros(()),
            l=ego.l,
            dl=jnp.tan(jnp.clip(ego.heading, -1.2, 1.2)) * shrink,
            ddl=ego.curvature - kappa,
            v=ego.v * jnp.cos(ego.heading) / shrink,
            a=ego.a,
            length=case.ego_length,
            width=case.ego_width,
        ),
        path=path,
        obstacles=_obstacles(case, world, perceive(case, world)),
        time_valid=jnp.ones((NUM_TIMES,), bool),
        tags=jnp.zeros((NUM_TAGS,), bool),
    )
