"""The station-time grid on which the additive learned reward is exact.

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
"""

import dataclasses
import math

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.errors import InputError
from rcirl_jax.features import FeatureMap
from rcirl_jax.features.path import path_view
from rcirl_jax.planner.safety import SafetyConfig
from rcirl_jax.reward import normalise
from rcirl_jax.reward.network import (
    ACTIVATIONS,
    feature_gates,
    layers_of,
    matmul_f32,
)
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.types import (
    Candidates,
    Kind,
    Normaliser,
    RewardParams,
    Scene,
    Trajectory,
)
from rcirl_jax.units import DT_S, NUM_TIMES, TIMES_S

FORBIDDEN = -1e6  # value of a state that no plan may take; finite: no NaN
FEASIBLE = -1e5  # values above it belong to plans that break nothing

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


class Lattice(flax.struct.PyTreeNode, kw_only=True):
    """What the recursion reads, made once per scene."""

    c0: jax.Array  # [T, N, F] features at v = 0 (a = j = 0)
    c1: jax.Array  # [T, N, F] their slope by v
    c2: jax.Array  # [T, N, F] and half second derivative
    blocked: jax.Array  # [T, N] bool: a body or a wall is there
    speed_cap: jax.Array  # [T, N] m/s
    first: Trajectory  # leaves []: the ego at t = 0, without its jerk
    first_row: jax.Array  # [F] features at t = 0 with jerk 0
    weight: jax.Array  # [T] gamma where valid, else 0
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
    grid = Candidates(
        trajectory=trajectory,
        feasible=jnp.ones((count,), bool),
        family=jnp.zeros((count,), jnp.int32),
    )
    return jnp.stack(features.rows(scene, grid), axis=-1)


def make_lattice(
    scene: Scene, weights: Weights, features: FeatureMap, config: DpConfig
) -> Lattice:
    """Evaluate F on the lattice and mark what is forbidden."""
    stations = scene.ego.s + jnp.arange(config.num_stations) * config.station_step
    f0, f1, f2 = (_grid_rows(features, scene, stations, v) for v in (0.0, 1.0, 2.0))
    c2 = 0.5 * (f2 - 2.0 * f1 + f0)
    ego = trajectory_on_path(scene, jnp.full((NUM_TIMES,), scene.ego.s))
    start = ego.replace(
        v=ego.v.at[0].set(scene.ego.v), a=ego.a.at[0].set(scene.ego.a), j=ego.j * 0.0
    )
    valid = scene.time_valid
    index = features.names.index
    limit = f0[0, :, index("speed_limit")] if "speed_limit" in features.names else None
    return Lattice(
        c0=f0,
        c1=f1 - f0 - c2,
        c2=c2,
        blocked=_blocked(scene, stations, config),
        speed_cap=_speed_cap(scene, limit, config),
        first=jax.tree.map(lambda x: x[0], start),
        first_row=features(scene, start)[0],
        weight=jnp.where(valid, weights[0]["gamma"], 0.0),
        has_next=jnp.concatenate([valid[1:], jnp.zeros((1,), bool)]),
    )


def _speed_cap(scene: Scene, limit: jax.Array | None, config: DpConfig) -> jax.Array:
    """[T, N] m/s: the safety filter's speed rule."""
    times = jnp.asarray(TIMES_S)[:, None]
    recovering = scene.ego.v - config.safety.speed_recovery * times
    if limit is None:
        return jnp.full((NUM_TIMES, config.num_stations), config.max_speed)
    return jnp.maximum(limit[None] + config.safety.speed_slack, recovering)


def _blocked(scene: Scene, stations: jax.Array, config: DpConfig) -> jax.Array:
    """[T, N] bool: the ego there and then would touch a body or pass a wall."""
    obstacles, ego = scene.obstacles, scene.ego
    path_l = path_view(scene, stations).l
    half_l = 0.5 * ego.width + config.safety.margin_across
    half_s = 0.5 * ego.length + config.safety.margin_along
    s, l = stations[None], path_l[None]
    front = s + 0.5 * ego.length
    out = jnp.zeros((NUM_TIMES, stations.shape[0]), bool)
    for n in range(obstacles.kind.shape[0]):
        low, high = obstacles.s_lower[n][:, None], obstacles.s_upper[n][:, None]
        right, left = obstacles.l_lower[n][:, None], obstacles.l_upper[n][:, None]
        kind, known = obstacles.kind[n], obstacles.valid[n][:, None]
        body = known & (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
        middle = 0.5 * (low[0, 0] + high[0, 0])
        aside_now = jnp.maximum(right[0, 0] - ego.l, ego.l - left[0, 0])
        from_behind = (middle < ego.s) & (aside_now < 0.5 * ego.width)
        inside = (s + half_s > low) & (s - half_s < high)
        inside = inside & (l + half_l > right) & (l - half_l < left)
        before = ego.s + 0.5 * ego.length <= low[0, 0]
        wall = known & (kind == Kind.STOP) & before
        out = out | (body & inside & ~from_behind) | (wall & (front > low))
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
    u = jnp.arange(2 * config.num_speeds + max(abs(k) for k in config.actions))
    v = 0.5 * config.speed_step * u.astype(jnp.float32)
    c0, c1, c2 = lattice.c0[t], lattice.c1[t], lattice.c2[t]
    v = v[None, :, None]
    x = c0[:, None] + c1[:, None] * v + c2[:, None] * v**2
    x = jnp.clip(x, layers.lower, layers.upper)
    return matmul_f32(x, layers.first) + layers.offset


def motion_activation(layers: Layers, a: jax.Array, j: jax.Array) -> jax.Array:
    """The share [..., H] of acceleration and jerk in the pre-activations."""
    a = jnp.clip(a, layers.bounds_a[0], layers.bounds_a[1])
    j = jnp.clip(j, layers.bounds_j[0], layers.bounds_j[1])
    return a[..., None] * layers.of_a + j[..., None] * layers.of_j
