"""Dynamic programming on the ST graph with state (s, v, a), which is exact.

    V_i(n, m, k-) = max_k  gamma_i R(f_i(n, m, k, k-)) + V_{i+1}(n + m + k, m + k, k)

over accelerations k with m + k >= 0, |k - k-| within the jerk limit, free of
bodies and walls at the next station and within the speed rule (`grid`). Apollo's
speed DP keeps (t, s) only and reads v and a off its single best predecessor, so
it is not optimal for its own cost.

One backward `lax.scan` over time makes an int8 policy, one forward scan reads
the plan off it; the plan's Trajectory goes through the operator shared with all
candidates, and its value is the network's own.
"""

import functools

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.commitment import InForce, committed
from rcirl_jax.planner.grid import (
    FEASIBLE,
    FORBIDDEN,
    DpConfig,
    Lattice,
    Layers,
    Weights,
    base_activation,
    make_lattice,
    make_layers,
    motion_activation,
    rest_of_network,
)
from rcirl_jax.planner.plan import Plan
from rcirl_jax.planner.rank import (
    Policy,
    RankConfig,
    best_plan,
    learned_score,
    with_plan_in_force,
)
from rcirl_jax.reward.network import matmul_f32
from rcirl_jax.sampling import sample
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.sampling.sampler import family_index
from rcirl_jax.types import Candidates, Scene, Trajectory
from rcirl_jax.units import DT_S, NUM_TIMES

MAX_ACTIVATION = 43.0  # 1, exp of twice it is still a normal float32


class DpPlan(flax.struct.PyTreeNode, kw_only=True):
    """The best plan of the lattice."""

    trajectory: Trajectory  # [T]
    value: jax.Array  # [] V of the plan, as the recursion added it up
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
    speeds = config.num_speeds
    lowest = min(0, config.actions[0])  # u < 0: rows of negative speeds, not taken
    rows = slice(k - lowest, k - lowest + 2 * speeds - 1, 2)
    pad = ((-lowest, 0), (0, 0))
    a = jnp.full(before.shape, k * config.step)
    if not _is_rational(layers, activation):
        x = jnp.pad(table, (*pad, (0, 0)), mode="edge")[rows]
        lift = lambda y: y[:, None, None]  # noqa: E731
        return _reward(x[None], layers, lift(a), lift(before), activation)
    motion = motion_activation(layers, a, (a - before) / DT_S)
    motion = jnp.exp(2.0 * jnp.clip(motion, -MAX_ACTIVATION, MAX_ACTIVATION))
    weights = layers.kernels[0][:, 0]
    total = jnp.sum(weights)
    for h in range(weights.shape[0]):
        x = jnp.pad(table[h], pad, mode="edge")[rows]
        total = total - 2.0 * weights[h] / (1.0 + x[None] * motion[:, h, None, None])
    return total


def _keeps_speed(lattice: Lattice, t: jax.Array, k: int, config: DpConfig) -> jax.Array:
    """[M, N] bool: v = w + a dt / 2 at time t is not negative and keeps the cap."""
    v = ((jnp.arange(config.num_speeds) + 0.5 * k) * config.speed_step)[:, None]
    return (v >= 0.0) & (v <= lattice.speed_cap[t][None] + 1e-4)


def _next_values(values: jax.Array, blocked: jax.Array) -> jax.Array:
    """V_{i+1} [K, M, N] seen from where it is entered: at (m', n + m') for (m', n).

    Shifting row m' by m' is a change of row length: in memory (m', n + m') of
    rows of length L is (m', n) of rows of length L + 1. FORBIDDEN off the lattice
    and where `blocked` [N].
    """
    actions, speeds, count = values.shape
    entered = jnp.where(blocked, FORBIDDEN, values)
    length = count + speeds
    padding = ((0, 0), (0, 0), (0, speeds))
    entered = jnp.pad(entered, padding, constant_values=FORBIDDEN)
    flat = jnp.pad(entered.reshape(actions, -1), ((0, 0), (0, speeds)))
    return flat.reshape(actions, speeds, length + 1)[..., :count]


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
    """Gamma R [K, M, N] of the last counted time: the acceleration is carried over."""

    def of(k: int) -> jax.Array:
        a = jnp.full((1,), k * config.step)
        reward = _edge_rewards(table, layers, k, a, config, activation)[0]
        # the limits after the weight, which may be small or negative
        keeps = _keeps_speed(lattice, t, k, config)
        return jnp.where(keeps, lattice.weight[t] * reward, FORBIDDEN)

    return jnp.stack([of(k) for k in config.actions])


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
        ahead = _next_values(values, lattice.blocked[t + 1])
        weight = jnp.where(lattice.has_next[t], lattice.weight[t], 0.0)
        best = jnp.full(values.shape, FORBIDDEN)
        choice = jnp.zeros(values.shape, jnp.int8)
        for i, k in enumerate(config.actions):
            span = _before(config, i)
            reward = _edge_rewards(
                table, layers, k, accelerations[span], config, activation
            )
            keeps = _keeps_speed(lattice, t, k, config)
            free = jnp.where(keeps, _shift(ahead[i], k), FORBIDDEN)
            q = weight * reward + free
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
    """Value, mean speed m_1 and action index of the best beginning.

    At time 1 the acceleration before is the ego's own, a_0, which lies off the
    lattice; the jerk of time 0 is that of time 1. Station and mean speed are the
    same number there, n_1 = m_1.
    """
    a0, v0 = lattice.first.a, lattice.first.v
    base = base_activation(lattice, layers, jnp.asarray(1), config)
    m = jnp.arange(config.num_speeds)
    off = jnp.abs(m * config.speed_step - (v0 + 0.5 * a0 * DT_S))
    near = (off <= config.first_reach) | (m == jnp.argmin(off))
    free = near & ~lattice.blocked[1, m]
    clipped = jnp.clip(lattice.first_row, layers.lower, layers.upper)
    start = matmul_f32(clipped, layers.first) + layers.offset
    ahead = _next_values(values, lattice.blocked[2])
    scores = []
    for i, k in enumerate(config.actions):
        a = jnp.asarray(k * config.step)
        rows = base[m, jnp.maximum(2 * m + k, 0)]
        j = (a - a0) / DT_S
        of_start = rest_of_network(
            layers, start + motion_activation(layers, a0, j), activation
        )
        now = lattice.weight[1] * _reward(rows, layers, a, a0, activation)
        q = lattice.weight[0] * of_start + now + _shift(ahead[i], k)[m, m]
        steady = jnp.abs(j) <= jnp.maximum(config.max_jerk, config.step / DT_S)
        keeps = _keeps_speed(lattice, jnp.asarray(1), k, config)[m, m]
        scores.append(jnp.where(free & keeps & steady, q, FORBIDDEN))
    table = jnp.stack(scores, axis=-1)  # [M, K]
    best = jnp.argmax(table)
    return table.reshape(-1)[best], best // table.shape[1], best % table.shape[1]


def solve(
    lattice: Lattice, layers: Layers, config: DpConfig, activation: str
) -> tuple[jax.Array, jax.Array]:
    """(value, n [T]): the best sequence of lattice stations."""
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
    return value, jnp.concatenate([head, rest])


def plan_dp(
    scene: Scene,
    weights: Weights,
    features: FeatureMap,
    activation: str,
    config: DpConfig,
) -> DpPlan:
    """The plan of highest learned value on the lattice.

    Args:
      scene: one scene; its path is the one driven (mode "speed").
      weights: effective parameters and normaliser.
      features: static.
      activation: static, key of ACTIVATIONS.
      config: static.

    Returns:
      The plan; `feasible` is False if every plan breaks a limit; its trajectory is then
      meaningless.
    """
    with jax.named_scope("dp"):
        lattice = make_lattice(scene, weights, features, config)
        layers = make_layers(weights, features, lattice.first_row)
        value, n = solve(lattice, layers, config, activation)
        s = scene.ego.s + n * config.station_step
        return DpPlan(
            trajectory=trajectory_on_path(scene, s),
            value=value,
            feasible=value > FEASIBLE,
            n=n,
        )


@functools.lru_cache(maxsize=16)
def dp_policy(
    features: FeatureMap, activation: str, rank: RankConfig, config: DpConfig
) -> Policy:
    """The planner that adds the lattice's best plan to the sampled candidates.

    The plan is one more candidate: it passes the same safety filter and is
    driven if its value is the highest of all that pass.
    """
    score = learned_score(features, activation)

    def anew(
        params: Weights, scene: Scene, key: jax.Array, in_force: InForce | None
    ) -> Plan:
        sampled = sample(key, scene, rank.sampler)
        plan = plan_dp(scene, params, features, activation, config)
        join = lambda many, one: jnp.concatenate([many, one[None]])  # noqa: E731
        candidates = Candidates(
            trajectory=jax.tree.map(join, sampled.trajectory, plan.trajectory),
            feasible=join(sampled.feasible, plan.feasible),
            family=join(sampled.family, jnp.asarray(family_index("cruise"))),
        )
        candidates = with_plan_in_force(candidates, in_force)
        scores = score(params, scene, candidates)
        return best_plan(scene, candidates, scores, rank, in_force)

    return committed(anew, rank.sampler, rank.safety, rank.commitment)
