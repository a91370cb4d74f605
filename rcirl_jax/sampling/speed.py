"""Speed profiles: stations [M, T] of one scene, family by family.

Only positions are made here; derivatives come from `kinematics`. All profiles
start in the ego's state (s, v, a). After its own duration a profile goes on at
its end speed. One that reverses is mended by `sampler.speed_profiles`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rcirl_jax.features.path import SLOPE_POINTS, table_slope
from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.geometry.polynomial import evaluate, quartic, quintic
from rcirl_jax.geometry.running import remaining_min
from rcirl_jax.sampling.config import SamplerConfig
from rcirl_jax.types import Kind, Scene
from rcirl_jax.units import DT_S, HORIZON_S, STATION_STEP_M, TIMES_S

FAMILIES = (
    "constant_speed",
    "cruise",
    "stop",
    "follow",
    "overtake",
    "envelope",
    "emergency",
    "random",
    "hard_negative",
    "in_force",  # what is left of the plan that is being driven
    "given",  # somebody else's, by its positions
)

MIN_PHASE_S = 0.5  # s, shortest phase of a two-phase profile


def family_index(name: str) -> int:
    """Number of a family in `Candidates.family`."""
    return FAMILIES.index(name)


def _roll(
    coefficients: Float[Array, " c"], duration: Float[Array, ""]
) -> Float[Array, " t"]:
    """Polynomial until `duration`, then its end speed."""
    times = jnp.asarray(TIMES_S)
    inside = jnp.minimum(times, duration)
    value, speed, _, _ = jax.vmap(evaluate, in_axes=(None, 0))(coefficients, inside)
    return value + jnp.maximum(speed, 0.0) * (times - inside)


def constant_speed(scene: Scene) -> Float[Array, "1 t"]:
    """S = s0 + v0 t: what a car does when nobody drives it."""
    return (scene.ego.s + scene.ego.v * jnp.asarray(TIMES_S))[None]


def reachable_speeds(
    scene: Scene, durations: Float[Array, " m"], config: SamplerConfig
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Lowest and highest end speed [M] m/s after each duration."""
    v0 = scene.ego.v
    limit = lookup(scene.path.speed_limit, scene.ego.s, STATION_STEP_M)
    lowest = jnp.maximum(v0 - config.reach_braking * durations, 0.0)
    highest = jnp.minimum(
        v0 + config.reach_acceleration * durations,
        jnp.maximum(config.limit_factor * limit, v0),
    )
    return lowest, highest


def _at_level(
    level: Float[Array, " m"],
    v0: Float[Array, ""],
    lowest: Float[Array, " m"],
    highest: Float[Array, " m"],
) -> Float[Array, " m"]:
    """Speed at a signed share of the way from v0 to either bound."""
    up, down = highest - v0, v0 - lowest
    return v0 + jnp.where(level >= 0.0, level * up, level * down)


def cruise(scene: Scene, config: SamplerConfig) -> Float[Array, "m t"]:
    """Quartics to an end speed with zero end acceleration (Apollo lattice)."""
    grid = np.array(
        [(d, level) for d in config.cruise_times for level in config.cruise_levels],
        np.float32,
    )
    durations, levels = jnp.asarray(grid[:, 0]), jnp.asarray(grid[:, 1])
    lowest, highest = reachable_speeds(scene, durations, config)
    speeds = _at_level(levels, scene.ego.v, lowest, highest)
    return jax.vmap(lambda v, d: _to_speed(scene, v, d))(speeds, durations)


def _to_speed(scene: Scene, speed: jax.Array, duration: jax.Array) -> jax.Array:
    ego = scene.ego
    return _roll(quartic(ego.s, ego.v, ego.a, speed, 0.0, duration), duration)


def _to_state(
    scene: Scene, station: jax.Array, speed: jax.Array, duration: jax.Array
) -> jax.Array:
    ego = scene.ego
    end = jnp.maximum(station, ego.s)
    curve = quintic(ego.s, ego.v, ego.a, end, speed, 0.0, duration)
    return _roll(curve, duration)


def stop(scene: Scene, config: SamplerConfig) -> Float[Array, "m t"]:
    """Quintics to a standstill: before the nearest line, or at a mean braking.

    Without a line ahead the line's place is the comfortable stopping distance
    v0^2 / (2 * 1.5), so that the number of profiles is fixed.
    """
    obstacles, ego = scene.obstacles, scene.ego
    front = ego.s + 0.5 * ego.length
    is_line = (obstacles.kind == Kind.STOP) | (obstacles.kind == Kind.VIRTUAL)
    ahead = is_line[:, None] & obstacles.valid & (obstacles.s_lower >= front)
    nearest_line = jnp.min(jnp.where(ahead, obstacles.s_lower, jnp.inf))
    without = front + ego.v**2 / 3.0
    line = jnp.where(jnp.isfinite(nearest_line), nearest_line, without)
    lines = np.array(
        [(d, gap) for d in config.stop_times for gap in config.stop_gaps], np.float32
    )
    durations, gaps = jnp.asarray(lines[:, 0]), jnp.asarray(lines[:, 1])
    at_line = jax.vmap(
        lambda d, gap: _to_state(scene, line - 0.5 * ego.length - gap, jnp.zeros(()), d)
    )(durations, gaps)
    brakings = jnp.asarray(config.stop_brakings, jnp.float32)
    anywhere = jax.vmap(
        lambda b: _to_state(
            scene,
            ego.s + ego.v**2 / (2.0 * b),
            jnp.zeros(()),
            jnp.clip(ego.v / b, 1.0, HORIZON_S),
        )
    )(brakings)
    return jnp.concatenate([at_line, anywhere])


def _edges(scene: Scene, index: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Obstacles in the way at time `index`: [N] usable, lower and upper station."""
    obstacles, ego = scene.obstacles, scene.ego
    lower, upper = obstacles.s_lower[:, index], obstacles.s_upper[:, index]
    at = jax.vmap(lookup, in_axes=(None, 0, None))
    path_l = at(scene.path.l, 0.5 * (lower + upper), STATION_STEP_M)
    beside = jnp.maximum(
        obstacles.l_lower[:, index] - path_l, path_l - obstacles.l_upper[:, index]
    )
    in_way = beside < 0.5 * ego.width
    moves = obstacles.kind < Kind.STOP
    known = obstacles.valid[:, index] & (obstacles.kind != Kind.NONE)
    return in_way & moves & known & (upper > ego.s), lower, upper


def _time_index(time: float) -> int:
    return int(np.argmin(np.abs(TIMES_S - time)))


def follow(scene: Scene, config: SamplerConfig) -> Float[Array, "m t"]:
    """Quintics to a headway behind the nearest obstacles in the way.

    Where there is none, the edge is taken at the constant-speed station plus
    the gap, so that the number of profiles is fixed.
    """
    profiles = []
    for time in config.edge_times:
        index = _time_index(time)
        usable, lower, _ = _edges(scene, index)
        free = scene.ego.s + scene.ego.v * TIMES_S[index] + 20.0
        stations = jnp.where(usable, lower, jnp.inf)
        order = jnp.argsort(stations)[: config.num_followed]
        edge = jnp.where(usable[order], lower[order], free)
        speed = jnp.where(
            usable[order], scene.obstacles.speed[order, index], scene.ego.v
        )
        profiles.append(_behind(scene, edge, speed, float(TIMES_S[index]), config))
    return jnp.concatenate(profiles)


def _behind(
    scene: Scene,
    edge: jax.Array,
    speed: jax.Array,
    duration: float,
    config: SamplerConfig,
) -> jax.Array:
    headways = jnp.asarray(config.follow_headways, jnp.float32)
    speed = jnp.maximum(speed, 0.0)
    gap = config.standstill_gap + headways[None] * speed[:, None]
    stations = edge[:, None] - gap - 0.5 * scene.ego.length
    speeds = jnp.broadcast_to(speed[:, None], stations.shape)
    ends = jnp.full((stations.size,), duration, jnp.float32)
    to_state = jax.vmap(lambda s, v, d: _to_state(scene, s, v, d))
    return to_state(stations.ravel(), speeds.ravel(), ends)


def overtake(scene: Scene, config: SamplerConfig) -> Float[Array, "m t"]:
    """Quintics to a clearance ahead of the obstacle that is easiest to pass."""
    profiles = []
    for time in config.edge_times:
        index = _time_index(time)
        usable, _, upper = _edges(scene, index)
        coasting = scene.ego.s + scene.ego.v * TIMES_S[index]
        effort = jnp.where(usable, jnp.abs(upper - coasting), jnp.inf)
        chosen = jnp.argmin(effort)
        edge = jnp.where(usable[chosen], upper[chosen], coasting)
        speed = jnp.where(
            usable[chosen], scene.obstacles.speed[chosen, index], scene.ego.v
        )
        station = edge + config.overtake_gap + 0.5 * scene.ego.length
        duration = jnp.asarray(TIMES_S[index])
        profiles.append(_to_state(scene, station, jnp.maximum(speed, 0.0), duration))
    return jnp.stack(profiles)


def speed_envelope(
    scene: Scene, lateral: Float[Array, " m"], braking: Float[Array, " m"]
) -> Float[Array, "m p"]:
    """Highest speed m/s at each grid station from which all later caps are kept.

        v(s)^2 = min over s' >= s of cap(s')^2 + 2 b (s' - s)
        cap(s) = min(limit(s), sqrt(a_lat / |kappa(s)|))

    One reverse running minimum of cap^2 + 2 b s for each (a_lat, b).
    """
    path = scene.path
    bend = table_slope(table_slope(path.l, SLOPE_POINTS), SLOPE_POINTS)
    kappa = jnp.maximum(jnp.abs(path.kappa + bend), 1e-5)
    cap = jnp.minimum(path.speed_limit**2, lateral[:, None] / kappa)
    stations = jnp.arange(path.l.shape[0]) * STATION_STEP_M
    ramp = 2.0 * braking[:, None] * stations
    lowest = remaining_min(cap + ramp)
    return jnp.sqrt(jnp.maximum(lowest - ramp, 0.0))


def envelope(scene: Scene, config: SamplerConfig) -> Float[Array, "m t"]:
    """Driving up to the speed envelope: brisk, usual and calm, without a leader.

    The quartics know one end speed and the limit at the ego; where limits and
    bends change within the horizon none of them keeps up with the road. Here

        a = min(a_max (1 - (v / u)^4), (u - v) / dt) below u, (u - v) / dt above,

    u the envelope's lower value here and one step ahead; |a| and its change per
    step are bounded.
    """
    grid = np.asarray(config.envelopes, np.float32)
    share, top, braking, lateral = jnp.asarray(grid.T)
    table = share[:, None] * speed_envelope(scene, lateral, braking)
    at = jax.vmap(lookup, in_axes=(0, 0, None))
    most = config.envelope_jerk * DT_S

    def advance(state: tuple, _: None) -> tuple[tuple, jax.Array]:
        s, v, a = state
        ahead = at(table, s + v * DT_S, STATION_STEP_M)
        ahead = jnp.minimum(ahead, at(table, s, STATION_STEP_M))
        reach = (ahead - v) / DT_S
        free = top * (1.0 - (v / jnp.maximum(ahead, 0.1)) ** 4)
        wanted = jnp.where(v <= ahead, jnp.minimum(free, reach), reach)
        wanted = jnp.clip(wanted, -config.reach_braking, top)
        a = jnp.clip(wanted, a - most, a + most)
        after = jnp.maximum(v + a * DT_S, 0.0)
        s = s + 0.5 * (v + after) * DT_S
        return (s, after, a), s

    ego = scene.ego
    start = tuple(jnp.full(share.shape, x) for x in (ego.s, ego.v, ego.a))
    _, later = jax.lax.scan(advance, start, length=TIMES_S.size - 1)
    return jnp.concatenate([start[0][None], later]).T


def emergency(scene: Scene, config: SamplerConfig) -> Float[Array, "m t"]:
    """s0 + v0 t - b t^2 / 2 until standing, for each emergency braking b."""
    brakings = jnp.asarray(config.emergency_brakings, jnp.float32)[:, None]
    times = jnp.minimum(jnp.asarray(TIMES_S)[None], scene.ego.v / brakings)
    return scene.ego.s + scene.ego.v * times - 0.5 * brakings * times**2


def random_two_phase(
    key: jax.Array, scene: Scene, config: SamplerConfig
) -> Float[Array, "m t"]:
    """Two quartics in a row with random durations and end speeds.

    Levels are cubes of uniform draws, so that profiles crowd near the present
    speed, where humans are. The key is consumed.
    """
    shape = (config.num_random,)
    split_key, time_key, level_key = jax.random.split(key, 3)
    first = jax.random.uniform(split_key, shape, minval=MIN_PHASE_S, maxval=5.0)
    second = jax.random.uniform(time_key, shape, minval=1.5, maxval=6.0)
    levels = jax.random.uniform(level_key, (2, *shape), minval=-1.0, maxval=1.0) ** 3
    lowest, highest = reachable_speeds(scene, first, config)
    mid = _at_level(levels[0], scene.ego.v, lowest, highest)
    lowest, highest = reachable_speeds(scene, first + second, config)
    end = jnp.clip(_at_level(levels[1], scene.ego.v, lowest, highest), lowest, highest)
    return jax.vmap(lambda *a: _two_phase(scene, *a))(mid, end, first, second)


def _two_phase(
    scene: Scene, mid: jax.Array, end: jax.Array, first: jax.Array, second: jax.Array
) -> jax.Array:
    ego, times = scene.ego, jnp.asarray(TIMES_S)
    one = quartic(ego.s, ego.v, ego.a, mid, 0.0, first)
    joint = evaluate(one, first)[0]
    two = quartic(joint, mid, 0.0, end, 0.0, second)
    later = jnp.clip(times - first, 0.0, second)
    early = jax.vmap(evaluate, in_axes=(None, 0))(one, jnp.minimum(times, first))[0]
    late = jax.vmap(evaluate, in_axes=(None, 0))(two, later)[0]
    rest = end * jnp.maximum(times - first - second, 0.0)
    return jnp.where(times <= first, early, late + rest)
