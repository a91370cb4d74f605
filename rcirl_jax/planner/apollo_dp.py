"""Apollo's speed DP with its published cost, as the hand-set rival of `dp`.

Source: Apollo r3.0, DP_ST_SPEED_OPTIMIZER with the values of its lane-follow
configuration. Nodes are (t, s), 1 s and 1 m apart. Every node keeps one
predecessor, chosen greedily, and reads its speed and acceleration off that
history:

    v = d / u,   a = (v - v_prev) / u,   j = (a - a_prev) / u
    cost = u (speed(v) + acceleration(a) + jerk(j) + obstacle(t, s))

An edge therefore costs what the way to its node was, Bellman's principle does
not hold and the plan need not be the cheapest of its own grid. The same state
on the learned reward is `time_station`.

Kept apart from the source, on purpose: the horizon is 8 s instead of 7 s, the
time axis of everything here; exceeding the limit is squared relative to the
limit, as Apollo's own later correction does; stop lines that demand a stop are
walls, because there is no QP behind this DP that would keep them; and the 1 s
stations are joined by a monotone cubic instead of that QP.
"""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.errors import InputError
from rcirl_jax.features.path import path_view
from rcirl_jax.features.relations import LATERAL_BUFFER_M
from rcirl_jax.sampling.kinematics import trajectory_on_path
from rcirl_jax.types import Kind, Scene, Trajectory
from rcirl_jax.units import DT_S, HORIZON_S, NUM_TIMES, TIMES_S

FORBIDDEN = 1e12  # cost of a node that no plan may take; finite: no NaN
FEASIBLE = 1e11  # costs below it belong to plans that break nothing
MIN_LIMIT_MPS = 2.5  # m/s, floor of the speed limit (Apollo speed_limit decider)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ApolloDpConfig:
    """Grid, weights and limits; hashable. Values of Apollo r3.0, lane follow."""

    # s between columns
    unit_t: float = 1.0
    # m between rows
    unit_s: float = 1.0
    # rows: 0 .. 149 m
    num_stations: int = 150
    # m/s, fastest edge (MKZ planning_upper_speed_limit)
    max_speed: float = 31.3
    obstacle_weight: float = 1.0
    obstacle_cost: float = 1e3  # per m^2 of missing gap
    # s, gap to a leader: its speed times this
    follow_time: float = 3.0
    # m, gap in front of an overtaken one
    overtake_gap: float = 20.0
    speed_cost: float = 1e3
    exceed_penalty: float = 10.0
    low_penalty: float = 10.0
    accel_penalty: float = 1.0
    decel_penalty: float = 1.0
    jerk_coefficient: float = 1.0
    max_acceleration: float = 3.0  # m/s^2
    max_deceleration: float = -4.0  # m/s^2
    # times per edge at which it is tested against the bodies
    edge_tests: int = 4

    def __post_init__(self) -> None:
        """The columns must end at the horizon."""
        columns = HORIZON_S / self.unit_t
        if columns < 2 or abs(columns - round(columns)) > 1e-6:
            raise InputError(
                f"ApolloDpConfig: unit_t: {self.unit_t}: expected a part of 8 s"
            )
        if self.unit_s <= 0.0 or self.num_stations < 2:
            raise InputError(
                f"ApolloDpConfig: unit_s, num_stations: {self.unit_s}, "
                f"{self.num_stations}: expected > 0 and at least 2"
            )

    @property
    def num_edges(self) -> int:
        """C, edges of a plan: 8 at 1 s."""
        return round(HORIZON_S / self.unit_t)

    @property
    def num_moves(self) -> int:
        """D, rows an edge may climb, 0 .. D - 1."""
        fastest = int(self.max_speed * self.unit_t / self.unit_s)
        return min(fastest + 1, self.num_stations)


class ApolloPlan(flax.struct.PyTreeNode, kw_only=True):
    """What the greedy recursion reads out."""

    trajectory: Trajectory  # [T]
    cost: jax.Array  # [] of the path, lower is better
    feasible: jax.Array  # [] bool: nothing forbidden on the way
    rows: jax.Array  # [C + 1] int32, station rows at the columns
    columns: jax.Array  # [] int32, edges used; fewer than C at the path's end


class Bodies(flax.struct.PyTreeNode, kw_only=True):
    """Who is in the path's way at some times; the ego is a point. Leaves [X, N]."""

    lower: jax.Array  # m, the centre is behind it below
    upper: jax.Array  # m, and past it above
    speed: jax.Array  # m/s
    body: jax.Array  # bool
    wall: jax.Array  # bool: a line that demands a stop, ahead of the ego at t = 0


class Graph(flax.struct.PyTreeNode, kw_only=True):
    """What an edge's cost reads, made once per scene."""

    obstacle: jax.Array  # [C + 1, S] cost of a node
    blocked: jax.Array  # [C, S, D] bool: the edge that arrives at s by d rows
    limit: jax.Array  # [S] m/s


def bodies_at(scene: Scene, times: jax.Array) -> Bodies:
    """Obstacles at times [X] s between those of the axis, at constant speed.

    A body in the way that is not ahead at t = 0 follows or touches already; it
    is not the plan's to avoid, as in the safety filter.
    """
    obstacles, half = scene.obstacles, 0.5 * scene.ego.length
    near = jnp.clip(jnp.round(times / DT_S), 0, NUM_TIMES - 1).astype(jnp.int32)
    at = lambda table: table[:, near].T  # noqa: E731
    speed = at(obstacles.speed)
    moved = speed * (times - jnp.asarray(TIMES_S)[near])[:, None]
    lower, upper = at(obstacles.s_lower) + moved, at(obstacles.s_upper) + moved
    path_l = jax.vmap(lambda s: path_view(scene, s).l)(0.5 * (lower + upper))
    aside = jnp.maximum(at(obstacles.l_lower) - path_l, path_l - at(obstacles.l_upper))
    in_way = aside < 0.5 * scene.ego.width + LATERAL_BUFFER_M
    kind = obstacles.kind[None]
    body = (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC) & in_way
    ahead = scene.ego.s + half <= obstacles.s_lower[:, 0]
    aside_now = jnp.maximum(
        obstacles.l_lower[:, 0] - scene.ego.l, scene.ego.l - obstacles.l_upper[:, 0]
    )
    corridor = obstacles.valid[:, 0] & (aside_now < 0.5 * scene.ego.width)
    known = at(obstacles.valid)
    return Bodies(
        lower=lower - half,
        upper=upper + half,
        speed=speed,
        body=body & known & (ahead | ~corridor)[None],
        wall=(kind == Kind.STOP) & known & ahead[None],
    )


def make_graph(scene: Scene, config: ApolloDpConfig) -> Graph:
    """Node costs, forbidden edges and speed limits of one scene."""
    s = scene.ego.s + jnp.arange(config.num_stations) * config.unit_s
    columns = jnp.arange(config.num_edges + 1) * config.unit_t
    at_nodes = bodies_at(scene, columns)
    obstacle = jax.vmap(lambda o: _obstacle_cost(o, s, config))(at_nodes)
    limit = jnp.maximum(path_view(scene, s).speed_limit, MIN_LIMIT_MPS)
    blocked = jax.vmap(lambda t: _blocked_edges(scene, t, s, config))
    return Graph(obstacle=obstacle, blocked=blocked(columns[:-1]), limit=limit)


def _obstacle_cost(o: Bodies, s: jax.Array, config: ApolloDpConfig) -> jax.Array:
    """Cost [S] of the nodes of one column: squares of the missing gaps."""
    follow = jnp.maximum(o.speed, 0.0) * config.follow_time
    to_lower = o.lower[None] - s[:, None]
    past_upper = s[:, None] - o.upper[None]
    behind = jnp.where(to_lower > 0.0, jnp.maximum(follow - to_lower, 0.0), 0.0)
    before = jnp.maximum(config.overtake_gap - past_upper, 0.0)
    before = jnp.where(past_upper > 0.0, before, 0.0)
    square = jnp.where(o.body[None], behind**2 + before**2, 0.0)
    return config.obstacle_weight * config.obstacle_cost * jnp.sum(square, axis=1)


def _blocked_edges(
    scene: Scene,
    t: jax.Array,
    s: jax.Array,
    config: ApolloDpConfig,
) -> jax.Array:
    """[S, D] bool: edges from time t that enter a body or pass a wall."""
    parts = jnp.arange(1, config.edge_tests + 1) / config.edge_tests
    way = jnp.arange(config.num_moves) * config.unit_s

    def at(part: jax.Array) -> jax.Array:
        time = (t + part * config.unit_t)[None]
        o = jax.tree.map(lambda x: x[0], bodies_at(scene, time))
        x = (s[:, None] - (1.0 - part) * way[None])[..., None]
        inside = (x > o.lower) & (x < o.upper) & o.body
        return jnp.any(inside | (o.wall & (x > o.lower)), axis=-1)

    return jnp.any(jax.vmap(at)(parts), axis=0)


def speed_cost(v: jax.Array, limit: jax.Array, config: ApolloDpConfig) -> jax.Array:
    """Per second: C_v (P_exceed x^2 above, P_low |x| below), x = v / limit - 1."""
    off = v / limit - 1.0
    above = config.exceed_penalty * off**2
    return config.speed_cost * jnp.where(off > 0.0, above, -config.low_penalty * off)


def acceleration_cost(a: jax.Array, config: ApolloDpConfig) -> jax.Array:
    """Per second: p a^2 plus soft walls a^2 p^2 / (1 + exp(.)) at the limits."""
    up, down = config.accel_penalty, config.decel_penalty
    soft_down = down**2 * jax.nn.sigmoid(config.max_deceleration - a)
    soft_up = up**2 * jax.nn.sigmoid(a - config.max_acceleration)
    return a**2 * (jnp.where(a > 0.0, up, down) + soft_down + soft_up)


def edge_cost(
    v: jax.Array,
    a: jax.Array,
    j: jax.Array,
    limit: jax.Array,
    config: ApolloDpConfig,
) -> jax.Array:
    """Cost of an edge without obstacles; any equal shapes (m, s)."""
    per_second = (
        speed_cost(v, limit, config)
        + acceleration_cost(a, config)
        + config.jerk_coefficient * j**2
    )
    return config.unit_t * per_second


class Column(flax.struct.PyTreeNode, kw_only=True):
    """All nodes of one time with the history each of them keeps; leaves [S]."""

    cost: jax.Array
    v: jax.Array  # m/s, of the edge that arrived
    a: jax.Array  # m/s^2


def _advance(
    column: Column,
    blocked: jax.Array,
    obstacle: jax.Array,
    graph: Graph,
    config: ApolloDpConfig,
) -> tuple[Column, jax.Array]:
    """The next column and the rows [S] its nodes climbed."""
    rows, moves = jnp.arange(config.num_stations), jnp.arange(config.num_moves)
    origin = rows[:, None] - moves[None]
    came = jnp.maximum(origin, 0)
    v = jnp.broadcast_to(moves * (config.unit_s / config.unit_t), origin.shape)
    a = (v - column.v[came]) / config.unit_t
    j = (a - column.a[came]) / config.unit_t
    limit = jnp.minimum(graph.limit[came], graph.limit[:, None])
    gain = edge_cost(v, a, j, limit, config) + config.unit_t * obstacle[:, None]
    free = (origin >= 0) & ~blocked
    free = free & (a >= config.max_deceleration) & (a <= config.max_acceleration)
    total = jnp.where(free, column.cost[came] + gain, FORBIDDEN)
    best = jnp.argmin(total, axis=1)
    pick = lambda x: jnp.take_along_axis(x, best[:, None], axis=1)[:, 0]  # noqa: E731
    cost = jnp.minimum(pick(total), FORBIDDEN)
    return Column(cost=cost, v=pick(v), a=pick(a)), best.astype(jnp.int32)


def _columns(scene: Scene, config: ApolloDpConfig) -> tuple[jax.Array, jax.Array]:
    """Costs [C + 1, S] of all nodes and the moves [C, S] that led to them."""
    graph = make_graph(scene, config)
    count = config.num_stations
    here = jnp.arange(count) == 0
    start = Column(
        cost=jnp.where(here, 0.0, FORBIDDEN),
        v=jnp.full((count,), scene.ego.v),
        a=jnp.full((count,), scene.ego.a),
    )

    def step(column: Column, x: tuple) -> tuple[Column, tuple]:
        blocked, obstacle = x
        after, move = _advance(column, blocked, obstacle, graph, config)
        return after, (after.cost, move)

    _, (costs, moves) = jax.lax.scan(step, start, (graph.blocked, graph.obstacle[1:]))
    return jnp.concatenate([start.cost[None], costs]), moves


def _read_out(
    costs: jax.Array, moves: jax.Array, config: ApolloDpConfig
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(cost, rows [C + 1], edges used) of the cheapest end.

    A plan ends in the last column or, earlier, in the last row; from there it
    is continued at its last speed.
    """
    count, edges = config.num_stations, config.num_edges
    columns = jnp.arange(edges + 1)
    last_row = jnp.arange(count)[None] == count - 1
    end = (columns[:, None] == edges) | (last_row & (columns[:, None] > 0))
    table = jnp.where(end, costs, 2.0 * FORBIDDEN)
    best = jnp.argmin(table)
    c_end, r_end = best // count, best % count
    climbed = moves[jnp.maximum(c_end - 1, 0), r_end]

    def back(at: jax.Array, x: tuple) -> tuple[jax.Array, jax.Array]:
        column, move = x
        beyond = column > c_end
        before = jnp.where(beyond, at, at - move[at])
        return before, jnp.where(beyond, r_end + climbed * (column - c_end), at)

    first, rest = jax.lax.scan(back, r_end, (columns[1:], moves), reverse=True)
    return table.reshape(-1)[best], jnp.concatenate([first[None], rest]), c_end


def join(scene: Scene, stations: jax.Array, unit_t: float) -> jax.Array:
    """Stations [T] m on the time axis through stations [C + 1] m every unit_t s.

    Cubic Hermite with the slopes of Fritsch and Carlson's monotone scheme: the
    harmonic mean of neighbouring edges' speeds, at t = 0 the ego's speed as far
    as the curve stays monotone (three times the first edge's).
    """
    rise = (stations[1:] - stations[:-1]) / unit_t
    both = rise[1:] * rise[:-1]
    middle = 2.0 * both / jnp.where(both > 0.0, rise[1:] + rise[:-1], 1.0)
    slope = jnp.concatenate(
        [jnp.minimum(scene.ego.v, 3.0 * rise[:1]), middle, rise[-1:]]
    )
    position = jnp.clip(jnp.asarray(TIMES_S) / unit_t, 0.0, rise.shape[0])
    low = jnp.minimum(position.astype(jnp.int32), rise.shape[0] - 1)
    x = position - low
    s0, s1 = stations[low], stations[low + 1]
    m0, m1 = slope[low] * unit_t, slope[low + 1] * unit_t
    ease = x**2 * (3.0 - 2.0 * x)
    bend = x * (1.0 - x) * (m0 * (1.0 - x) - m1 * x)
    return s0 + (s1 - s0) * ease + bend


def plan_apollo(scene: Scene, config: ApolloDpConfig = ApolloDpConfig()) -> ApolloPlan:
    """The plan of Apollo's greedy (t, s) recursion on its own cost.

    Args:
      scene: one scene; its path is the one driven.
      config: static.

    Returns:
      The plan; where every plan breaks something `feasible` is False and the
      stations stay at the ego, as Apollo's all-zero profile.
    """
    with jax.named_scope("apollo_dp"):
        costs, moves = _columns(scene, config)
        cost, rows, columns = _read_out(costs, moves, config)
        feasible = cost < FEASIBLE
        rows = jnp.where(feasible, rows, 0)
        s = join(scene, scene.ego.s + rows * config.unit_s, config.unit_t)
        return ApolloPlan(
            trajectory=trajectory_on_path(scene, s),
            cost=cost,
            feasible=feasible,
            rows=rows,
            columns=columns,
        )
