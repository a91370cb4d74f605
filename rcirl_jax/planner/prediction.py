"""Prediction of the other road users, the same in training and in the planner.

The simulator's observer and the training's scenes both describe the others by
their state now (`Bodies`) and get their future from `obstacles_of`, so that a
learner is trained on what it will see while driving:

    the NUM_BODIES most relevant bodies, moved by `predict`;
    the nearest line that demands a stop now, as a wall for all times;
    the destination, where it lies within the view.

A scene from a log holds the recorded future instead; `with_predicted_futures` puts the
prediction in its place.
"""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

from rcirl_jax.geometry.relevance import relevance_distance
from rcirl_jax.planner.baselines import Idm, idm_acceleration
from rcirl_jax.types import Ego, Kind, Obstacles, Path, Scene
from rcirl_jax.units import (
    DT_S,
    LINE_HALF_WIDTH_M,
    NUM_STATIONS,
    NUM_TIMES,
    STATION_STEP_M,
    TIMES_S,
)

NUM_BODIES = 8  # bodies handed to the planner, the most relevant first
LANE_CHANGE_MPS = 0.3  # m/s, lateral speed taken as a lane change
CROSSING_SLOPE = 0.5  # 1, |l_dot| beyond this share of the speed crosses the road
LINE_DEPTH_M = 0.1  # m, thickness of a stop wall (Apollo's virtual obstacle)
STANDING_MPS = 0.2  # m/s (Apollo)
STARTING_MPS = 0.5  # m/s of a leader for which who stands behind it starts too
VIEW_M = (NUM_STATIONS - 1) * STATION_STEP_M  # m, farthest station of a scene


class Bodies(flax.struct.PyTreeNode, kw_only=True):
    """The others now, in the scene's Frenet frame; all [M]."""

    s: jax.Array  # m, station of the centre
    l: jax.Array  # m, lateral offset of the centre
    speed: jax.Array  # m/s along the reference line, signed
    l_dot: jax.Array  # m/s, lateral speed
    a: jax.Array  # m/s^2 along the reference line
    half_s: jax.Array  # m, half extent along the line
    half_l: jax.Array  # m, half extent across it
    kind: jax.Array  # int32, `Kind`
    present: jax.Array  # bool


def most_relevant(bodies: Bodies, ego: Ego, path: Path) -> jax.Array:
    """Places [NUM_BODIES] of the bodies that matter most (`geometry.relevance`).

    Each keeps its speed, as the ego does; the nearest come first, absent ones last.
    """
    s = bodies.s[:, None] - ego.s + bodies.speed[:, None] * TIMES_S
    distance = relevance_distance(
        s,
        lateral_motion(bodies, path)[0],
        bodies.present[:, None],
        bodies.half_l + 0.5 * ego.width,
        ego.v,
        path.l,
        jnp,
    )
    return jax.lax.top_k(-distance, NUM_BODIES)[1]


def relevant(bodies: Bodies, ego: Ego, path: Path) -> Bodies:
    """The `NUM_BODIES` bodies that matter most."""
    index = most_relevant(bodies, ego, path)
    leaves, tree = jax.tree.flatten(bodies)
    taken = jnp.stack([x.astype(jnp.float32) for x in leaves])[:, index]
    kinds = zip(taken, leaves, strict=True)
    return jax.tree.unflatten(tree, [x.astype(old.dtype) for x, old in kinds])


def lateral_motion(bodies: Bodies, path: Path) -> tuple[jax.Array, jax.Array]:
    """Offsets l [M, T] m, and which bodies [M] cross the road instead of following it.

    A lane keeper that moves sideways ends in the middle of the lane it moves to; what
    crosses the road, and every pedestrian, goes straight on.
    """
    times = jnp.asarray(TIMES_S)[None]
    width = jnp.maximum(path.lane_left[0] - path.lane_right[0], 1.0)
    middle = 0.5 * (path.lane_left[0] + path.lane_right[0])
    l, l_dot = bodies.l[:, None], bodies.l_dot[:, None]
    crosses = (bodies.kind == Kind.PEDESTRIAN) | (
        jnp.abs(bodies.l_dot) > CROSSING_SLOPE * jnp.abs(bodies.speed) + LANE_CHANGE_MPS
    )
    direction = jnp.sign(l_dot)
    lane = jnp.round((l - middle) / width + 0.5 * direction)
    room = jnp.maximum((middle + width * lane - l) * direction, 0.0)
    room = jnp.where(jnp.abs(l_dot) > LANE_CHANGE_MPS, room, 0.0)
    keeps = l + direction * jnp.minimum(jnp.abs(l_dot) * times, room)
    return jnp.where(crosses[:, None], l + l_dot * times, keeps), crosses


@dataclasses.dataclass(frozen=True, kw_only=True)
class Following:
    """Parameters of a predicted driver's car following; hashable, not fitted."""

    idm: Idm = dataclasses.field(
        default_factory=lambda: Idm(acceleration=1.0, braking=2.0)
    )
    # s, time constant with which the present acceleration gives way to the IDM's
    memory: float = 2.0
    # s, shortest headway; one below the IDM's is taken for the driver's own
    shortest_headway: float = 0.4
    # 1, least desired speed, as a share of the limit at the ego
    limit_share: float = 0.8
    # m/s^2 below which braking is taken to go on until standing
    hard_braking: float = -2.0
    # m beyond the half widths within which a body is in the way
    margin: float = 0.2


def predict(
    bodies: Bodies, ego: Ego, path: Path
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Stations [M, T] m, offsets [M, T] m and speeds [M, T] m/s of the others.

    Whoever keeps a lane follows the nearest body ahead in it (the ego too, which is
    taken to keep its speed), by the IDM with the headway that is kept now:

        a(t) = w a_0 + (1 - w) a_IDM(t),   w = exp(-t / memory)

    Without a lead vehicle only the first term acts. A standing vehicle waits for its
    lead vehicle to start. Hard braking goes on until standing; what crosses or comes
    towards the ego keeps its speed. Speeds never change sign.
    """
    how = Following()
    l, crosses = lateral_motion(bodies, path)
    count = bodies.s.shape[0]
    times = jnp.asarray(TIMES_S)
    join = lambda many, one: jnp.append(many, one)  # noqa: E731
    half_s = join(bodies.half_s, 0.5 * ego.length)
    half_l = join(bodies.half_l, 0.5 * ego.width)
    present = join(bodies.present, True)
    all_l = jnp.concatenate([l, jnp.broadcast_to(ego.l, (1, NUM_TIMES))])
    follows = ~crosses & (bodies.speed >= 0.0) & (bodies.kind != Kind.STATIC)
    brakes = bodies.a < how.hard_braking
    desired = jnp.maximum(bodies.speed, how.limit_share * path.speed_limit[0])

    def leader(s: jax.Array, v: jax.Array, k: jax.Array) -> tuple[jax.Array, ...]:
        """Gap [M] m and speed of the nearest body ahead, and whether there is one."""
        aside = jnp.abs(all_l[:, k][None] - l[:, k][:, None]) - half_l
        in_way = present & (aside < bodies.half_l[:, None] + how.margin)
        in_way = in_way & (s[None] > s[:count, None])
        gap = s[None] - s[:count, None] - half_s - bodies.half_s[:, None]
        gap = jnp.where(in_way, gap, jnp.inf)
        nearest = jnp.argmin(gap, axis=1)
        found = jnp.any(in_way, axis=1)
        return jnp.where(found, jnp.min(gap, axis=1), 1e3), v[nearest], found

    begin = (join(bodies.s, ego.s), join(bodies.speed, ego.v))
    gap, _, _ = leader(*begin, jnp.zeros((), jnp.int32))
    kept = (gap - how.idm.standstill_gap) / jnp.maximum(bodies.speed, 1.0)
    headway = jnp.clip(kept, how.shortest_headway, how.idm.headway)
    idm = dataclasses.replace(how.idm, headway=headway)

    def advance(carry: tuple, k: jax.Array) -> tuple[tuple, tuple]:
        s, v = carry
        gap, lead, found = leader(s, v, k)
        own = v[:count]
        found = found & ((own > STANDING_MPS) | (lead > STARTING_MPS))
        share = jnp.exp(-times[k] / how.memory)
        idm_a = idm_acceleration(own, gap, own - lead, desired, idm)
        a = share * bodies.a + jnp.where(found, (1.0 - share) * idm_a, 0.0)
        a = jnp.where(brakes, jnp.minimum(a, bodies.a), a)
        after = jnp.where(follows, jnp.maximum(own + a * DT_S, 0.0), own)
        after = join(after, v[-1])
        return (s + 0.5 * (v + after) * DT_S, after), (s[:count], own)

    _, (s, v) = jax.lax.scan(advance, begin, jnp.arange(NUM_TIMES))
    return s.T, l, v.T


def obstacles_of(
    bodies: Bodies,
    line: jax.Array,
    destination: jax.Array,
    ego: Ego,
    path: Path,
) -> Obstacles:
    """The planner's obstacles [NUM_BODIES + 2, T]: bodies, stop wall, destination.

    Args:
      bodies: all that is perceived, at least `NUM_BODIES` slots.
      line: [] m, station of the nearest line that demands a stop now; inf if none.
      destination: [] m, station of the destination; inf if it is not known.
      ego: of the scene.
      path: of the scene.
    """
    near = relevant(bodies, ego, path)
    s, l, speed = predict(near, ego, path)
    walls = jnp.stack([line, destination])
    known = walls < VIEW_M
    walls = jnp.where(known, walls, 0.0)[:, None] * jnp.ones((2, NUM_TIMES))
    wide = jnp.full((2, NUM_TIMES), LINE_HALF_WIDTH_M)
    none = jnp.zeros((2,))
    join = lambda *parts: jnp.concatenate(parts)  # noqa: E731
    here = join(near.present, known)
    kind = jnp.where(near.present, near.kind, Kind.NONE)
    return Obstacles(
        s_lower=join(s - near.half_s[:, None], walls),
        s_upper=join(s + near.half_s[:, None], walls + LINE_DEPTH_M),
        l_lower=join(l - near.half_l[:, None], -wide),
        l_upper=join(l + near.half_l[:, None], wide),
        speed=join(speed, jnp.zeros((2, NUM_TIMES))),
        valid=jnp.broadcast_to(here[:, None], (NUM_BODIES + 2, NUM_TIMES)),
        kind=join(kind, jnp.array([Kind.STOP, Kind.VIRTUAL], jnp.int32)),
        a=join(near.a, none),
        l_dot=join(near.l_dot, none),
    )


def bodies_now(obstacles: Obstacles) -> Bodies:
    """The bodies of a scene in their state at t = 0."""
    o = obstacles
    middle = lambda low, high: 0.5 * (low[:, 0] + high[:, 0])  # noqa: E731
    half = lambda low, high: 0.5 * (high[:, 0] - low[:, 0])  # noqa: E731
    return Bodies(
        s=middle(o.s_lower, o.s_upper),
        l=middle(o.l_lower, o.l_upper),
        speed=o.speed[:, 0],
        l_dot=o.l_dot,
        a=o.a,
        half_s=half(o.s_lower, o.s_upper),
        half_l=half(o.l_lower, o.l_upper),
        kind=o.kind,
        present=o.valid[:, 0] & (o.kind != Kind.NONE) & (o.kind < Kind.STOP),
    )


def with_predicted_futures(scene: Scene) -> Scene:
    """A scene from a log as the planner would have seen it at t = 0.

    Recorded futures are replaced by predicted ones, and lines by what they demand now;
    everything else stays, including the mask of the recorded future.
    """
    o = scene.obstacles
    front = scene.ego.s + 0.5 * scene.ego.length
    now = o.valid[:, 0] & (o.s_lower[:, 0] >= front)
    nearest = lambda kind: jnp.min(  # noqa: E731
        jnp.where(now & (o.kind == kind), o.s_lower[:, 0], jnp.inf)
    )
    seen = obstacles_of(
        bodies_now(o), nearest(Kind.STOP), nearest(Kind.VIRTUAL), scene.ego, scene.path
    )
    return scene.replace(obstacles=seen)


def select_future(scene: Scene, predicted: jax.Array) -> Scene:
    """A scene from a log as the planner sees it, or as recorded.

    Args:
      scene: of a log; the slots of both forms are as many as the log's.
      predicted: [] bool, which of the two.
    """
    more = scene.obstacles.valid.shape[0] - (NUM_BODIES + 2)

    def one(seen: jax.Array, recorded: jax.Array) -> jax.Array:
        empty = [(0, more), *[(0, 0)] * (seen.ndim - 1)]
        return jnp.where(predicted, jnp.pad(seen, empty), recorded)

    obstacles = jax.tree.map(
        one, with_predicted_futures(scene).obstacles, scene.obstacles
    )
    return scene.replace(obstacles=obstacles)
