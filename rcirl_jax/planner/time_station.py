"""Apollo's kind of speed DP: state (t, s) only, and what it loses.

At every (t, s) it keeps the one best predecessor and reads speed, acceleration
and jerk off that history. The cost of an edge then depends on how the node was
reached, Bellman's principle does not hold, and the result need not be optimal
for its own cost (Apollo r3.0, dp_st_speed). The recursion here runs on the
same lattice, reward and limits as `dp`, so the difference of the two values is
the price of the smaller state and of nothing else.
"""

import jax
import jax.numpy as jnp

from rcirl_jax.features import FeatureMap
from rcirl_jax.planner.dp import DpPlan
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
from rcirl_jax.planner.plan import Plan, plan_of
from rcirl_jax.planner.rank import Policy
from rcirl_jax.reward.module import product
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.types import Scene
from rcirl_jax.units import DT_S, NUM_TIMES


def _node_reward(
    lattice: Lattice,
    layers: Layers,
    t: jax.Array,
    state: tuple[jax.Array, jax.Array],
    k: jax.Array,
    config: DpConfig,
    activation: str,
) -> jax.Array:
    """Gamma R [N] of every node at time t under acceleration k, limits included."""
    m, before = state
    base = base_activation(lattice, layers, t, config)
    u = jnp.clip(2 * m + k, 0, base.shape[1] - 1)
    rows = jnp.take_along_axis(base, u[:, None, None], axis=1)[:, 0]
    a = k * config.step
    motion = motion_activation(layers, a, (a - before) / DT_S)
    reward = lattice.weight[t] * rest_of_network(layers, rows + motion, activation)
    v = (m + 0.5 * k) * config.speed_step
    smooth = jnp.abs(a - before) <= jnp.maximum(
        config.jerk_reach * config.step + 1e-3, config.max_jerk * DT_S
    )
    keeps = (v >= 0.0) & (v <= lattice.speed_cap[t] + 1e-4) & smooth
    return jnp.where(keeps, reward, FORBIDDEN)


def _first_states(lattice: Lattice, config: DpConfig) -> tuple[jax.Array, ...]:
    """(value, m, acceleration before) [N] of the nodes that time 1 may have."""
    n = jnp.arange(config.num_stations)
    means = n * config.speed_step
    expected = lattice.first.v + 0.5 * lattice.first.a * DT_S
    near = jnp.abs(means - expected) <= config.first_reach
    near = near | (n == jnp.argmin(jnp.abs(means - expected)))
    entered = near & (n < config.num_speeds) & ~lattice.blocked[1]
    return (
        jnp.where(entered, 0.0, FORBIDDEN),
        jnp.minimum(n, config.num_speeds - 1),
        jnp.full(n.shape, lattice.first.a),
    )


def _spread(
    lattice: Lattice,
    layers: Layers,
    t: jax.Array,
    nodes: tuple[jax.Array, ...],
    config: DpConfig,
    activation: str,
) -> tuple[jax.Array, ...]:
    """(score, target, origin, action) of every edge that leaves time t."""
    best, m, before = nodes
    count = config.num_stations
    n, a0 = jnp.arange(count), lattice.first.a
    clipped = jnp.clip(lattice.first_row, layers.lower, layers.upper)
    start = product(clipped, layers.first) + layers.offset
    scores, targets = [], []
    for k in config.actions:
        action = jnp.full((count,), k)
        gain = _node_reward(lattice, layers, t, (m, before), action, config, activation)
        # the jerk of time 0 is that of time 1
        j = (k * config.step - before) / DT_S
        motion = motion_activation(layers, a0 + 0.0 * j, j)
        of_start = rest_of_network(layers, start + motion, activation)
        gain = gain + jnp.where(t == 1, lattice.weight[0] * of_start, 0.0)
        reach = n + m + k
        inside = (m + k >= 0) & (m + k < config.num_speeds) & (reach < count)
        target = jnp.clip(reach, 0, count - 1)
        free = inside & ~lattice.blocked[t + 1, target]
        scores.append(jnp.where(free, best + gain, 2.0 * FORBIDDEN))
        targets.append(target)
    taken = jnp.repeat(jnp.asarray(config.actions), count)
    origin = jnp.tile(n, len(config.actions))
    return jnp.concatenate(scores), jnp.concatenate(targets), origin, taken


def plan_time_station(
    scene: Scene,
    weights: Weights,
    features: FeatureMap,
    activation: str,
    config: DpConfig,
) -> DpPlan:
    """The plan of the (t, s)-only recursion; arguments as `dp.plan_dp`."""
    lattice = make_lattice(scene, weights, features, config)
    layers = make_layers(weights, features, lattice.first_row)
    count = config.num_stations

    def forward(nodes: tuple, t: jax.Array) -> tuple[tuple, jax.Array]:
        score, target, origin, action = _spread(
            lattice, layers, t, nodes, config, activation
        )
        top = jnp.full((count,), 2.0 * FORBIDDEN).at[target].max(score)
        numbered = jnp.where(score >= top[target], jnp.arange(score.size), -1)
        entry = jnp.full((count,), -1).at[target].max(numbered)
        known, chosen = entry >= 0, jnp.maximum(entry, 0)
        came, k = origin[chosen], action[chosen]
        a = (k * config.step).astype(jnp.float32)
        arrived = (
            jnp.where(known, jnp.maximum(top, FORBIDDEN), FORBIDDEN),
            jnp.where(known, nodes[1][came] + k, 0),
            jnp.where(known, a, 0.0),
        )
        return arrived, came

    times = jnp.arange(1, NUM_TIMES - 1)
    (best, m, before), pointers = jax.lax.scan(
        forward, _first_states(lattice, config), times
    )
    last = jnp.asarray(NUM_TIMES - 1)
    k_last = jnp.round(before / config.step).astype(jnp.int32)
    best = best + _node_reward(
        lattice, layers, last, (m, before), k_last, config, activation
    )
    end = jnp.argmax(best)

    def back(at: jax.Array, pointer: jax.Array) -> tuple[jax.Array, jax.Array]:
        return pointer[at], at

    first, rest = jax.lax.scan(back, end, pointers, reverse=True)
    stations = jnp.concatenate([jnp.zeros((1,), jnp.int32), first[None], rest])
    s = scene.ego.s + stations * config.station_step
    return DpPlan(
        trajectory=trajectory_on_path(scene, s),
        value=best[end],
        feasible=best[end] > FEASIBLE,
        n=stations,
    )


def time_station_policy(
    features: FeatureMap, activation: str, config: DpConfig
) -> Policy:
    """The recursion as a planner without a filter: to be measured, not driven."""

    def policy(
        params: Weights, scene: Scene, key: jax.Array, before: Plan | None = None
    ) -> Plan:
        del key, before
        plan = plan_time_station(scene, params, features, activation, config)
        return plan_of(
            plan.trajectory,
            fallback=~plan.feasible,
            admissible=plan.feasible.astype(jnp.int32),
        )

    return policy
