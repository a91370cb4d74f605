"""The feature map F from plain numbers. Needs numpy only.

This one file may be copied into a planner's repository, beside `reader.py`. It
computes what `rcirl_jax.features` computes, within 1e-5; docs/own_planner.md describes
the structs and docs/features.md every column.

    scene = Scene(ego=Ego(...), path=Path(...), obstacles=[Obstacle(...), ...])
    columns = FeatureMap(reward.names, reward.units)
    values = reward.value(columns(scene, s, l), scene.time_valid)   # s, l [K, T] m

Everything is in the scene's Frenet frame, SI units and radians: station `s` along the
reference line, 0 at the ego's centre now; lateral offset `l` from it, left positive;
`dl` and `ddl` are derivatives of `l` by station. Axes: `T` = 18 times, `P` = 128
points of the station grid, `K` candidates, `F` features.
"""

import dataclasses
import enum
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import numpy as np

NUM_TIMES = 18  # T
HORIZON_S = 8.0  # s
DT_S = HORIZON_S / (NUM_TIMES - 1)  # s, 0.470588
TIMES_S = np.linspace(0.0, HORIZON_S, NUM_TIMES).astype(np.float32)  # [T] s
NUM_STATIONS = 128  # P
STATION_STEP_M = 2.0  # m between points of the station grid

LATERAL_BUFFER_M = 0.2  # m of lateral gap below which an obstacle is in the way
NUDGE_RANGE_M = 3.0  # m of lateral gap beyond which it is ignored
OBSTACLE_CAP_M = 100.0  # m, "none" of follow, overtake, side-pass and collision
LINE_CAP_M = 60.0  # m, "none" of stop, virtual and nudge
LATERAL_CAP_M = 10.0  # m, lateral "none"
MIN_COLLISION_M = -10.0  # m, deepest penetration told apart
FAR_M = np.float32(1e6)  # m, "no such obstacle"
MIN_ADVANCE_M = 1.0  # m between neighbours below which dl/ds is taken as 0
SLOPE_POINTS = 3  # grid points on each side for the slope of the given path
MIN_SHRINK = 0.1  # 1, least value of 1 - kappa l

Array = np.ndarray  # float32 unless said otherwise


class FeatureError(ValueError):
    """A scene, candidate or column is wrong. One line."""


class Kind(enum.IntEnum):
    """What an obstacle is."""

    NONE = 0  # an empty slot
    VEHICLE = 1
    CYCLIST = 2
    PEDESTRIAN = 3
    STATIC = 4  # a standing object that never moves
    STOP = 5  # a stop line or a red light; valid only while it demands a stop
    VIRTUAL = 6  # the destination of the route


# ---------------------------------------------------------------- the plain structs


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ego:
    """The controlled car now."""

    s: float = 0.0  # m, station of the centre
    l: float = 0.0  # m, lateral offset of the centre
    dl: float = 0.0  # 1, dl/ds
    ddl: float = 0.0  # 1/m, d2l/ds2
    v: float  # m/s along the reference line
    a: float = 0.0  # m/s^2 along the reference line
    length: float  # m
    width: float  # m


@dataclasses.dataclass(frozen=True, kw_only=True)
class Path:
    """The reference line and the given path; point p lies at station 2 p m."""

    kappa: Array  # [P] 1/m, curvature of the reference line, left positive
    l: Array  # [P] m, lateral offset of the given path
    # [P] m/s, that the planner may drive: posted, for curves, braking for both
    speed_limit: Array


@dataclasses.dataclass(frozen=True, kw_only=True)
class Obstacle:
    """One obstacle as a box along the road at every time; a line is a thin box."""

    kind: int  # `Kind`
    s_lower: Array  # [T] m, station of the rear end
    s_upper: Array  # [T] m, station of the front end
    l_lower: Array  # [T] m, lateral offset of the right side
    l_upper: Array  # [T] m, lateral offset of the left side
    speed: Array  # [T] m/s along the reference line, signed
    valid: Array  # [T] bool, there at that time (STOP: demands a stop)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene:
    """One planning frame: all that a candidate is judged against."""

    ego: Ego
    path: Path
    obstacles: Sequence[Obstacle] = ()  # in any order, as many as there are
    num_valid: int = NUM_TIMES  # times that count, from the first; online all of them

    @property
    def time_valid(self) -> Array:
        """[T] bool, the times that count."""
        return np.arange(NUM_TIMES) < self.num_valid


def checked(scene: Scene) -> Scene:
    """The scene with float32 arrays of the right shapes.

    Raises:
      FeatureError: a number is missing, not finite or out of range.
    """
    ego = {f.name: getattr(scene.ego, f.name) for f in dataclasses.fields(Ego)}
    ego = {name: _numbers(f"ego.{name}", value, ()) for name, value in ego.items()}
    for name in ("length", "width"):
        if not ego[name] > 0.0:
            _fail(f"ego.{name}", ego[name], "over 0 m")
    names = [f.name for f in dataclasses.fields(Path)]
    path = {
        name: _numbers(f"path.{name}", getattr(scene.path, name), (NUM_STATIONS,))
        for name in names
    }
    _every("path.speed_limit", path["speed_limit"], path["speed_limit"] >= 0, ">= 0")
    if not 1 <= scene.num_valid <= NUM_TIMES:
        _fail("num_valid", scene.num_valid, f"1 to {NUM_TIMES}")
    boxes = [_box(f"obstacles[{n}]", box) for n, box in enumerate(scene.obstacles)]
    return Scene(
        ego=Ego(**ego), path=Path(**path), obstacles=boxes, num_valid=scene.num_valid
    )


def _box(field: str, box: Obstacle) -> Obstacle:
    """One obstacle, checked; numbers at times when it is not there become 0."""
    if box.kind not in set(Kind):
        _fail(f"{field}.kind", box.kind, f"0 to {max(Kind):d}")
    valid = _numbers(f"{field}.valid", box.valid, (NUM_TIMES,)) != 0.0
    leaves = {}
    for name in ("s_lower", "s_upper", "l_lower", "l_upper", "speed"):
        try:
            given = np.where(valid, getattr(box, name), 0.0)
        except (TypeError, ValueError):
            given = getattr(box, name)
        leaves[name] = _numbers(f"{field}.{name}", given, (NUM_TIMES,))
    for axis in ("s", "l"):
        low, high = leaves[f"{axis}_lower"], leaves[f"{axis}_upper"]
        _every(f"{field}.{axis}_lower", low, low <= high, f"at most {axis}_upper")
    return Obstacle(kind=int(box.kind), valid=valid, **leaves)


def _numbers(field: str, given: Any, shape: tuple[int, ...]) -> Any:  # noqa: ANN401
    """Finite float32 numbers of a shape."""
    try:
        with np.errstate(over="ignore"):
            array = np.asarray(given).astype(np.float32, casting="unsafe")
    except (TypeError, ValueError):
        _fail(field, given, "numbers")
    if array.shape != shape:
        _fail(field, f"shape {array.shape}", f"shape {shape}")
    _every(field, array, np.isfinite(array), "finite numbers")
    return array


def _every(field: str, values: Array, good: Array, expected: str) -> None:
    if not np.all(good):
        at = np.argwhere(~np.asarray(good))[0].tolist()
        _fail(f"{field}{at if at else ''}", values[tuple(at)], expected)


def _fail(field: str, value: object, expected: str) -> NoReturn:
    raise FeatureError(f"scene: {field}: {str(value)[:80]}: expected {expected}")


# ------------------------------------------------------------------------- the path


@dataclasses.dataclass(frozen=True, kw_only=True)
class PathView:
    """The path at the stations of candidates; all [K, T]."""

    l: Array  # m, lateral offset of the given path
    dl: Array  # 1, its slope by station
    ddl: Array  # 1/m, its second derivative
    kappa: Array  # 1/m, curvature of the reference line
    dkappa: Array  # 1/m^2, its slope
    speed_limit: Array  # m/s


def table_slope(table: Array, points: int) -> Array:
    """Slope [P] by station: difference over `points` grid points on each side."""
    padded = np.pad(table, points, mode="edge")
    return (padded[2 * points :] - padded[: -2 * points]) / np.float32(
        2.0 * points * STATION_STEP_M
    )


def path_view(path: Path, s: Array) -> PathView:
    """The path at stations s: linear between grid points, held at both ends."""
    dl = table_slope(path.l, SLOPE_POINTS)
    tables = {
        "l": path.l,
        "dl": dl,
        "ddl": table_slope(dl, SLOPE_POINTS),
        "kappa": path.kappa,
        "dkappa": table_slope(path.kappa, 1),
        "speed_limit": path.speed_limit,
    }
    position = np.clip(s / np.float32(STATION_STEP_M), 0.0, NUM_STATIONS - 1.0)
    low = np.minimum(position.astype(np.int32), NUM_STATIONS - 2)
    share = position - low.astype(np.float32)
    at = {
        name: table[low] + share * (table[low + 1] - table[low])
        for name, table in tables.items()
    }
    return PathView(**at)


def driven_curvature(view: PathView, l: Array, dl: Array, ddl: Array) -> Array:
    """Curvature 1/m of the path driven (Werling 2010, app. I); see docs/features.md."""
    shrink = np.maximum(1.0 - view.kappa * l, np.float32(MIN_SHRINK))
    tangent = dl / shrink
    cosine = 1.0 / np.sqrt(1.0 + tangent**2)
    inner = (ddl + (view.dkappa * l + view.kappa * dl) * tangent) * cosine**2 / shrink
    return (inner + view.kappa) * cosine / shrink


# ----------------------------------------------------------------------- the motion


@dataclasses.dataclass(frozen=True, kw_only=True)
class Motion:
    """Candidates with the derivatives that F reads; all [K, T]."""

    s: Array  # m
    v: Array  # m/s
    a: Array  # m/s^2
    j: Array  # m/s^3
    l: Array  # m
    dl: Array  # 1
    ddl: Array  # 1/m


def motion(scene: Scene, view: PathView, s: Array, l: Array | None) -> Motion:
    """Derivatives of positions, made as in training; l None: on the given path.

    On the path, l, dl and ddl are the path's at the station (dl and ddl the ego's at
    the first time); otherwise they are differences of the positions.
    """
    ego = scene.ego
    v, a, j = by_time(s, ego.v, ego.a, scene.time_valid)
    if l is None:
        l, dl, ddl = view.l, view.dl.copy(), view.ddl.copy()
    else:
        dl = by_station(s, l)
        dl[:, 0] = ego.dl
        ddl = by_station(s, dl)
    dl[:, 0], ddl[:, 0] = ego.dl, ego.ddl
    return Motion(s=s, v=v, a=a, j=j, l=l, dl=dl, ddl=ddl)


def by_time(s: Array, v0: float, a0: float, valid: Array) -> tuple[Array, Array, Array]:
    """Speed, acceleration and jerk [K, T] of stations.

        v_i = (s_{i+1} - s_{i-1}) / 2dt        v_0, a_0: the ego's
        a_i = (s_{i+1} - 2 s_i + s_{i-1}) / dt^2
        j_i = (a_i - a_{i-1}) / dt             j_0 = j_1

    At the last valid time there is no next point: a is carried over and
    v = (s_i - s_{i-1}) / dt + a dt / 2.
    """
    ahead, behind = _neighbours(s)
    has_next = np.append(valid[1:], False)
    a = (ahead - 2.0 * s + behind) / np.float32(DT_S**2)
    a[:, 0] = a0
    a = np.where(has_next, a, np.concatenate([a[:, :1], a[:, :-1]], axis=1))
    last = (s - behind) / np.float32(DT_S) + np.float32(0.5 * DT_S) * a
    v = np.where(has_next, (ahead - behind) / np.float32(2.0 * DT_S), last)
    v[:, 0] = v0
    step = (a[:, 1:] - a[:, :-1]) / np.float32(DT_S)
    return v, a, np.concatenate([step[:, :1], step], axis=1)


def by_station(s: Array, x: Array) -> Array:
    """dx/ds [K, T] over the neighbouring times; 0 where the car advances <= 1 m."""
    advance, change = (np.subtract(*_neighbours(y)) for y in (s, x))
    moves = advance > MIN_ADVANCE_M
    return np.where(moves, change / np.where(moves, advance, 1.0), 0.0)


def _neighbours(x: Array) -> tuple[Array, Array]:
    """The values at the next and the previous time [K, T]; the same at the ends."""
    ahead = np.concatenate([x[:, 1:], x[:, -1:]], axis=1)
    return ahead, np.concatenate([x[:, :1], x[:, :-1]], axis=1)


# -------------------------------------------------------------------- the obstacles


class Nearest:
    """The nearest member of a class so far: its key and speed; all [K, T]."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.key = np.full(shape, FAR_M, np.float32)
        self.speed = np.zeros(shape, np.float32)

    def meet(self, member: Array, key: Array, speed: Array) -> None:
        """Of two at the very same key the slower counts: order does not matter."""
        key = np.where(member, key, FAR_M)
        wins = (key < self.key) | ((key == self.key) & (speed < self.speed))
        self.key = np.minimum(key, self.key)
        self.speed = np.where(wins, speed, self.speed)

    def at(self, offset: Array | float, v: Array, cap: float) -> tuple[Array, Array]:
        """(distance, speed minus the ego's); (cap, 0) where none is nearer."""
        distance = self.key - offset
        known = distance < cap
        return (
            np.where(known, distance, np.float32(cap)),
            np.where(known, self.speed - v, np.float32(0.0)),
        )


def relations(scene: Scene, x: Motion) -> dict[str, Array]:
    """Distances and relative speeds of all classes, by column name; all [K, T].

        gap         = max(s_lower - (s + L/2), (s - L/2) - s_upper)
        lateral gap = max(l_lower - (l + W/2), (l - W/2) - l_upper)

    Boxes grow by the ego's half extents, so that the ego becomes a point.
    """
    s, v = x.s, x.v
    names = ("follow", "overtake", "nudge", "front", "rear", "stop", "virtual")
    near = {name: Nearest(s.shape) for name in names}
    signed, overrun = np.full(s.shape, FAR_M**2), np.zeros(s.shape, np.float32)
    for box in scene.obstacles:
        lower = box.s_lower - np.float32(0.5) * scene.ego.length
        if box.kind == Kind.STOP:
            near["stop"].meet(box.valid & (s <= lower), lower, box.speed)
            overrun = np.maximum(overrun, _overrun(s, lower, box.valid))
        elif box.kind == Kind.VIRTUAL:
            near["virtual"].meet(box.valid & (s <= lower), lower, box.speed)
        elif box.kind != Kind.NONE:
            signed = np.minimum(signed, _meet_body(near, scene.ego, box, x))
    signed = np.where(signed > 0.0, np.sqrt(np.maximum(signed, 0.0)), signed)
    signed = np.where(overrun > 0.0, np.minimum(signed, -overrun), signed)
    collision = np.clip(signed, np.float32(MIN_COLLISION_M), np.float32(OBSTACLE_CAP_M))
    found: dict[str, Array] = {"collision_distance": collision}
    for name, column, offset, cap in (
        ("follow", "follow", s, OBSTACLE_CAP_M),
        ("overtake", "overtake", -s, OBSTACLE_CAP_M),
        ("front", "sidepass_front", s, OBSTACLE_CAP_M),
        ("rear", "sidepass_rear", -s, OBSTACLE_CAP_M),
        ("stop", "stop", s, LINE_CAP_M),
        ("virtual", "virtual", s, LINE_CAP_M),
    ):
        distance, speed = near[name].at(offset, v, cap)
        found[f"{column}_distance"], found[f"{column}_speed"] = distance, speed
    found["nudge_lateral"], found["nudge_speed"] = near["nudge"].at(
        0.0, v, LATERAL_CAP_M
    )
    return found


def _meet_body(near: dict[str, Nearest], ego: Ego, box: Obstacle, x: Motion) -> Array:
    """Puts a body into its class; its distance squared, or minus its depth, [K, T]."""
    half_length, half_width = (np.float32(0.5) * y for y in (ego.length, ego.width))
    lower, upper = box.s_lower - half_length, box.s_upper + half_length
    right, left = box.l_lower - half_width, box.l_upper + half_width
    aside = np.maximum(right - x.l, x.l - left)
    gap = np.maximum(lower - x.s, x.s - upper)
    in_way = box.valid & (aside < np.float32(LATERAL_BUFFER_M))
    beside = box.valid & ~in_way & (aside < NUDGE_RANGE_M)
    ahead, behind = x.s <= lower, x.s >= upper
    near["follow"].meet(in_way & ahead, lower, box.speed)
    near["overtake"].meet(in_way & behind, -upper, box.speed)
    near["front"].meet(beside & ahead, lower, box.speed)
    near["rear"].meet(beside & behind, -upper, box.speed)
    near["nudge"].meet(beside & (gap < 0.0), aside, box.speed)
    depth = np.maximum(gap, aside)
    square = np.maximum(gap, 0.0) ** 2 + np.maximum(aside, 0.0) ** 2
    return np.where(box.valid, np.where(depth < 0.0, depth, square), FAR_M**2)


def _overrun(s: Array, wall: Array, valid: Array) -> Array:
    """How far [K, T] m a line was just crossed: 0 unless the front was not beyond it.

    At the first time every line that demands a stop behind the front counts.
    """
    before = np.concatenate([np.full_like(s[:, :1], -FAR_M), s[:, :-1]], axis=1)
    demanded = np.append(FAR_M if valid[0] else -FAR_M, np.where(valid, wall, -FAR_M))
    crossed = valid & (s > wall) & (before <= demanded[:-1])
    return np.where(crossed, s - wall, np.float32(0.0))


# ---------------------------------------------------------------------- the columns


@dataclasses.dataclass(frozen=True, kw_only=True)
class Frame:
    """What the columns read; arrays [K, T]."""

    scene: Scene
    x: Motion
    view: PathView
    kappa: Array  # 1/m, curvature of the path driven
    near: dict[str, Array]  # of `relations`


def _related(name: str) -> Callable[[Frame], Array]:
    return lambda frame: frame.near[name]


def _nudge_distance(frame: Frame) -> Array:
    """Along the road: 0 while something is abreast, the cap otherwise."""
    abreast = frame.near["nudge_lateral"] < LATERAL_CAP_M
    return np.where(abreast, np.float32(0.0), np.float32(LINE_CAP_M))


def _collision(frame: Frame) -> Array:
    return (frame.near["collision_distance"] < 0.0).astype(np.float32)


# name -> unit and column
COLUMNS: dict[str, tuple[str, Callable[[Frame], Array]]] = {
    "l": ("m", lambda frame: frame.x.l),
    "dl": ("1", lambda frame: frame.x.dl),
    "ddl": ("1/m", lambda frame: frame.x.ddl),
    "curvature": ("1/m", lambda frame: frame.kappa),
    "station": ("m", lambda frame: frame.x.s - frame.scene.ego.s),
    "time": ("s", lambda frame: np.broadcast_to(TIMES_S, frame.x.s.shape)),
    "velocity": ("m/s", lambda frame: frame.x.v),
    "speed_limit": ("m/s", lambda frame: frame.view.speed_limit),
    "acceleration": ("m/s^2", lambda frame: frame.x.a),
    "jerk": ("m/s^3", lambda frame: frame.x.j),
    "lateral_acceleration": ("m/s^2", lambda frame: frame.x.v**2 * frame.kappa),
    "collision_distance": ("m", _related("collision_distance")),
    "collision": ("1", _collision),
    "follow_distance": ("m", _related("follow_distance")),
    "follow_speed": ("m/s", _related("follow_speed")),
    "overtake_distance": ("m", _related("overtake_distance")),
    "overtake_speed": ("m/s", _related("overtake_speed")),
    "stop_distance": ("m", _related("stop_distance")),
    "stop_speed": ("m/s", _related("stop_speed")),
    "virtual_distance": ("m", _related("virtual_distance")),
    "virtual_speed": ("m/s", _related("virtual_speed")),
    "nudge_distance": ("m", _nudge_distance),
    "nudge_lateral": ("m", _related("nudge_lateral")),
    "nudge_speed": ("m/s", _related("nudge_speed")),
    "sidepass_front_distance": ("m", _related("sidepass_front_distance")),
    "sidepass_front_speed": ("m/s", _related("sidepass_front_speed")),
    "sidepass_rear_distance": ("m", _related("sidepass_rear_distance")),
    "sidepass_rear_speed": ("m/s", _related("sidepass_rear_speed")),
}


class FeatureMap:
    """F with the columns of a weights file, in its order."""

    def __init__(self, names: Sequence[str], units: Sequence[str]) -> None:
        if len(names) != len(units):
            _fail("units", f"{len(units)} units", f"{len(names)}, one for each name")
        for index, (name, unit) in enumerate(zip(names, units, strict=True)):
            if name not in COLUMNS:
                _fail(f"features[{index}]", name, f"one of {', '.join(COLUMNS)}")
            if unit != COLUMNS[name][0]:
                _fail(f"features[{index}]: {name}", unit, COLUMNS[name][0])
        self.names = tuple(names)

    def __call__(self, scene: Scene, s: Array, l: Array | None = None) -> Array:
        """F of K candidates in one scene, float32 [K, T, F], as `Reward.value` reads.

        Args:
          scene: one planning frame.
          s: [K, T] m, stations at `TIMES_S`.
          l: [K, T] m, lateral offsets; None: all drive along the given path.

        Raises:
          FeatureError: a number is missing, not finite or out of range.
        """
        scene, count = checked(scene), np.shape(s)[0] if np.ndim(s) else 0
        s = _numbers("candidates.s", s, (count, NUM_TIMES))
        if l is not None:
            l = _numbers("candidates.l", l, (count, NUM_TIMES))
        with np.errstate(over="ignore", invalid="ignore"):
            view = path_view(scene.path, s)
            x = motion(scene, view, s, l)
            kappa = driven_curvature(view, x.l, x.dl, x.ddl)
            frame = Frame(
                scene=scene, x=x, view=view, kappa=kappa, near=relations(scene, x)
            )
            columns = [COLUMNS[name][1](frame) for name in self.names]
        return np.stack(columns, axis=-1).astype(np.float32, copy=False)
