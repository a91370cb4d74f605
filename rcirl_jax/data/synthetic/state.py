"""State of the simulated traffic: R recordings with N slots each, as arrays."""

import dataclasses
from typing import Literal

import numpy as np

from rcirl_jax.data.synthetic.drivers import DRIVER, drift, quintic
from rcirl_jax.data.synthetic.roads import GRID_M, STRAIGHT_KAPPA, Road

MIN_CHANGE_M = 20.0  # m, a slow car needs this much road to change lanes
CHANGE_BEFORE_BEND_M = 60.0  # m before a bend without new lane changes
CHANGE_BEFORE_STOP_M = 35.0  # m before a stop line without new lane changes
CHANGE_AFTER_ENTRY_M = 45.0  # m after the road's start without lane changes
ROW_M = 1.0e5  # m, longer than any road: keeps the recordings of a batch apart
PAST_STOP_M = 10.0  # m behind a stop line or bend, still without lane changes


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoadTable:
    """Roads of all recordings, padded to equal sizes."""

    limit: np.ndarray  # [R, G] m/s, envelope of the limit
    curve: np.ndarray  # [R, G] m/s, envelope of the curve speed
    kappa: np.ndarray  # [R, G] 1/m
    calm: np.ndarray  # [R, G] bool, lane changes may start here
    num_lanes: np.ndarray  # [R, 1]
    lane_width: np.ndarray  # [R, 1] m
    length: np.ndarray  # [R, 1] m
    stop_s: np.ndarray  # [R, S + 1] m, inf after the last
    stop_is_sign: np.ndarray  # [R, S + 1] bool
    green: np.ndarray  # [R, 1] s
    yellow: np.ndarray  # [R, 1] s
    cycle: np.ndarray  # [R, 1] s

    def index(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Grid index of stations [R, N] m, for use on [R, G] tables."""
        rows = np.arange(s.shape[0])[:, None]
        return rows, np.clip((s / GRID_M).astype(int), 0, self.limit.shape[1] - 1)

    def offset(self, lane: np.ndarray) -> np.ndarray:
        """Lateral offset [R, N] m of lane centres."""
        return (0.5 * (self.num_lanes - 1) - lane) * self.lane_width


def road_table(roads: list[Road]) -> RoadTable:
    """Stack roads; arrays are continued by their last value."""
    size = max(road.x.size for road in roads)
    lines = max(len(road.stops) for road in roads) + 1
    stop_s = np.full((len(roads), lines), np.inf)
    is_sign = np.zeros((len(roads), lines), bool)
    for r, road in enumerate(roads):
        for i, stop in enumerate(road.stops):
            stop_s[r, i], is_sign[r, i] = stop.station, stop.is_sign

    def stack(rows: list[np.ndarray]) -> np.ndarray:
        return np.array([np.pad(x, (0, size - x.size), mode="edge") for x in rows])

    def column(values: list[float]) -> np.ndarray:
        return np.array(values)[:, None]

    return RoadTable(
        limit=stack([road.limit_envelope() for road in roads]),
        curve=stack([road.curve_envelope() for road in roads]),
        kappa=stack([road.kappa for road in roads]),
        calm=stack([_calm(road) for road in roads]),
        num_lanes=column([road.num_lanes for road in roads]),
        lane_width=column([road.lane_width for road in roads]),
        length=column([road.length for road in roads]),
        stop_s=stop_s,
        stop_is_sign=is_sign,
        green=column([road.cycle[0] for road in roads]),
        yellow=column([road.cycle[1] for road in roads]),
        cycle=column([sum(road.cycle) for road in roads]),
    )


def _calm(road: Road) -> np.ndarray:
    s = np.arange(road.x.size) * GRID_M
    calm = s > CHANGE_AFTER_ENTRY_M
    for where in s[np.abs(road.kappa) > STRAIGHT_KAPPA]:
        calm &= (s < where - CHANGE_BEFORE_BEND_M) | (s > where + PAST_STOP_M)
    for stop in road.stops:
        before = stop.station - CHANGE_BEFORE_STOP_M
        calm &= (s < before) | (s > stop.station + PAST_STOP_M)
    return calm


class State:
    """Mutable state of all vehicles; every array is [R, N]."""

    def __init__(self, num_recordings: int, num_slots: int) -> None:
        shape = (num_recordings, num_slots)
        self.vehicle = np.full(shape, -1)  # number in the recording; -1: empty slot
        self.driver = np.zeros(shape, DRIVER)
        for name in ("acceleration", "deceleration", "headway", "length"):
            self.driver[name] = 1.0  # empty slots stay finite
        self.s = np.zeros(shape)  # m, station of the box centre
        self.v = np.zeros(shape)  # m/s, along the own path
        self.a = np.zeros(shape)  # m/s^2
        self.lane = np.zeros(shape, int)  # where the car is, or changes to
        self.old_lane = np.zeros(shape, int)  # where a change began
        self.phase = np.ones(shape)  # of the lane change; 1: none
        self.changed = np.full(shape, -np.inf)  # s, start of the last change
        self.next_stop = np.zeros(shape, int)  # index of the stop line ahead
        self.decided = np.zeros(shape, bool)  # saw that the light is not green
        self.committed = np.zeros(shape, bool)  # drives on although it is not
        self.stood = np.zeros(shape)  # s, standing at a stop sign
        self.parked = np.zeros(shape, bool)  # at the destination, for good
        self.noise = np.zeros((2, *shape))  # m/s^2, OU noise and its low-pass

    @property
    def alive(self) -> np.ndarray:
        """Slots in use."""
        return self.vehicle >= 0

    def occupied(self) -> np.ndarray:
        """Bit mask of the lanes each vehicle is in; 0 for empty slots."""
        old = np.where(self.phase < 1.0, 1 << self.old_lane, 0)
        return np.where(self.alive, (1 << self.lane) | old, 0)

    def advance_per_metre(self) -> np.ndarray:
        """d(phase)/ds of a lane change, 1/m."""
        seconds = np.maximum(self.v * self.driver["change_time"], MIN_CHANGE_M)
        left = np.maximum(self.driver["destination"] - self.s - 1.0, 2.0)
        return np.maximum(1.0 / seconds, (1.0 - self.phase) / left)

    def lateral(self, table: RoadTable) -> tuple[np.ndarray, np.ndarray]:
        """Offset [m] and slope dl/ds of every vehicle."""
        q, rate = quintic(self.phase)
        start, end = table.offset(self.old_lane), table.offset(self.lane)
        wander, tilt = drift(self.driver, self.s)
        slope = (end - start) * rate * self.advance_per_metre() + tilt
        return start + (end - start) * q + wander, slope


class Neighbours:
    """Who is ahead of and behind whom, lane by lane, at one instant.

    Every lane holds its vehicles of all recordings in one sorted list, of keys
    `s + ROW_M r`, so that a search is one bisection per vehicle.
    """

    def __init__(self, state: State, num_lanes: int) -> None:
        self.lanes = state.occupied()  # [R, N] bit masks
        self._s = state.s.ravel().copy()
        self._slots = state.s.shape[1]
        rows = np.arange(len(state.s))[:, None]
        self._keys = (state.s + ROW_M * rows).ravel()
        self._sorted = []
        flat = self.lanes.ravel()
        for lane in range(num_lanes):
            members = np.flatnonzero((flat >> lane) & 1)
            self._sorted.append(members[np.argsort(self._keys[members])])

    def leader(self, look: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest ahead in the lanes `look` [R, N] (bit masks).

        Returns:
          Slot [R, N] (0 if there is none) and distance [R, N] m from centre to
          centre along the road (inf if there is none).
        """
        return self._nearest(look, "right", 0)

    def follower(self, look: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest behind, as `leader`; distances are positive."""
        return self._nearest(look, "left", -1)

    def _nearest(
        self, look: np.ndarray, side: Literal["left", "right"], shift: int
    ) -> tuple[np.ndarray, np.ndarray]:
        flat = look.ravel()
        best = np.full(flat.size, np.inf)
        index = np.zeros(flat.size, int)
        for lane, members in enumerate(self._sorted):
            who = np.flatnonzero((flat >> lane) & 1)
            if who.size == 0 or members.size == 0:
                continue
            keys = self._keys[members]
            at = np.searchsorted(keys, self._keys[who], side=side) + shift
            inside = (at >= 0) & (at < members.size)
            found = members[np.clip(at, 0, members.size - 1)]
            inside &= found // self._slots == who // self._slots
            distance = np.abs(self._s[found] - self._s[who])
            nearer = inside & (distance < best[who])
            best[who[nearer]] = distance[nearer]
            index[who[nearer]] = found[nearer] % self._slots
        return index.reshape(look.shape), best.reshape(look.shape)
