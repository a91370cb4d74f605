"""One pure function per feature: (frame of one point) -> scalar.

`COLUMNS` maps the name used in data_specs/features/*.toml to the function that
computes it. To add a feature: write a function here, name it there. The
functions are elementwise, so a Frame whose leaves carry further axes gives a
column with these axes.

Where each obstacle stands relative to one point of a trajectory.

Everything is geometry in the Frenet frame of the scene: the ego's box and the
obstacles' boxes are axis-aligned there (headings relative to the reference
line are small; the obstacle's own tilt is already in its extents). Source of
the classes: the paper's Table I and Apollo's per-point rule (stop test and
time axis corrected).

Three habits make this fast where it counts, on [T, K] grids of candidates:

* whatever depends on obstacle and time alone is folded into the obstacle
  first (`slots`): its box grows by the ego's half extents, so the ego becomes
  a point, and what cannot be met moves to infinity, so masks disappear;
* the loop over obstacles is unrolled, so XLA runs through one fused
  elementwise loop per result; reductions over an obstacle axis cost 3 times
  as much on a CPU;
* where the nearest of a class stands is found first, its speed second, by that
  place: carrying both through one pass takes three times the instructions.

The scene's path at given stations, by few gathers.

A table lookup costs a gather of two neighbours, and a CPU pays for every number that
it gathers. What is read together stands in one of four tables; XLA drops a table that
nobody reads.
"""

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rcirl_jax.geometry.frenet import entry, path_curvature
from rcirl_jax.types import Ego, Kind, Obstacles, Scene, Trajectory
from rcirl_jax.units import STATION_STEP_M, TIMES_S

SLOPE_POINTS = 3  # grid points on each side for dl/ds: 6 m, about a car's length


class PathView(flax.struct.PyTreeNode, kw_only=True):
    """The path at the stations of one trajectory; all [T]."""

    l: jax.Array  # m, lateral offset of the given path
    dl: jax.Array  # 1, its slope by station
    ddl: jax.Array  # 1/m, its second derivative
    kappa: jax.Array  # 1/m, curvature of the reference line
    dkappa: jax.Array  # 1/m^2, its slope
    speed_limit: jax.Array  # m/s
    road_left: jax.Array  # m, lateral offset of the drivable area's left edge
    road_right: jax.Array  # m, of its right edge

    def curvature(self, trajectory: Trajectory) -> jax.Array:
        """Curvature 1/m of the path that the trajectory drives; any equal shape."""
        at = path_curvature
        for _ in range(self.kappa.ndim):
            at = jax.vmap(at)
        return at(self.kappa, self.dkappa, trajectory.l, trajectory.dl, trajectory.ddl)


def table_slope(table: Float[Array, " p"], points: int) -> Float[Array, " p"]:
    """Central difference over `points` grid points on each side, by station."""
    first, last = (jnp.broadcast_to(table[i], (points,)) for i in (0, -1))
    padded = jnp.concatenate([first, table, last])
    return (padded[2 * points :] - padded[: -2 * points]) / (
        2.0 * points * STATION_STEP_M
    )


def path_view(scene: Scene, s: Float[Array, " t"]) -> PathView:
    """The path at stations s [T] m; linear between grid points, held at the ends."""
    path = scene.path
    dl = table_slope(path.l, SLOPE_POINTS)
    position = jnp.clip(s / STATION_STEP_M, 0.0, path.l.shape[0] - 1.0)
    low = jnp.minimum(position.astype(jnp.int32), path.l.shape[0] - 2)
    share = position - low
    entries = jax.vmap(entry, in_axes=(0, None))

    def at(*columns: jax.Array) -> jax.Array:
        table = jnp.stack(columns)
        rise = jnp.pad(table[:, 1:] - table[:, :-1], ((0, 0), (0, 1)))
        start, slope = jnp.split(entries(jnp.concatenate([table, rise]), low), 2)
        return start + share * slope

    l, dl_at, ddl = at(path.l, dl, table_slope(dl, SLOPE_POINTS))
    kappa, dkappa = at(path.kappa, table_slope(path.kappa, 1))
    (limit,) = at(path.speed_limit)
    road_left, road_right = at(path.road_left, path.road_right)
    return PathView(
        l=l,
        dl=dl_at,
        ddl=ddl,
        kappa=kappa,
        dkappa=dkappa,
        speed_limit=limit,
        road_left=road_left,
        road_right=road_right,
    )


LATERAL_BUFFER_M = 0.2  # m added to the half widths; half of Apollo's 0.4 m
NUDGE_RANGE_M = 3.0  # m, lateral gap beyond which Apollo's path decider ignores
OBSTACLE_CAP_M = 100.0  # m, Apollo: follow, overtake, side-pass "none" distance
LINE_CAP_M = 60.0  # m, Apollo: stop, virtual and nudge "none" distance
LATERAL_CAP_M = 10.0  # m, Apollo: lateral "none" distance
FAR_M = 1e6  # m, "no such obstacle"


class Nearest(flax.struct.PyTreeNode, kw_only=True):
    """The nearest member of a class; (cap, 0) where none is nearer than the cap."""

    distance: jax.Array  # m, in [0, cap]
    speed: jax.Array  # m/s, obstacle minus ego


class Relations(flax.struct.PyTreeNode, kw_only=True):
    """One point against all obstacles; all scalars."""

    follow: Nearest  # in the way and ahead
    overtake: Nearest  # in the way and behind
    nudge: Nearest  # beside, abreast; distance is the lateral gap
    sidepass_front: Nearest  # beside, ahead
    sidepass_rear: Nearest  # beside, behind
    stop: Nearest  # a line ahead that demands a stop
    virtual: Nearest  # the destination ahead
    body: jax.Array  # m, signed distance to the closest body; < 0 penetration
    line_overrun: jax.Array  # m, how far a demanding line was just crossed


class Slot(flax.struct.PyTreeNode, kw_only=True):
    """One obstacle at one time, grown by the ego's half extents; scalars."""

    lower: jax.Array  # m, the ego's centre is behind it below; FAR_M: no body
    upper: jax.Array  # m, and past it above; -FAR_M: no body
    right: jax.Array  # m, the ego's side clears it on the right below
    left: jax.Array  # m, and on the left above
    speed: jax.Array  # m/s along the road
    wall: jax.Array  # m, the same for a line that demands a stop; FAR_M: none
    wall_before: jax.Array  # m, a time earlier; -FAR_M: did not demand one
    end: jax.Array  # m, the same for the destination; FAR_M: none


def slots(ego: Ego, obstacles: Obstacles) -> tuple[Slot, ...]:
    """The N obstacles as Slots with leaves [T]."""
    half_length, half_width = 0.5 * ego.length, 0.5 * ego.width
    kind = obstacles.kind[:, None]
    body = obstacles.valid & (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
    line = obstacles.valid & (kind == Kind.STOP)
    end = obstacles.valid & (kind == Kind.VIRTUAL)
    lower = obstacles.s_lower - half_length
    upper, left = obstacles.s_upper + half_length, obstacles.l_upper + half_width
    # a body that lacks a number has no place: the distance to bodies is NaN then
    numbers = lower + upper + obstacles.l_lower + left + obstacles.speed
    lacking = body & ~jnp.isfinite(numbers)
    demanded = jnp.where(line, lower, -FAR_M)
    before = jnp.concatenate(
        [jnp.where(line[:, :1], FAR_M, -FAR_M), demanded[:, :-1]], axis=1
    )
    leaves = (
        jnp.where(body, lower, FAR_M),
        jnp.where(body, jnp.where(lacking, jnp.nan, upper), -FAR_M),
        obstacles.l_lower - half_width,
        jnp.where(lacking, jnp.nan, left),
        obstacles.speed,
        jnp.where(line, lower, FAR_M),
        before,
        jnp.where(end, lower, FAR_M),
    )
    names = ("lower", "upper", "right", "left", "speed", "wall", "wall_before", "end")
    return tuple(
        Slot(**{name: leaf[n] for name, leaf in zip(names, leaves, strict=True)})
        for n in range(obstacles.kind.shape[0])
    )


# m, of each class: a member further away than this is none
CAPS_M = {
    "follow": OBSTACLE_CAP_M,
    "overtake": OBSTACLE_CAP_M,
    "nudge": LATERAL_CAP_M,
    "sidepass_front": OBSTACLE_CAP_M,
    "sidepass_rear": OBSTACLE_CAP_M,
    "stop": LINE_CAP_M,
    "virtual": LINE_CAP_M,
}


def _larger(a: jax.Array | float, b: jax.Array) -> jax.Array:
    """One instruction where `jnp.maximum` takes four; NaN where b is."""
    return jnp.where(a > b, a, b)


def _gaps(o: Slot, s: jax.Array, l: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(gap, lateral gap) m; negative where they overlap."""
    return _larger(o.lower - s, s - o.upper), _larger(o.right - l, l - o.left)


def _memberships(
    o: Slot, s: jax.Array, gap: jax.Array, aside: jax.Array
) -> dict[str, tuple[jax.Array, jax.Array]]:
    """Of each class: whether the obstacle is a member, and what orders members.

    Ordering by an edge's station orders by the distance to it.
    """
    in_way = aside < LATERAL_BUFFER_M
    beside = ~in_way & (aside < NUDGE_RANGE_M)
    ahead, behind = s <= o.lower, (s >= o.upper) & (o.upper > -FAR_M)
    return {
        "follow": (in_way & ahead, o.lower),
        "overtake": (in_way & behind, -o.upper),
        "nudge": (beside & (gap < 0.0), aside),
        "sidepass_front": (beside & ahead, o.lower),
        "sidepass_rear": (beside & behind, -o.upper),
        "stop": (s <= o.wall, o.wall),
        "virtual": (s <= o.end, o.end),
    }


def _nearest(
    ego_slots: tuple[Slot, ...],
    met: list[dict[str, tuple[jax.Array, jax.Array]]],
    s: jax.Array,
    v: jax.Array,
) -> dict[str, Nearest]:
    """The nearest of each class; of two at the very same place the slower."""
    from_ego = {"overtake": -s, "sidepass_rear": -s, "nudge": jnp.zeros_like(s)}
    found = {}
    for name, cap in CAPS_M.items():
        edge = speed = jnp.asarray(FAR_M)
        for classes in met:
            member, key = classes[name]
            key = jnp.where(member, key, FAR_M)
            edge = jnp.where(edge < key, edge, key)  # no member's is NaN
        for o, classes in zip(ego_slots, met, strict=True):
            member, key = classes[name]
            slower = member & (key == edge) & (o.speed < speed)
            speed = jnp.where(slower, o.speed, speed)
        distance = edge - from_ego.get(name, s)
        known = distance < cap
        # none is found where compiled code rounds a key differently in each loop
        unknown = ~known | (speed >= FAR_M)
        found[name] = Nearest(
            distance=jnp.where(known, distance, cap),
            speed=jnp.where(unknown, 0.0, speed - v),
        )
    return found


def relate(
    ego_slots: tuple[Slot, ...],
    s: jax.Array,
    l: jax.Array,
    v: jax.Array,
    s_before: jax.Array,
) -> Relations:
    """Classify every obstacle against the ego at (s, l) with speed v.

        gap = max(s_lower - (s + L/2), (s - L/2) - s_upper)
        lateral_gap = max(l_lower - (l + W/2), (l - W/2) - l_upper)

    An obstacle with lateral_gap < buffer is in the way: ahead of the bumper it
    is followed, behind the tail it is overtaken, in between it collides. One
    beside the ego within the nudge range is nudged while abreast and
    side-passed while ahead or behind. A line counts as overrun at the time
    where the front bumper first lies beyond it while it demands a stop.

    The distance to a body is sqrt(max(gap, 0)^2 + max(lateral_gap, 0)^2) apart
    and the larger (shallower) of the two negative gaps inside.

    Args:
      ego_slots: N slots with scalar leaves, of `slots`.
      s: m, station of the ego's centre.
      l: m, its lateral offset.
      v: m/s, its speed.
      s_before: m, its station one time earlier; very negative at the first.
    """
    signed, overrun = jnp.asarray(FAR_M**2), jnp.zeros(())
    met = []
    for o in ego_slots:
        gap, aside = _gaps(o, s, l)
        met.append(_memberships(o, s, gap, aside))
        square = _larger(0.0, gap) ** 2 + _larger(0.0, aside) ** 2
        depth = jnp.maximum(gap, aside)
        # NaN of one body stays: a comparison would forget it at the next
        signed = jnp.minimum(signed, jnp.where(depth < 0.0, depth, square))
        crossed = (s > o.wall) & (s_before <= o.wall_before)
        overrun = jnp.where(crossed, jnp.maximum(overrun, s - o.wall), overrun)
    outside = jnp.sqrt(jnp.where(signed > 0.0, signed, 1.0))
    return Relations(
        **_nearest(ego_slots, met, s, v),
        body=jnp.where(signed > 0.0, outside, signed),
        line_overrun=overrun,
    )


MIN_COLLISION_M = -10.0  # m, deepest penetration told apart
BEFORE_M = 1e6  # m, how far back the ego is taken to be before the first time


class Frame(flax.struct.PyTreeNode, kw_only=True):
    """What the columns read at one point; all leaves scalars."""

    time: jax.Array  # s
    advance: jax.Array  # m, station since t = 0
    point: Trajectory  # leaves [] instead of [T]
    relations: Relations
    path: PathView
    kappa: jax.Array  # 1/m, curvature of the path driven


def make_frame(scene: Scene, trajectory: Trajectory) -> Frame:
    """The frames of one trajectory; every leaf is [T]."""
    view = path_view(scene, trajectory.s)
    points = jax.tree.map(lambda x: x[:, None], (trajectory, view))
    frame = _grid(scene, *points)
    return jax.tree.map(lambda x: x[:, 0], frame)


def candidate_frames(scene: Scene, trajectories: Trajectory) -> Frame:
    """The frames of K trajectories [K, T] of a scene; every leaf is [T, K].

    Candidates run along the last axis, so that XLA's loops are long and all
    lanes of the processor's vectors are filled.
    """
    view = jax.vmap(path_view, in_axes=(None, 0))(scene, trajectories.s)
    leaves, tree = jax.tree.flatten((trajectories, view))
    points = jnp.stack(leaves).swapaxes(1, 2)  # one copy instead of one a leaf
    return _grid(scene, *jax.tree.unflatten(tree, points))


def _grid(scene: Scene, trajectory: Trajectory, view: PathView) -> Frame:
    """Frames of a [T, K] grid of points; the one place that maps over points."""
    s = trajectory.s
    before = jnp.concatenate([jnp.full_like(s[:1], -BEFORE_M), s[:-1]])
    kappa = view.curvature(trajectory)

    def row(time: jax.Array, obstacles: tuple, s: jax.Array, *rest: jax.Array) -> tuple:
        one = jax.vmap(relate, in_axes=(None, 0, 0, 0, 0))
        return jnp.broadcast_to(time, s.shape), one(obstacles, s, *rest)

    everyone = slots(scene.ego, scene.obstacles)
    time, relations = jax.vmap(row)(
        jnp.asarray(TIMES_S), everyone, s, trajectory.l, trajectory.v, before
    )
    return Frame(
        time=time,
        advance=s - scene.ego.s,
        point=trajectory,
        relations=relations,
        path=view,
        kappa=kappa,
    )


def driven_curvature(scene: Scene, trajectory: Trajectory) -> jax.Array:
    """Curvature [T] 1/m of the path driven: reference line plus lateral motion."""
    return path_view(scene, trajectory.s).curvature(trajectory)


def _collision_distance(frame: Frame) -> jax.Array:
    overrun, signed = frame.relations.line_overrun, frame.relations.body
    signed = jnp.where(overrun > 0.0, jnp.minimum(signed, -overrun), signed)
    return jnp.clip(signed, MIN_COLLISION_M, OBSTACLE_CAP_M)


def _of_nearest(name: str, attribute: str) -> Callable[[Frame], jax.Array]:
    """Distance or relative speed of the nearest of a class."""

    def column(frame: Frame) -> jax.Array:
        nearest: Nearest = getattr(frame.relations, name)
        return getattr(nearest, attribute)

    return column


def _nudge_distance(frame: Frame) -> jax.Array:
    """Along the road: 0 while something is abreast, the cap otherwise."""
    abreast = frame.relations.nudge.distance < LATERAL_CAP_M
    return jnp.where(abreast, 0.0, LINE_CAP_M)


COLUMNS: dict[str, Callable[[Frame], jax.Array]] = {
    "l": lambda frame: frame.point.l,
    "dl": lambda frame: frame.point.dl,
    "ddl": lambda frame: frame.point.ddl,
    "curvature": lambda frame: frame.kappa,
    "station": lambda frame: frame.advance,
    "time": lambda frame: frame.time,
    "velocity": lambda frame: frame.point.v,
    "speed_limit": lambda frame: frame.path.speed_limit,
    "acceleration": lambda frame: frame.point.a,
    "jerk": lambda frame: frame.point.j,
    "lateral_acceleration": lambda frame: frame.point.v**2 * frame.kappa,
    "collision_distance": _collision_distance,
    "collision": lambda frame: (_collision_distance(frame) < 0.0).astype(jnp.float32),
    "follow_distance": _of_nearest("follow", "distance"),
    "follow_speed": _of_nearest("follow", "speed"),
    "overtake_distance": _of_nearest("overtake", "distance"),
    "overtake_speed": _of_nearest("overtake", "speed"),
    "stop_distance": _of_nearest("stop", "distance"),
    "stop_speed": _of_nearest("stop", "speed"),
    "virtual_distance": _of_nearest("virtual", "distance"),
    "virtual_speed": _of_nearest("virtual", "speed"),
    "nudge_distance": _nudge_distance,
    "nudge_lateral": _of_nearest("nudge", "distance"),
    "nudge_speed": _of_nearest("nudge", "speed"),
    "sidepass_front_distance": _of_nearest("sidepass_front", "distance"),
    "sidepass_front_speed": _of_nearest("sidepass_front", "speed"),
    "sidepass_rear_distance": _of_nearest("sidepass_rear", "distance"),
    "sidepass_rear_speed": _of_nearest("sidepass_rear", "speed"),
}

# features that candidates of a scene do not share at t = 0: they say how a candidate
# begins, not where (`FeatureMap.context` leaves them out)
OF_CANDIDATE_AT_START = frozenset({"acceleration", "jerk"})
