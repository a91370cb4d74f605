"""Baselines that drive instead of ranking: constant speed and IDM.

They produce one trajectory each; every candidate is then valued by how close
it comes to that trajectory, so that all metrics are defined for them too.

A driver model that follows, stops and gives way: IDM with gap acceptance.

It stands in for a human where demonstrations are made rather than recorded,
and is a baseline row of its own. Along the path it is an IDM; a body that
crosses becomes a wall at its near edge while the ego would arrive within the
time gap that the driver keeps (gap acceptance, HCM 2010 ch. 19).

Two careful drivers say who could have avoided a collision. They drive like the one that
gives way, with wide margins, and brake harder at a risk.

CC, the competent and careful human driver of UN R157 annex 3: perceives a risk when a
body is in its path, or enters it, with a time to collision of at most 2 s; 0.75 s later
it brakes, building up 12.65 m/s^3 to 0.774 g. FSM, the fuzzy safety model of the JRC:
brakes by how far the gap lies between a safe and an unsafe distance, before the
conflict (PFS) and in it (CFS).
"""

import dataclasses
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.planner.plan import Plan, held
from rcirl_jax.sampling.kinematics import trajectory_from_positions, trajectory_on_path
from rcirl_jax.types import Kind, Obstacles, Scene, Trajectory
from rcirl_jax.units import DT_S, NUM_TIMES, STATION_STEP_M, TIMES_S

SUBSTEPS = 5  # integration steps of the IDM between two times (0.094 s)
TUNED_IDM_ROW = "IDM, tuned"  # name of its row in all tables
IN_WAY_M = 0.2  # m, lateral buffer within which an obstacle is a leader


class Idm(flax.struct.PyTreeNode, kw_only=True):
    """Intelligent Driver Model (Treiber, Hennecke, Helbing 2000), usual values."""

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


class Yielding(flax.struct.PyTreeNode, kw_only=True):
    """Parameters of the driver that gives way."""

    idm: Idm = Idm()
    # 1, share of the planner's speed limit that is driven
    limit_share: float | jax.Array = 0.97
    # s kept between a crossing body and the ego at the conflict
    time_gap: float | jax.Array = 1.2
    # m kept to the near edge of a crossing body
    distance_gap: float | jax.Array = 2.0
    # m added to the half widths when the path is searched for bodies
    margin: float | jax.Array = 0.35
    # m/s sideways above which a body crosses
    crossing_speed: float | jax.Array = 0.7
    # s within which somebody who enters the lane ahead counts as the leader
    entering: float | jax.Array = 2.5


def _in_path(scene: Scene, margin: float | jax.Array) -> jax.Array:
    """[N, T] bool: the body's box reaches into the strip the ego will drive."""
    o = scene.obstacles
    middle = 0.5 * (o.s_lower + o.s_upper)
    at = jax.vmap(jax.vmap(lookup, (None, 0, None)), (None, 0, None))
    path_l = at(scene.path.l, middle, STATION_STEP_M)
    aside = jnp.maximum(o.l_lower - path_l, path_l - o.l_upper)
    known = o.valid & (o.kind != Kind.NONE)[:, None]
    return known & (aside < 0.5 * scene.ego.width + margin)


def _arrival(scene: Scene, station: jax.Array, limit: jax.Array) -> jax.Array:
    """Time [s] at which the ego's centre reaches a station at 1 m/s^2, then limit."""
    way = jnp.maximum(station - scene.ego.s, 0.0)
    v = jnp.maximum(scene.ego.v, 0.0)
    rise = jnp.maximum(limit - v, 0.0)
    ramp_way = v * rise + 0.5 * rise**2
    inside = -v + jnp.sqrt(v**2 + 2.0 * way)
    beyond = rise + (way - ramp_way) / jnp.maximum(jnp.maximum(limit, v), 0.5)
    return jnp.where(way <= ramp_way, inside, beyond)


def _walls(
    scene: Scene, in_path: jax.Array, crosses: jax.Array, driver: Yielding
) -> jax.Array:
    """[N] m, gap to the wall that a crossing body raises; inf without one."""
    o, ego = scene.obstacles, scene.ego
    limit = scene.path.speed_limit[0]
    times = jnp.asarray(TIMES_S)
    enter = jnp.min(jnp.where(in_path, times, jnp.inf), axis=1)
    leave = jnp.max(jnp.where(in_path, times, -jnp.inf), axis=1) + DT_S
    near = jnp.min(jnp.where(in_path, o.s_lower, jnp.inf), axis=1)
    far = jnp.max(jnp.where(in_path, o.s_upper, -jnp.inf), axis=1)
    reach = 0.5 * ego.length + driver.distance_gap
    arrive = _arrival(scene, near - reach, limit)
    clear = _arrival(scene, far + reach, limit)
    meets = (arrive < leave + driver.time_gap) & (clear > enter - driver.time_gap)
    gap = near - ego.s - reach
    # too late to stop for it: go on
    stoppable = gap > ego.v**2 / (2.0 * 6.0) - driver.distance_gap
    counts = crosses & jnp.isfinite(enter) & meets & stoppable & (far > ego.s)
    return jnp.where(counts, jnp.maximum(gap, 0.2), jnp.inf)


def _leaders(scene: Scene, in_path: jax.Array, driver: Yielding) -> jax.Array:
    """[N] bool: bodies and lines ahead in the path, now or soon."""
    soon = jnp.asarray(TIMES_S) <= driver.entering
    front = scene.ego.s + 0.5 * scene.ego.length
    ahead = scene.obstacles.s_lower[:, 0] > front - 0.5
    return jnp.any(in_path & soon, axis=1) & ahead


def acceleration(scene: Scene, driver: Yielding) -> jax.Array:
    """The driver's acceleration [] m/s^2: the lowest that any reason demands."""
    o, ego = scene.obstacles, scene.ego
    in_path = _in_path(scene, driver.margin)
    sideways = jnp.abs(o.l_lower[:, 1] - o.l_lower[:, 0]) / DT_S
    is_body = (o.kind >= Kind.VEHICLE) & (o.kind <= Kind.STATIC)
    crosses = is_body & (sideways > driver.crossing_speed) & ~_drives_along(o)
    leads = _leaders(scene, in_path, driver) & ~crosses
    front = ego.s + 0.5 * ego.length
    gap = jnp.where(leads, o.s_lower[:, 0] - front, 1e3)
    speed = jnp.where(leads, o.speed[:, 0], ego.v)
    wall = jnp.minimum(_walls(scene, in_path, crosses, driver), 1e3)
    standing = wall + driver.idm.standstill_gap
    desired = driver.limit_share * scene.path.speed_limit[0]
    respond = jax.vmap(idm_acceleration, (None, 0, 0, None, None))
    behind = respond(ego.v, gap, ego.v - speed, desired, driver.idm)
    blocked = respond(
        ego.v, standing, jnp.where(wall < 1e3, ego.v, 0.0), desired, driver.idm
    )
    return jnp.minimum(jnp.min(behind), jnp.min(blocked))


def bodies_in_path(scene: Scene, driver: Yielding) -> tuple[jax.Array, jax.Array]:
    """Gap [N] m (inf if none) and speed [N] m/s along the road of bodies ahead.

    Bodies in the ego's path now or within the driver's `entering` time, and
    lines that demand a stop.
    """
    o = scene.obstacles
    leads = _leaders(scene, _in_path(scene, driver.margin), driver)
    gap = o.s_lower[:, 0] - scene.ego.s - 0.5 * scene.ego.length
    sideways = jnp.abs(o.l_lower[:, 1] - o.l_lower[:, 0]) / DT_S
    in_way_now = sideways < driver.crossing_speed
    counts = leads & in_way_now
    return jnp.where(counts, gap, jnp.inf), jnp.where(counts, o.speed[:, 0], 0.0)


def _drives_along(o: Obstacles) -> jax.Array:
    """[N] bool: moves mainly along the road, with the ego."""
    sideways = jnp.abs(o.l_lower[:, 1] - o.l_lower[:, 0]) / DT_S
    return o.speed[:, 0] > 1.5 * sideways


USUAL = Yielding()
RISK_TTC_S = 2.0  # s, CC
REACTION_S = 0.75  # s
BRAKING = 7.59  # m/s^2, CC: 0.774 g
BRAKING_JERK = 12.65  # m/s^3
B_MIN, B_MAX = 4.0, 6.0  # m/s^2, FSM: comfortable and hard
B_LEADER = 7.0  # m/s^2, FSM: assumed of the leader
STANDING_GAP_M = 2.0  # m, FSM
# their driving between risks: wide margins, early yielding
CAREFUL = Yielding(
    idm=Idm(headway=1.8, acceleration=1.2, braking=1.6, standstill_gap=3.0),
    limit_share=0.92,
    time_gap=1.8,
    distance_gap=3.0,
    margin=0.5,
    entering=4.0,
)


def cc_braking(
    gap: jax.Array, v: jax.Array, a: jax.Array, v_lead: jax.Array
) -> jax.Array:
    """Braking m/s^2 >= 0 of the CC driver: full at a risk, otherwise 0."""
    del a
    closing = jnp.maximum(v - v_lead, 1e-3)
    return jnp.where(gap / closing <= RISK_TTC_S, BRAKING, 0.0)


def fsm_braking(
    gap: jax.Array, v: jax.Array, a: jax.Array, v_lead: jax.Array
) -> jax.Array:
    """Braking m/s^2 >= 0 of the fuzzy safety model.

    PFS: d_safe = v tau + v^2 / 2 b_min - v_l^2 / 2 b_l + 2, d_unsafe with b_max
         PFS = clip((d - 2 - d_safe) / (d_unsafe - d_safe), 0, 1)
    CFS: d_safe = (v + a tau / 2 - v_l) tau + (v + a tau - v_l)^2 / 2 b_min
    brake = CFS (b_max - b_min) + b_min where CFS > 0, else PFS b_min
    """
    lead = v_lead**2 / (2.0 * B_LEADER)

    def proactive(b: float) -> jax.Array:
        return v * REACTION_S + v**2 / (2.0 * b) - lead + STANDING_GAP_M

    def critical(b: float) -> jax.Array:
        slow = jnp.maximum(a, -B_MIN)
        later = jnp.maximum(v + slow * REACTION_S, 0.0)
        way = (v + 0.5 * slow * REACTION_S - v_lead) * REACTION_S
        return way + jnp.maximum(later - v_lead, 0.0) ** 2 / (2.0 * b)

    def share(d: jax.Array, safe: jax.Array, unsafe: jax.Array) -> jax.Array:
        width = jnp.minimum(unsafe - safe, -1e-3)
        return jnp.clip((d - safe) / width, 0.0, 1.0)

    pfs = share(gap - STANDING_GAP_M, proactive(B_MIN), proactive(B_MAX))
    cfs = share(gap, critical(B_MIN), critical(B_MAX))
    cfs = jnp.where(v > v_lead, cfs, 0.0)
    hard = cfs * (B_MAX - B_MIN) + B_MIN
    return jnp.where(cfs > 0.0, hard, pfs * B_MIN)


def _careful(braking: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """A driver that brakes by the hardest demand of any body in its path."""

    def driven(scene: Scene, driver: Yielding) -> jax.Array:
        gap, lead = bodies_in_path(scene, driver)
        every = jax.vmap(braking, (0, None, None, 0))
        brake = jnp.max(every(gap, scene.ego.v, scene.ego.a, lead))
        a = acceleration(scene, driver)
        return jnp.minimum(a, jnp.where(brake > 0.0, -brake, a))

    return driven


def behind_the_nearest(scene: Scene, driver: Yielding) -> jax.Array:
    """IDM behind the nearest body or line in the ego's corridor now."""
    obstacles, ego = scene.obstacles, scene.ego
    front = ego.s + 0.5 * ego.length
    aside = jnp.maximum(
        obstacles.l_lower[:, 0] - ego.l, ego.l - obstacles.l_upper[:, 0]
    )
    gap = obstacles.s_lower[:, 0] - front
    in_way = aside < 0.5 * ego.width + IN_WAY_M
    known = obstacles.valid[:, 0] & (obstacles.kind != Kind.NONE)
    leads = known & in_way & (obstacles.s_upper[:, 0] > ego.s)
    nearest = jnp.argmin(jnp.where(leads, gap, jnp.inf))
    found = leads[nearest]
    return idm_acceleration(
        ego.v,
        jnp.where(found, gap[nearest], 1e3),
        jnp.where(found, ego.v - obstacles.speed[nearest, 0], 0.0),
        scene.path.speed_limit[0],
        driver.idm,
    )


# (scene, driver) -> acceleration [] m/s^2
RULES = {
    "constant speed": lambda scene, driver: jnp.zeros(()),
    "IDM": behind_the_nearest,
    "IDM yielding": acceleration,
    "CC": _careful(cc_braking),
    "FSM": _careful(fsm_braking),
}


class Rule(flax.struct.PyTreeNode, kw_only=True):
    """A driver model, as data: `rule` makes it, `rule_policy` drives by it."""

    place: jax.Array  # [] in RULES
    driver: Yielding  # its constants; IDM reads `driver.idm` only


def rule(name: str, driver: Yielding = USUAL) -> Rule:
    """The driver model of a name of `RULES`."""
    numbers = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), driver)
    return Rule(place=jnp.asarray(list(RULES).index(name)), driver=numbers)


def rule_policy(
    params: Rule, scene: Scene, key: jax.Array, before: Plan | None = None
) -> Plan:
    """All driver models as one policy of the simulator."""
    del key, before
    a = jax.lax.switch(params.place, [*RULES.values()], scene, params.driver)
    return held(scene.ego.v, a)
