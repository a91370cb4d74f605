"""Planning frames from what a car measures: metres, seconds, radians, Cartesian.

    scene = scene_from(
        ego=Car(x=3.0, y=0.2, heading=0.0, speed=12.0, length=4.9, width=2.1),
        centre_line=CentreLine(points=[[0, 0], [300, 0]], speed_limit=13.9),
        obstacles=[Body(x=40, y=0, heading=0.0, speed=8.0, length=4.5, width=1.8)],
        signals=[Signal(x=80, y=0, state="red")],
    )

The scene is what the simulator's observer makes of the same moment, so that a reward
reads what it learned from: the eight most relevant bodies with a future, the nearest
line that demands a stop, the destination. The frame: x and y of any one Cartesian
frame, heading counter-clockwise from its x axis. `plain_scene` makes the structs of
`features.py` of a scene. In C++: rcirl/scene_builder.hpp.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from rcirl_jax.export.own_planner import features
from rcirl_jax.export.own_planner.inputs import (
    BODY_KINDS,
    STATES,
    Body,
    Car,
    CentreLine,
    Signal,
    check,
    check_numbers,
    check_one_of,
    check_radians,
    floats,
    polyline,
    table,
)
from rcirl_jax.geometry.boxes import frenet_extent
from rcirl_jax.geometry.frenet import (
    ReferenceLine,
    project_points,
    reference_line_from_polyline,
)
from rcirl_jax.geometry.limits import LOOK_AHEAD_M, planning_limit
from rcirl_jax.planner.prediction import Bodies, most_relevant, obstacles_of
from rcirl_jax.simulation.agents import can_stop
from rcirl_jax.types import NUM_TAGS, Ego, Kind, Obstacles, Path, Scene
from rcirl_jax.units import (
    HORIZON_S,
    NUM_STATIONS,
    NUM_TIMES,
    STATION_STEP_M,
    TIMES_S,
)

BESIDE_M = 20.0  # m beside the centre line beyond which the ego is not on its road
STEEPEST = 1.2  # rad, tilt beyond which dl/ds grows no more
MIN_SHRINK = 0.1  # 1, least value of 1 - kappa l
GRID_BLOCK = 256  # points: grids are a multiple, so that few sizes compile
LONG_GRID_M = np.arange(
    0.0, (NUM_STATIONS - 1) * STATION_STEP_M + LOOK_AHEAD_M + 1e-6, STATION_STEP_M
)
# what plain scenes have of a path
PATH = ("kappa", "l", "speed_limit", "road_left", "road_right")


class Parts(flax.struct.PyTreeNode, kw_only=True):
    """One moment before the others' future is predicted; numpy."""

    ego: Ego
    path: Path
    bodies: Bodies
    wall: Any  # [] m, the nearest line that demands a stop; inf
    goal: Any  # [] m, where the front comes to rest; inf
    station: Any  # [] m, of the ego on its line


def scene_from(
    *,
    ego: Car,
    centre_line: CentreLine,
    obstacles: Sequence[Body] = (),
    signals: Sequence[Signal] = (),
    predictions: Sequence[Any] | None = None,
    path: Any = None,  # noqa: ANN401
    destination: tuple[float, float] | None = None,
) -> Scene:
    """Build the planning frame of one moment; `plain_scene` makes it plain numbers.

    Args:
      ego: the car that is planned for.
      centre_line: of its lane.
      obstacles: the others, in any order; the eight most relevant count.
      signals: stop lines of the lane; the nearest ahead that demands a stop counts.
      predictions: for each obstacle its future as rows (t, x, y, heading) in s, m and
        rad, t from 0 on and rising; after the last row it is not there. None: the
        package's own prediction, which is what training scenes hold by default.
      path: [m, 2] m, the path along which speed is planned; None: the centre line.
      destination: (x, y) m where the ego's centre shall come to rest.

    Raises:
      InputError: names the field, its value and what was expected.

    Examples:
        >>> from rcirl_jax import Body, Car, CentreLine
        >>> scene = rcirl_jax.scene_from(
        ...     ego=Car(x=3.0, y=0.2, heading=0.0, speed=12.0, length=4.9, width=2.1),
        ...     centre_line=CentreLine(points=[[0, 0], [300, 0]], speed_limit=13.9),
        ...     obstacles=[Body(x=40, y=0, heading=0, speed=8, length=4.5, width=1.8)],
        ... )
        >>> candidates = rcirl_jax.sample_candidates(scene)
        >>> reward = rcirl_jax.load_weights("weights.msgpack")
        >>> rcirl_jax.score_candidates(reward, scene, candidates).shape
        (122,)
    """
    check_numbers("ego", ego)
    frame = LineFrame(centre_line, (ego.x, ego.y))
    points = frame.points(ego, obstacles, signals, destination)
    parts = frame.parts(
        *project_points(frame.line, points), ego, obstacles, signals, path
    )
    scene = _scene_of(parts)
    if predictions is None:
        return scene
    futures = _futures(frame, obstacles, predictions, float(parts.station))
    first = most_relevant(parts.bodies, parts.ego, parts.path)
    return scene.replace(obstacles=_with_futures(scene.obstacles, futures, first))


def scene_of(parts: Parts) -> Scene:
    """Build the planning frame of one moment; pure, so that `vmap` makes many."""
    return Scene(
        ego=parts.ego,
        path=parts.path,
        obstacles=obstacles_of(
            parts.bodies, parts.wall, parts.goal, parts.ego, parts.path
        ),
        time_valid=jnp.ones(NUM_TIMES, bool),
        tags=jnp.zeros(NUM_TAGS, bool),
    )


_scene_of = jax.jit(scene_of)


def plain_scene(scene: Scene) -> features.Scene:
    """Return one scene in plain numbers; leave out what is never there."""
    ego = {name: float(value) for name, value in vars(scene.ego).items()}
    kinds = np.asarray(scene.obstacles.kind)
    tables = {name: np.asarray(getattr(scene.obstacles, name)) for name in features.BOX}
    boxes = [
        features.Obstacle(kind=kind, **{name: x[n] for name, x in tables.items()})
        for n, kind in enumerate(kinds.tolist())
        if kind != Kind.NONE and tables["valid"][n].any()
    ]
    return features.Scene(
        ego=features.Ego(**ego),
        path=features.Path(**{n: np.asarray(getattr(scene.path, n)) for n in PATH}),
        obstacles=boxes,
        num_valid=int(np.sum(scene.time_valid)),
    )


class LineFrame:
    """The Frenet frame of a centre line; smoothed once, for all moments on it.

    Args:
      road: the line.
      origin: (x, y) m, a place near the ego from which float32 numbers are precise.
      size: points of its grid, at least; lines of one size make a batch.
    """

    def __init__(
        self, road: CentreLine, origin: tuple[float, float], size: int = 0
    ) -> None:
        self.road, self.origin = road, np.asarray(origin, float)
        points = polyline("centre_line.points", road.points) - self.origin
        self.length = float(np.sum(np.hypot(*np.diff(points, axis=0).T)))
        count = max(int(self.length / STATION_STEP_M) + 2, size)
        count = -(-count // GRID_BLOCK) * GRID_BLOCK
        self.line: ReferenceLine = reference_line_from_polyline(
            points, size=count, step=STATION_STEP_M
        )
        tables = ("x", "y", "heading", "kappa")
        self.tables = {n: np.asarray(getattr(self.line, n)) for n in tables}
        self.tree = KDTree(np.stack([self.tables["x"], self.tables["y"]], axis=1))
        self.grid = np.arange(count) * STATION_STEP_M
        self.posted = _posted_limits(self)

    def points(
        self,
        ego: Car,
        obstacles: Sequence[Body] = (),
        signals: Sequence[Signal] = (),
        destination: tuple[float, float] | None = None,
    ) -> np.ndarray:
        """Return places [q, 2] m of a moment, to be projected on the line.

        Those of the ego, the obstacles, the signals and, if any, the destination.

        Raises:
          InputError: names the field, its value and what was expected.
        """
        check_numbers("ego", ego)
        check("ego.speed", ego.speed, ego.speed >= 0.0, "0 m/s or more")
        for n, body in enumerate(obstacles):
            check_numbers(f"obstacles[{n}]", body)
            check_one_of(f"obstacles[{n}].kind", body.kind, BODY_KINDS)
        for n, signal in enumerate(signals):
            check_numbers(f"signals[{n}]", signal)
            check_one_of(f"signals[{n}].state", signal.state, STATES)
        ends = [] if destination is None else table("destination", [destination], 2)
        places = [(p.x, p.y) for p in (ego, *obstacles, *signals)]
        return np.array([*places, *ends]) - self.origin

    def parts(
        self,
        s: np.ndarray,
        l: np.ndarray,
        ego: Car,
        obstacles: Sequence[Body] = (),
        signals: Sequence[Signal] = (),
        path: Any = None,  # noqa: ANN401
        slots: int = 0,
    ) -> Parts:
        """Return one moment on the line; see `scene_from`.

        Args:
          s: [q] m, stations of `points`.
          l: [q] m, their offsets.
          ego: the car that is planned for.
          obstacles: the others.
          signals: stop lines.
          path: along which speed is planned; None: the line.
          slots: of bodies, at least; moments of one number of slots make a batch.
        """
        s, l = s.astype(float), l.astype(float)
        s0, first = float(s[0]), 1 + len(obstacles)
        last = first + len(signals)
        now = _ego(self, ego, s0, float(l[0]))
        goal = s[last] - s0 + 0.5 * ego.length if last < s.size else math.inf
        goal = goal if goal > 0.5 * ego.length else math.inf
        return Parts(
            ego=now,
            path=_path(self, path, s0),
            bodies=_bodies(self, obstacles, s[1:first] - s0, l[1:first], s0, slots),
            wall=np.float32(_nearest_line(signals, s[first:last] - s0, now)),
            goal=np.float32(goal),
            station=np.float32(s0),
        )

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (s, l) m of points [q, 2] m."""
        s, l = project_points(self.line, np.asarray(points, float) - self.origin)
        return s.astype(float), l.astype(float)

    def table(self, name: str, s: np.ndarray | float) -> np.ndarray:
        """Return heading or curvature at stations; straight beyond the line's end."""
        values = self.tables[name]
        beyond = 0.0 if name == "kappa" else None
        return np.asarray(np.interp(s, self.grid, values, right=beyond))

    def tilt(self, s: np.ndarray | float, heading: np.ndarray | float) -> np.ndarray:
        """Return headings against the line's, in (-pi, pi]."""
        apart = np.asarray(heading) - self.table("heading", s)
        return np.arctan2(np.sin(apart), np.cos(apart))


def _ego(frame: LineFrame, ego: Car, s0: float, l: float) -> Ego:
    """Return the ego in the frame, from its station and offset on the line."""
    ahead = frame.length - s0
    need = max(HORIZON_S * ego.speed, 1.0)
    tilt, kappa = frame.tilt(s0, ego.heading), frame.table("kappa", s0)
    turned = f"{math.degrees(tilt):.0f} degrees from the line"
    begins = f"begins {-s0:.1f} m ahead of the ego"
    ends = f"ends {ahead:.1f} m ahead of the ego"
    beside = f"{abs(l):.1f} m beside the centre line"
    behind_it = "a line from behind it on, in driving direction"
    own_lane = f"at most {BESIDE_M:g} m; give the line of the lane that it drives on"
    far_enough = f"{need:.1f} m, what it drives in {HORIZON_S:g} s"
    check("centre_line", begins, s0 >= -1e-3, behind_it)
    check("ego", beside, abs(l) <= BESIDE_M, own_lane)
    check("centre_line", ends, ahead >= need, far_enough)
    along = "along it, whose points are in driving direction"
    check("ego.heading", turned, abs(tilt) <= 0.5 * math.pi, along)
    shrink = max(1.0 - kappa * l, MIN_SHRINK)
    values = {
        "s": 0.0,
        "l": l,
        "dl": math.tan(np.clip(tilt, -STEEPEST, STEEPEST)) * shrink,
        "ddl": ego.curvature - kappa,
        "v": ego.speed * math.cos(tilt) / shrink,
        "a": ego.acceleration,
        "length": ego.length,
        "width": ego.width,
    }
    return Ego(**_floats(values))


def _path(frame: LineFrame, path: Any, s0: float) -> Path:  # noqa: ANN401
    """Return the line from the ego on, with limits that look ahead."""
    road = frame.road
    stations = s0 + LONG_GRID_M
    kappa = frame.table("kappa", stations)
    l = np.zeros_like(stations)
    if path is not None:
        at, offsets = frame.project(polyline("path", path))
        check("path", "turns back", np.all(np.diff(at) > 0.0), "driving direction")
        l = np.interp(stations, at, offsets)
    at, limits = frame.posted
    posted = limits[np.clip(np.searchsorted(at, stations, "right") - 1, 0, None)]
    limit = planning_limit(kappa, l, posted, STATION_STEP_M)
    check("centre_line.lane_width", road.lane_width, road.lane_width > 0.0, "over 0 m")
    half = 0.5 * road.lane_width
    left, right = (half if x is None else x for x in (road.road_left, road.road_right))
    flat = np.ones(NUM_STATIONS)
    tables = {
        "kappa": kappa,
        "l": l,
        "speed_limit": limit,
        "lane_left": half * flat,
        "lane_right": -half * flat,
        "road_left": left * flat,
        "road_right": -right * flat,
    }
    return Path(**_floats({n: x[:NUM_STATIONS] for n, x in tables.items()}))


def _posted_limits(frame: LineFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return stations [m] m from which posted limits [m] m/s hold."""
    limits = np.atleast_1d(floats("centre_line.speed_limit", frame.road.speed_limit))
    check("centre_line.speed_limit", limits, np.all(limits > 0.0), "over 0 m/s")
    if limits.shape == (1,):
        return np.zeros(1), limits
    points = np.asarray(frame.road.points, float)
    check(
        "centre_line.speed_limit",
        f"{limits.size} numbers",
        limits.shape == (len(points),),
        f"one for each of the {len(points)} points, or one for all",
    )
    return np.maximum.accumulate(frame.project(points)[0]), limits


def _bodies(
    frame: LineFrame,
    others: Sequence[Body],
    s: np.ndarray,
    l: np.ndarray,
    s0: float,
    slots: int,
) -> Bodies:
    """Return the others in the frame, s from the ego on; filled up to few sizes."""
    size = max(8, slots, 1 << (len(others) - 1).bit_length())  # few compilations
    rows = np.zeros((size, 6))
    kinds = np.zeros(size, np.int32)
    for n, b in enumerate(others):
        rows[n] = b.heading, b.speed, b.acceleration, b.length, b.width, s[n]
        kinds[n] = Kind[b.kind.upper()]
    heading, speed, acceleration, length, width, station = rows.T
    tilt = frame.tilt(station + s0, heading)
    half_s, half_l = extents(length, width, tilt)
    leaves = {
        "s": station,
        "l": np.append(l, np.zeros(size - len(others))),
        "speed": speed * np.cos(tilt),
        "l_dot": speed * np.sin(tilt),
        "a": acceleration * np.cos(tilt),
        "half_s": half_s,
        "half_l": half_l,
    }
    which: dict[str, Any] = {"kind": kinds, "present": np.arange(size) < len(others)}
    return Bodies(**_floats(leaves), **which)


def _floats(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return numpy's float32, leaves of a tree that JAX is given."""
    return {name: np.asarray(x, np.float32) for name, x in values.items()}


def _nearest_line(signals: Sequence[Signal], stations: np.ndarray, now: Ego) -> float:
    """Return the station of the nearest line ahead that demands a stop; inf: none.

    Yellow does where the ego can still stop, as in the simulator.
    """
    nearest = math.inf
    for signal, s in zip(signals, stations, strict=True):
        way = float(s) - 0.5 * float(now.length)
        demands = signal.state in ("red", "stop") or (
            signal.state == "yellow" and can_stop(float(now.v), way)
        )
        if demands and way >= 0.0:
            nearest = min(nearest, float(s))
    return nearest


_extents = jax.jit(jax.vmap(frenet_extent))


def extents(
    length: np.ndarray, width: np.ndarray, tilt: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return half extents [q] m along and across the line of tilted boxes."""
    given = (np.asarray(x, np.float32) for x in (length, width, tilt))
    along, across = _extents(*given)
    return np.asarray(along), np.asarray(across)


def _futures(
    frame: LineFrame, others: Sequence[Body], predictions: Sequence[Any], s0: float
) -> dict[str, np.ndarray]:
    """Return boxes of given futures at the T times; all [M, T]."""
    count, need = len(predictions), f"{len(others)}, one for each obstacle"
    check("predictions", count, count == len(others), need)
    found = {name: np.zeros((len(others), NUM_TIMES)) for name in features.BOX}
    ones = np.ones(NUM_TIMES)
    for n, (body, given) in enumerate(zip(others, predictions, strict=True)):
        name = f"predictions[{n}]"
        t, x, y, heading = table(name, given, 4).T
        check(
            f"{name}: t", t, t[0] <= 1e-6 and np.all(np.diff(t) > 0), "from 0 s, rising"
        )
        check_radians(f"{name}: heading", float(heading[np.argmax(np.abs(heading))]))
        s, l = frame.project(np.stack([x, y], axis=1))
        tilt = np.unwrap(frame.tilt(s, heading))
        s = s - s0
        rate = np.gradient(s, t) if t.size > 1 else body.speed * np.cos(tilt)
        s, l, tilt, rate = (np.interp(TIMES_S, t, z) for z in (s, l, tilt, rate))
        half_s, half_l = extents(body.length * ones, body.width * ones, tilt)
        until = t[-1] + 1e-6 >= TIMES_S
        boxes = (s - half_s, s + half_s, l - half_l, l + half_l, rate, until)
        for key, values in zip(features.BOX, boxes, strict=True):
            found[key][n] = values
    return found


def _with_futures(seen: Obstacles, futures: dict, first: jax.Array) -> Obstacles:
    """Return obstacles with the given futures instead of predicted ones."""
    count = len(futures["speed"])
    leaves = {}
    for name, values in futures.items():
        table = np.array(getattr(seen, name))
        for slot, body in enumerate(np.asarray(first).tolist()):
            if body < count:
                table[slot] = values[body]
        leaves[name] = jnp.asarray(table)
    return seen.replace(**leaves)
