"""The other road users: IDM along the heading, MOBIL across lanes, scripts.

One rule finds what is in an agent's way whatever it is: a lane keeper, an
oncoming car, a crossing car or a pedestrian looks along its own heading and
counts every body whose box reaches into its corridor. So lanes, junctions and
crosswalks need no maps of conflicts.

    IDM (Treiber, Hennecke, Helbing 2000), capped at -8 m/s^2:
        a [1 - (v / v0)^4 - max_j (s*_j / gap_j)^2],
        s* = s0 + max(v T + v (v - v_j) / (2 sqrt(a b)), 0)
    MOBIL (Kesting, Treiber, Helbing 2007): change if it is safe and
        a~_e - a_e + p [(a~_n - a_n) + (a~_o - a_o)] > threshold

Before them, the stop lines: what a light shows, and who has to stop.
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.simulation.cases import (
    NUM_AGENTS,
    ROAD_STEP_M,
    STEP_S,
    Agents,
    AgentState,
    Case,
    EgoState,
    LineKind,
    Lines,
    World,
)
from rcirl_jax.types import Kind

# m/s^2: at yellow one stops if this braking suffices (dilemma-zone practice)
YELLOW_BRAKING_MPS2 = 3.0
STOP_WINDOW_M = 5.0  # m before a stop sign within which standing counts (nuPlan)
STOP_SPEED_MPS = 0.1  # m/s, standing (nuPlan)


def colours(lines: Lines, time: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(yellow, red) [L] bool of all lines at a time [s]."""
    is_light = lines.kind == LineKind.LIGHT
    cycle = jnp.maximum(lines.green + lines.yellow + lines.red, 1e-3)
    phase = jnp.mod(time + lines.offset, cycle)
    yellow = is_light & (phase >= lines.green) & (phase < lines.green + lines.yellow)
    red = is_light & (phase >= lines.green + lines.yellow)
    return yellow, red


def can_stop(v: Any, distance: Any) -> Any:  # noqa: ANN401
    """True where 3 m/s^2 stop a driver at speed v m/s within distance m, elementwise.

    Arguments are numbers or arrays, of numpy or JAX.
    """
    return v**2 <= 2.0 * YELLOW_BRAKING_MPS2 * distance


def must_stop(
    lines: Lines, time: jax.Array, distance: jax.Array, v: jax.Array
) -> jax.Array:
    """True where lights demand a stop of a driver; shape of `distance`.

    Red always does; yellow where the driver can still stop with 3 m/s^2.

    Args:
      lines: [L].
      time: [] s.
      distance: [..., L] m from the driver's front to the lines.
      v: [..., 1] m/s, the driver's speed.
    """
    yellow, red = colours(lines, time)
    return red | (yellow & can_stop(v, jnp.maximum(distance, 0.0)))


def stopping_for_light(
    lines: Lines, halts: jax.Array, time: jax.Array, distance: jax.Array, v: jax.Array
) -> jax.Array:
    """Lights [L] that have demanded a stop of the ego and are not green again.

    Who could stop when the light turned yellow has to: without this a driver who
    brakes late by a little is let go on, and meets red at the line.
    """
    yellow, red = colours(lines, time)
    return (yellow | red) & (halts | must_stop(lines, time, distance, v))


def mark_stop_sign_served(
    lines: Lines, served: jax.Array, distance: jax.Array, v: jax.Array
) -> jax.Array:
    """Stop signs at which the ego has stood: within 5 m before it, below 0.1 m/s."""
    stands = (v < STOP_SPEED_MPS) & (distance >= 0.0) & (distance <= STOP_WINDOW_M)
    return served | (stands & (lines.kind == LineKind.STOP_SIGN))


def stop_line(case: Case, world: World, ego: EgoState) -> jax.Array:
    """Station [] m of the nearest line that demands a stop of the ego now; inf.

    Args:
      case: the drive, with its lines.
      world: its clock, the stop signs at which the ego has stood, the lights that it
        stops for.
      ego: whose front is at or before the line.
    """
    lines = case.lines
    distance = lines.s - (ego.s + 0.5 * case.ego_length)
    time = world.step * STEP_S
    light = stopping_for_light(lines, world.halts, time, distance, ego.v[None])
    sign = (lines.kind == LineKind.STOP_SIGN) & ~world.served
    return jnp.min(jnp.where((light | sign) & (distance >= 0.0), lines.s, jnp.inf))


MAX_BRAKING_MPS2 = 8.0  # m/s^2, physical cap of an agent's braking
IDM_EXPONENT = 4.0  # 1, Treiber et al.
CORRIDOR_MARGIN_M = 0.2  # m beyond the half widths within which a body is in the way
LANE_TILT = 0.17  # sin of the heading below which an agent keeps a lane (10 degrees)
SPEED_GAIN_S = 0.3  # s, time constant with which a scripted speed is approached
LATERAL_RATE = 1.2  # 1/s, lane keeping: critically damped, settles in about 4 s
LATERAL_SPEED_MPS = 1.2  # m/s, of a lane change that MOBIL decides
SAFE_BRAKING_MPS2 = 3.5  # m/s^2 that MOBIL may impose on the new follower
LANE_CHANGE_GAP_M = 2.0  # m, free ahead and behind that MOBIL asks for
MOBIL_PERIOD = 10  # steps between two decisions of an agent (1 s)
MIN_GAP_M = 0.1  # m, keeps (s* / gap)^2 finite
LEAVE_BEHIND_M = 150.0  # m behind the ego where an agent leaves the drive
LEAVE_AHEAD_M = 400.0  # m ahead, for agents that appeared relative to the ego
LEAVE_ASIDE_M = 150.0  # m, lateral
APPEAR_MARGIN_M = 2.0  # m around a body where nobody appears
NO_LIMIT = 1e3  # m/s^2, nothing holds the agent back


class Bodies(flax.struct.PyTreeNode, kw_only=True):
    """Ego (index 0) and agents as boxes, [A + 1]."""

    s: jax.Array
    l: jax.Array
    heading: jax.Array
    v: jax.Array
    length: jax.Array
    width: jax.Array
    present: jax.Array


def bodies_of(case: Case, ego: EgoState, state: AgentState) -> Bodies:
    """The ego in front of the agents."""
    join = lambda one, rest: jnp.concatenate([one[None], rest])  # noqa: E731
    agents = case.agents
    return Bodies(
        s=join(ego.s, state.s),
        l=join(ego.l, state.l),
        heading=join(ego.heading, state.heading),
        v=join(ego.v, state.v),
        length=join(case.ego_length, agents.length),
        width=join(case.ego_width, agents.width),
        present=join(jnp.ones((), bool), state.present),
    )


class Corridor(flax.struct.PyTreeNode, kw_only=True):
    """The surroundings that agent i meets along its heading; all [A, A + 1]."""

    gap: jax.Array  # m between the boxes along i's heading
    ahead: jax.Array  # bool: j's centre lies ahead of i's
    aside: jax.Array  # m between the boxes across i's heading; < 0 in the way
    across: jax.Array  # m, signed offset of j across i's heading
    speed: jax.Array  # m/s, of j along i's heading
    other: jax.Array  # bool: j is present and not i itself


def corridors(case: Case, bodies: Bodies, direction: jax.Array) -> Corridor:
    """Relative geometry of all pairs; `direction` [A] rad is where i looks."""
    cosine, sine = jnp.cos(direction)[:, None], jnp.sin(direction)[:, None]
    ds = bodies.s[None] - bodies.s[1:, None]
    dl = bodies.l[None] - bodies.l[1:, None]
    along, across = ds * cosine + dl * sine, dl * cosine - ds * sine
    turn = bodies.heading[None] - direction[:, None]
    c, s = jnp.abs(jnp.cos(turn)), jnp.abs(jnp.sin(turn))
    reach_along = 0.5 * (bodies.length * c + bodies.width * s)
    reach_across = 0.5 * (bodies.length * s + bodies.width * c)
    own_length = 0.5 * bodies.length[1:, None]
    own_width = 0.5 * bodies.width[1:, None]
    itself = jnp.arange(NUM_AGENTS + 1)[None] == jnp.arange(NUM_AGENTS)[:, None] + 1
    return Corridor(
        gap=jnp.abs(along) - reach_along - own_length,
        ahead=along > 0.0,
        aside=jnp.abs(across) - reach_across - own_width,
        across=across,
        speed=bodies.v[None] * jnp.cos(turn),
        other=bodies.present[None] & ~itself,
    )


def interaction(
    agents: Agents, v: jax.Array, lead_speed: jax.Array, gap: jax.Array
) -> jax.Array:
    """(s* / gap)^2 of the IDM; v is [A, 1], the others [A, M]."""
    driver = agents.driver
    comfort = 2.0 * jnp.sqrt(driver.acceleration * driver.braking)[:, None]
    wanted = driver.standstill[:, None] + jnp.maximum(
        v * driver.headway[:, None] + v * (v - lead_speed) / comfort, 0.0
    )
    return (wanted / jnp.maximum(gap, MIN_GAP_M)) ** 2


def _scripted(agents: Agents, clock: jax.Array) -> tuple[jax.Array, ...]:
    """(active, target speed, rate) [A] of the speed script now."""
    script = agents.script
    begun = clock[:, None] >= script.start
    phase = jnp.sum(begun, axis=1) - 1
    pick = jax.nn.one_hot(phase, script.start.shape[1])
    speed = jnp.sum(jnp.where(pick > 0.0, script.speed, 0.0), axis=1)
    rate = jnp.sum(jnp.where(pick > 0.0, script.rate, 0.0), axis=1)
    return phase >= 0, speed, rate


def _ahead_of_lines(case: Case, state: AgentState, time: jax.Array) -> jax.Array:
    """(s* / gap)^2 [A] against the nearest demanding line of the ego's road."""
    agents, lines = case.agents, case.lines
    front = state.s + 0.5 * agents.length
    distance = lines.s[None] - front[:, None]
    stop = must_stop(lines, time, distance, state.v[:, None])
    gap = jnp.where(stop & (distance > -1.0), distance, jnp.inf)
    nearest = jnp.maximum(jnp.min(gap, axis=1), 0.0) + agents.driver.standstill - 1.0
    ratio = interaction(
        agents, state.v[:, None], jnp.zeros((NUM_AGENTS, 1)), nearest[:, None]
    )[:, 0]
    along = jnp.cos(agents.heading) > 0.0
    keeps = jnp.abs(jnp.sin(agents.heading)) < LANE_TILT
    obeys = agents.driver.obeys_lines & along & keeps
    return jnp.where(obeys & jnp.isfinite(nearest), ratio, 0.0)


def _changing_aside(
    case: Case, state: AgentState, pairs: Corridor, keeps: jax.Array
) -> jax.Array:
    """Corridor test that also looks along the lane one is moving to, [A, A + 1]."""
    to_go = (state.l_target - state.l)[:, None]
    sign = jnp.where(jnp.cos(state.heading) > 0.0, 1.0, -1.0)[:, None]
    width = jnp.abs(pairs.across) - pairs.aside  # sum of the half widths
    target = jnp.abs(pairs.across - sign * to_go) - width
    target = jnp.where(keeps[:, None], target, pairs.aside)
    return jnp.minimum(pairs.aside, target)


def accelerations(
    case: Case, bodies: Bodies, state: AgentState, pairs: Corridor, time: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(desired, limit set by others, the ego's part in that limit), [A] m/s^2.

    The wish (free road or script) is the driver's own and acts at once; the
    limit is a reaction and acts after the reaction delay.
    """
    agents, driver = case.agents, case.agents.driver
    v = state.v[:, None]
    keeps = jnp.abs(jnp.sin(state.heading)) < 3.0 * LANE_TILT
    aside = _changing_aside(case, state, pairs, keeps)
    in_way = pairs.other & pairs.ahead & (aside < CORRIDOR_MARGIN_M)
    ratio = interaction(agents, v, pairs.speed, pairs.gap)
    ratio = jnp.where(in_way, ratio, 0.0)
    strongest = jnp.maximum(jnp.max(ratio, axis=1), _ahead_of_lines(case, state, time))
    active, target, rate = _scripted(agents, state.clock)
    share = state.v / jnp.maximum(driver.desired, 0.1)
    free = driver.acceleration * (1.0 - share**IDM_EXPONENT)
    scripted = jnp.clip((target - state.v) / SPEED_GAIN_S, -rate, rate)
    wanted = jnp.where(active, scripted, free)
    lapse = (state.clock >= driver.lapse_start) & (state.clock < driver.lapse_end)
    attends = driver.reacts & ~lapse
    held = driver.acceleration * (1.0 - share**IDM_EXPONENT - strongest)
    limit = jnp.where(attends, jnp.maximum(held, -MAX_BRAKING_MPS2), NO_LIMIT)
    for_ego = driver.acceleration * (1.0 - share**IDM_EXPONENT - ratio[:, 0])
    because = jnp.where(attends & (ratio[:, 0] >= strongest), for_ego, 0.0)
    return wanted, limit, jnp.maximum(because, -MAX_BRAKING_MPS2)


def mobil(
    case: Case, bodies: Bodies, state: AgentState, pairs: Corridor, step: jax.Array
) -> jax.Array:
    """Lateral targets [A] m after this step's MOBIL decisions."""
    agents, driver, road = case.agents, case.agents.driver, case.road
    width = road.lane_width
    lane = jnp.round(state.l_target / width)
    settled = jnp.abs(state.l - state.l_target) < 0.3
    turn = jnp.mod(step + jnp.arange(NUM_AGENTS), MOBIL_PERIOD) == 0
    ready = driver.changes_lane & state.present & turn & settled & (state.v > 3.0)
    v = state.v[:, None]
    half_widths = jnp.abs(pairs.across) - pairs.aside
    share = (state.v / jnp.maximum(driver.desired, 0.1)) ** IDM_EXPONENT
    ratio = interaction(agents, v, pairs.speed, pairs.gap)
    in_own = pairs.other & (pairs.aside < 0.0)
    same_way = jnp.cos(bodies.heading)[None] > 0.5
    # how hard j would have to brake for i, and j's room ahead with and without i
    behind = _ratio_behind(case, bodies, state, pairs)
    own_ahead = jnp.where(in_own & pairs.ahead, ratio, 0.0)
    old = jnp.where(in_own & ~pairs.ahead & same_way, behind, 0.0)
    sides = np.array([1.0, -1.0])[:, None, None]  # left before right
    there = pairs.other & (jnp.abs(pairs.across - sides * width) < half_widths)
    ahead = jnp.where(there & pairs.ahead, ratio, 0.0)
    follower = jnp.where(there & ~pairs.ahead & same_way, behind, 0.0)
    near = jnp.where(there, -pairs.gap, -jnp.inf)
    found = jnp.concatenate([own_ahead[None], old[None], ahead, follower, near])
    found = jnp.max(found, axis=2)  # [8, A]
    now, freed = -found[0], found[1]
    best_target, best_gain = state.l_target, driver.threshold
    for side, strongest, imposed, room in zip(
        (1.0, -1.0), found[2:4], found[4:6], -found[6:], strict=True
    ):
        exists = lane + 1.0 <= road.lanes_left
        if side < 0.0:
            exists = lane - 1.0 >= -road.lanes_right
        gain = driver.acceleration * (
            -strongest - now + driver.politeness * (freed - imposed)
        )
        braking = driver.acceleration * (strongest + share - 1.0)
        safe = (
            (driver.acceleration * imposed < SAFE_BRAKING_MPS2)
            & (braking < SAFE_BRAKING_MPS2)
            & (room > LANE_CHANGE_GAP_M)
        )
        better = ready & exists & safe & (gain > best_gain)
        best_gain = jnp.where(better, gain, best_gain)
        best_target = jnp.where(better, (lane + side) * width, best_target)
    return best_target


def _ratio_behind(
    case: Case, bodies: Bodies, state: AgentState, pairs: Corridor
) -> jax.Array:
    """(s* / gap)^2 of body j if it followed agent i, [A, A + 1].

    The ego as a follower is credited with i's own driver parameters.
    """
    driver = case.agents.driver
    spread = lambda x: jnp.concatenate([x[:1], x])[None]  # noqa: E731
    comfort = 2.0 * jnp.sqrt(spread(driver.acceleration) * spread(driver.braking))
    v = bodies.v[None]
    wanted = spread(driver.standstill) + jnp.maximum(
        v * spread(driver.headway) + v * (v - state.v[:, None]) / comfort, 0.0
    )
    return (wanted / jnp.maximum(pairs.gap, MIN_GAP_M)) ** 2


def move(case: Case, state: AgentState, applied: jax.Array) -> AgentState:
    """Agents after one step under their present accelerations [A], m/s^2."""
    agents, h = case.agents, STEP_S
    stands = agents.kind == Kind.STATIC
    runs = state.present & (state.clock >= 0.0) & ~stands
    v = jnp.maximum(state.v + applied * h, 0.0)
    v = jnp.where(runs, v, state.v)
    a = (v - state.v) / h
    mean_v = jnp.where(runs, 0.5 * (state.v + v), 0.0)
    keeps = jnp.abs(jnp.sin(agents.heading)) < LANE_TILT
    sign = jnp.where(jnp.cos(agents.heading) > 0.0, 1.0, -1.0)
    pull = LATERAL_RATE**2 * (state.l_target - state.l)
    pull = pull - 2.0 * LATERAL_RATE * state.l_dot
    limit = jnp.minimum(_lateral_limit(agents, state.clock), 0.4 * mean_v)
    l_dot = jnp.clip(state.l_dot + pull * h, -limit, limit)
    l_dot = jnp.where(keeps & runs, l_dot, 0.0)
    tilt = jnp.arctan2(l_dot, jnp.maximum(mean_v, 0.5))
    heading = jnp.where(keeps, agents.heading + sign * tilt, state.heading)
    kappa = jax.vmap(lookup, in_axes=(None, 0, None))(
        case.road.kappa, state.s, ROAD_STEP_M
    )
    shrink = jnp.where(keeps, jnp.maximum(1.0 - kappa * state.l, 0.1), 1.0)
    along = jnp.where(keeps, sign, jnp.cos(heading)) * mean_v / shrink
    aside = jnp.where(keeps, l_dot, jnp.sin(heading) * mean_v)
    return state.replace(
        s=state.s + along * h,
        l=state.l + aside * h,
        heading=heading,
        v=v,
        a=jnp.where(runs, a, 0.0),
        l_dot=l_dot,
        clock=jnp.where(runs, state.clock + h, state.clock),
    )


def _lateral_limit(agents: Agents, clock: jax.Array) -> jax.Array:
    script = agents.script
    begun = clock[:, None] >= script.move_start
    last = jnp.sum(begun, axis=1) - 1
    pick = jax.nn.one_hot(last, script.move_start.shape[1]) > 0.0
    speed = jnp.sum(jnp.where(pick, script.move_speed, 0.0), axis=1)
    return jnp.where(last >= 0, speed, LATERAL_SPEED_MPS)


def steer_targets(agents: Agents, state: AgentState) -> jax.Array:
    """Lateral targets [A] m: the last scripted move that has begun, if any."""
    script, target = agents.script, state.l_target
    for m in range(script.move_start.shape[1]):
        begun = state.clock >= script.move_start[:, m]
        target = jnp.where(begun, script.move_l[:, m], target)
    return target


def spawn_and_despawn(
    case: Case, ego: EgoState, state: AgentState, step: jax.Array
) -> AgentState:
    """Agents appear, start their clocks, and leave."""
    agents = case.agents
    due = (
        (agents.kind != Kind.NONE)
        & ~state.present
        & ~state.gone
        & (ego.s >= agents.appear_s)
        & (step * STEP_S >= agents.appear_t)
    )
    where = jnp.where(agents.relative, ego.s + agents.s, agents.s)
    bodies = bodies_of(case, ego, state)
    near = (
        bodies.present[None]
        & (
            jnp.abs(bodies.s[None] - where[:, None])
            < 0.5 * (bodies.length[None] + agents.length[:, None]) + APPEAR_MARGIN_M
        )
        & (
            jnp.abs(bodies.l[None] - agents.l[:, None])
            < 0.5 * (bodies.width[None] + agents.width[:, None])
        )
    )
    blocked = agents.relative & jnp.any(near, axis=1)
    new = due & ~blocked
    pick = lambda fresh, old: jnp.where(new, fresh, old)  # noqa: E731
    zero = jnp.zeros_like(state.s)
    state = state.replace(
        s=pick(where, state.s),
        l=pick(agents.l, state.l),
        heading=pick(agents.heading, state.heading),
        v=pick(zero, state.v),
        a=pick(zero, state.a),
        l_dot=pick(zero, state.l_dot),
        l_target=pick(agents.l, state.l_target),
        clock=pick(zero - 1.0, state.clock),
        present=state.present | new,
        queue=jnp.where(new[:, None], NO_LIMIT, state.queue),
    )
    gap = jnp.maximum(state.s - ego.s - 0.5 * case.ego_length, 0.0)
    arrival = gap / jnp.maximum(ego.v, 1.0)
    starts = state.present & (state.clock < 0.0) & (arrival <= agents.arrival_s)
    speed = agents.v + agents.v_share * ego.v
    leaves = (
        (state.s < ego.s - LEAVE_BEHIND_M)
        | (agents.relative & (state.s > ego.s + LEAVE_AHEAD_M))
        | (jnp.abs(state.l) > LEAVE_ASIDE_M)
    ) & state.present
    return state.replace(
        v=jnp.where(starts, speed, state.v),
        clock=jnp.where(starts, 0.0, state.clock),
        present=state.present & ~leaves,
        gone=state.gone | leaves,
    )
