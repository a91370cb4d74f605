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

import numpy as np

from rcirl_jax.types import Lane

GRID_M = 0.5  # m between grid points of the reference line
CENTRE_STEP_M = 2.0  # m between points of an emitted lane centre
LATERAL_REFERENCE_MPS2 = 2.0  # m/s^2, comfort bound in curves (AASHTO: about 0.2 g)
CURVE_BRAKING_MPS2 = 1.2  # m/s^2, deceleration with which drivers enter curves
LIMIT_BRAKING_MPS2 = 0.8  # m/s^2, deceleration towards a lower speed limit
CLEAR_M = 60.0  # m before a stop line or bend without lane changes and destinations
CLEAR_BEHIND_M = 10.0  # m behind it without lane changes
CHANGE_AFTER_ENTRY_M = 45.0  # m after the road's start without lane changes
STRAIGHT_KAPPA = 0.004  # 1/m, a sharper curve is a bend

Knots = list[tuple[float, float]]


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
    lights: tuple[float, ...]  # m, stop lines of traffic lights
    signs: tuple[float, ...]  # m, stop lines of stop signs
    truck_share: float
    truck_length: tuple[float, float]  # m, shortest and longest

    @property
    def length(self) -> float:
        """Length of the reference line, m."""
        return (self.x.size - 1) * GRID_M

    @property
    def stops(self) -> np.ndarray:
        """Stations [n] m of all stop lines, lights first."""
        return np.array(self.lights + self.signs)

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

    def _clear(self, behind_m: float) -> np.ndarray:
        """[g] bool: no bend or stop line from CLEAR_M ahead to `behind_m` behind."""
        busy = np.abs(self.kappa) > STRAIGHT_KAPPA
        busy[np.round(self.stops / GRID_M).astype(int)] = True
        count = np.concatenate([[0], np.cumsum(busy)])
        at = np.arange(busy.size)
        ahead = np.minimum(at + int(CLEAR_M / GRID_M) + 1, busy.size)
        return count[ahead] == count[np.maximum(at - int(behind_m / GRID_M), 0)]

    def changes_allowed(self) -> np.ndarray:
        """[g] bool: lane changes may begin here."""
        s = np.arange(self.x.size) * GRID_M
        return self._clear(CLEAR_BEHIND_M) & (s > CHANGE_AFTER_ENTRY_M)

    def parking(self) -> np.ndarray:
        """Stations [n] m where destinations may lie."""
        s = np.arange(self.x.size) * GRID_M
        middle = (s > 0.35 * self.length) & (s < 0.88 * self.length)
        return s[self._clear(CLEAR_M) & middle]


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
    belongs to the piece that ends at it; light i is "signal-i".
    """
    changes = np.flatnonzero(np.diff(road.limit)) * GRID_M
    cuts = np.unique([0.0, *changes, *road.stops, road.length]).tolist()
    made = []
    for k in range(road.num_lanes + 1):
        on_road = k < road.num_lanes
        for p, (start, end) in enumerate(itertools.pairwise(cuts)):
            s = np.linspace(start, end, int(np.ceil((end - start) / CENTRE_STEP_M)) + 1)
            x, y, _ = to_world(road, s, np.full(s.size, road.offset(k)), 0.0 * s)
            edges = road.offset(k) + np.array([0.5, -0.5]) * road.lane_width
            line = to_world(road, np.full(2, end), edges, np.zeros(2))[:2]
            light, sign = on_road and end in road.lights, on_road and end in road.signs
            piece = Lane(
                id=f"{k}.{p}",
                centre=np.stack([x, y], axis=1),
                left_width=np.full(s.size, 0.5 * road.lane_width),
                right_width=np.full(s.size, 0.5 * road.lane_width),
                speed_limit=float(road.limit[int(0.5 * (start + end) / GRID_M)]),
                successors=() if end == cuts[-1] else (f"{k}.{p + 1}",),
                left=f"{k - 1}.{p}" if k > 0 else None,
                right=f"{k + 1}.{p}" if on_road else None,
                stop_line=np.stack(line, axis=1) if light or sign else None,
                signal_ids=(f"signal-{road.lights.index(end)}",) if light else (),
                stop_sign=sign,
            )
            made.append(piece)
    return tuple(made)


def _road(
    length: float,
    knots: Knots,
    limits: Knots,
    *,
    lights: tuple[float, ...] = (),
    signs: tuple[float, ...] = (),
    highway: bool = False,
) -> Road:
    """Returns a road.

    Args:
      length: m.
      knots: (station m, curvature 1/m), linear in between; empty: straight.
      limits: (from station m, limit m/s).
      lights: m, stop lines of traffic lights.
      signs: m, stop lines of stop signs.
      highway: three lanes of 3.6 m (12 ft; AASHTO Green Book) with long trucks; else
        two of 3.5 m (German RASt 06: 3.25 to 3.50 m). German counts: 5 to 20 % trucks.
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
        lane_width=3.6 if highway else 3.5,
        x=np.concatenate([[0.0], np.cumsum(np.cos(chord) * GRID_M)]),
        y=np.concatenate([[0.0], np.cumsum(np.sin(chord) * GRID_M)]),
        heading=heading,
        kappa=kappa,
        limit=speeds[np.searchsorted(starts, s, side="left").clip(1) - 1],
        lights=lights,
        signs=signs,
        truck_share=0.13 if highway else 0.05,
        truck_length=(8.0, 14.0) if highway else (6.5, 9.0),
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


# bends of R = 500 m and 300 m, in between the limit falls
_S_CURVE = _arc(150.0, 80.0, 180.0, 1 / 500.0) + _arc(560.0, 80.0, 150.0, -1 / 300.0)
_S_LIMITS = [(0.0, 27.8), (500.0, 22.2)]
ROADS: dict[str, Road] = {
    "highway_straight": _road(1100.0, [], [(0.0, 30.0)], highway=True),
    "highway_s_curve": _road(1100.0, _S_CURVE, _S_LIMITS, highway=True),
    "arterial_signals": _road(800.0, [], [(0.0, 16.7)], lights=(300.0, 580.0)),
    "urban_turn_left": _turn(1.0, 18.0),
    "urban_turn_right": _turn(-1.0, 22.0),
    "stop_sign": _road(480.0, [], [(0.0, 13.9)], signs=(260.0,)),
}
