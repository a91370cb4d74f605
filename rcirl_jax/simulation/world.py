"""One step of the simulated world, pure and vmappable.

`step` moves the ego (`drive`) and the others (`agents`), `observe` is what the planner
sees, `contacts` and what follows it say who was at fault.

The ego is a kinematic bicycle with lagging actuators on a curved road:

    s'       = v cos(h) / (1 - kappa l)          kappa: of the reference line
    l'       = v sin(h)
    h'       = v c - kappa s'                    h: heading against the line
    v'       = a,          tau_a a' = a_cmd - a              tau_a = 0.2 s
                           tau_c c' = c_cmd - c              tau_c = 0.05 s

c = tan(steering angle) / wheelbase is the curvature that the steering delivers;
lagging c or the angle differs by less than 1 % below 10 degrees. The lags are
nuPlan's; they are integrated exactly for a held command, so their response does
not depend on the step.

The planner sees what training scenes hold: obstacles as boxes in the Frenet frame at
the 18 times, their future predicted by `planner.prediction`, never read.

Contacts and times to collision are judged in the ego's own tangent frame:
a body at (ds, dl) on a
road of local curvature kappa lies, for bodies near the ego, at

    x = (1/kappa - l_j) sin(kappa ds),   y = 1/kappa - (1/kappa - l_j) cos(kappa ds)

relative to the reference line's point at the ego, which is exact where the
curvature is constant.
"""

import dataclasses
import math

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.features.columns import path_curvature
from rcirl_jax.geometry.boxes import Box, contact_interval, frenet_extent, separation
from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.geometry.limits import planning_limit
from rcirl_jax.planner.plan import either
from rcirl_jax.planner.prediction import Bodies, obstacles_of
from rcirl_jax.simulation.agents import (
    CORRIDOR_MARGIN_M,
    LANE_TILT,
    NO_LIMIT,
    accelerations,
    bodies_of,
    colours,
    corridors,
    mark_stop_sign_served,
    mobil,
    move,
    spawn_and_despawn,
    steer_targets,
    stop_line,
    stopping_for_light,
)
from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    NUM_DELAY,
    NUM_HISTORY,
    NUM_LINES,
    ROAD_STEP_M,
    STEP_S,
    AgentState,
    Case,
    EgoState,
    LineKind,
    Record,
    Replay,
    Road,
    Seen,
    World,
    nobody_recorded,
)
from rcirl_jax.types import NUM_TAGS, Ego, Kind, Path, Scene
from rcirl_jax.units import NUM_STATIONS, NUM_TIMES


@dataclasses.dataclass(frozen=True, kw_only=True)
class Vehicle:
    """Limits and lags of the ego, and the gains of its path tracking."""

    acceleration_lag: float = 0.2  # s, nuPlan
    steering_lag: float = 0.05  # s, nuPlan
    min_acceleration: float = -8.0  # m/s^2, full braking on dry road
    max_acceleration: float = 4.0  # m/s^2 (Apollo)
    max_curvature: float = 0.1979  # 1/m (Apollo)
    substeps: int = 2  # integration steps of one simulator step
    # path tracking: the lateral error decays over this length,
    # max(min_length, time * v)
    tracking_time: float = 0.9  # s
    tracking_min_length: float = 5.0  # m
    tracking_damping: float = 1.0  # 1, critically damped


UNROLLED = 4  # substeps that are written out instead of looped over


def _at(table: jax.Array, s: jax.Array) -> jax.Array:
    return lookup(table, s, ROAD_STEP_M)


def path_points(
    road: Road, s: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The given path at stations [M].

    Returns:
      Offset l m, slope dl/ds, curvature 1/m of the path, and kappa 1/m of the
      reference line there; all [M].
    """
    step = 2.0 * ROAD_STEP_M
    around = jnp.stack([s - step, s, s + step])
    at = jax.vmap(jax.vmap(lookup, (None, 0, None)), (None, 0, None))
    behind, here, ahead = at(road.path_l, around, ROAD_STEP_M)
    kappas = at(road.kappa, around, ROAD_STEP_M)
    slope = (ahead - behind) / (2.0 * step)
    bend = (ahead - 2.0 * here + behind) / step**2
    dkappa = (kappas[2] - kappas[0]) / (2.0 * step)
    curvature = path_curvature(kappas[1], dkappa, here, slope, bend)
    return here, slope, curvature, kappas[1]


def steering_lead(vehicle: Vehicle) -> float:
    """Time [s] by which curvature commands lead the path: the lag, half a step."""
    return vehicle.steering_lag + 0.5 * STEP_S


def steering(
    ego: EgoState, road: Road, vehicle: Vehicle, planned: jax.Array | None = None
) -> jax.Array:
    """Curvature command 1/m that leads the ego onto its path.

        c = c_path(s + v tau) - (l - l_path) / D^2 - 2 z (h - h_path) / D

    so that the lateral error e obeys e'' + 2 z e' / D + e / D^2 = 0 by station.

    Args:
      ego: its state.
      road: with the given path.
      vehicle: limits, lags and gains.
      planned: [3, 2] l m, dl and ddl 1/m of a planned path, now and `steering_lead`
        later; None: the given path is followed.
    """
    ahead = ego.s + ego.v * steering_lead(vehicle)
    l, slopes, curvatures, kappas = path_points(road, jnp.stack([ahead, ego.s]))
    feedforward, l_path, slope = curvatures[0], l[1], slopes[1]
    if planned is not None:
        (l_path, l), (slope, dl), (_, ddl) = planned
        turn = _at(road.kappa, ahead + ROAD_STEP_M) - _at(road.kappa, ahead)
        feedforward = path_curvature(kappas[0], turn / ROAD_STEP_M, l, dl, ddl)
    reach = jnp.maximum(vehicle.tracking_time * ego.v, vehicle.tracking_min_length)
    shrink = jnp.maximum(1.0 - kappas[1] * ego.l, 0.1)
    off_heading = ego.heading - jnp.arctan(slope / shrink)
    command = (
        feedforward
        - (ego.l - l_path) / reach**2
        - 2.0 * vehicle.tracking_damping * off_heading / reach
    )
    return jnp.clip(command, -vehicle.max_curvature, vehicle.max_curvature)


def drive(
    ego: EgoState,
    road: Road,
    acceleration: jax.Array,
    vehicle: Vehicle,
    planned: jax.Array | None = None,
) -> EgoState:
    """The ego one simulator step (0.1 s) later, under an acceleration command.

    It follows the given path, or a planned one (as in `steering`).
    """
    command = jnp.clip(acceleration, vehicle.min_acceleration, vehicle.max_acceleration)
    h = STEP_S / vehicle.substeps
    take_a = 1.0 - math.exp(-h / vehicle.acceleration_lag)
    take_c = 1.0 - math.exp(-h / vehicle.steering_lag)
    target = steering(ego, road, vehicle, planned)

    def substep(_: int, ego: EgoState) -> EgoState:
        a = ego.a + take_a * (command - ego.a)
        c = ego.curvature + take_c * (target - ego.curvature)
        v = jnp.maximum(ego.v + 0.5 * (ego.a + a) * h, 0.0)
        a = jnp.where(v > 0.0, a, jnp.maximum(a, 0.0))
        mean_v, mean_c = 0.5 * (ego.v + v), 0.5 * (ego.curvature + c)
        kappa = _at(road.kappa, ego.s)
        shrink = jnp.maximum(1.0 - kappa * ego.l, 0.1)
        rate = mean_v * jnp.cos(ego.heading) / shrink
        turn = (mean_v * mean_c - kappa * rate) * h
        middle = ego.heading + 0.5 * turn
        return EgoState(
            s=ego.s + mean_v * jnp.cos(middle) / shrink * h,
            l=ego.l + mean_v * jnp.sin(middle) * h,
            heading=ego.heading + turn,
            v=v,
            a=a,
            curvature=c,
        )

    unroll = vehicle.substeps <= UNROLLED
    return jax.lax.fori_loop(0, vehicle.substeps, substep, ego, unroll=unroll)


# nuPlan's constants (reference: its no-at-fault-collision metric)
STOPPED_EGO_MPS = 0.05  # m/s, an ego slower than this is not at fault
STOPPED_TRACK_MPS = 0.05  # m/s, hitting a standing track is the ego's fault
OFF_ROAD_M = 0.3  # m outside the drivable area that counts
TTC_STANDING_MPS = 0.005  # m/s, below it the ego has no time to collision
TTC_HORIZON_S = 3.0  # s, nuPlan's projection
NEAR_M = 25.0  # m along the road within which its curvature bends the picture


class Contacts(flax.struct.PyTreeNode, kw_only=True):
    """The ego against every agent; all [A]."""

    clearance: jax.Array  # m, separation; < 0 overlapping; inf if absent
    hit: jax.Array  # bool
    at_fault: jax.Array  # bool, of the hits
    ttc: jax.Array  # s, inf if never within nuPlan's horizon
    relative_speed: jax.Array  # m/s
    ahead: jax.Array  # bool, for nuPlan's TTC


def _local(case: Case, ego: EgoState, state: AgentState) -> tuple[jax.Array, jax.Array]:
    """Agents' centres [A] in the tangent frame at the ego's station."""
    kappa = lookup(case.road.kappa, ego.s, ROAD_STEP_M)
    ds = jnp.clip(state.s - ego.s, -200.0, 200.0)
    angle = kappa * jnp.clip(ds, -NEAR_M, NEAR_M)  # no wrapping round far away
    # sin(a)/kappa and (1 - cos(a))/kappa without dividing by a small kappa
    along = ds * jnp.sinc(angle / jnp.pi)
    bulge = 0.5 * ds * angle * jnp.sinc(0.5 * angle / jnp.pi) ** 2
    return along - state.l * jnp.sin(angle), bulge + state.l * jnp.cos(angle)


def contacts(case: Case, ego: EgoState, state: AgentState) -> Contacts:
    """Separation, fault and time to collision of the ego against all agents."""
    x, y = _local(case, ego, state)
    kappa = lookup(case.road.kappa, ego.s, ROAD_STEP_M)
    heading = state.heading + kappa * jnp.clip(state.s - ego.s, -NEAR_M, NEAR_M)
    own = Box(
        x=jnp.zeros(()),
        y=ego.l,
        heading=ego.heading,
        length=case.ego_length,
        width=case.ego_width,
    )
    others = Box(
        x=x,
        y=y,
        heading=heading,
        length=case.agents.length,
        width=case.agents.width,
    )
    vx = state.v * jnp.cos(heading) - ego.v * jnp.cos(ego.heading)
    vy = state.v * jnp.sin(heading) - ego.v * jnp.sin(ego.heading)
    apart = jax.vmap(separation, in_axes=(None, 0))(own, others)
    enter, leave = jax.vmap(contact_interval, in_axes=(None, 0, 0, 0))(
        own, others, vx, vy
    )
    meets = (enter <= leave) & (leave >= 0.0) & state.present
    ttc = jnp.where(meets, jnp.maximum(enter, 0.0), jnp.inf)
    ttc = jnp.where((ttc <= TTC_HORIZON_S) & (ego.v > TTC_STANDING_MPS), ttc, jnp.inf)
    # the agent's place in the ego's own axes
    dx, dy = x, y - ego.l
    along = dx * jnp.cos(ego.heading) + dy * jnp.sin(ego.heading)
    half = 0.5 * case.ego_length
    clearance = jnp.where(state.present, apart, jnp.inf)
    hit = state.present & (apart <= 0.0)
    behind = along < -0.5 * half  # behind the rear axle
    reach = 0.5 * (
        case.agents.length * jnp.abs(jnp.cos(heading - ego.heading))
        + case.agents.width * jnp.abs(jnp.sin(heading - ego.heading))
    )
    front = along + reach > half  # reaches beyond the front bumper line
    standing_track = state.v <= STOPPED_TRACK_MPS
    lateral_fault = _straddles(case, ego)
    at_fault = standing_track | (~behind & (front | lateral_fault))
    at_fault = at_fault & (ego.v > STOPPED_EGO_MPS)
    return Contacts(
        clearance=clearance,
        hit=hit,
        at_fault=hit & at_fault,
        ttc=ttc,
        relative_speed=jnp.sqrt(vx**2 + vy**2),
        ahead=(along > 0.0) | (lateral_fault & ~behind),
    )


def _straddles(case: Case, ego: EgoState) -> jax.Array:
    """True if the ego covers more than one lane or leaves the drivable area."""
    width = case.road.lane_width
    centre = width * jnp.round(ego.l / width)
    reach = 0.5 * (
        case.ego_width * jnp.abs(jnp.cos(ego.heading))
        + case.ego_length * jnp.abs(jnp.sin(ego.heading))
    )
    return jnp.abs(ego.l - centre) + reach > 0.5 * width + 0.05


def off_road(case: Case, ego: EgoState) -> jax.Array:
    """Returns how far [m] the farthest corner lies outside the drivable area; >= 0."""
    reach = 0.5 * (
        case.ego_width * jnp.abs(jnp.cos(ego.heading))
        + case.ego_length * jnp.abs(jnp.sin(ego.heading))
    )
    left = ego.l + reach - case.road.edge_left
    right = case.road.edge_right - (ego.l - reach)
    return jnp.maximum(jnp.maximum(left, right), 0.0)


def headway(case: Case, ego: EgoState, state: AgentState) -> jax.Array:
    """Time [s] to the rear of the nearest agent ahead in the own corridor."""
    nearest = gap_ahead(case, ego, state)
    return jnp.where(ego.v > 0.5, nearest / jnp.maximum(ego.v, 0.5), jnp.inf)


def gap_ahead(case: Case, ego: EgoState, state: AgentState) -> jax.Array:
    """Distance [m] to the rear of the nearest agent ahead in the own corridor; inf."""
    half_s = 0.5 * (
        case.agents.length * jnp.abs(jnp.cos(state.heading))
        + case.agents.width * jnp.abs(jnp.sin(state.heading))
    )
    half_l = 0.5 * (
        case.agents.length * jnp.abs(jnp.sin(state.heading))
        + case.agents.width * jnp.abs(jnp.cos(state.heading))
    )
    gap = state.s - half_s - ego.s - 0.5 * case.ego_length
    aside = jnp.abs(state.l - ego.l) - half_l - 0.5 * case.ego_width
    in_way = state.present & (gap > 0.0) & (aside < CORRIDOR_MARGIN_M)
    return jnp.min(jnp.where(in_way, gap, jnp.inf))


def is_vru(case: Case) -> jax.Array:
    """[A] bool: pedestrians and cyclists."""
    kind = case.agents.kind
    return (kind == Kind.PEDESTRIAN) | (kind == Kind.CYCLIST)


def road_limit(road: Road, steers: bool = False) -> jax.Array:
    """Speed limit [R] m/s of a road as the planner gets it (`geometry.limits`).

    The bends of the given path count unless the planner `steers`.
    """
    path_l = jnp.zeros_like(road.path_l) if steers else road.path_l
    return planning_limit(road.kappa, path_l, road.speed_limit, ROAD_STEP_M, jnp)


EDGE_SHARE = 0.05  # 1, of a lane's width, by which a free lane may be narrower


def lane_centre(road: Road, ego: EgoState) -> jax.Array:
    """Centre [] m of the lane that the ego is on, of those of its direction.

    Where that lane ends within the planner's view, it is that of the nearest lane which
    does not, if there is one.
    """
    width = road.lane_width
    own = jnp.clip(jnp.round(ego.l / width), -road.lanes_right, road.lanes_left)
    highest = jnp.min(_window(road.route_left, ego.s)) / width
    lowest = jnp.max(_window(road.route_right, ego.s)) / width
    highest = jnp.minimum(jnp.floor(highest - 0.5 + EDGE_SHARE), road.lanes_left)
    lowest = jnp.maximum(jnp.ceil(lowest + 0.5 - EDGE_SHARE), -road.lanes_right)
    goes_on = jnp.where(lowest <= highest, jnp.clip(own, lowest, highest), own)
    return width * goes_on


SEEN = ("s", "l", "heading", "v", "a", "present")  # rows of `World.seen`


def visible(state: AgentState) -> jax.Array:
    """Returns the visible state of the agents, rows [6, A] in the order of `SEEN`."""
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
    """Returns the perceived agents [A], from the ego's station on."""
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


def observe(case: Case, world: World, limit: jax.Array, steers: bool = False) -> Scene:
    """The planning frame of one case now.

    Where the planner `steers`, the reference line is the middle of the lane that the
    ego is on, as in training scenes, and the road is what the route leaves free.

    Args:
      case: the drive.
      world: its state.
      limit: [R] m/s, `road_limit(case.road)`, computed once per case.
      steers: the planner plans paths, not speed along the given one.
    """
    ego, road = world.ego, case.road
    kappa = lookup(road.kappa, ego.s, ROAD_STEP_M)
    shrink = jnp.maximum(1.0 - kappa * ego.l, 0.1)
    flat = jnp.ones((NUM_STATIONS,))
    middle = lane_centre(road, ego) if steers else jnp.zeros(())
    if steers:
        ego = ego.replace(l=ego.l - middle)
        kappa = kappa / jnp.maximum(1.0 - kappa * middle, 0.1)
        bend = _window(road.kappa, ego.s)
        path = Path(
            kappa=bend / jnp.maximum(1.0 - bend * middle, 0.1),
            l=0.0 * flat,
            speed_limit=_window(limit, ego.s),
            lane_left=0.5 * road.lane_width * flat,
            lane_right=-0.5 * road.lane_width * flat,
            road_left=_window(road.route_left, ego.s) - middle,
            road_right=_window(road.route_right, ego.s) - middle,
        )
    else:
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
    bodies = _bodies(case, world, perceive(case, world))
    if steers:
        bodies = bodies.replace(l=bodies.l - middle)
    return Scene(
        ego=seen_ego,
        path=path,
        obstacles=obstacles_of(
            bodies,
            stop_line(case, world, ego) - ego.s,
            road.destination - ego.s,
            seen_ego,
            path,
        ),
        time_valid=jnp.ones((NUM_TIMES,), bool),
        tags=jnp.zeros((NUM_TAGS,), bool),
    )


DEPARTURE_M = 2.0  # m from its own log beyond which replayed agents turn reactive
CONFLICT_S = 3.0  # s to a collision below which they do


def start(case: Case) -> World:
    """The world at t = 0: the ego on its path, in its heading and curvature."""
    zero = jnp.zeros((NUM_AGENTS,))
    no = jnp.zeros((NUM_AGENTS,), bool)
    l, slope, curvature, _ = (x[0] for x in path_points(case.road, jnp.zeros((1,))))
    kappa = case.road.kappa[0]
    ego = EgoState(
        s=jnp.zeros(()),
        l=l,
        heading=jnp.arctan(slope / jnp.maximum(1.0 - kappa * l, 0.1)),
        v=case.ego_v,
        a=jnp.zeros(()) if case.ego_a is None else case.ego_a,
        curvature=curvature,
    )
    state = AgentState(
        s=zero,
        l=zero,
        heading=zero,
        v=zero,
        a=zero,
        l_dot=zero,
        l_target=zero,
        clock=zero - 1.0,
        present=no,
        gone=no,
        queue=jnp.full((NUM_AGENTS, NUM_DELAY), NO_LIMIT),
    )
    step = jnp.zeros((), jnp.int32)
    state = spawn_and_despawn(case, ego, state, step)
    replay = _replay(case)
    reactive = ~jnp.any(replay.present)
    state = either(reactive, state, _from_log(case, replay, state, step))
    return World(
        step=step,
        ego=ego,
        agents=state,
        seen=jnp.stack([visible(state)] * NUM_HISTORY),
        served=jnp.zeros((NUM_LINES,), bool),
        halts=jnp.zeros((NUM_LINES,), bool),
        stopped=jnp.zeros((), bool),
        reactive=reactive,
    )


def _replay(case: Case) -> Replay:
    return jax.tree.map(jnp.asarray, case.replay or nobody_recorded())


def _from_log(
    case: Case, replay: Replay, state: AgentState, step: jax.Array
) -> AgentState:
    """Agents where their logs have them at a step."""
    index = jnp.minimum(step, replay.s.shape[1] - 1)
    at = lambda table: table[:, index]  # noqa: E731
    present = at(replay.present) & (case.agents.kind != Kind.NONE) & ~state.gone
    v = at(replay.v)
    return state.replace(
        s=at(replay.s),
        l=at(replay.l),
        heading=at(replay.heading),
        v=v,
        a=jnp.where(state.present & present, (v - state.v) / STEP_S, 0.0),
        l_target=at(replay.l),
        clock=jnp.where(present, 1e3, -1.0),
        present=present,
    )


def _advance_agents(case: Case, world: World) -> tuple[AgentState, jax.Array]:
    """Agents after one step, and the hardest braking [] that the ego causes."""
    time = world.step * STEP_S
    state = world.agents
    bodies = bodies_of(case, world.ego, state)
    looks = jnp.where(
        jnp.abs(jnp.sin(state.heading)) < 3.0 * LANE_TILT,
        jnp.where(jnp.cos(state.heading) > 0.0, 0.0, jnp.pi),
        state.heading,
    )
    pairs = corridors(case, bodies, looks)
    wish, limit, because = accelerations(case, bodies, state, pairs, time)
    target = steer_targets(case.agents, state)
    target = mobil(case, bodies, state.replace(l_target=target), pairs, world.step)
    queue = jnp.concatenate([limit[:, None], state.queue[:, :-1]], axis=1)
    late = jnp.round(case.agents.driver.delay / STEP_S).astype(jnp.int32)
    late = jnp.clip(late, 0, NUM_DELAY - 1)
    reaction = jnp.take_along_axis(queue, late[:, None], axis=1)[:, 0]
    state = state.replace(l_target=target, queue=queue)
    moved = move(case, state, jnp.minimum(wish, reaction))
    induced = jnp.max(jnp.where(state.present, -because, 0.0))
    return moved, jnp.maximum(induced, 0.0)


def _turns_reactive(replay: Replay, world: World, ttc: jax.Array) -> jax.Array:
    """True if the ego has left its log, or a conflict is near."""
    index = jnp.minimum(world.step, replay.ego_s.shape[0] - 1)
    departed = jnp.hypot(
        world.ego.s - replay.ego_s[index], world.ego.l - replay.ego_l[index]
    )
    return replay.turns_reactive & ((departed > DEPARTURE_M) | (ttc < CONFLICT_S))


def step(
    case: Case,
    world: World,
    acceleration: jax.Array,
    fallback: jax.Array,
    vehicle: Vehicle,
    follow_log: jax.Array | bool = False,
    planned: jax.Array | None = None,
) -> tuple[World, Record]:
    """One tick of 0.1 s.

    Args:
      case: the drive.
      world: its state.
      acceleration: m/s^2, the ego's command.
      fallback: bool, of the plan in force (only logged).
      vehicle: the ego's limits and lags.
      follow_log: bool, the ego is the recorded human, where there is one.
      planned: [3, 2] the planned path, as in `steering`; None: the given one.

    Returns:
      The world one step later and the record of that later moment.
    """
    ego, replay = world.ego, _replay(case)
    moved_ego = drive(ego, case.road, acceleration, vehicle, planned)
    human = _human(replay, ego, world.step + 1)
    moved_ego = either(follow_log, human, moved_ego)
    state, induced = _advance_agents(case, world)
    logged = _from_log(case, replay, world.agents, world.step + 1)
    state = either(world.reactive, state, logged)
    induced = jnp.where(world.reactive, induced, 0.0)
    # what has ended stays as it is
    over = world.stopped
    moved_ego = either(over, ego, moved_ego)
    found = contacts(case, moved_ego, state)
    crossed_red, crossed_sign, served, halts = _lines(case, world, moved_ego)
    crash = jnp.any(found.at_fault)
    record = _record(case, world, moved_ego, state, found).replace(
        red_light=crossed_red,
        stop_sign=crossed_sign,
        induced_braking=induced,
        fallback=fallback,
        command=acceleration,
    )
    # a hit agent leaves: every collision counts once
    state = state.replace(
        present=state.present & ~found.hit, gone=state.gone | found.hit
    )
    # of who was recorded nobody appears by a script; who is far away leaves
    state = spawn_and_despawn(case, moved_ego, state, world.step + 1)
    ttc = jnp.min(jnp.where(found.ahead, found.ttc, jnp.inf))
    turns = _turns_reactive(replay, world, ttc) & ~jnp.asarray(follow_log)
    return World(
        step=world.step + 1,
        ego=moved_ego,
        agents=state,
        seen=jnp.concatenate([visible(state)[None], world.seen[:-1]]),
        served=served,
        halts=halts,
        stopped=over | crash,
        reactive=world.reactive | turns,
    ), record


def _human(replay: Replay, ego: EgoState, step: jax.Array) -> EgoState:
    """The recorded human's state at a step; a and curvature by differences."""
    index = jnp.minimum(step, replay.ego_s.shape[0] - 1)
    s, l, v = replay.ego_s[index], replay.ego_l[index], replay.ego_v[index]
    advance = jnp.maximum(s - ego.s, 1e-3)
    # the direction of a few centimetres says nothing about the car's
    moves = v > 2.0
    heading = jnp.where(moves, jnp.arctan2(l - ego.l, advance), ego.heading)
    return EgoState(
        s=s, l=l, heading=heading, v=v, a=(v - ego.v) / STEP_S, curvature=ego.curvature
    )


def _lines(
    case: Case, world: World, moved: EgoState
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """(red light run, stop sign run, served signs, halts) of this step."""
    lines, half = case.lines, 0.5 * case.ego_length
    before = lines.s - (world.ego.s + half)
    after = lines.s - (moved.s + half)
    crosses = (before >= 0.0) & (after < 0.0)
    time = world.step * STEP_S
    _, red = colours(lines, time)
    is_sign = lines.kind == LineKind.STOP_SIGN
    ran_red = jnp.any(crosses & red)
    ran_sign = jnp.any(crosses & is_sign & ~world.served)
    served = mark_stop_sign_served(lines, world.served, after, moved.v)
    halts = stopping_for_light(lines, world.halts, time, before, world.ego.v[None])
    return ran_red, ran_sign, served, halts


def _record(
    case: Case, world: World, ego: EgoState, state: AgentState, found: Contacts
) -> Record:
    road = case.road
    count = lambda mask: jnp.sum(mask, dtype=jnp.int32)  # noqa: E731
    front = ego.s + 0.5 * case.ego_length
    fault = found.at_fault
    return Record(
        valid=(world.step < case.steps) & ~world.stopped,
        s=ego.s,
        l=ego.l,
        heading=ego.heading,
        v=ego.v,
        a=ego.a,
        curvature=ego.curvature,
        speed_limit=lookup(road.speed_limit, ego.s, ROAD_STEP_M),
        path_l=lookup(road.path_l, ego.s, ROAD_STEP_M),
        clearance=jnp.min(found.clearance),
        ttc=jnp.min(jnp.where(found.ahead, found.ttc, jnp.inf)),
        headway=headway(case, ego, state),
        free_way=jnp.minimum(
            gap_ahead(case, ego, state),
            stop_line(case, world, ego) - front,
        ),
        collision=count(found.hit),
        at_fault=count(fault),
        at_fault_vru=count(fault & is_vru(case)),
        at_fault_object=count(fault & (case.agents.kind == Kind.STATIC)),
        impact_speed=jnp.max(jnp.where(found.hit, found.relative_speed, 0.0)),
        red_light=jnp.zeros((), bool),
        stop_sign=jnp.zeros((), bool),
        off_road=off_road(case, ego),
        induced_braking=jnp.zeros(()),
        fallback=jnp.zeros((), bool),
        command=jnp.zeros(()),
    )
