"""Candidate trajectories: one sampler, offline and online.

Speed profiles are made family by family as end conditions; one call solves the
polynomials of all of them and one rolls them out. Only positions are made here;
derivatives come from `kinematics`. All profiles start in the ego's state (s, v, a).
After its own duration a profile goes on at its end speed; one that reverses stands
still instead. Offline and online the sampler is the same: (key, scene, config) ->
Candidates. A user's own candidates (`own_sampler`) take the place of the families, but
for constant speed and the emergency stops, which the safety filter needs.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rcirl_jax.errors import InputError
from rcirl_jax.features.columns import SLOPE_POINTS, driven_curvature, table_slope
from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.geometry.polynomial import evaluate, quartic, quintic
from rcirl_jax.runtime.user_code import python_sha256
from rcirl_jax.sampling.kinematics import (
    remaining_min,
    running_max,
    trajectory_from_positions,
    trajectory_on_path,
)
from rcirl_jax.sampling.own_sampler import (
    START_M,
    own_count,
    own_positions,
)
from rcirl_jax.types import Candidates, Kind, Scene, Trajectory
from rcirl_jax.units import DT_S, HORIZON_S, NUM_TIMES, STATION_STEP_M, TIMES_S

MODES = ("speed", "path_speed")


@dataclasses.dataclass(frozen=True, kw_only=True)
class SamplerConfig:
    """Grid, jitter and limits of the sampler. Hashable: a static argument.

    Sources: families and 8 s horizon after Apollo's lattice planner
    (cruise, stop, follow, overtake); limits after its constraint checker,
    except that jerk is judged on 0.47 s differences and therefore looser.
    """

    # "speed": along the scene's given path (the paper's case study);
    # "path_speed": lateral profiles too.
    mode: str = "speed"
    # s, ends of the cruise quartics
    cruise_times: tuple[float, ...] = (2.0, 3.0, 4.0, 6.0, 8.0)
    # 1, end speeds as signed shares of the reachable range, dense near v0
    cruise_levels: tuple[float, ...] = (-1.0, -0.6, -0.3, -0.12, 0.0, 0.12, 0.3, 0.6)
    # s, times at which obstacles' edges are followed or overtaken
    edge_times: tuple[float, ...] = (4.0, 8.0)
    # s, headways kept behind a followed obstacle
    follow_headways: tuple[float, ...] = (0.4, 0.8, 1.3, 2.0)
    # number of obstacles followed, nearest first
    num_followed: int = 2
    # m, bumper gap kept to a followed obstacle at standstill
    standstill_gap: float = 2.0
    # m, clearance ahead of an overtaken obstacle (Apollo: 5 m)
    overtake_gap: float = 5.0
    # s, durations of stops at a line
    stop_times: tuple[float, ...] = (3.0, 5.0, 8.0)
    # m, front bumper before the line when standing
    stop_gaps: tuple[float, ...] = (0.5, 2.5)
    # m/s^2, mean braking of stops without a line
    stop_brakings: tuple[float, ...] = (0.8, 1.5, 2.5)
    # drives up to the speed envelope: share of it (1), acceleration, braking
    # and, in bends, lateral acceleration in m/s^2
    envelopes: tuple[tuple[float, float, float, float], ...] = (
        (0.985, 2.0, 0.9, 3.0),
        (0.965, 1.3, 0.8, 2.5),
        (0.9, 0.8, 0.6, 1.8),
    )
    # m/s^3, how fast their acceleration changes
    envelope_jerk: float = 3.0
    # m/s^2, emergency stops, always offered
    emergency_brakings: tuple[float, ...] = (4.0, 6.0, 8.0)
    # number of random two-phase profiles
    num_random: int = 48
    # m/s^2, mean accelerations that bound the reachable end speeds
    reach_braking: float = 3.0
    reach_acceleration: float = 2.0
    # 1, end speeds are capped at this multiple of the limit at the ego
    limit_factor: float = 1.2
    # s, durations from which lateral moves are drawn, at the candidate's own speed
    lateral_times: tuple[float, ...] = (3.0, 5.0)
    # m, shortest lateral move
    min_lateral_length: float = 15.0
    # m, offsets of nudges from the lateral position at t = 0
    nudge_offsets: tuple[float, ...] = (-0.8, -0.4, 0.4, 0.8)
    # m, gap at which what is in the way is passed; 0: no such profiles
    pass_gap: float = 0.0
    # lateral profiles with which every speed profile is paired; 0: hold, 1: centre
    lateral_always: tuple[int, ...] = (0, 1)
    # every n-th speed profile is paired with each further lateral profile
    lateral_stride: int = 4
    # m/s^2, feasible accelerations (Apollo: -6 to 4)
    min_acceleration: float = -6.0
    max_acceleration: float = 4.0
    # m/s^3, feasible |jerk| on the 0.47 s grid
    max_jerk: float = 12.0
    # 1/m (Apollo)
    max_curvature: float = 0.1979
    # m/s^2 (Apollo's 4, with room for the noise of recorded paths)
    max_lateral_acceleration: float = 6.0
    # FILE.py:FUNCTION of the user's own candidates, "" for the grid above, and the
    # sha256 of the file
    own: str = ""
    own_sha256: str = ""

    def __post_init__(self) -> None:
        """Reject an unknown mode; hash the file of own candidates."""
        if self.mode not in MODES:
            raise InputError(f"mode: {self.mode}: expected one of {MODES}")
        if self.own and not self.own_sha256:
            object.__setattr__(self, "own_sha256", python_sha256(self.own, "sampler"))

    def on_own(self, base: "SamplerConfig") -> "SamplerConfig":
        """Returns another grid, with own candidates in its place if there are any."""
        return dataclasses.replace(base, own=self.own, own_sha256=self.own_sha256)


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

START_MPS = 0.5  # m/s between the ego's speed and that of own candidates, at first
MIN_PHASE_S = 0.5  # s, shortest phase of a two-phase profile


def family_index(name: str) -> int:
    """Number of a family in `Candidates.family`."""
    return FAMILIES.index(name)


def as_candidates(trajectory: Trajectory) -> Candidates:
    """Trajectories [K, T], or one [T], as candidates that are all feasible."""
    every = jax.tree.map(jnp.atleast_2d, trajectory)
    count = every.s.shape[0]
    return Candidates(
        trajectory=every,
        feasible=jnp.ones(count, bool),
        family=jnp.zeros(count, jnp.int32),
    )


def _speed_families(config: SamplerConfig) -> np.ndarray:
    """Family number of every speed profile, in the order they are built."""
    if config.own:
        count = own_count(config.own, config.own_sha256)
        counts = (1, count, len(config.emergency_brakings))
        numbers = [family_index(x) for x in ("constant_speed", "given", "emergency")]
        return np.repeat(numbers, counts).astype(np.int32)
    num_stop = len(config.stop_times) * len(config.stop_gaps)
    num_edge = len(config.edge_times)
    counts = {
        "constant_speed": 1,
        "cruise": len(config.cruise_times) * len(config.cruise_levels),
        "stop": num_stop + len(config.stop_brakings),
        "follow": num_edge * config.num_followed * len(config.follow_headways),
        "overtake": num_edge,
        "envelope": len(config.envelopes),
        "emergency": len(config.emergency_brakings),
        "random": config.num_random,
    }
    numbers = [family_index(name) for name in counts]
    return np.repeat(numbers, list(counts.values())).astype(np.int32)


def _pairs(config: SamplerConfig) -> tuple[np.ndarray, np.ndarray]:
    """(speed profile, lateral profile) of every `path_speed` candidate.

    Every speed profile is driven with `lateral_always`, holding the offset and towards
    the lane's centre; every `lateral_stride`-th with each further lateral profile.
    """
    num_speed = _speed_families(config).size
    every_profile = np.arange(num_speed)
    strided = every_profile[:: config.lateral_stride]
    pairs = [(i, m) for m in config.lateral_always for i in every_profile]
    rest = [m for m in range(num_lateral(config)) if m not in config.lateral_always]
    pairs += [(i, m) for m in rest for i in strided]
    grid = np.array(pairs, np.int32)
    return grid[:, 0], grid[:, 1]


def num_candidates(config: SamplerConfig) -> int:
    """K, fixed by the configuration alone."""
    if config.mode == "speed" or config.own:
        return _speed_families(config).size
    return _pairs(config)[0].size


def as_planned(scene: Scene, config: SamplerConfig) -> Scene:
    """Returns a scene without its given path, where paths are planned.

    The path of a scene from a log is the one that the human took, which would tell the
    planner where to go. Instead it gets the reference line, as in closed loop.
    """
    if config.mode == "speed":
        return scene
    return scene.replace(path=scene.path.replace(l=jnp.zeros_like(scene.path.l)))


def sample(key: jax.Array, scene: Scene, config: SamplerConfig) -> Candidates:
    """K candidate trajectories of one scene.

    Args:
      key: typed PRNG key, consumed; only the "random" family depends on it.
      scene: one scene.
      config: static; decides K.

    Returns:
      Candidates with K = `num_candidates(config)`. Infeasible ones stay in
      place and are masked; emergency stops count as feasible always, where paths vary
      those that keep the offset or the lane.
    """
    with jax.named_scope("sampling"):
        scene = as_planned(scene, config)
        stations = speed_profiles(key, scene, config)
        family = jnp.asarray(_speed_families(config))
        keeps = True
        if config.mode == "speed":
            trajectory = jax.vmap(trajectory_on_path, in_axes=(None, 0))(
                scene, stations
            )
            allowed = jnp.ones(family.shape, bool)
        elif config.own:
            trajectory = jax.vmap(trajectory_from_positions, in_axes=(None, 0, 0))(
                scene, stations, _own_offsets(key, scene, stations, config)
            )
            allowed = jnp.ones(family.shape, bool)
        else:
            which_speed, which_lateral = _pairs(config)
            moves = Moves(*jnp.stack(lateral_moves(scene, config))[:, which_lateral])
            trajectory = jax.vmap(_with_lateral, in_axes=(None, 0, 0))(
                scene, stations[which_speed], moves
            )
            family = family[which_speed]
            allowed = moves.allowed > 0.0
            keeps = which_lateral < 2  # the others swerve as hard as they brake
        inside = jax.vmap(lambda x: within_limits(scene, x, config))(trajectory)
        is_emergency = (family == family_index("emergency")) & keeps
        if config.own:
            allowed = _begins(scene, stations, config) | is_emergency
        return Candidates(
            trajectory=trajectory,
            feasible=(inside | is_emergency) & allowed,
            family=family,
        )


def speed_profiles(
    key: jax.Array, scene: Scene, config: SamplerConfig
) -> Float[Array, "m t"]:
    """Stations of all speed profiles, in the order of `_speed_families`.

    Reversing is replaced by standing still.
    """
    ego, times = scene.ego, jnp.asarray(TIMES_S)
    coasting = (ego.s + ego.v * times)[None]  # what a car does when nobody drives it
    if config.own:
        given, _ = own_positions(config.own, config.own_sha256, scene, key)
        return running_max(jnp.concatenate([coasting, given, emergency(scene, config)]))
    random = _random_phases(key, scene, config)
    cruising, ways = _cruise(scene, config), _to_states(scene, config)
    # quartics: cruise and the first phases; quintics: stop, follow, overtake
    speeds = jnp.concatenate([cruising[0], random.mid])
    durations = jnp.concatenate([cruising[1], random.first])
    to_speed = quartic(ego.s, ego.v, ego.a, speeds, 0.0, durations)
    ends = jnp.maximum(ways[0], ego.s)
    to_state = quintic(ego.s, ego.v, ego.a, ends, ways[1], 0.0, ways[2])
    curves = jnp.concatenate([jnp.pad(to_speed, ((0, 0), (0, 1))), to_state])
    durations = jnp.concatenate([durations, ways[2]])[:, None]
    inside = jnp.minimum(times, durations)
    value, speed, _, _ = evaluate(curves[:, None], inside)
    rolled = value + jnp.maximum(speed, 0.0) * (times - inside)
    count = cruising[0].size
    first = slice(count, speeds.size)
    stations = [
        coasting,
        rolled[:count],
        rolled[speeds.size :],
        envelope(scene, config),
        emergency(scene, config),
        _second_phases(random, to_speed[first], value[first]),
    ]
    return running_max(jnp.concatenate(stations))


def _begins(
    scene: Scene, stations: Float[Array, "m t"], config: SamplerConfig
) -> jax.Array:
    """True [M] for profiles that go on from the ego's place and speed, as ours all do.

    Derivatives at t = 0 are the ego's own: a jump there would not be seen in them.
    """
    there = jnp.abs(stations[:, 0] - scene.ego.s) < START_M
    mean = (stations[:, 1] - stations[:, 0]) / DT_S  # m/s, of the first step
    low, high = 0.5 * config.min_acceleration, 0.5 * config.max_acceleration
    gained = mean - scene.ego.v
    kept = (gained > low * DT_S - START_MPS) & (gained < high * DT_S + START_MPS)
    return there & kept


def _own_offsets(
    key: jax.Array, scene: Scene, stations: Float[Array, "m t"], config: SamplerConfig
) -> Float[Array, "m t"]:
    """L [M, T] m of own candidates, and the offset that is held by what stands beside.

    Raises:
      InputError: stations alone are given.
    """
    _, given = own_positions(config.own, config.own_sha256, scene, key)
    if given is None:
        raise InputError(f"{config.own}: s alone: expected s, l where l is planned")
    held = Moves(*jnp.stack(lateral_moves(scene, config))[:, 0])
    hold = jax.vmap(lambda s: lateral_offset(scene, held, s))(stations)
    after = 1 + given.shape[0]
    return jnp.concatenate([hold[:1], given, hold[after:]])


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


def _cruise(
    scene: Scene, config: SamplerConfig
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """End speeds m/s and durations s of the cruise quartics (Apollo lattice).

    Their end acceleration is 0.
    """
    grid = np.array(
        [(d, level) for d in config.cruise_times for level in config.cruise_levels],
        np.float32,
    )
    durations, levels = jnp.asarray(grid[:, 0]), jnp.asarray(grid[:, 1])
    lowest, highest = reachable_speeds(scene, durations, config)
    return _at_level(levels, scene.ego.v, lowest, highest), durations


def _to_states(
    scene: Scene, config: SamplerConfig
) -> tuple[Float[Array, " m"], Float[Array, " m"], Float[Array, " m"]]:
    """End stations m, speeds m/s and durations s of stop, follow and overtake."""
    parts = (_stop(scene, config), *_follow_and_overtake(scene, config))
    stations, speeds, durations = zip(*parts, strict=True)
    return (
        jnp.concatenate(stations),
        jnp.concatenate(speeds),
        jnp.concatenate(durations),
    )


def _stop(scene: Scene, config: SamplerConfig) -> tuple[jax.Array, ...]:
    """To a standstill: before the nearest line, or at a mean braking.

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
    brakings = jnp.asarray(config.stop_brakings, jnp.float32)
    stations = (
        line - 0.5 * ego.length - lines[:, 1],
        ego.s + ego.v**2 / (2.0 * brakings),
    )
    durations = (lines[:, 0], jnp.clip(ego.v / brakings, 1.0, HORIZON_S))
    stations = jnp.concatenate(stations)
    return stations, jnp.zeros_like(stations), jnp.concatenate(durations)


def _in_the_way(scene: Scene) -> jax.Array:
    """Returns the obstacles [N, T] that are in the way and not behind."""
    obstacles, ego = scene.obstacles, scene.ego
    lower, upper = obstacles.s_lower, obstacles.s_upper
    at = jax.vmap(jax.vmap(lookup, (None, 0, None)), (None, 0, None))
    path_l = at(scene.path.l, 0.5 * (lower + upper), STATION_STEP_M)
    beside = jnp.maximum(obstacles.l_lower - path_l, path_l - obstacles.l_upper)
    moves = (obstacles.kind < Kind.STOP) & (obstacles.kind != Kind.NONE)
    in_way = beside < 0.5 * ego.width
    return in_way & moves[:, None] & obstacles.valid & (upper > ego.s)


def _follow_and_overtake(
    scene: Scene, config: SamplerConfig
) -> tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]:
    """To a headway behind the nearest in the way; to a clearance ahead of one.

    Overtaken is the obstacle that is easiest to pass. Where nothing is in the way, the
    edge is taken at the constant-speed station (plus 20 m), so that the number of
    profiles is fixed.
    """
    ego = scene.ego
    near = [int(np.argmin(np.abs(TIMES_S - time))) for time in config.edge_times]
    at = TIMES_S[near]  # [E]
    o = scene.obstacles
    in_way = _in_the_way(scene).astype(jnp.float32)
    facts = jnp.stack([in_way, o.s_lower, o.s_upper, o.speed])
    facts = jnp.stack([facts[..., i] for i in near], axis=1)  # [4, E, N]
    in_way, lower, upper, _ = facts
    usable, coasting = in_way > 0.0, ego.s + ego.v * at  # [E, N], [E]

    order = jnp.argsort(jnp.where(usable, lower, jnp.inf), axis=1)
    order = order[:, : config.num_followed]
    taken = jnp.take_along_axis(facts, order[None], axis=2)
    found = taken[0] > 0.0
    edge = jnp.where(found, taken[1], coasting[:, None] + 20.0)
    pace = jnp.maximum(jnp.where(found, taken[3], ego.v), 0.0)
    headways = jnp.asarray(config.follow_headways, jnp.float32)
    gap = config.standstill_gap + headways * pace[..., None]
    stations = edge[..., None] - gap - 0.5 * ego.length
    spread = lambda x: jnp.broadcast_to(x, stations.shape).ravel()  # noqa: E731
    follow = stations.ravel(), spread(pace[..., None]), spread(at[:, None, None])

    effort = jnp.where(usable, jnp.abs(upper - coasting[:, None]), jnp.inf)
    easiest = jnp.argmin(effort, axis=1)[:, None]
    taken = jnp.take_along_axis(facts, easiest[None], axis=2)[..., 0]
    edge = jnp.where(taken[0] > 0.0, taken[2], coasting)
    pace = jnp.where(taken[0] > 0.0, taken[3], ego.v)
    stations = edge + config.overtake_gap + 0.5 * ego.length
    return follow, (stations, jnp.maximum(pace, 0.0), jnp.asarray(at))


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


class _Phases(NamedTuple):
    """Two speed changes in a row, as they are drawn; all [num_random]."""

    mid: jax.Array  # m/s, speed after the first
    end: jax.Array  # m/s, and after the second
    first: jax.Array  # s, duration of the first
    second: jax.Array  # s, and of the second


def _random_phases(key: jax.Array, scene: Scene, config: SamplerConfig) -> _Phases:
    """Random durations and end speeds. The key is consumed.

    Levels are cubes of uniform draws, so that profiles crowd near the present
    speed, where humans are.
    """
    shape = (2, config.num_random)
    draws = jax.vmap(lambda k: jax.random.uniform(k, shape))(jax.random.split(key, 3))
    between = lambda x, low, high: jnp.maximum(low, x * (high - low) + low)  # noqa: E731
    first = between(draws[0, 0], MIN_PHASE_S, 5.0)
    second = between(draws[1, 0], 1.5, 6.0)
    levels = between(draws[2], -1.0, 1.0) ** 3
    lowest, highest = reachable_speeds(scene, first, config)
    mid = _at_level(levels[0], scene.ego.v, lowest, highest)
    lowest, highest = reachable_speeds(scene, first + second, config)
    end = jnp.clip(_at_level(levels[1], scene.ego.v, lowest, highest), lowest, highest)
    return _Phases(mid, end, first, second)


def _second_phases(
    drawn: _Phases, curves: Float[Array, "m c"], early: Float[Array, "m t"]
) -> Float[Array, "m t"]:
    """Quartics from the first phases' ends, after their stations `early`."""
    times, first, second = jnp.asarray(TIMES_S), drawn.first[:, None], drawn.second
    joint = evaluate(curves, drawn.first)[0]
    two = quartic(joint, drawn.mid, 0.0, drawn.end, 0.0, second)
    later = jnp.clip(times - first, 0.0, second[:, None])
    late = evaluate(two[:, None], later)[0]
    rest = drawn.end[:, None] * jnp.maximum(times - first - second[:, None], 0.0)
    return jnp.where(times <= first, early, late + rest)


def num_lateral(config: SamplerConfig) -> int:
    """Number of lateral profiles: hold, centre, neighbours, nudges and passes."""
    passes = 2 if config.pass_gap else 0
    return 1 + 3 * len(config.lateral_times) + len(config.nudge_offsets) + passes


class Moves(NamedTuple):
    """Lateral profiles; all [m]."""

    target: jax.Array  # m, offset that it leads to
    seconds: jax.Array  # s that it takes, at the candidate's own speed
    shortest: jax.Array  # m that it takes at least
    longest: jax.Array  # m that it takes at most
    back: jax.Array  # m, station from which it leads to the lane's centre; inf
    allowed: jax.Array  # 1 or 0: there is such a lane


# 1, largest curvature of a quintic move of offset y over length L, times L^2 / y
MOVE_CURVATURE = 10.0 / 3.0**0.5
BESIDE_M = 0.35  # m beside the ego's box within which a body is passed
GROUP_M = 40.0  # m; standing bodies nearer than that to the first are passed with it
PAST_M = 3.0  # m beyond the last of them at which the way back begins


def lateral_moves(scene: Scene, config: SamplerConfig) -> Moves:
    """The lateral profiles of a scene.

    Profile 0 holds the offset of t = 0, profile 1 goes to the lane's centre; the
    others are neighbouring lanes (allowed inside the road's edges), nudges, and past
    what is in the way, on its left and on its right, and back where that stands.
    """
    ego, path = scene.ego, scene.path
    left = lookup(path.lane_left, ego.s, STATION_STEP_M)
    right = lookup(path.lane_right, ego.s, STATION_STEP_M)
    centre, width = 0.5 * (left + right), left - right
    road = (
        lookup(path.road_right, ego.s, STATION_STEP_M) + 0.5 * ego.width,
        lookup(path.road_left, ego.s, STATION_STEP_M) - 0.5 * ego.width,
    )
    slow = max(config.lateral_times)
    targets, times = [ego.l], [slow]
    for shift in (0.0, 1.0, -1.0):
        targets += [centre + shift * width] * len(config.lateral_times)
        times += config.lateral_times
    targets += [ego.l + offset for offset in config.nudge_offsets]
    times += [slow] * len(config.nudge_offsets)
    count = len(targets)
    least: list[Any] = [config.min_lateral_length] * count
    longest: list[Any] = [jnp.inf] * count
    back: list[Any] = [jnp.inf] * count
    if config.pass_gap:
        sides, begin, end = _in_front(scene, centre)
        clear = 0.5 * ego.width + config.pass_gap
        for target in (sides[1] + clear, sides[0] - clear):
            targets.append(target)
            times.append(min(config.lateral_times))
            least.append(0.0)
            longest.append(begin - ego.s)
            back.append(end)
    target, seconds, shortest, most, back_at = (
        jnp.stack([jnp.asarray(value, jnp.float32) for value in values])
        for values in (targets, times, least, longest, back)
    )
    # neither bends more than the car can, nor more than half of what is allowed at the
    # speed now: between the times of a trajectory nobody would see it
    bend = jnp.maximum(
        1.25 / config.max_curvature, 2.0 * ego.v**2 / config.max_lateral_acceleration
    )
    bend = MOVE_CURVATURE * bend * jnp.abs(target - ego.l)
    shortest = jnp.maximum(shortest, jnp.sqrt(bend))
    most = jnp.maximum(most, shortest)
    inside = (target >= road[0]) & (target <= road[1])
    free = jnp.arange(target.size) < 1 + len(config.lateral_times)
    allowed = (inside | free).astype(jnp.float32)
    return Moves(target, seconds, shortest, most, back_at, allowed)


def _in_front(
    scene: Scene, centre: jax.Array
) -> tuple[tuple[jax.Array, jax.Array], jax.Array, jax.Array]:
    """Finds the body to pass: the nearest in the lane's middle, and those with it.

    Returns:
      Offsets m of its right and left side, the station m at which the ego has to be
      beside it, and that from which it may go back, inf while one of them moves.
      Without a body all is far away.
    """
    o, ego = scene.obstacles, scene.ego
    lower, upper = o.s_lower[:, 0], o.s_upper[:, 0]
    right, left = o.l_lower[:, 0], o.l_upper[:, 0]
    aside = jnp.maximum(right - centre, centre - left)
    is_body = (o.kind != Kind.NONE) & (o.kind < Kind.STOP) & o.valid[:, 0]
    half = 0.5 * ego.length
    ahead = is_body & (upper + half > ego.s) & (aside < 0.5 * ego.width + BESIDE_M)
    first = jnp.min(jnp.where(ahead, lower, jnp.inf))
    group = ahead & (lower < first + GROUP_M)
    sides = (
        jnp.min(jnp.where(group, right, jnp.inf)),
        jnp.max(jnp.where(group, left, -jnp.inf)),
    )
    moves = jnp.any(group & (jnp.abs(o.speed[:, 0]) > START_MPS))
    last = jnp.max(jnp.where(group, upper, -jnp.inf)) + half + PAST_M
    found = jnp.any(group)
    # infinite numbers would make the curves NaN
    begin, right, left = (jnp.where(found, x, 1e3) for x in (first - half, *sides))
    return (right, left), begin, jnp.where(found & ~moves, last, jnp.inf)


def lateral_offset(
    scene: Scene, move: Moves, s: Float[Array, " t"]
) -> Float[Array, " t"]:
    """L [T] m along stations s, of one profile.

    A quintic in s to the target over the way of `seconds`, then constant; then a
    quintic back to the lane's centre over as long a way.
    """
    ego = scene.ego
    way = lookup(s, move.seconds / DT_S, 1.0) - ego.s
    length = jnp.clip(way, move.shortest, move.longest)
    curve = quintic(ego.l, ego.dl, ego.ddl, move.target, 0.0, 0.0, length)
    there = evaluate(curve[None], jnp.clip(s - ego.s, 0.0, length))[0]
    home = 0.5 * (scene.path.lane_left[0] + scene.path.lane_right[0])
    share = jnp.clip((s - move.back) / jnp.maximum(way, move.shortest), 0.0, 1.0)
    return there + (home - move.target) * share**3 * (
        10.0 - 15.0 * share + 6.0 * share**2
    )


def _with_lateral(scene: Scene, s: jax.Array, move: Moves) -> Trajectory:
    return trajectory_from_positions(scene, s, lateral_offset(scene, move, s))


def within_limits(
    scene: Scene, trajectory: Trajectory, config: SamplerConfig
) -> jax.Array:
    """True if one trajectory respects the vehicle's limits at its valid times.

    a in [min, max], |j|, |kappa|, |v^2 kappa| bounded. v is not: it can be some tenths
    of a m/s below 0 at the end of a stop. Times outside the scene's mask and t = 0
    (given) do not count.
    """
    kappa = driven_curvature(scene, trajectory)
    ok = (
        (trajectory.a >= config.min_acceleration)
        & (trajectory.a <= config.max_acceleration)
        & (jnp.abs(trajectory.j) <= config.max_jerk)
        & (jnp.abs(kappa) <= config.max_curvature)
        & (jnp.abs(trajectory.v**2 * kappa) <= config.max_lateral_acceleration)
    )
    counts = scene.time_valid & (np.arange(NUM_TIMES) > 0)
    return jnp.all(ok | ~counts)


DRIFT_SHARE = 0.25  # 1, of a hard negative's size: how far it drifts aside instead


def hard_negatives(
    key: jax.Array, scene: Scene, human: Trajectory, config: SamplerConfig, count: int
) -> Candidates:
    """Offline only: `count` trajectories near the human that drive worse.

    Half brake late and lose the gap (stations ahead of the human's by up to
    6 m at the end), half lag behind; in `path_speed` a third of each drifts aside
    instead, by up to 1.5 m, one half to each side. The departure grows like
    (t / 8)^p with p in [1, 3], so that near times stay human. The key is consumed.
    """
    size_key, power_key = jax.random.split(key)
    size = jax.random.uniform(size_key, (count,), minval=1.0, maxval=6.0)
    sign = jnp.where(jnp.arange(count) % 2 == 0, 1.0, -1.0)
    power = jax.random.uniform(power_key, (count,), minval=1.0, maxval=3.0)
    share = jnp.asarray(TIMES_S) / HORIZON_S
    grows = share[None] ** power[:, None]
    drifts = (jnp.arange(count) % 6 >= 4) & (config.mode == "path_speed")
    along = jnp.where(drifts, 0.0, size * sign)
    stations = running_max(human.s[None] + along[:, None] * grows)
    if config.mode == "speed":
        trajectory = jax.vmap(trajectory_on_path, in_axes=(None, 0))(scene, stations)
    else:
        aside = jnp.where(drifts, DRIFT_SHARE * size * sign, 0.0)
        offsets = human.l[None] + aside[:, None] * grows
        trajectory = jax.vmap(trajectory_from_positions, in_axes=(None, 0, 0))(
            scene, stations, offsets
        )
    return Candidates(
        trajectory=trajectory,
        feasible=jax.vmap(lambda x: within_limits(scene, x, config))(trajectory),
        family=jnp.full((count,), family_index("hard_negative"), jnp.int32),
    )
