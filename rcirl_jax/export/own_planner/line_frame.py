"""The Frenet frame of a centre line, and one moment of a planner's view in it."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import flax.struct
import jax
import numpy as np
from scipy.spatial import KDTree

from rcirl_jax.errors import InputError
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
from rcirl_jax.planner.prediction import Bodies
from rcirl_jax.simulation.agents import can_stop
from rcirl_jax.types import Ego, Kind, Path
from rcirl_jax.units import HORIZON_S, NUM_STATIONS, STATION_STEP_M

BESIDE_M = 20.0  # m beside the centre line beyond which the ego is not on its road
STEEPEST = 1.2  # rad, tilt beyond which dl/ds grows no more
MIN_SHRINK = 0.1  # 1, least value of 1 - kappa l
GRID_BLOCK = 256  # points: grids are a multiple, so that few sizes compile
_extents_of = jax.jit(jax.vmap(frenet_extent))
LONG_GRID_M = np.arange(
    0.0, (NUM_STATIONS - 1) * STATION_STEP_M + LOOK_AHEAD_M + 1e-6, STATION_STEP_M
)


class Parts(flax.struct.PyTreeNode, kw_only=True):
    """What is known of one moment before the others' future is predicted; numpy."""

    ego: Ego
    path: Path
    bodies: Bodies
    wall: Any  # [] m, the nearest line that demands a stop; inf
    goal: Any  # [] m, where the front comes to rest; inf
    station: Any  # [] m, of the ego on its line


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
        _check_others(obstacles, signals)
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
    ahead, need = frame.length - s0, HORIZON_S * ego.speed
    if s0 < -1e-3:
        raise InputError(
            f"scene_from: centre_line: begins {-s0:.1f} m ahead of the ego: expected a "
            "line from behind it on, in driving direction"
        )
    if abs(l) > BESIDE_M:
        raise InputError(
            f"scene_from: ego: {abs(l):.1f} m beside the centre line: expected at most "
            f"{BESIDE_M:g} m; give the line of the lane that it drives on"
        )
    if ahead < max(need, 1.0):
        raise InputError(
            f"scene_from: centre_line: ends {ahead:.1f} m ahead of the ego: expected "
            f"{max(need, 1.0):.1f} m, what it drives in {HORIZON_S:g} s"
        )
    tilt, kappa = frame.tilt(s0, ego.heading), frame.table("kappa", s0)
    if abs(tilt) > 0.5 * math.pi:
        raise InputError(
            f"scene_from: ego.heading: {math.degrees(tilt):.0f} degrees from the line: "
            "expected along it, whose points are in driving direction"
        )
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
        if np.any(np.diff(at) <= 0.0):
            raise InputError("scene_from: path: turns back: expected driving direction")
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
    if limits.shape != (len(points),):
        raise InputError(
            f"scene_from: centre_line.speed_limit: {limits.size} numbers: expected one "
            f"for each of the {len(points)} points, or one for all"
        )
    return np.maximum.accumulate(frame.project(points)[0]), limits


def _check_others(others: Sequence[Body], signals: Sequence[Signal]) -> None:
    """Check every number of the others and every name."""
    for n, body in enumerate(others):
        check_numbers(f"obstacles[{n}]", body)
        check_one_of(f"obstacles[{n}].kind", body.kind, BODY_KINDS)
    for n, signal in enumerate(signals):
        check_numbers(f"signals[{n}]", signal)
        check_one_of(f"signals[{n}].state", signal.state, STATES)


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


def extents(
    length: np.ndarray, width: np.ndarray, tilt: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return half extents [q] m along and across the line of tilted boxes."""
    given = (np.asarray(x, np.float32) for x in (length, width, tilt))
    along, across = _extents_of(*given)
    return np.asarray(along), np.asarray(across)


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
