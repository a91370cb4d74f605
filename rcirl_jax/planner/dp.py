"""Search: the plan of the highest sum on a lattice, by dynamic programming.

    V_i(n, m, k-) = max_k  [ own_i + gain gamma_i R(f_i) ](n, m, k, k-)
                           + V_{i+1}(n + m + k, m + k, k)

over accelerations k with m + k >= 0, |k - k-| within the jerk limit, free of bodies and
walls at the next station and halfway to it, and within the speed rule. own is the
planner's own cost as a sum over times (`reward.time_sums`), gain that of
`planner.rank`, and 0 where V does not know the scene; a reward without a prior cost has
own 0 and gain 1. Apollo's speed DP keeps (t, s) only and reads v and a off its single
best predecessor, so it is not optimal for its own cost.

One backward `lax.scan` over time makes an int8 policy, one forward scan reads plans off
it: the best of each of the most valued beginnings. A lattice's plan has jerk in steps,
so each comes once more, smoothed (`smoothed`). Search proposes, ranking chooses: all
join the sampled candidates, pass the same filter and are valued by the same score
(`dp_policy`).

The station-time grid on which sums over times are exact.

The operator of `sampling.kinematics` makes v, a and j of a time from the
stations around it. With w_i = (s_i - s_{i-1}) / dt and a_{i-1} known,

    a_i chosen:  w_{i+1} = w_i + a_i dt,   s_{i+1} = s_i + w_{i+1} dt,
    v_i = w_i + a_i dt / 2,   j_i = (a_i - a_{i-1}) / dt

so (s_i, w_i, a_{i-1}) is a Markov state of that very operator. On the lattice
a = k da, w = m da dt, s = n da dt^2 transitions are integer sums,

    m' = m + k,   n' = n + m',

and nothing is ever interpolated: a path on the lattice has exactly the
features, and therefore the value, that the network computes for it.

Features at (t, n) are at most quadratic in v (relative speeds are affine,
lateral acceleration is v^2 kappa), so three evaluations of F at v = 0, 1, 2
give them for every speed; a and j enter through columns of their own. What is
left per state and action is a sum of hidden pre-activations.

How far a plan is from the best one of its own reward.

    G = V(tau*) - V(tau),   g = G / (V(tau*) - V(emergency stop))

tau* is the best that passes the safety filter of the plan itself, the plan of a finer
lattice and the emergency stop. V has no unit, so g sets the scale: 0 is the
best plan known, 1 is as bad as braking for no reason.
"""

import dataclasses
import functools
import math

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from rcirl_jax.errors import InputError
from rcirl_jax.features import FeatureMap
from rcirl_jax.features.columns import path_view
from rcirl_jax.planner.plan import Plan, PreviousPlan, committed
from rcirl_jax.planner.rank import (
    Policy,
    RankConfig,
    Ranking,
    best_plan,
    gain_in,
    learned_score,
    ranking_score,
    with_plan_in_force,
)
from rcirl_jax.planner.safety import MOVING_MPS, SafetyConfig, check
from rcirl_jax.reward import normalise
from rcirl_jax.reward.network import (
    ACTIVATIONS,
    feature_gates,
    layers_of,
    matmul_f32,
)
from rcirl_jax.reward.time_sums import TIME_SUMS, Grid, TimeSum
from rcirl_jax.sampling import sample
from rcirl_jax.sampling.kinematics import (
    running_max,
    trajectory_from_positions,
    trajectory_on_path,
)
from rcirl_jax.sampling.sampler import (
    SamplerConfig,
    as_candidates,
    emergency,
    family_index,
    within_limits,
)
from rcirl_jax.types import (
    Candidates,
    Kind,
    Normaliser,
    RewardParams,
    Scene,
    Trajectory,
)
from rcirl_jax.units import DT_S, NUM_TIMES, STATION_STEP_M, TIMES_S

FORBIDDEN = -1e6  # value of a state that no plan may take; finite: no NaN
FEASIBLE = -1e5  # values above it belong to plans that break nothing
LARGEST = 1e4  # that own costs may come to

Weights = tuple[RewardParams, Normaliser]


@dataclasses.dataclass(frozen=True, kw_only=True)
class DpConfig:
    """Lattice and limits; hashable. Halving `step` nests the lattice."""

    # m/s^2 between neighbouring accelerations; dt and dt^2 times it are the
    # steps of speed (0.94 m/s) and station (0.44 m)
    step: float = 2.0
    min_acceleration: float = -6.0  # m/s^2
    max_acceleration: float = 4.0  # m/s^2
    max_jerk: float = 12.0  # m/s^3 on the 0.47 s grid, as the sampler's
    max_speed: float = 34.0  # m/s, highest speed of the lattice
    max_way: float = 250.0  # m, longest way of the lattice in 8 s
    # m/s, how far the first interval's mean speed may be from v0 + a0 dt / 2
    first_reach: float = 1.5
    # plans read off the lattice: of as many beginnings, the most valued first
    proposals: int = 8
    safety: SafetyConfig = dataclasses.field(default_factory=SafetyConfig)

    def __post_init__(self) -> None:
        """Reject a lattice without room."""
        if not 0.05 <= self.step <= 4.0:
            raise InputError(f"dp_step: {self.step}: expected 0.05 to 4 m/s^2")

    @property
    def speed_step(self) -> float:
        """m/s between neighbouring mean speeds w."""
        return self.step * DT_S

    @property
    def station_step(self) -> float:
        """M between neighbouring stations."""
        return self.step * DT_S**2

    @property
    def actions(self) -> tuple[int, ...]:
        """The accelerations k in units of `step`, rising."""
        low = math.ceil(self.min_acceleration / self.step - 1e-9)
        high = math.floor(self.max_acceleration / self.step + 1e-9)
        return tuple(range(low, high + 1))

    @property
    def num_speeds(self) -> int:
        """M, mean speeds 0 .. (M - 1) `speed_step`."""
        return math.ceil(self.max_speed / self.speed_step) + 1

    @property
    def num_stations(self) -> int:
        """N, stations 0 .. (N - 1) `station_step` from the ego."""
        longest = (NUM_TIMES - 1) * (self.num_speeds - 1)
        return min(longest, math.ceil(self.max_way / self.station_step)) + 1

    @property
    def jerk_reach(self) -> int:
        """Largest |k_i - k_{i-1}|."""
        return max(1, math.floor(self.max_jerk * DT_S / self.step + 1e-9))


class Objective(flax.struct.PyTreeNode, kw_only=True):
    """The rest of the sum besides the learned reward; of one scene."""

    gain: ArrayLike = 1.0  # [] of V
    reference: Trajectory | None = None  # leaves [T], where the own cost is no sum
    own: str = flax.struct.field(pytree_node=False, default="constant V")


V_ALONE = Objective()


class Lattice(flax.struct.PyTreeNode, kw_only=True):
    """The tables that the recursion reads, made once per scene."""

    c0: jax.Array  # [T, N, F] features at v = 0 (a = j = 0)
    c1: jax.Array  # [T, N, F] their slope by v
    c2: jax.Array  # [T, N, F] and half second derivative
    blocked: jax.Array  # [T, N] bool: a body or a wall is there
    blocked_after: jax.Array  # [T - 1, 2 N + M] bool: half a time later, twice as fine
    speed_cap: jax.Array  # [T, N] m/s
    first: Trajectory  # leaves []: the ego at t = 0, without its jerk
    first_row: jax.Array  # [F] features at t = 0 with jerk 0
    weight: jax.Array  # [T] gain gamma where valid, else 0; over `unit`
    own: TimeSum  # over `unit`
    unit: jax.Array  # [] in which values are added up, far above FORBIDDEN
    has_next: jax.Array  # [T] bool


def _grid_rows(
    features: FeatureMap, scene: Scene, stations: jax.Array, v: float
) -> jax.Array:
    """F [T, N, F] on the station grid at one speed, a = j = 0."""
    count = stations.shape[0]
    s = jnp.broadcast_to(stations[:, None], (count, NUM_TIMES))
    on_path = jax.vmap(trajectory_on_path, in_axes=(None, 0))(scene, s)
    still = jnp.zeros_like(s)
    trajectory = on_path.replace(v=still + v, a=still, j=still)
    return jnp.stack(features.rows(scene, as_candidates(trajectory)), axis=-1)


def make_lattice(
    scene: Scene,
    weights: Weights,
    features: FeatureMap,
    config: DpConfig,
    objective: Objective = V_ALONE,
) -> Lattice:
    """Evaluate F and the own cost on the lattice and mark what is forbidden."""
    stations = scene.ego.s + jnp.arange(config.num_stations) * config.station_step
    f0, f1, f2 = (_grid_rows(features, scene, stations, v) for v in (0.0, 1.0, 2.0))
    c2 = 0.5 * (f2 - 2.0 * f1 + f0)
    ego = trajectory_on_path(scene, jnp.full((NUM_TIMES,), scene.ego.s))
    start = ego.replace(
        v=ego.v.at[0].set(scene.ego.v), a=ego.a.at[0].set(scene.ego.a), j=ego.j * 0.0
    )
    valid = scene.time_valid
    blocked = _blocked(scene, config)
    grid = Grid(
        stations,
        _speeds(config),
        jnp.asarray(config.actions, jnp.float32) * config.step,
    )
    own = TIME_SUMS[objective.own](scene, grid, objective.reference)
    largest = jnp.sum(jnp.max(jnp.abs(own.point), axis=(1, 2)))
    unit = jnp.maximum(largest / LARGEST, 1.0)
    scaled = {x: getattr(own, x) / unit for x in ("point", "action", "square", "size")}
    return Lattice(
        c0=f0,
        c1=f1 - f0 - c2,
        c2=c2,
        blocked=blocked[::2, : 2 * config.num_stations : 2],
        blocked_after=blocked[1::2],
        speed_cap=_speed_cap(scene, stations, config),
        first=jax.tree.map(lambda x: x[0], start),
        first_row=features(scene, start)[0],
        weight=jnp.where(valid, objective.gain / unit * weights[0]["gamma"], 0.0),
        own=own.replace(**scaled),
        unit=unit,
        has_next=jnp.concatenate([valid[1:], jnp.zeros((1,), bool)]),
    )


def _speeds(config: DpConfig) -> jax.Array:
    """Speeds [U] m/s of the tables, from 0 on, half a `speed_step` apart."""
    count = 2 * config.num_speeds + max(abs(k) for k in config.actions)
    return 0.5 * config.speed_step * jnp.arange(count, dtype=jnp.float32)


def _speed_cap(scene: Scene, stations: jax.Array, config: DpConfig) -> jax.Array:
    """[T, N] m/s: the safety filter's rules of speed limit and lateral acceleration."""
    safety = config.safety
    view = path_view(scene, stations)
    recovering = scene.ego.v - safety.speed_recovery * jnp.asarray(TIMES_S)[:, None]
    slow = jnp.maximum(view.speed_limit + safety.speed_slack, recovering)
    bend = jnp.maximum(jnp.abs(view.kappa), 1e-6)
    return jnp.minimum(slow, jnp.sqrt(safety.max_lateral_acceleration / bend))


def _blocked(scene: Scene, config: DpConfig) -> jax.Array:
    """[2 T - 1, 2 N + M] bool: the ego there and then touches a body or passes a wall.

    At the times and halfway between two, where what moves is between its two places, on
    stations of half a step.
    """
    obstacles, ego, safety = scene.obstacles, scene.ego, config.safety
    count = 2 * config.num_stations + config.num_speeds
    s = ego.s + 0.5 * config.station_step * jnp.arange(count)
    l = path_view(scene, s).l
    half_l = 0.5 * ego.width + safety.margin_across
    front = s + 0.5 * ego.length
    times = 0.5 * DT_S * jnp.arange(2 * NUM_TIMES - 1)[:, None]

    def between(x: jax.Array) -> jax.Array:
        middle = jnp.append(0.5 * (x[1:] + x[:-1]), 0.0)
        return jnp.stack([x, middle], axis=-1).reshape(-1)[:-1, None]

    out = jnp.zeros((2 * NUM_TIMES - 1, count), bool)
    for n in range(obstacles.kind.shape[0]):
        low, high = between(obstacles.s_lower[n]), between(obstacles.s_upper[n])
        right, left = between(obstacles.l_lower[n]), between(obstacles.l_upper[n])
        known = between(obstacles.valid[n].astype(jnp.float32)) == 1.0
        kind = obstacles.kind[n]
        body = known & (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
        moves = (jnp.abs(obstacles.speed[n, 0]) > MOVING_MPS) & (kind != Kind.STATIC)
        grown = jnp.where(moves, safety.margin_growth * times, 0.0)
        half_s = 0.5 * ego.length + safety.margin_along + grown
        middle = 0.5 * (low[0, 0] + high[0, 0])
        aside_now = jnp.maximum(right[0, 0] - ego.l, ego.l - left[0, 0])
        from_behind = (middle < ego.s) & (aside_now < 0.5 * ego.width)
        inside = (s + half_s > low) & (s - half_s < high)
        inside = inside & (l + half_l > right) & (l - half_l < left)
        way = low[0, 0] - ego.s - 0.5 * ego.length  # to a line
        slack = jnp.minimum(safety.line_margin, 0.5 * way)
        wall = known & (kind == Kind.STOP) & (way >= 0.0)
        out = out | (body & inside & ~from_behind) | (wall & (front > low - slack))
    return out


class Layers(flax.struct.PyTreeNode, kw_only=True):
    """The network with the normaliser in its first layer, a and j apart."""

    first: jax.Array  # [F, H] rows of acceleration and jerk are 0
    offset: jax.Array  # [H]
    of_a: jax.Array  # [H]
    of_j: jax.Array  # [H]
    lower: jax.Array  # [F]
    upper: jax.Array  # [F]
    bounds_a: jax.Array  # [2]
    bounds_j: jax.Array  # [2]
    kernels: tuple[jax.Array, ...]  # the layers after the first
    biases: tuple[jax.Array, ...]


def make_layers(weights: Weights, features: FeatureMap, first_row: jax.Array) -> Layers:
    """Fold the normaliser into the first layer and take a and j out of it.

    `first_row` [F], the features at t = 0, sets the gates of a gated reward.
    """
    params, norm = weights
    kernels, biases = layers_of(params["point"])
    first = kernels[0] / norm.scale[:, None]
    if "scene_gating" in params:
        start = normalise(norm, first_row)
        first = feature_gates(params["scene_gating"], start)[:, None] * first
    bias = biases[0] if biases else jnp.zeros((1,))
    none, open_bounds = jnp.zeros(first.shape[1]), jnp.array([-jnp.inf, jnp.inf])
    parts = {"acceleration": (none, open_bounds), "jerk": (none, open_bounds)}
    offset = bias - matmul_f32(norm.location, first)
    for name in parts:
        if name in features.names:
            i = features.names.index(name)
            parts[name] = (first[i], jnp.stack([norm.lower[i], norm.upper[i]]))
            first = first.at[i].set(0.0)
    return Layers(
        first=first,
        offset=offset,
        of_a=parts["acceleration"][0],
        of_j=parts["jerk"][0],
        lower=norm.lower,
        upper=norm.upper,
        bounds_a=parts["acceleration"][1],
        bounds_j=parts["jerk"][1],
        kernels=tuple(kernels[1:]),
        biases=tuple(biases[1:]),
    )


def rest_of_network(layers: Layers, x: jax.Array, activation: str) -> jax.Array:
    """R from first-layer pre-activations [..., H]."""
    if not layers.kernels:
        return x[..., 0]
    for kernel, bias in zip(layers.kernels[:-1], layers.biases, strict=True):
        x = matmul_f32(ACTIVATIONS[activation](x), kernel) + bias
    return matmul_f32(ACTIVATIONS[activation](x), layers.kernels[-1])[..., 0]


def base_activation(
    lattice: Lattice, layers: Layers, t: jax.Array, config: DpConfig
) -> jax.Array:
    """Pre-activations [N, U, H] at time t without a and j; u = 2 v / speed_step."""
    v = _speeds(config)[None, :, None]
    c0, c1, c2 = lattice.c0[t], lattice.c1[t], lattice.c2[t]
    x = c0[:, None] + c1[:, None] * v + c2[:, None] * v**2
    x = jnp.clip(x, layers.lower, layers.upper)
    return matmul_f32(x, layers.first) + layers.offset


def motion_activation(layers: Layers, a: jax.Array, j: jax.Array) -> jax.Array:
    """The share [..., H] of acceleration and jerk in the pre-activations."""
    a = jnp.clip(a, layers.bounds_a[0], layers.bounds_a[1])
    j = jnp.clip(j, layers.bounds_j[0], layers.bounds_j[1])
    return a[..., None] * layers.of_a + j[..., None] * layers.of_j


MAX_ACTIVATION = 43.0  # 1, exp of twice it is still a normal float32


class DpPlan(flax.struct.PyTreeNode, kw_only=True):
    """A plan of the lattice, or several with a first axis more."""

    trajectory: Trajectory  # [T]
    value: jax.Array  # [] of the plan, as the recursion added it up
    feasible: jax.Array  # [] bool: nothing forbidden on the way
    n: jax.Array  # [T] int32, stations on the lattice


def _reward(
    rows: jax.Array, layers: Layers, a: jax.Array, before: jax.Array, activation: str
) -> jax.Array:
    """R [...] of pre-activations [..., H] under a after `before`, m/s^2 [...]."""
    motion = motion_activation(layers, a, (a - before) / DT_S)
    return rest_of_network(layers, rows + motion, activation)


def _prepare(base: jax.Array, layers: Layers, activation: str) -> jax.Array:
    """Pre-activations [N, U, H] in the layout of `_edge_rewards`."""
    if _is_rational(layers, activation):
        x = jnp.clip(base, -MAX_ACTIVATION, MAX_ACTIVATION)
        return jnp.exp(2.0 * jnp.transpose(x, (2, 1, 0)))
    return jnp.transpose(base, (1, 0, 2))


def _is_rational(layers: Layers, activation: str) -> bool:
    return activation == "tanh" and len(layers.kernels) == 1


def _edge_rewards(
    table: jax.Array,
    layers: Layers,
    k: int,
    before: jax.Array,
    config: DpConfig,
    activation: str,
) -> jax.Array:
    """R [B, M, N] of acceleration k after `before` [B] m/s^2 at one time.

    This is where the time goes. With one layer of tanh, base x and motion y,

        tanh(x + y) = 1 - 2 / (1 + exp(2x) exp(2y))

    so an edge costs one division per hidden unit and no transcendental. It
    holds through overflow and underflow of the product.

    Args:
      table: [H, U, N] exp(2x), or [U, N, H] x of any other network.
      layers: of `make_layers`.
      k: the action.
      before: accelerations that may come before it.
      config: static.
      activation: static.
    """
    a = jnp.full(before.shape, k * config.step)
    if not _is_rational(layers, activation):
        x = _at_speeds(table, k, config)
        lift = lambda y: y[:, None, None]  # noqa: E731
        return _reward(x[None], layers, lift(a), lift(before), activation)
    motion = motion_activation(layers, a, (a - before) / DT_S)
    motion = jnp.exp(2.0 * jnp.clip(motion, -MAX_ACTIVATION, MAX_ACTIVATION))
    weights = layers.kernels[0][:, 0]
    total = jnp.sum(weights)
    for h in range(weights.shape[0]):
        x = _at_speeds(table[h], k, config)
        total = total - 2.0 * weights[h] / (1.0 + x[None] * motion[:, h, None, None])
    return total


def _at_speeds(table: jax.Array, k: int, config: DpConfig) -> jax.Array:
    """Rows [M, ...] of a table [U, ...] at v = w + a dt / 2, u = 2 m + k.

    Those of negative speeds are not taken; they get the row of 0.
    """
    lowest = min(0, config.actions[0])
    padding = [(-lowest, 0)] + [(0, 0)] * (table.ndim - 1)
    first = k - lowest
    padded = jnp.pad(table, padding, mode="edge")
    return padded[first : first + 2 * config.num_speeds - 1 : 2]


def _own_share(
    lattice: Lattice, t: jax.Array, i: int, before: jax.Array, config: DpConfig
) -> jax.Array:
    """The own cost's share [B, M, N] of action i after `before` [B] m/s^2 at time t."""
    own, k = lattice.own, config.actions[i]
    jerk = own.of_jerk((k * config.step - before) / DT_S)
    of_motion = own.counts[t] * (own.action[i] + jerk)
    return of_motion[:, None, None] + _at_speeds(own.point[t], k, config)


def _keeps_speed(lattice: Lattice, t: jax.Array, k: int, config: DpConfig) -> jax.Array:
    """[M, N] bool: v = w + a dt / 2 at time t is not negative and keeps the cap.

    So does the mean speed w up to there: between two times the speed is at most the
    larger of both.
    """
    w = (jnp.arange(config.num_speeds) * config.speed_step)[:, None]
    v = w + 0.5 * k * config.speed_step
    return (v >= 0.0) & (jnp.maximum(v, w) <= lattice.speed_cap[t][None] + 1e-4)


def _next_values(values: jax.Array, lattice: Lattice, t: jax.Array) -> jax.Array:
    """V_{t+1} [K, M, N] seen from where it is entered: at (m', n + m') for (m', n).

    Shifting row m' by m' is a change of row length: in memory (m', n + m') of
    rows of length L is (m', n) of rows of length L + 1. FORBIDDEN off the lattice,
    where the ego may not be at t + 1, and where it may not be halfway, at 2 n + m'
    half stations.
    """
    actions, speeds, count = values.shape
    entered = jnp.where(lattice.blocked[t + 1], FORBIDDEN, values)
    length = count + speeds
    padding = ((0, 0), (0, 0), (0, speeds))
    entered = jnp.pad(entered, padding, constant_values=FORBIDDEN)
    flat = jnp.pad(entered.reshape(actions, -1), ((0, 0), (0, speeds)))
    free = flat.reshape(actions, speeds, length + 1)[..., :count]
    halfway = 2 * jnp.arange(count) + jnp.arange(speeds)[:, None]
    return jnp.where(lattice.blocked_after[t][halfway], FORBIDDEN, free)


def _shift(x: jax.Array, k: int) -> jax.Array:
    """Row m of the result is row m + k of x [M, N]; FORBIDDEN off the lattice."""
    size = x.shape[0]
    padded = jnp.pad(x, ((max(-k, 0), max(k, 0)), (0, 0)), constant_values=FORBIDDEN)
    start = max(k, 0)
    return padded[start : start + size]


def _before(config: DpConfig, i: int) -> slice:
    """Indices of the accelerations from which action i is within the jerk limit."""
    reach = config.jerk_reach
    return slice(max(i - reach, 0), min(i + reach + 1, len(config.actions)))


def _carried(
    lattice: Lattice,
    table: jax.Array,
    layers: Layers,
    t: jax.Array,
    config: DpConfig,
    activation: str,
) -> jax.Array:
    """The share [K, M, N] of the last counted time: the acceleration is carried on."""

    def of(i: int, k: int) -> jax.Array:
        a = jnp.full((1,), k * config.step)
        reward = _edge_rewards(table, layers, k, a, config, activation)
        total = lattice.weight[t] * reward + _own_share(lattice, t, i, a, config)
        # the limits after the weight, which may be small or negative
        return jnp.where(_keeps_speed(lattice, t, k, config), total[0], FORBIDDEN)

    return jnp.stack([of(i, k) for i, k in enumerate(config.actions)])


def backward(
    lattice: Lattice, layers: Layers, config: DpConfig, activation: str
) -> tuple[jax.Array, jax.Array]:
    """Values at time 2 [K, M, N] and policies [T - 3, K, M, N] (times 2 .. T - 2).

    Cost: T N M (K pairs within the jerk limit) edges with H divisions each; at
    step 1 m/s^2 that is 1.2e8 edges.
    """
    accelerations = jnp.asarray(config.actions, jnp.float32) * config.step

    def prepared(t: jax.Array) -> jax.Array:
        base = base_activation(lattice, layers, t, config)
        return _prepare(base, layers, activation)

    def stage(values: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array]:
        table = prepared(t)
        ahead = _next_values(values, lattice, t)
        best = jnp.full(values.shape, FORBIDDEN)
        choice = jnp.zeros(values.shape, jnp.int8)
        for i, k in enumerate(config.actions):
            span = _before(config, i)
            reward = _edge_rewards(
                table, layers, k, accelerations[span], config, activation
            )
            keeps = _keeps_speed(lattice, t, k, config)
            free = jnp.where(keeps, _shift(ahead[i], k), FORBIDDEN)
            now = lattice.weight[t] * reward + _own_share(
                lattice, t, i, accelerations[span], config
            )
            q = jnp.where(lattice.has_next[t], now, 0.0) + free
            choice = choice.at[span].set(
                jnp.where(q > best[span], jnp.int8(i), choice[span])
            )
            best = best.at[span].max(q)
        ends = lattice.has_next[t - 1] & ~lattice.has_next[t]
        carried = _carried(lattice, table, layers, t, config, activation)
        best = best + jnp.where(ends, carried, 0.0)
        return jnp.maximum(best, FORBIDDEN), choice

    last = jnp.asarray(NUM_TIMES - 1)
    terminal = _carried(lattice, prepared(last), layers, last, config, activation)
    times = jnp.arange(2, NUM_TIMES - 1)
    return jax.lax.scan(stage, terminal, times, reverse=True)


def _first_step(
    lattice: Lattice,
    layers: Layers,
    values: jax.Array,
    config: DpConfig,
    activation: str,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Value, mean speed m_1 and action index of the best beginnings, all [P].

    At time 1 the acceleration before is the ego's own, a_0, which lies off the
    lattice; the jerk of time 0 is that of time 1. Station and mean speed are the
    same number there, n_1 = m_1.
    """
    a0, v0 = lattice.first.a, lattice.first.v
    base = base_activation(lattice, layers, jnp.asarray(1), config)
    m = jnp.arange(config.num_speeds)
    off = jnp.abs(m * config.speed_step - (v0 + 0.5 * a0 * DT_S))
    near = (off <= config.first_reach) | (m == jnp.argmin(off))
    free = near & ~lattice.blocked[1, m] & ~lattice.blocked_after[0, m]
    clipped = jnp.clip(lattice.first_row, layers.lower, layers.upper)
    start = matmul_f32(clipped, layers.first) + layers.offset
    ahead = _next_values(values, lattice, jnp.asarray(1))
    scores = []
    for i, k in enumerate(config.actions):
        a = jnp.asarray(k * config.step)
        rows = base[m, jnp.maximum(2 * m + k, 0)]
        j = (a - a0) / DT_S
        of_start = rest_of_network(
            layers, start + motion_activation(layers, a0, j), activation
        )
        now = lattice.weight[1] * _reward(rows, layers, a, a0, activation)
        own = _own_share(lattice, jnp.asarray(1), i, a0[None], config)[0, m, m]
        own = own + lattice.own.counts[0] * lattice.own.of_jerk(j)
        begins = lattice.weight[0] * of_start + now + own
        q = begins + _shift(ahead[i], k)[m, m]
        steady = jnp.abs(j) <= jnp.maximum(config.max_jerk, config.step / DT_S)
        keeps = _keeps_speed(lattice, jnp.asarray(1), k, config)[m, m]
        scores.append(jnp.where(free & keeps & steady, q, FORBIDDEN))
    table = jnp.stack(scores, axis=-1)  # [M, K]
    values, best = jax.lax.top_k(table.reshape(-1), config.proposals)
    return values, best // table.shape[1], best % table.shape[1]


def solve(
    lattice: Lattice, layers: Layers, config: DpConfig, activation: str
) -> tuple[jax.Array, jax.Array]:
    """(values [P], n [P, T]): the best stations of each of the best beginnings."""
    values, policies = backward(lattice, layers, config, activation)
    value, m1, first = _first_step(lattice, layers, values, config, activation)
    actions = jnp.asarray(config.actions)
    # the state at time 2 follows from the choice made at time 1
    m2 = jnp.clip(m1 + actions[first], 0, config.num_speeds - 1)
    n2 = jnp.clip(m1 + m2, 0, config.num_stations - 1)

    def read(state: tuple, policy: jax.Array) -> tuple[tuple, jax.Array]:
        n, m, i = state
        chosen = policy[i, m, n].astype(jnp.int32)
        m_next = jnp.clip(m + actions[chosen], 0, config.num_speeds - 1)
        n_next = jnp.clip(n + m_next, 0, config.num_stations - 1)
        return (n_next, m_next, chosen), n_next

    _, rest = jax.lax.scan(read, (n2, m2, first), policies)
    head = jnp.stack([jnp.zeros_like(m1), m1, n2])
    return value, jnp.concatenate([head, rest]).T


def search(
    scene: Scene,
    weights: Weights,
    features: FeatureMap,
    activation: str,
    config: DpConfig,
    objective: Objective = V_ALONE,
) -> DpPlan:
    """The plans of the highest sum on the lattice, one for each of P beginnings.

    Args:
      scene: one scene; its path is the one driven (mode "speed").
      weights: effective parameters and normaliser.
      features: static.
      activation: static, key of ACTIVATIONS.
      config: static.
      objective: the own cost and the gain of V.

    Returns:
      Plans with leaves [P], the best first; where `feasible` is False every plan of
      that beginning breaks a limit, and its trajectory is meaningless.
    """
    with jax.named_scope("dp"):
        lattice = make_lattice(scene, weights, features, config, objective)
        layers = make_layers(weights, features, lattice.first_row)
        value, n = solve(lattice, layers, config, activation)
        s = scene.ego.s + n * config.station_step
        return DpPlan(
            trajectory=jax.vmap(trajectory_on_path, (None, 0))(scene, s),
            value=lattice.unit * value,
            feasible=value > FEASIBLE,
            n=n,
        )


SMOOTHNESS = 0.02  # s^6, weight of jerk squared against metres squared


def _smoother() -> tuple[np.ndarray, np.ndarray]:
    """Matrices [T, T] of stations and [T, 2] of what is given, of `smoothed`.

    The x of least |x - s|^2 + c |D (g, x)|^2, with the two given stations g before them
    and D the third differences over dt^3, solves linear equations.
    """
    times = NUM_TIMES + 1
    jerk = np.diff(np.eye(times), 3, axis=0) / DT_S**3
    given, free = jerk[:, :2], jerk[:, 2:]
    equations = np.eye(NUM_TIMES - 1) + SMOOTHNESS * free.T @ free
    inverse = np.linalg.inv(equations)
    return inverse, -SMOOTHNESS * inverse @ free.T @ given


_OF_STATIONS, _OF_GIVEN = _smoother()


def smoothed(scene: Scene, s: jax.Array) -> jax.Array:
    """Stations [..., T] m near `s` with less jerk, from the ego's own v and a on.

        min_x  |x - s|^2 + c sum_i jerk_i(x)^2

    with x_0 = s_0 and x_{-1} = x_0 - v_0 dt + a_0 dt^2 / 2, and never backwards.
    """
    ego = scene.ego
    before = ego.s - ego.v * DT_S + 0.5 * ego.a * DT_S**2
    given = jnp.asarray(_OF_GIVEN, jnp.float32) @ jnp.stack([before, ego.s])
    smooth = s[..., 1:] @ jnp.asarray(_OF_STATIONS, jnp.float32).T + given
    return running_max(jnp.concatenate([s[..., :1], smooth], axis=-1))


def along(scene: Scene, trajectory: Trajectory) -> Scene:
    """The same scene whose given path is that of a trajectory [T]."""
    stations = STATION_STEP_M * jnp.arange(scene.path.l.shape[0])
    l = jnp.interp(stations, running_max(trajectory.s), trajectory.l)
    return scene.replace(path=scene.path.replace(l=l))


def _on(scene: Scene, on_path: Scene, s: jax.Array, steers: bool) -> Trajectory:
    """The trajectory through stations [T] on the path of `on_path`."""
    if not steers:
        return trajectory_on_path(scene, s)
    l = path_view(on_path, s).l.at[0].set(scene.ego.l)
    return trajectory_from_positions(scene, s, l)


@functools.lru_cache(maxsize=16)
def dp_policy(
    features: FeatureMap,
    activation: str,
    rank: RankConfig,
    config: DpConfig,
    own: str = "constant V",
) -> Policy:
    """The planner by a `Ranking` to whose sampled candidates search adds its plans.

    Its parameters are the ranking and `alone`: of the sampled candidates only emergency
    stops may then be driven.

    Plans of the lattice and their smoothed twins are candidates like others: they pass
    the same safety filter, and the one of the highest score is driven. Where paths are
    planned, speed is searched along the path of the best sampled candidate, path first
    and speed second as in Apollo's EM planner.

    Args:
      features: static.
      activation: key of ACTIVATIONS.
      rank: sampler and filter.
      config: lattice.
      own: the prior cost of the rankings that will drive, of TIME_SUMS.

    Raises:
      InputError: the own cost is no sum over times.
    """
    if own not in TIME_SUMS:
        raise InputError(
            f"dp: {own}: expected {', '.join(TIME_SUMS)}: other own costs are no sums "
            "over times, which alone can be searched"
        )
    score = ranking_score(features, activation, rank.own)

    def replan(
        searching: tuple[Ranking, jax.Array],
        scene: Scene,
        key: jax.Array,
        in_force: PreviousPlan | None,
    ) -> Plan:
        params, alone = searching
        sampled = sample(key, scene, rank.sampler)
        values = score(params, scene, sampled)
        admissible = check(scene, sampled, rank.safety).admissible
        best = jnp.argmax(jnp.where(admissible, values, -jnp.inf))
        reference = jax.tree.map(lambda x: x[best], sampled.trajectory)
        on_path = along(scene, reference) if rank.steers else scene
        objective = Objective(
            gain=gain_in(params, features(scene, reference)[0]),
            reference=reference,
            own=own,
        )
        weights = (params.reward, params.normaliser)
        plans = search(on_path, weights, features, activation, config, objective)
        stations = plans.trajectory.s
        s = jnp.concatenate([stations, smoothed(scene, stations)])
        found = jax.vmap(lambda s: _on(scene, on_path, s, rank.steers))(s)
        may = jax.vmap(lambda x: within_limits(scene, x, rank.sampler))(found)
        may = may & jnp.tile(plans.feasible, 2)
        family = jnp.full(may.shape, family_index("cruise"))
        proposed = Candidates(trajectory=found, feasible=may, family=family)
        stops = ~alone | (sampled.family == family_index("emergency"))
        sampled = sampled.replace(feasible=sampled.feasible & stops)
        added = with_plan_in_force(proposed, in_force)
        candidates = jax.tree.map(lambda *x: jnp.concatenate(x), sampled, added)
        scores = jnp.concatenate([values, score(params, scene, added)])
        return best_plan(scene, candidates, scores, rank, in_force)

    return committed(replan, rank.sampler, rank.safety, rank.commitment)


MIN_SPREAD = 1e-6  # V, difference below which g is not defined
FINE = DpConfig(step=1.0)  # double the resolution of the planner's default


def emergency_stop(scene: Scene) -> Trajectory:
    """The hardest braking that the sampler offers, on the scene's path."""
    return trajectory_on_path(scene, emergency(scene, SamplerConfig())[-1])


def optimality_gap(
    scene: Scene,
    trajectory: Trajectory,
    weights: Weights,
    features: FeatureMap,
    activation: str,
    lattice: DpConfig = FINE,
) -> dict[str, jax.Array]:
    """Returns how much less the plan `trajectory` is worth than the scene's best plan.

    Args:
      scene: one scene.
      trajectory: the plan to judge, on the scene's path.
      weights: effective parameters and normaliser.
      features: static.
      activation: static, key of ACTIVATIONS.
      lattice: static, of the finer solver.

    Returns:
      Scalars: `admissible`, whether the plan passes the safety filter; `gap` G >= 0,
      NaN where it does not; `normalised` g, NaN too where braking is as good.
    """
    lattice = dataclasses.replace(lattice, proposals=1)
    found = search(scene, weights, features, activation, lattice)
    plan = jax.tree.map(lambda x: x[0], found)
    # a lattice without a plan gives a trajectory that means nothing
    finer = jax.tree.map(
        lambda a, b: jnp.where(plan.feasible, a, b), plan.trajectory, trajectory
    )
    stop = emergency_stop(scene)
    many = as_candidates(jax.tree.map(lambda *x: jnp.stack(x), trajectory, finer, stop))
    values = learned_score(features, activation)(weights, scene, many)
    admissible = check(scene, many, SafetyConfig()).admissible
    best = jnp.max(jnp.where(admissible, values, -jnp.inf))
    gap = jnp.where(admissible[0], best - values[0], jnp.nan)
    spread = best - values[2]
    wide = spread > MIN_SPREAD
    normalised = jnp.where(wide, gap / jnp.where(wide, spread, 1.0), jnp.nan)
    return {"admissible": admissible[0], "gap": gap, "normalised": normalised}
