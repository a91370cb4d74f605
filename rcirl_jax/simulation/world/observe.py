"""From the world to the planner's Scene: perception, prediction, map view.

The planner sees what training scenes hold: obstacles as boxes in the Frenet frame at
the 18 times, their future predicted by `planner.prediction`, never read.
"""

import jax
import jax.numpy as jnp

from rcirl_jax.geometry.boxes import frenet_extent
from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.geometry.limits import planning_limit
from rcirl_jax.planner.prediction import Bodies, obstacles_of
from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    NUM_HISTORY,
    ROAD_STEP_M,
    STEP_S,
    AgentState,
    Case,
    Road,
    Seen,
    World,
)
from rcirl_jax.simulation.world.lines import stop_line
from rcirl_jax.types import NUM_TAGS, Ego, Path, Scene
from rcirl_jax.units import NUM_STATIONS, NUM_TIMES


def road_limit(road: Road) -> jax.Array:
    """Speed limit [R] m/s of a road as the planner gets it (`geometry.limits`)."""
    return planning_limit(road.kappa, road.path_l, road.speed_limit, ROAD_STEP_M, jnp)


SEEN = ("s", "l", "heading", "v", "a", "present")  # rows of `World.seen`


def visible(state: AgentState) -> jax.Array:
    """What can be seen of the agents, rows [6, A] in the order of `SEEN`."""
    return jnp.stack([getattr(state, name).astype(jnp.float32) for name in SEEN])


def perceive(case: Case, world: World) -> Seen:
    """Leaves [A]: delayed, noisy, with dropouts, as `case.perception` says."""
    noise = case.perception
    age = jnp.round(noise.latency / STEP_S).astype(jnp.int32)
    late = world.seen[jnp.clip(age, 0, NUM_HISTORY - 1)]
    late = Seen(**dict(zip(SEEN, late, strict=True)))
    key = jax.random.fold_in(jax.random.key(case.seed), world.step)
    draw = jax.random.normal(key, (3, NUM_AGENTS))
    # a Gaussian below its quantile is a dropout: no second draw is needed
    lost = jax.scipy.special.ndtr(draw[2]) < noise.dropout
    return late.replace(
        s=late.s + noise.sigma_position * draw[0],
        l=late.l + 0.5 * noise.sigma_position * draw[1],
        v=jnp.maximum(late.v * (1.0 + noise.sigma_speed * draw[0]), 0.0),
        present=(late.present > 0.0) & ~lost,
    )


def _bodies(case: Case, world: World, seen: Seen) -> Bodies:
    """What is perceived of the agents [A], from the ego's station on."""
    half_s, half_l = jax.vmap(frenet_extent)(
        case.agents.length, case.agents.width, seen.heading
    )
    along = jnp.cos(seen.heading)
    return Bodies(
        s=seen.s - world.ego.s,
        l=seen.l,
        speed=seen.v * along,
        l_dot=seen.v * jnp.sin(seen.heading),
        a=seen.a * along,
        half_s=half_s,
        half_l=half_l,
        kind=case.agents.kind,
        present=seen.present,
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
      limit: [R] m/s, `road_limit(case.road)`, computed once per case.
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
    seen_ego = Ego(
        s=jnp.zeros(()),
        l=ego.l,
        dl=jnp.tan(jnp.clip(ego.heading, -1.2, 1.2)) * shrink,
        ddl=ego.curvature - kappa,
        v=ego.v * jnp.cos(ego.heading) / shrink,
        a=ego.a,
        length=case.ego_length,
        width=case.ego_width,
    )
    return Scene(
        ego=seen_ego,
        path=path,
        obstacles=obstacles_of(
            _bodies(case, world, perceive(case, world)),
            stop_line(case, world, ego) - ego.s,
            road.destination - ego.s,
            seen_ego,
            path,
        ),
        time_valid=jnp.ones((NUM_TIMES,), bool),
        tags=jnp.zeros((NUM_TAGS,), bool),
    )
