"""Road shapes of the synthetic traffic, and their lanes.

A road is one reference line with parallel lanes. The line is the integral of a
curvature profile that is linear between knots (straights, clothoids, arcs):

    heading(s) = int kappa ds,   (x, y)(s) = int (cos, sin)(heading) ds

Station `s` [m] runs along the line, offset `l` [m] is positive to the left.
Lane 0 is the leftmost; lane `num_lanes` is the strip at the right edge (hard
shoulder or parking strip), where drivers stop at their destination.
"""

import dataclasses
import itertools
from collections.abc import Callable
from functools import partial

import numpy as np

from rcirl_jax.types import Lane

GRID_M = 0.5  # m between grid points of the reference line
CENTRE_STEP_M = 2.0  # m between points of an emitted lane centre
HIGHWAY_LANE_M = 3.6  # m, lane width (12 ft; AASHTO Green Book)
URBAN_LANE_M = 3.5  # m, lane width (German RASt 06: 3.25 to 3.50 m)
HIGHWAY_TRUCK_SHARE, URBAN_TRUCK_SHARE = 0.13, 0.05  # 1 (German counts: 5-20 %)
HIGHWAY_TRUCK_M, URBAN_TRUCK_M = (8.0, 14.0), (6.5, 9.0)  # m, shortest, longest
LATERAL_REFERENCE_MPS2 = 2.0  # m/s^2, comfort bound in curves (AASHTO: about 0.2 g)
CURVE_BRAKING_MPS2 = 1.2  # m/s^2, deceleration with which drivers enter curves
LIMIT_BRAKING_MPS2 = 0.8  # m/s^2, deceleration towards a lower speed limit
STOP_CLEARANCE_M = 60.0  # m around stop lines without destinations
STRAIGHT_KAPPA = 0.004  # 1/m, no destinations and lane changes in sharper bends


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stop:
    """A stop line across all lanes."""

    station: float  # m
    is_sign: bool  # a stop sign; else a traffic light


@dataclasses.dataclass(frozen=True, kw_only=True)
class Road:
    """A road; arrays hold one value per GRID_M of station."""

    num_lanes: int
    lane_width: float  # m
    x: np.ndarray  # [g] m
    y: np.ndarray  # [g] m
    heading: np.ndarray  # [g] rad
    kappa: np.ndarray  # [g] 1/m
    limit: np.ndarray  # [g] m/s
    truck_share: float
    truck_length: tuple[float, float]  # m, shortest and longest
    stops: tuple[Stop, ...] = ()
    # s of green, yellow and red in a signal's cycle
    cycle: tuple[float, float, float] = (22.0, 4.0, 24.0)

    @property
    def length(self) -> float:
        """Length of the reference line, m."""
        return (self.x.size - 1) * GRID_M

    def offset(self, lane: np.ndarray | int) -> np.ndarray:
        """Lateral offset [m] of lane centres; the strip is lane `num_lanes`."""
        return (0.5 * (self.num_lanes - 1) - np.asarray(lane)) * self.lane_width

    def limit_envelope(self) -> np.ndarray:
        """[g] m/s: the limit, and what still lets one slow down to later ones."""
        return _envelope(self.limit, LIMIT_BRAKING_MPS2)

    def curve_envelope(self) -> np.ndarray:
        """[g] m/s at which v^2 |kappa| stays within LATERAL_REFERENCE_MPS2."""
        kappa = np.maximum(np.abs(self.kappa), 1e-5)
        return _envelope(np.sqrt(LATERAL_REFERENCE_MPS2 / kappa), CURVE_BRAKING_MPS2)

    def parking(self) -> np.ndarray:
        """Stations [m] where destinations may lie."""
        s = np.arange(self.x.size) * GRID_M
        free = (s > 0.35 * self.length) & (s < 0.88 * self.length)
        bend = np.abs(self.kappa) > STRAIGHT_KAPPA
        for where in s[bend][:: int(10.0 / GRID_M)]:
            free &= np.abs(s - where) > STOP_CLEARANCE_M
        for stop in self.stops:
            free &= np.abs(s - stop.station) > STOP_CLEARANCE_M
        return s[free]


def _envelope(speed: np.ndarray, braking: float) -> np.ndarray:
    """v(s) = min over s' >= s of sqrt(speed(s')^2 + 2 braking (s' - s))."""
    s = np.arange(speed.size) * GRID_M
    energy = speed**2 + 2.0 * braking * s
    ahead = np.minimum.accumulate(energy[::-1])[::-1]
    return np.sqrt(ahead - 2.0 * braking * s)


def to_world(
    road: Road, s: np.ndarray, l: np.ndarray, slope: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World position and heading of a motion along the road.

        heading = heading_road + atan2(dl/ds, 1 - kappa l)

    Args:
      road: the road.
      s: [n] m, station.
      l: [n] m, offset.
      slope: [n] dl/ds.

    Returns:
      x, y [m] and heading [rad], each [n].
    """
    index = np.clip((s / GRID_M).astype(int), 0, road.x.size - 2)
    rest = s - index * GRID_M
    kappa = (road.heading[index + 1] - road.heading[index]) / GRID_M
    chord = road.heading[index] + 0.5 * kappa * rest
    heading = road.heading[index] + kappa * rest
    x = road.x[index] + rest * np.cos(chord) - l * np.sin(heading)
    y = road.y[index] + rest * np.sin(chord) + l * np.cos(heading)
    return x, y, heading + np.arctan2(slope, 1.0 - kappa * l)


def lanes(road: Road) -> tuple[Lane, ...]:
    """Return the road's lanes, cut at stop lines and limit changes, and its strip.

    Piece p of lane k is named "k.p"; the strip is lane `num_lanes`. A stop line
    belongs to the piece that ends at it and is governed by signal "signal-i".
    """
    changes = np.flatnonzero(np.diff(road.limit)) * GRID_M
    inner = {float(s) for s in changes} | {stop.station for stop in road.stops}
    cuts = [0.0, *sorted(inner), road.length]
    number_at = {stop.station: i for i, stop in enumerate(road.stops)}
    edges = np.array([0.5, -0.5]) * road.lane_width
    made = []
    for k in range(road.num_lanes + 1):
        on_road = k < road.num_lanes
        for p, (start, end) in enumerate(itertools.pairwise(cuts)):
            count = max(int(np.ceil((end - start) / CENTRE_STEP_M)), 1) + 1
            s = np.linspace(start, end, count)
            x, y, _ = to_world(road, s, np.full(count, road.offset(k)), 0.0 * s)
            half = np.full(count, 0.5 * road.lane_width)
            line, signs = None, False
            signals: tuple[str, ...] = ()
            if on_road and end in number_at:
                i = number_at[end]
                ends = to_world(
                    road, np.full(2, end), road.offset(k) + edges, np.zeros(2)
                )
                line, signs = np.stack(ends[:2], axis=1), road.stops[i].is_sign
                signals = () if signs else (f"signal-{i}",)
            piece = Lane(
                id=f"{k}.{p}",
                centre=np.stack([x, y], axis=1),
                left_width=half,
                right_width=half.copy(),
                speed_limit=float(road.limit[int(0.5 * (start + end) / GRID_M)]),
                successors=() if end == cuts[-1] else (f"{k}.{p + 1}",),
                left=f"{k - 1}.{p}" if k > 0 else None,
                right=f"{k + 1}.{p}" if on_road else None,
                stop_line=line,
                signal_ids=signals,
                stop_sign=signs,
            )
            made.append(piece)
    return tuple(made)


Knots = list[tuple[float, float]]


def _road(
    length: float,
    knots: Knots,
    limits: Knots,
    *,
    stops: tuple[Stop, ...] = (),
    highway: bool = False,
) -> Road:
    """A road from its curvature and limits.

    Args:
      length: m.
      knots: (station m, curvature 1/m), linear in between; empty: straight.
      limits: (from station m, limit m/s).
      stops: its stop lines.
      highway: three wide lanes with long trucks; else two urban lanes.
    """
    s = np.arange(int(round(length / GRID_M)) + 1) * GRID_M
    stations, values = np.array(knots or [(0.0, 0.0)]).T
    kappa = np.interp(s, stations, values)
    mean = 0.5 * (kappa[1:] + kappa[:-1])
    heading = np.concatenate([[0.0], np.cumsum(mean * GRID_M)])
    # each step follows its chord, as `to_world` does between grid points
    chord = 0.5 * (heading[:-1] + heading[1:])
    starts, speeds = np.array(limits).T
    return Road(
        num_lanes=3 if highway else 2,
        lane_width=HIGHWAY_LANE_M if highway else URBAN_LANE_M,
        x=np.concatenate([[0.0], np.cumsum(np.cos(chord) * GRID_M)]),
        y=np.concatenate([[0.0], np.cumsum(np.sin(chord) * GRID_M)]),
        heading=heading,
        kappa=kappa,
        limit=speeds[np.searchsorted(starts, s, side="left").clip(1) - 1],
        stops=stops,
        truck_share=HIGHWAY_TRUCK_SHARE if highway else URBAN_TRUCK_SHARE,
        truck_length=HIGHWAY_TRUCK_M if highway else URBAN_TRUCK_M,
    )


def _arc(start: float, clothoid: float, arc: float, kappa: float) -> Knots:
    """Knots of a bend: clothoid, arc, clothoid; it turns kappa (clothoid + arc)."""
    end = start + clothoid + arc
    first = (start, 0.0), (start + clothoid, kappa)
    return [*first, (end, kappa), (end + clothoid, 0.0)]


def _turn(side: float, radius: float) -> Road:
    """520 m, two lanes, 50 km/h, a right-angled bend with 10 m clothoids."""
    clothoid = 10.0
    arc = 0.5 * np.pi * radius - clothoid
    return _road(520.0, _arc(230.0, clothoid, arc, side / radius), [(0.0, 13.9)])


ROADS: dict[str, Callable[[], Road]] = {
    "highway_straight": partial(_road, 1100.0, [], [(0.0, 30.0)], highway=True),
    # bends of R = 500 m and 300 m, the limit falls
    "highway_s_curve": partial(
        _road,
        1100.0,
        _arc(150.0, 80.0, 180.0, 1 / 500.0) + _arc(560.0, 80.0, 150.0, -1 / 300.0),
        [(0.0, 27.8), (500.0, 22.2)],
        highway=True,
    ),
    "arterial_signals": partial(
        _road,
        800.0,
        [],
        [(0.0, 16.7)],
        stops=tuple(Stop(station=s, is_sign=False) for s in (300.0, 580.0)),
    ),
    "urban_turn_left": partial(_turn, 1.0, 18.0),
    "urban_turn_right": partial(_turn, -1.0, 22.0),
    "stop_sign": partial(
        _road, 480.0, [], [(0.0, 13.9)], stops=(Stop(station=260.0, is_sign=True),)
    ),
}
