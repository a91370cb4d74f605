"""One step of the world: agents decide, all bodies move, the step is recorded."""

import jax
import jax.numpy as jnp

from rcirl_jax.geometry.frenet import lookup
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
    World,
)
from rcirl_jax.simulation.world import agents as others
from rcirl_jax.simulation.world import judge
from rcirl_jax.simulation.world import lines as signals
from rcirl_jax.simulation.world.observe import visible
from rcirl_jax.simulation.world.vehicle import Vehicle, drive, path_points
from rcirl_jax.types import Kind

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
        queue=jnp.full((NUM_AGENTS, NUM_DELAY), others.NO_LIMIT),
    )
    step = jnp.zeros((), jnp.int32)
    state = others.come_and_go(case, ego, state, step)
    if case.replay is not None:
        state = _from_log(case, case.replay, state, step)
    return World(
        step=step,
        ego=ego,
        agents=state,
        seen=jnp.stack([visible(state)] * NUM_HISTORY),
        served=jnp.zeros((NUM_LINES,), bool),
        halts=jnp.zeros((NUM_LINES,), bool),
        stopped=jnp.zeros((), bool),
        reactive=jnp.zeros((), bool),
    )


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
    bodies = others.bodies_of(case, world.ego, state)
    looks = jnp.where(
        jnp.abs(jnp.sin(state.heading)) < 3.0 * others.LANE_TILT,
        jnp.where(jnp.cos(state.heading) > 0.0, 0.0, jnp.pi),
        state.heading,
    )
    pairs = others.corridors(case, bodies, looks)
    wish, limit, because = others.accelerations(case, bodies, state, pairs, time)
    target = others.steer_targets(case.agents, state)
    target = others.mobil(
        case, bodies, state.replace(l_target=target), pairs, world.step
    )
    queue = jnp.concatenate([limit[:, None], state.queue[:, :-1]], axis=1)
    late = jnp.round(case.agents.driver.delay / STEP_S).astype(jnp.int32)
    late = jnp.clip(late, 0, NUM_DELAY - 1)
    reaction = jnp.take_along_axis(queue, late[:, None], axis=1)[:, 0]
    state = state.replace(l_target=target, queue=queue)
    moved = others.move(case, state, jnp.minimum(wish, reaction))
    induced = jnp.max(jnp.where(state.present, -because, 0.0))
    return moved, jnp.maximum(induced, 0.0)


def _turns_reactive(
    case: Case, replay: Replay, world: World, ttc: jax.Array
) -> jax.Array:
    """Whether the ego has left its log, or a conflict is near."""
    index = jnp.minimum(world.step, replay.ego_s.shape[0] - 1)
    departed = jnp.hypot(
        world.ego.s - replay.ego_s[index], world.ego.l - replay.ego_l[index]
    )
    turns = (departed > DEPARTURE_M) | (ttc < CONFLICT_S)
    return world.reactive | (replay.turns_reactive & turns)


def step(
    case: Case,
    world: World,
    acceleration: jax.Array,
    fallback: jax.Array,
    vehicle: Vehicle,
    follow_log: bool = False,
) -> tuple[World, Record]:
    """One tick of 0.1 s.

    Args:
      case: the drive.
      world: its state.
      acceleration: m/s^2, the ego's command.
      fallback: bool, of the plan in force (only logged).
      vehicle: the ego's limits and lags.
      follow_log: static; the ego is the recorded human.

    Returns:
      The world one step later and the record of that later moment.
    """
    ego = world.ego
    if follow_log and case.replay is not None:
        moved_ego = _human(case.replay, ego, world.step + 1)
    else:
        moved_ego = drive(ego, case.road, acceleration, vehicle)
    state, induced = _advance_agents(case, world)
    if case.replay is not None:
        logged = _from_log(case, case.replay, world.agents, world.step + 1)
        keep = world.reactive
        state = jax.tree.map(lambda a, b: jnp.where(keep, a, b), state, logged)
        induced = jnp.where(keep, induced, 0.0)
    # what has ended stays as it is
    over = world.stopped
    moved_ego = jax.tree.map(lambda a, b: jnp.where(over, a, b), ego, moved_ego)
    found = judge.contacts(case, moved_ego, state)
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
    if case.replay is None:
        state = others.come_and_go(case, moved_ego, state, world.step + 1)
    reactive = world.reactive
    if case.replay is not None and not follow_log:
        ttc = jnp.min(jnp.where(found.ahead, found.ttc, jnp.inf))
        reactive = _turns_reactive(case, case.replay, world, ttc)
    return World(
        step=world.step + 1,
        ego=moved_ego,
        agents=state,
        seen=jnp.concatenate([visible(state)[None], world.seen[:-1]]),
        served=served,
        halts=halts,
        stopped=over | crash,
        reactive=reactive,
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
    _, red = signals.colours(lines, time)
    is_sign = lines.kind == LineKind.STOP_SIGN
    ran_red = jnp.any(crosses & red)
    ran_sign = jnp.any(crosses & is_sign & ~world.served)
    served = signals.serve(lines, world.served, after, moved.v)
    halts = signals.halting(lines, world.halts, time, before, world.ego.v[None])
    return ran_red, ran_sign, served, halts


def _record(
    case: Case, world: World, ego: EgoState, state: AgentState, found: judge.Contacts
) -> Record:
    road = case.road
    count = lambda mask: jnp.sum(mask, dtype=jnp.int32)  # noqa: E731
    nearest = jnp.argmin(found.ttc)
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
        ttc_counts=found.ahead[nearest] & jnp.isfinite(found.ttc[nearest]),
        headway=judge.headway(case, ego, state),
        free_way=jnp.minimum(
            judge.gap_ahead(case, ego, state),
            signals.stop_line(case, world, ego) - front,
        ),
        collision=count(found.hit),
        at_fault=count(fault),
        at_fault_vru=count(fault & judge.is_vru(case)),
        at_fault_object=count(fault & (case.agents.kind == Kind.STATIC)),
        impact_speed=jnp.max(jnp.where(found.hit, found.relative_speed, 0.0)),
        red_light=jnp.zeros((), bool),
        stop_sign=jnp.zeros((), bool),
        off_road=judge.off_road(case, ego),
        induced_braking=jnp.zeros(()),
        fallback=jnp.zeros((), bool),
        command=jnp.zeros(()),
    )
