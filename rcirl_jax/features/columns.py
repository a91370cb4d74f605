"""The feature map F, one pure function per feature: (frame of points) -> column.

Runs on numpy and on JAX: `namespace` says whose arrays it was given. It imports numpy
and `units.py` alone, so that a planner may copy both, with
`export/own_planner/features.py`, and compute F without JAX.

`COLUMNS` maps the name used in data_specs/features/*.toml to the function that
computes it. To add a feature: write a function here, name it there. The
functions are elementwise, so a Frame whose leaves carry further axes gives a
column with these axes.

Everything is geometry in the Frenet frame of the scene: the ego's box and the
obstacles' boxes are axis-aligned there (headings relative to the reference
line are small; the obstacle's own tilt is already in its extents). Source of
the classes: the paper's Table I and Apollo's per-point rule (stop test and
time axis corrected).

Three rules make this fast where it counts, on [T, K] grids of candidates:

* whatever depends on obstacle and time alone is folded into the obstacle
  first (`slots`): its box grows by the ego's half extents, so the ego becomes
  a point, and what cannot be met moves to infinity, so masks disappear;
* the loop over obstacles is unrolled, so XLA runs through one fused
  elementwise loop per result; reductions over an obstacle axis cost 3 times
  as much on a CPU;
* where the nearest of a class stands is found first, its speed second, by that
  place: carrying both through one pass takes three times the instructions.

A lookup on the path costs a gather of two neighbours, and a CPU pays for every number
that it gathers. What is read together stands in one table; XLA drops an
unused table.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

try:
    from rcirl_jax import units
except ImportError:  # both files were copied
    import units  # pyright: ignore[reportMissingImports]

Array = Any  # of numpy, or of JAX
# of rcirl_jax.types, or plain ones with the same fields
Scene = Any
Ego = Any
Obstacles = Any
Trajectory = Any
DT_S, Kind = units.DT_S, units.Kind


def namespace(*arrays: Array) -> Any:  # noqa: ANN401
    """Return numpy where all arrays are numpy's, else jax.numpy."""
    numpy = np.ndarray | np.generic | float
    others = (x for x in arrays if not isinstance(x, numpy))
    other = next(others, None)
    return np if other is None else other.__array_namespace__()


SLOPE_POINTS = 3  # grid points on each side for dl/ds: 6 m, about a car's length


class PathView(NamedTuple):
    """The path at the stations of one trajectory; all [T]."""

    l: Array  # m, lateral offset of the given path
    dl: Array  # 1, its slope by station
    ddl: Array  # 1/m, its second derivative
    kappa: Array  # 1/m, curvature of the reference line
    dkappa: Array  # 1/m^2, its slope
    speed_limit: Array  # m/s
    road_left: Array  # m, lateral offset of the drivable area's left edge
    road_right: Array  # m, of its right edge

    def curvature(self, trajectory: Trajectory) -> Array:
        """Curvature 1/m of the path that the trajectory drives; any equal shape."""
        l, dl, ddl = trajectory.l, trajectory.dl, trajectory.ddl
        return path_curvature(self.kappa, self.dkappa, l, dl, ddl)


def path_curvature(
    kappa: Array, dkappa: Array, l: Array, dl: Array, ddl: Array
) -> Array:
    """Curvature 1/m of a path given in Frenet coordinates (Werling 2010, app. I).

    tan(d) = dl / (1 - kappa l)
    kappa_x = [ (ddl + (dkappa l + kappa dl) tan d) cos^2 d / (1 - kappa l)
                + kappa ] cos d / (1 - kappa l)
    """
    xp = namespace(kappa, l)
    shrink = xp.maximum(1.0 - kappa * l, 0.1)
    tangent = dl / shrink
    cosine = 1.0 / xp.sqrt(1.0 + tangent**2)
    inner = (ddl + (dkappa * l + kappa * dl) * tangent) * cosine**2 / shrink
    return (inner + kappa) * cosine / shrink


def table_slope(table: Array, points: int) -> Array:
    """Central difference [P] over `points` grid points on each side, by station."""
    xp = namespace(table)
    first, last = (xp.broadcast_to(table[i], (points,)) for i in (0, -1))
    padded = xp.concatenate([first, table, last])
    return (padded[2 * points :] - padded[: -2 * points]) / (
        2.0 * points * units.STATION_STEP_M
    )


def path_view(scene: Scene, s: Array) -> PathView:
    """The path at stations s m; linear between grid points, held at the ends."""
    path = scene.path
    xp = namespace(s, path.l)
    dl = table_slope(path.l, SLOPE_POINTS)
    position = xp.clip(s / units.STATION_STEP_M, 0.0, path.l.shape[0] - 1.0)
    low = xp.minimum(position.astype(xp.int32), path.l.shape[0] - 2)
    share = position - low.astype(xp.float32)

    def at(*columns: Array) -> Array:
        table = xp.stack(columns)
        rise = xp.pad(table[:, 1:] - table[:, :-1], ((0, 0), (0, 1)))
        table = xp.concatenate([table, rise])
        if xp is np:
            start, slope = np.split(np.take(table, low, axis=1), 2)
        else:  # plain indexing masks what lies outside, as slow as the gather
            found = table.at[:, low].get(mode="promise_in_bounds")
            start, slope = xp.split(found, 2)
        return start + share * slope

    l, dl_at, ddl = at(path.l, dl, table_slope(dl, SLOPE_POINTS))
    kappa, dkappa = at(path.kappa, table_slope(path.kappa, 1))
    (limit,) = at(path.speed_limit)
    road_left, road_right = at(path.road_left, path.road_right)
    return PathView(l, dl_at, ddl, kappa, dkappa, limit, road_left, road_right)


FIRST = np.arange(units.NUM_TIMES) == 0  # [T]
MIN_ADVANCE_M = 1.0  # m between neighbours below which dl/ds is taken as 0


def differentiate(
    s: Array, v0: Array, a0: Array, time_valid: Array
) -> tuple[Array, Array, Array]:
    """Return speed, acceleration and jerk of stations on the time axis.

        v_i = (s_{i+1} - s_{i-1}) / 2dt        v_0, a_0 given (the ego's state)
        a_i = (s_{i+1} - 2 s_i + s_{i-1}) / dt^2
        j_i = (a_i - a_{i-1}) / dt             j_0 = j_1

    At the last valid time there is no next point: a is carried over and v
    follows from it. Because the mask is shared by all trajectories of a scene,
    the operator is the same for all of them.

    Args:
      s: [..., T] m.
      v0: m/s at t = 0.
      a0: m/s^2 at t = 0.
      time_valid: [T] bool, a prefix of True with at least 3 entries.

    Returns:
      v m/s, a m/s^2, j m/s^3, all [..., T]. Beyond the last valid time they are
      finite and meaningless.
    """
    xp = namespace(s, time_valid)
    behind, ahead = _neighbours(s)
    has_next = xp.concatenate([time_valid[1:], xp.zeros_like(time_valid[:1])])
    central_a = xp.where(FIRST, a0, (ahead - 2.0 * s + behind) / DT_S**2)
    carried_a, _ = _neighbours(central_a)
    a = xp.where(has_next, central_a, carried_a)
    v = xp.where(
        has_next, (ahead - behind) / (2.0 * DT_S), (s - behind) / DT_S + 0.5 * a * DT_S
    )
    v = xp.where(FIRST, v0, v)
    step = (a[..., 1:] - a[..., :-1]) / DT_S
    return v, a, xp.concatenate([step[..., :1], step], axis=-1)


def lateral_derivatives(
    s: Array, l: Array, dl0: Array, ddl0: Array
) -> tuple[Array, Array]:
    """Return dl/ds and d2l/ds2 by divided differences over the neighbouring times.

    Where the car advances less than `MIN_ADVANCE_M` between the neighbours the
    derivative by station is not defined by positions and is set to 0.

    Args:
      s: [..., T] m.
      l: [..., T] m.
      dl0: dl/ds at t = 0.
      ddl0: 1/m, at t = 0.

    Returns:
      dl (1) and ddl (1/m), [..., T].
    """
    xp = namespace(s, l)
    advance = _spread(s)
    moves = advance > MIN_ADVANCE_M
    safe = xp.where(moves, advance, 1.0)
    dl = xp.where(FIRST, dl0, xp.where(moves, _spread(l) / safe, 0.0))
    ddl = xp.where(FIRST, ddl0, xp.where(moves, _spread(dl) / safe, 0.0))
    return dl, ddl


def _neighbours(x: Array) -> tuple[Array, Array]:
    """x_{i-1} and x_{i+1}; at the ends the end itself."""
    padded = namespace(x).concatenate([x[..., :1], x, x[..., -1:]], axis=-1)
    return padded[..., :-2], padded[..., 2:]


def _spread(x: Array) -> Array:
    """x_{i+1} - x_{i-1}, one-sided at both ends."""
    behind, ahead = _neighbours(x)
    return ahead - behind


LATERAL_BUFFER_M = 0.2  # m added to the half widths; half of Apollo's 0.4 m
NUDGE_RANGE_M = 3.0  # m, lateral gap beyond which Apollo's path decider ignores
OBSTACLE_CAP_M = 100.0  # m, Apollo: follow, overtake, side-pass "none" distance
LINE_CAP_M = 60.0  # m, Apollo: stop, virtual and nudge "none" distance
LATERAL_CAP_M = 10.0  # m, Apollo: lateral "none" distance
FAR_M = 1e6  # m, "no such obstacle"


class Nearest(NamedTuple):
    """The nearest member of a class; (cap, 0) where none is nearer than the cap."""

    distance: Array  # m, in [0, cap]
    speed: Array  # m/s, obstacle minus ego


class Relations(NamedTuple):
    """One point against all obstacles; all scalars."""

    follow: Nearest  # in the way and ahead
    overtake: Nearest  # in the way and behind
    nudge: Nearest  # beside, abreast; distance is the lateral gap
    sidepass_front: Nearest  # beside, ahead
    sidepass_rear: Nearest  # beside, behind
    stop: Nearest  # a line ahead that demands a stop
    virtual: Nearest  # the destination ahead
    body: Array  # m, signed distance to the closest body; < 0 penetration
    line_overrun: Array  # m, how far a demanding line was just crossed


class Slot(NamedTuple):
    """One obstacle at one time, grown by the ego's half extents; scalars."""

    lower: Array  # m, the ego's centre is behind it below; FAR_M: no body
    upper: Array  # m, and past it above; -FAR_M: no body
    right: Array  # m, the ego's side clears it on the right below
    left: Array  # m, and on the left above
    speed: Array  # m/s along the road
    wall: Array  # m, the same for a line that demands a stop; FAR_M: none
    wall_before: Array  # m, a time earlier; -FAR_M: did not demand one
    end: Array  # m, the same for the destination; FAR_M: none


def slots(ego: Ego, obstacles: Obstacles) -> tuple[Slot, ...]:
    """The N obstacles as Slots with leaves [T]."""
    xp = namespace(obstacles.s_lower, ego.length)
    half_length, half_width = 0.5 * ego.length, 0.5 * ego.width
    kind = obstacles.kind[:, None]
    body = obstacles.valid & (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
    line = obstacles.valid & (kind == Kind.STOP)
    end = obstacles.valid & (kind == Kind.VIRTUAL)
    lower = obstacles.s_lower - half_length
    upper, left = obstacles.s_upper + half_length, obstacles.l_upper + half_width
    # a body that lacks a number has no place: the distance to bodies is NaN then
    numbers = lower + upper + obstacles.l_lower + left + obstacles.speed
    lacking = body & ~xp.isfinite(numbers)
    demanded = xp.where(line, lower, -FAR_M)
    before = xp.concatenate(
        [xp.where(line[:, :1], FAR_M, -FAR_M), demanded[:, :-1]], axis=1
    )
    leaves = (
        xp.where(body, lower, FAR_M),
        xp.where(body, xp.where(lacking, xp.nan, upper), -FAR_M),
        obstacles.l_lower - half_width,
        xp.where(lacking, xp.nan, left),
        obstacles.speed,
        xp.where(line, lower, FAR_M),
        before,
        xp.where(end, lower, FAR_M),
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


def _larger(a: Array | float, b: Array) -> Array:
    """Return the larger; NaN where b is. XLA compares once, `maximum` four times."""
    return np.maximum(a, b) if namespace(b) is np else namespace(b).where(a > b, a, b)


def _smaller(a: Array, b: Array) -> Array:
    """Return the smaller, as `_larger`."""
    return np.minimum(a, b) if namespace(b) is np else namespace(b).where(a < b, a, b)


def _gaps(o: Slot, s: Array, l: Array) -> tuple[Array, Array]:
    """(gap, lateral gap) m; negative where they overlap."""
    return _larger(o.lower - s, s - o.upper), _larger(o.right - l, l - o.left)


def _memberships(
    o: Slot, s: Array, gap: Array, aside: Array
) -> dict[str, tuple[Array, Array]]:
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
    met: list[dict[str, tuple[Array, Array]]],
    s: Array,
    v: Array,
) -> dict[str, Nearest]:
    """The nearest of each class; of two at the very same place the slower."""
    xp = namespace(s)
    from_ego = {"overtake": -s, "sidepass_rear": -s, "nudge": xp.zeros_like(s)}
    found = {}
    for name, cap in CAPS_M.items():
        members = [
            (*classes[name], o.speed) for o, classes in zip(ego_slots, met, strict=True)
        ]
        if xp is np:  # XLA cannot see, numpy can, that an obstacle is in few classes
            members = [x for x in members if (x[0] & (x[1] < FAR_M)).any()]
        edge = speed = xp.full_like(s, FAR_M)
        for member, key, _ in members:
            key = xp.where(member, key, FAR_M)
            edge = _smaller(edge, key)  # no member's is NaN
        for member, key, its_speed in members:
            slower = member & (key == edge) & (its_speed < speed)
            speed = xp.where(slower, its_speed, speed)
        distance = edge - from_ego.get(name, s)
        known = distance < cap
        # none is found where compiled code rounds a key differently in each loop
        unknown = ~known | (speed >= FAR_M)
        found[name] = Nearest(
            distance=xp.where(known, distance, cap),
            speed=xp.where(unknown, 0.0, speed - v),
        )
    return found


def relate(
    ego_slots: tuple[Slot, ...],
    s: Array,
    l: Array,
    v: Array,
    s_before: Array,
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
    xp = namespace(s)
    signed, overrun = xp.full_like(s, FAR_M**2), xp.zeros_like(s)
    met = []
    for o in ego_slots:
        gap, aside = _gaps(o, s, l)
        met.append(_memberships(o, s, gap, aside))
        square = _larger(0.0, gap) ** 2 + _larger(0.0, aside) ** 2
        depth = xp.maximum(gap, aside)
        # NaN of one body stays: a comparison would forget it at the next
        signed = xp.minimum(signed, xp.where(depth < 0.0, depth, square))
        crossed = (s > o.wall) & (s_before <= o.wall_before)
        overrun = xp.where(crossed, xp.maximum(overrun, s - o.wall), overrun)
    outside = xp.sqrt(xp.where(signed > 0.0, signed, 1.0))
    return Relations(
        **_nearest(ego_slots, met, s, v),
        body=xp.where(signed > 0.0, outside, signed),
        line_overrun=overrun,
    )


MIN_COLLISION_M = -10.0  # m, largest penetration reported
BEFORE_M = 1e6  # m, how far back the ego is taken to be before the first time


class Frame(NamedTuple):
    """The inputs of the columns at one point; all leaves scalars."""

    time: Array  # s
    advance: Array  # m, station since t = 0
    point: Trajectory  # leaves [] instead of [T]
    relations: Relations
    path: PathView
    kappa: Array  # 1/m, curvature of the path driven


def driven_curvature(scene: Scene, trajectory: Trajectory) -> Array:
    """Curvature [T] 1/m of the path driven: reference line plus lateral motion."""
    return path_view(scene, trajectory.s).curvature(trajectory)


def _collision_distance(frame: Frame) -> Array:
    overrun, signed = frame.relations.line_overrun, frame.relations.body
    xp = namespace(signed)
    signed = xp.where(overrun > 0.0, xp.minimum(signed, -overrun), signed)
    return xp.clip(signed, MIN_COLLISION_M, OBSTACLE_CAP_M)


def _of_nearest(name: str, attribute: str) -> Callable[[Frame], Array]:
    """Distance or relative speed of the nearest of a class."""

    def column(frame: Frame) -> Array:
        nearest: Nearest = getattr(frame.relations, name)
        return getattr(nearest, attribute)

    return column


def _nudge_distance(frame: Frame) -> Array:
    """Along the road: 0 while something is abreast, the cap otherwise."""
    abreast = frame.relations.nudge.distance < LATERAL_CAP_M
    return namespace(abreast).where(abreast, 0.0, LINE_CAP_M)


COLUMNS: dict[str, Callable[[Frame], Array]] = {
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
    "collision": lambda frame: (_collision_distance(frame) < 0.0).astype("float32"),
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
