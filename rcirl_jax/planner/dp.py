"""Dynamic programming on the ST graph with state (s, v, a): Bellman holds.

    V_i(n, m, k-) = max_k  gamma_i R(f_i(n, m, k, k-)) + V_{i+1}(n + m + k, m + k, k)

over accelerations k with m + k >= 0, |k - k-| within the jerk limit, free of
bodies and walls at the next station and within the speed rule (`grid`). Apollo's
speed DP keeps (t, s) only and reads v and a off its single best predecessor, so
it is not optimal for its own cost (`time_station` measures by how much).

One backward `lax.scan` over time makes an int8 policy, one forward scan reads
the plan off it; the plan's Trajectory goes through the operator shared with all
candidates, and its value is the network's own.
"""

import functools

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.features import FeatureMap
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
from rcirl_jax.planner.rank import Policy, RankConfig, command, learned_score
from rcirl_jax.planner.safety import check, choose
from rcirl_jax.sampling import sample
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.sampling.speed import family_index
from rcirl_jax.types import Candidates, Scene, Trajectory
from rcirl_jax.units import DT_S, NUM_TIMES


class DpPlan(flax.struct.PyTreeNode, kw_only=True):
    """The best plan of the lattice."""

    trajectory: Trajectory  # [T]
    value: jax.Array  # [] V of the plan, as the recursion added it up
    feasible: jax.Array  # [] bool: nothing forbidden on the way
    n: jax.Array  # [T] int32, stations on the lattice


def _rewards(
    base: jax.Array,
    layers: Layers,
    k: int,
    before: jax.Array,
    config: DpConfig,
    activation: str,
) -> jax.Array:
    """R [N, M] of acceleration k after `before` (m/s^2, []) at one time."""
    a = jnp.asarray(k * config.step)
    u = 2 * jnp.arange(config.num_speeds) + k  # 2 v / speed_step
    rows = jnp.take(base, jnp.clip(u, 0, base.shape[1] - 1), axis=1)
    motion = motion_activation(layers, a, (a - before) / DT_S)
    return rest_of_network(layers, rows + motion, activation)


def _keeps_speed(lattice: Lattice, t: jax.Array, k: int, config: DpConfig) -> jax.Array:
    """[N, M] bool: v = w + a dt / 2 at time t is not negative and keeps the cap."""
    v = (jnp.arange(config.num_speeds) + 0.5 * k) * config.speed_step
    return (v[None] >= 0.0) & (v[None] <= lattice.speed_cap[t][:, None] + 1e-4)


def _next_values(values: jax.Array, blocked: jax.Array, k: int) -> jax.Array:
    """V_{i+1} [N, M] seen from (n, m) under action k; FORBIDDEN off the lattice.

    Args:
      values: [N, M, K] of the next time, at the action index of k already [N, M].
      blocked: [N] bool: that station may not be entered.
      k: the action.
    """
    count, speeds = values.shape
    entered = jnp.where(blocked[:, None], FORBIDDEN, values)
    n = jnp.arange(count)[:, None]
    m = jnp.arange(speeds)[None] + k
    inside = (m >= 0) & (m < speeds) & (n + m < count)
    row = jnp.clip(n + m, 0, count - 1)
    column = jnp.clip(m, 0, speeds - 1)
    return jnp.where(inside, entered[row, column], FORBIDDEN)


def backward(
    lattice: Lattice, layers: Layers, config: DpConfig, activation: str
) -> tuple[jax.Array, jax.Array]:
    """Values at time 2 [N, M, K] and policies [T - 3, N, M, K] (times 2 .. T - 2)."""
    actions = config.actions
    last = NUM_TIMES - 1
    accelerations = jnp.asarray(actions, jnp.float32) * config.step

    def stage_rewards(t: jax.Array) -> jax.Array:
        """Q rewards [K(next), N, M, K(before)] of time t, gamma included."""
        base = base_activation(lattice, layers, t, config)
        of = lambda k, a: _rewards(base, layers, k, a, config, activation)  # noqa: E731
        rows = [
            jnp.stack([of(k, accelerations[i]) for i in range(len(actions))], axis=-1)
            for k in actions
        ]
        # at the last valid time the acceleration is carried over
        kept = [_keeps_speed(lattice, t, k, config) for k in actions]
        carried = jnp.stack(
            [jnp.where(kept[i], rows[i][..., i], FORBIDDEN) for i in range(len(kept))],
            axis=-1,
        )
        moved = jnp.stack(rows)
        found = jnp.where(lattice.has_next[t], moved, carried[None])
        return lattice.weight[t] * found

    def stage(values: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array]:
        rewards = stage_rewards(t)
        best = jnp.full(values.shape, 2.0 * FORBIDDEN)
        choice = jnp.zeros(values.shape, jnp.int8)
        for i, k in enumerate(actions):
            ahead = _next_values(values[..., i], lattice.blocked[t + 1], k)
            keeps = _keeps_speed(lattice, t, k, config)
            ahead = jnp.where(keeps, ahead, FORBIDDEN)
            q = rewards[i] + ahead[..., None]
            steady = jnp.abs(jnp.asarray(actions) - k) <= config.jerk_reach
            q = jnp.where(steady, q, FORBIDDEN)
            choice = jnp.where(q > best, jnp.int8(i), choice)
            best = jnp.maximum(q, best)
        return jnp.maximum(best, FORBIDDEN), choice

    base = base_activation(lattice, layers, jnp.asarray(last), config)
    ends = [
        _rewards(base, layers, k, accelerations[i], config, activation)
        for i, k in enumerate(actions)
    ]
    at_end = jnp.asarray(last)
    keeps = [_keeps_speed(lattice, at_end, k, config) for k in actions]
    terminal = lattice.weight[last] * jnp.stack(ends, axis=-1)
    terminal = jnp.where(jnp.stack(keeps, axis=-1), terminal, FORBIDDEN)
    times = jnp.arange(2, last)
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
    lattice; the jerk of time 0 is that of time 1.
    """
    a0, v0 = lattice.first.a, lattice.first.v
    base = base_activation(lattice, layers, jnp.asarray(1), config)
    m = jnp.arange(config.num_speeds)
    free = ~lattice.blocked[1, m]
    expected = v0 + 0.5 * a0 * DT_S
    near = jnp.abs(m * config.speed_step - expected) <= config.first_reach
    near = near | (m == jnp.argmin(jnp.abs(m * config.speed_step - expected)))
    norm_row = jnp.clip(lattice.first_row, layers.lower, layers.upper)
    start = norm_row @ layers.first + layers.offset
    scores = []
    for i, k in enumerate(config.actions):
        rewards = _rewards(base, layers, k, a0, config, activation)[m, m]
        ahead = _next_values(values[..., i], lattice.blocked[2], k)[m, m]
        keeps = _keeps_speed(lattice, jnp.asarray(1), k, config)[m, m]
        j = (k * config.step - a0) / DT_S
        r0 = rest_of_network(
            layers, start + motion_activation(layers, a0, j), activation
        )
        q = lattice.weight[0] * r0 + lattice.weight[1] * rewards + ahead
        steady = jnp.abs(j) <= jnp.maximum(config.max_jerk, config.step / DT_S)
        scores.append(jnp.where(near & free & keeps & steady, q, FORBIDDEN))
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
        chosen = policy[n, m, i].astype(jnp.int32)
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
      The plan; `feasible` is False where every plan breaks something, and the
      trajectory then means nothing.
    """
    with jax.named_scope("dp"):
        lattice = make_lattice(scene, weights, features, config)
        layers = make_layers(weights, features)
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
    emergency = family_index("emergency")

    def policy(params: Weights, scene: Scene, key: jax.Array) -> Plan:
        sampled = sample(key, scene, rank.sampler)
        plan = plan_dp(scene, params, features, activation, config)
        join = lambda many, one: jnp.concatenate([many, one[None]])  # noqa: E731
        candidates = Candidates(
            trajectory=jax.tree.map(join, sampled.trajectory, plan.trajectory),
            feasible=join(sampled.feasible, plan.feasible),
            family=join(sampled.family, jnp.asarray(family_index("cruise"))),
        )
        verdict = check(scene, candidates, rank.safety)
        scores = score(params, scene, candidates)
        index, fallback = choose(verdict, candidates, scores)
        chosen = jax.tree.map(lambda x: x[index], candidates.trajectory)
        hard = fallback | (candidates.family[index] == emergency)
        return Plan(
            acceleration=command(chosen, hard, rank.period),
            s=chosen.s,
            fallback=fallback,
            admissible=jnp.sum(verdict.admissible, dtype=jnp.int32),
        )

    return policy
