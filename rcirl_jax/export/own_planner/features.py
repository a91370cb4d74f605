"""The feature map F from plain numbers, float32. Needs numpy only.

This file, the package's own F (`rcirl_jax/features/columns.py`), the safety filter
(`rcirl_jax/planner/safety.py`), the constants (`rcirl_jax/units.py`) and `choose.py`
may be copied into a planner's repository, beside `reader.py`. docs/own_planner.md
describes the structs and docs/features.md every column.

    scene = Scene(ego=Ego(...), path=Path(...), obstacles=[Obstacle(...), ...])
    choice = choose(reward, scene, s, l)                            # s, l [K, T] m

`choose` filters what is unsafe; a value alone says nothing of it:

    columns = FeatureMap(reward.names, reward.units)
    values = reward.value(columns(scene, s, l), scene.time_valid)

Everything is in the scene's Frenet frame, SI units and radians: station `s` along the
reference line, 0 at the ego's centre now; lateral offset `l` from it, left positive;
`dl` and `ddl` are derivatives of `l` by station. Axes: `T` = 18 times, `P` = 128
points of the station grid, `K` candidates, `F` features.
"""

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple, NoReturn

import numpy as np

try:
    from rcirl_jax import units
    from rcirl_jax.features import columns as f
except ImportError:  # the files were copied
    import columns as f  # pyright: ignore[reportMissingImports]
    import units  # pyright: ignore[reportMissingImports]

Array = np.ndarray  # float32 unless said otherwise
HORIZON_S, NUM_TIMES, TIMES_S = units.HORIZON_S, units.NUM_TIMES, units.TIMES_S
STATION_STEP_M, NUM_STATIONS = units.STATION_STEP_M, units.NUM_STATIONS
Kind = units.Kind
FAR_M = 1e6  # m, where the road's edges are taken to be if they are not known
BOX = ("s_lower", "s_upper", "l_lower", "l_upper", "speed", "valid")  # [T] each

# unit of every column
NEAREST = ("follow", "overtake", "stop", "virtual", "sidepass_front", "sidepass_rear")
UNITS = {
    **dict.fromkeys(("l", "station", "collision_distance"), "m"),
    **dict.fromkeys(("nudge_distance", "nudge_lateral"), "m"),
    **{f"{name}_distance": "m" for name in NEAREST},
    **{f"{name}_speed": "m/s" for name in (*NEAREST, "nudge")},
    **dict.fromkeys(("velocity", "speed_limit"), "m/s"),
    **dict.fromkeys(("acceleration", "lateral_acceleration"), "m/s^2"),
    **{"jerk": "m/s^3", "time": "s", "dl": "1", "collision": "1"},
    **dict.fromkeys(("ddl", "curvature"), "1/m"),
}


class FeatureError(ValueError):
    """A scene, candidate or column is wrong. One line."""


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
    # [P] m, lateral offsets of the road's edges, for the filter alone; None: not known
    road_left: Array | None = None
    road_right: Array | None = None


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


_ZEROS = np.zeros(NUM_TIMES, np.float32)
NOTHING = Obstacle(
    kind=Kind.NONE,
    **dict.fromkeys(BOX[:-1], _ZEROS),
    valid=np.zeros(NUM_TIMES, bool),
)


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
    unknown = {"road_left": FAR_M, "road_right": -FAR_M}
    path = {}
    for name in (f.name for f in dataclasses.fields(Path)):
        given = getattr(scene.path, name)
        if given is None and name in unknown:
            given = np.full(NUM_STATIONS, unknown[name])
        path[name] = _numbers(f"path.{name}", given, (NUM_STATIONS,))
    _every("path.speed_limit", path["speed_limit"], path["speed_limit"] >= 0, ">= 0")
    left, right = path["road_left"], path["road_right"]
    _every("path.road_left", left, left >= right, "at least road_right")
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
    for name in BOX[:-1]:
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


class Driven(NamedTuple):
    """Candidates in their scene, checked."""

    scene: Any  # leaves as in `rcirl_jax.types`; of obstacles at least one, maybe empty
    motion: Any  # leaves s, v, a, j, l, dl, ddl [K, T]
    path: f.PathView  # at the candidates' stations [K, T]


def driven(scene: Scene, s: Array, l: Array | None = None) -> Driven:
    """Return candidates with their derivatives, in a scene of arrays.

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
    ego, boxes = scene.ego, scene.obstacles or [NOTHING]
    obstacles = SimpleNamespace(
        kind=np.array([box.kind for box in boxes]),
        **{n: np.array([getattr(box, n) for box in boxes]) for n in BOX},
    )
    plain = SimpleNamespace(ego=ego, path=scene.path, obstacles=obstacles)
    with np.errstate(over="ignore", invalid="ignore"):
        view = f.path_view(plain, s)
        v, a, j = f.differentiate(s, ego.v, ego.a, scene.time_valid)
        if l is None:
            l = view.l
            given = zip((ego.dl, ego.ddl), (view.dl, view.ddl), strict=True)
            dl, ddl = (np.where(f.FIRST, first, rest) for first, rest in given)
        else:
            dl, ddl = f.lateral_derivatives(s, l, ego.dl, ego.ddl)
    motion = SimpleNamespace(s=s, v=v, a=a, j=j, l=l, dl=dl, ddl=ddl)
    return Driven(plain, motion, view)


class FeatureMap:
    """F with the columns of a weights file, in its order."""

    def __init__(self, names: Sequence[str], units: Sequence[str]) -> None:
        if len(names) != len(units):
            _fail("units", f"{len(units)} units", f"{len(names)}, one for each name")
        for index, (name, unit) in enumerate(zip(names, units, strict=True)):
            if name not in UNITS:
                _fail(f"features[{index}]", name, f"one of {', '.join(UNITS)}")
            if unit != UNITS[name]:
                _fail(f"features[{index}]: {name}", unit, UNITS[name])
        self.names = tuple(names)

    def __call__(self, scene: Scene, s: Array, l: Array | None = None) -> Array:
        """Return F of K candidates in one scene, float32 [K, T, F], for `Reward.value`.

        Arguments and errors are those of `driven`.
        """
        return self.of(driven(scene, s, l))

    def of(self, given: Driven) -> Array:
        """Return F of candidates, float32 [K, T, F]."""
        plain, point, view = given
        s = point.s
        with np.errstate(over="ignore", invalid="ignore"):
            start = np.full_like(s[:, :1], -f.BEFORE_M)
            before = np.concatenate([start, s[:, :-1]], axis=1)
            frame = f.Frame(
                time=np.broadcast_to(TIMES_S, s.shape),
                advance=s - plain.ego.s,
                point=point,
                relations=f.relate(
                    f.slots(plain.ego, plain.obstacles), s, point.l, point.v, before
                ),
                path=view,
                kappa=view.curvature(point),
            )
            columns = [f.COLUMNS[name](frame) for name in self.names]
        return np.stack(columns, axis=-1).astype(np.float32, copy=False)
