"""Synthetic human traffic: drivers, lane changes, stops, and the simulation.

Several recordings advance together as arrays [R, N], R recordings with N slots each.
Every recording draws from its own random stream, so that it does not depend on the
others of its batch. Steps are at most 1 / STEP_HZ long; a first-order actuator with
bounded jerk stands between the driver model and the motion.

Longitudinal: the intelligent driver model (Treiber, Hennecke, Helbing 2000,
Phys. Rev. E 62, 1805, eqs. 1-3), with v speed, g gap, dv closing speed,

    dv/dt = a [1 - (v/v0)^4 - (s*/g)^2],
    s* = s0 + max(0, v T + v dv / (2 sqrt(a b)))

where a [m/s^2] is the largest acceleration, b [m/s^2] the comfortable braking,
T [s] the time headway, s0 [m] the gap at rest, v0 [m/s] the desired speed.
Above v0 the free term is -b [1 - (v0/v)^(4a/b)], so that a lower v0 ahead
brakes by b at most (Treiber and Kesting 2013, Traffic Flow Dynamics, sec. 11.3.7).
Equilibrium gap: s_e = (s0 + v T) / sqrt(1 - (v/v0)^4).

Lateral: MOBIL (Kesting, Treiber, Helbing 2007, TRR 1999, eqs. 2-5). A change is
safe if the new follower's acceleration stays above -b_safe, and wanted if

    (a'_e - a_e) + p [(a'_n - a_n) + (a'_o - a_o)] > threshold

for the driver e, new follower n and old follower o; primes: after the change.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np

from rcirl_jax.data.formats.synthetic.roads import (
    GRID_M,
    LATERAL_REFERENCE_MPS2,
    ROADS,
    STRAIGHT_KAPPA,
    Road,
)

EXPONENT = 4.0  # 1, delta of the IDM (Treiber 2000)
MIN_GAP_M = 0.1  # m, gaps are not taken smaller in the IDM
NUM_WAVES = 3  # sinusoids that make up the drift inside the lane
TRUCK_SPEED = 0.85  # 1, a truck's desired speed over a car's
TRUCK_ACCELERATION = 0.55  # 1, a truck's acceleration over a car's
TRUCK_WIDTH_M = (2.3, 2.5)  # m, range (Directive 96/53/EC: 2.55 m at most)
SIDE_CLEARANCE_M = 1.0  # m kept between two such vehicles in neighbouring lanes
MIN_CHANGE_M = 20.0  # m, a slow car needs this much road to change lanes
CHANGE_BEFORE_BEND_M = 60.0  # m before a bend without new lane changes
CHANGE_BEFORE_STOP_M = 35.0  # m before a stop line without new lane changes
CHANGE_AFTER_ENTRY_M = 45.0  # m after the road's start without lane changes
ROW_M = 1.0e5  # m, longer than any road: keeps the recordings of a batch apart
PAST_STOP_M = 10.0  # m behind a stop line or bend, still without lane changes
MIN_CHANGE_MPS = 4.0  # m/s, slower cars do not begin a lane change
MIN_SIDE_GAP_M = 2.0  # m, gap to the new leader and the new follower
SIDE_GAP_S = 0.25  # s, and this much of the driving time
OWN_BRAKING_MPS2 = 2.0  # m/s^2, a change may cost its driver this much
GO_RIGHT_M = 500.0  # m before the destination: the driver works to the right
GO_RIGHT_MPS2 = 1.5  # m/s^2, incentive to do so
PULL_OVER_M = 30.0  # m before the destination, at least, the car pulls over
PULL_OVER_S = 3.2  # s before it, and
PULL_OVER_MPS2 = 1.5  # m/s^2, before more braking than this is needed
STRIP_CLEAR_M = 12.0  # m around the car's way on the strip that must be free
STOP_AHEAD_M = 300.0  # m, lines and destinations farther ahead do not matter yet
AT_LINE_M = 4.0  # m, standing closer than this counts as standing at the line
AT_REST_MPS = 0.1  # m/s
REVOKE_MPS2 = 1.5  # m/s^2, a light run is given up if this braking is enough
ARRIVED_M = 1.5  # m, standing closer than this to the destination is arriving
GREEN, YELLOW, RED = 0, 1, 2
COLOURS = ("green", "yellow", "red")
STEP_HZ = 20.0  # 1/s, least rate of the simulation steps
ACTUATOR_S = 0.25  # s, lag from the wish to the acceleration (nuPlan: 0.2 s)
HARD_BRAKING_MPS2 = 4.0  # m/s^2, beyond it the driver stamps on the pedal
HARD_JERK_MPS3 = 12.65  # m/s^3, then (UN R157 competent driver)
START_SHARE = 0.3  # a standing car starts if the wish exceeds this share of a
CREEP_MPS = 0.5  # m/s, slower cars that do not want to go come to rest
CREEP_MPS2 = 0.4  # m/s^2, with this braking
PREVIEW_S = 0.7  # s ahead at which a driver reads the desired speed
NOISE_LOWPASS_S = 1.0  # s, makes the acceleration noise smooth
CHANGE_EVERY_S = 0.5  # s between two looks at the neighbouring lanes
ENTRY_M = 12.0  # m, station where vehicles enter
MIN_HEADWAY_S = 1.0  # s, least time between two arrivals in a lane
MIN_ENTRY_SHARE = 0.4  # a vehicle waits to enter below this share of its speed
ENTRY_BRAKING_MPS2 = 1.0  # m/s^2, an entering vehicle must not need more
FILL_LENGTH_M = 16.0  # m between centres of vehicles at the start, at least,
FILL_HEADWAY_S = 0.3  # s, and this above the driver's headway
MIN_TRIP_M = 150.0  # m, nearer destinations are dropped
EXIT_M = 2.0  # m before the road's end, vehicles leave here
POOL = 64  # drivers sampled at once
HISTORY_S = 1.0  # s of past states that are kept for the reaction time

Range = tuple[float, float]  # low, high of a uniform distribution
Spread = tuple[float, float, float, float]  # mean or median, sd, low, high

# one driver with the vehicle; comments give the unit
DRIVER = np.dtype(
    [
        ("speed_factor", "f8"),  # 1, desired speed over the limit
        ("headway", "f8"),  # s, T
        ("jam_gap", "f8"),  # m, s0
        ("acceleration", "f8"),  # m/s^2, a
        ("deceleration", "f8"),  # m/s^2, b
        ("delay", "f8"),  # s, reaction time
        ("lateral", "f8"),  # m/s^2, accepted in curves
        ("politeness", "f8"),  # 1, p
        ("threshold", "f8"),  # m/s^2
        ("safe", "f8"),  # m/s^2, b_safe
        ("change_time", "f8"),  # s, duration of a lane change
        ("line_gap", "f8"),  # m, left to a stop line
        ("sign_wait", "f8"),  # s, standing at a stop sign
        ("dilemma", "f8"),  # m/s^2, yellow: brakes if less than this is needed
        ("length", "f8"),  # m
        ("width", "f8"),  # m
        ("destination", "f8"),  # m, station; inf without one
        ("drift", "f8"),  # m, amplitude of each wave
        ("drift_wave", "f8", (NUM_WAVES,)),  # rad/m
        ("drift_phase", "f8", (NUM_WAVES,)),  # rad
    ]
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DriverConfig:
    """Distributions of the drivers; values in data_specs/sources/synthetic.toml.

    `Range` is uniform. `Spread` is normal (lognormal for `headway_s`: median
    and sd of the logarithm), clipped to its last two values.
    """

    speed_factor: Spread  # 1, desired speed over the limit
    headway_s: Spread  # s, T
    jam_gap_m: Range  # m, s0
    acceleration_mps2: Range  # m/s^2, a
    deceleration_mps2: Range  # m/s^2, b
    emergency_mps2: float  # m/s^2, nobody brakes harder
    delay_s: Range  # s, reaction time
    noise_mps2: float  # m/s^2, sd of the acceleration noise
    noise_time_s: float  # s, its correlation time
    lateral_mps2: Range  # m/s^2, lateral acceleration accepted in curves
    jerk_mps3: float  # m/s^3, limit of the pedals in normal driving
    politeness: Range  # 1
    threshold_mps2: Range  # m/s^2
    safe_mps2: Range  # m/s^2
    change_time_s: Range  # s, duration of a lane change
    change_pause_s: float  # s, least time between the starts of lane changes
    drift_m: float  # m, sd of the drift inside the lane
    drift_period_s: Range  # s, periods of the drift at the speed limit
    line_gap_m: Range  # m, left to a stop line
    sign_wait_s: Range  # s, standing at a stop sign
    dilemma_mps2: Range  # m/s^2
    destination_share: float  # 1, share of car drivers who stop on the way
    car_length_m: Spread  # m
    car_width_m: Spread  # m


# fields of DRIVER that are drawn uniformly, and the setting that says between what
RANGES = {
    "jam_gap": "jam_gap_m",
    "acceleration": "acceleration_mps2",
    "deceleration": "deceleration_mps2",
    "delay": "delay_s",
    "lateral": "lateral_mps2",
    "politeness": "politeness",
    "threshold": "threshold_mps2",
    "safe": "safe_mps2",
    "change_time": "change_time_s",
    "line_gap": "line_gap_m",
    "sign_wait": "sign_wait_s",
    "dilemma": "dilemma_mps2",
}


def sample_drivers(
    rng: np.random.Generator, config: DriverConfig, road: Road, count: int
) -> np.ndarray:
    """`count` drivers with their vehicles, as an array of DRIVER.

    Args:
      rng: consumed.
      config: the distributions.
      road: gives the share of trucks, the places to stop and the drift's room.
      count: number of drivers.
    """
    drivers = np.zeros(count, DRIVER)
    truck = rng.random(count) < road.truck_share
    for name, setting in RANGES.items():
        low, high = getattr(config, setting)
        drivers[name] = rng.uniform(low, high, count)
    drivers["speed_factor"] = _normal(rng, config.speed_factor, count)
    median, sigma, low, high = config.headway_s
    drivers["headway"] = np.clip(median * rng.lognormal(0.0, sigma, count), low, high)
    drivers["length"] = np.where(
        truck,
        rng.uniform(*road.truck_length, count),
        _normal(rng, config.car_length_m, count),
    )
    drivers["width"] = np.where(
        truck,
        rng.uniform(*TRUCK_WIDTH_M, count),
        _normal(rng, config.car_width_m, count),
    )
    drivers["speed_factor"] *= np.where(truck, TRUCK_SPEED, 1.0)
    drivers["acceleration"] *= np.where(truck, TRUCK_ACCELERATION, 1.0)
    stops = (rng.random(count) < config.destination_share) & ~truck
    places = rng.choice(road.parking(), count)
    drivers["destination"] = np.where(stops, places, np.inf)
    # drift l(s) = A sum_i sin(w_i s + p_i) of variance 3 A^2 / 2 = drift_m^2. It runs
    # with the distance, so that a standing car does not slide. Wide vehicles drift
    # less: their peak 3 A leaves room for the neighbour
    periods = rng.uniform(*config.drift_period_s, (count, NUM_WAVES))
    drivers["drift_wave"] = 2.0 * np.pi / (periods * float(road.limit.max()))
    drivers["drift_phase"] = rng.uniform(0.0, 2.0 * np.pi, (count, NUM_WAVES))
    amplitude = config.drift_m * np.sqrt(2.0 / NUM_WAVES)
    room = 0.5 * (road.lane_width - drivers["width"] - SIDE_CLEARANCE_M)
    least = min(amplitude, 0.1 / NUM_WAVES)
    drivers["drift"] = np.clip(room / NUM_WAVES, least, amplitude)
    return drivers


def _normal(rng: np.random.Generator, spread: Spread, count: int) -> np.ndarray:
    mean, sd, low, high = spread
    return np.clip(rng.normal(mean, sd, count), low, high)


def idm_acceleration(
    v: np.ndarray,
    desired: np.ndarray,
    gap: np.ndarray,
    leader_v: np.ndarray,
    driver: np.ndarray,
) -> np.ndarray:
    """IDM acceleration [m/s^2] (module docstring), without the emergency bound.

    Args:
      v: [...] m/s, own speed.
      desired: [...] m/s, v0 here and now.
      gap: [...] m, bumper to bumper; inf without a leader.
      leader_v: [...] m/s, the leader's speed; any number without a leader.
      driver: [...] of DRIVER.
    """
    a, b = driver["acceleration"], driver["deceleration"]
    desired = np.maximum(desired, 0.5)
    below = np.minimum(v / desired, 1.0)
    above = np.minimum(desired / np.maximum(v, desired), 1.0)
    free = np.where(
        v <= desired, a * (1.0 - below**EXPONENT), b * (above ** (EXPONENT * a / b) - 1)
    )
    headway, jam_gap = driver["headway"], driver["jam_gap"]
    return free - interaction(v, gap, leader_v, a, b, headway, jam_gap)


def interaction(
    v: np.ndarray,
    gap: np.ndarray,
    leader_v: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    headway: np.ndarray | float,
    jam_gap: np.ndarray | float,
) -> np.ndarray:
    """Return the IDM's interaction term a (s*/g)^2 [m/s^2], >= 0."""
    closing = v * (v - leader_v) / (2.0 * np.sqrt(a * b))
    wanted = jam_gap + np.maximum(0.0, v * headway + closing)
    return a * (wanted / np.maximum(gap, MIN_GAP_M)) ** 2


def line_acceleration(v: np.ndarray, gap: np.ndarray, driver: np.ndarray) -> np.ndarray:
    """Acceleration bound [m/s^2] of a stop `gap` [m] before the front bumper.

    The IDM's interaction with a standing obstacle, with a short headway and not
    harder than 1.15 times the braking v^2 / (2 g) that is needed, plus 0.3: the
    IDM alone brakes far harder than a human when a light turns late.
    """
    a, b = driver["acceleration"], driver["deceleration"]
    idm = a - interaction(v, gap, np.zeros_like(v), a, b, 0.6, driver["line_gap"])
    room = np.maximum(gap - 0.5 * driver["line_gap"], 0.3)
    return np.maximum(idm, -(1.15 * v**2 / (2.0 * room) + 0.3))


def desired_speed(
    driver: np.ndarray,
    limit_envelope: np.ndarray,
    curve_envelope: np.ndarray,
    stretch: np.ndarray,
) -> np.ndarray:
    """Desired speed [m/s] from the limit and the curve ahead.

    Args:
      driver: [...] of DRIVER.
      limit_envelope: [...] m/s.
      curve_envelope: [...] m/s, for LATERAL_REFERENCE_MPS2 on the line.
      stretch: [...] 1 - kappa l: radius of the own path over the line's.
    """
    curve = np.sqrt(driver["lateral"] / LATERAL_REFERENCE_MPS2 * stretch)
    return np.minimum(driver["speed_factor"] * limit_envelope, curve * curve_envelope)


def drift(driver: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drift inside the lane [m] and its slope dl/ds at stations s [m]."""
    angle = driver["drift_wave"] * s[..., None] + driver["drift_phase"]
    amplitude = driver["drift"]
    slope = np.sum(driver["drift_wave"] * np.cos(angle), axis=-1)
    return amplitude * np.sum(np.sin(angle), axis=-1), amplitude * slope


def quintic(phase: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quintic q = 10 p^3 - 15 p^4 + 6 p^5 and dq/dp: a step with soft ends."""
    p = np.clip(phase, 0.0, 1.0)
    return p**3 * (10.0 - 15.0 * p + 6.0 * p**2), 30.0 * p**2 * (1.0 - p) ** 2


# ----------------------------------------------------------------------- state


class RoadTable:
    """Roads of all recordings, padded to equal sizes; arrays keep their last value."""

    def __init__(self, roads: Sequence[Road]) -> None:
        size = max(road.x.size for road in roads)

        def stack(rows: Iterable[np.ndarray]) -> np.ndarray:
            return np.array([np.pad(x, (0, size - x.size), mode="edge") for x in rows])

        def column(values: Iterable[float]) -> np.ndarray:
            return np.array(list(values))[:, None]

        # [R, G] m/s, envelopes of the limit and of the speed in curves
        self.limit = stack(road.limit_envelope() for road in roads)
        self.curve = stack(road.curve_envelope() for road in roads)
        self.kappa = stack(road.kappa for road in roads)  # [R, G] 1/m
        self.calm = stack(map(_calm, roads))  # [R, G] bool, lane changes may start here
        self.num_lanes = column(road.num_lanes for road in roads)  # [R, 1]
        self.lane_width = column(road.lane_width for road in roads)  # [R, 1] m
        self.length = column(road.length for road in roads)  # [R, 1] m
        self.green = column(road.cycle[0] for road in roads)  # [R, 1] s
        self.yellow = column(road.cycle[1] for road in roads)  # [R, 1] s
        self.cycle = column(sum(road.cycle) for road in roads)  # [R, 1] s
        lines = max(len(road.stops) for road in roads) + 1
        self.stop_s = np.full((len(roads), lines), np.inf)  # m, inf after the last
        self.stop_is_sign = np.zeros((len(roads), lines), bool)
        for r, road in enumerate(roads):
            for i, stop in enumerate(road.stops):
                self.stop_s[r, i] = stop.station
                self.stop_is_sign[r, i] = stop.is_sign

    def index(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the grid index of stations [R, N] m, for use on [R, G] tables."""
        rows = np.arange(s.shape[0])[:, None]
        return rows, np.clip((s / GRID_M).astype(int), 0, self.limit.shape[1] - 1)

    def offset(self, lane: np.ndarray) -> np.ndarray:
        """Return the lateral offset [R, N] m of lane centres."""
        return (0.5 * (self.num_lanes - 1) - lane) * self.lane_width


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
        """Return offset [m] and slope dl/ds of every vehicle."""
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


# ----------------------------------------------------------------- lane changes


def change_lanes(
    state: State,
    table: RoadTable,
    around: Neighbours,
    desired: np.ndarray,
    config: DriverConfig,
    clock: float,
) -> None:
    """Begin at most one lane change per recording: the most wanted safe one.

    One at a time, so that two cars never choose the same gap at once.
    """
    rows, grid = table.index(state.s)
    able = state.alive & (state.phase >= 1.0) & (state.v > MIN_CHANGE_MPS)
    able &= clock - state.changed > config.change_pause_s
    able &= table.calm[rows, grid] & (state.lane < table.num_lanes)
    able &= state.s < table.length - 2.0 * MIN_CHANGE_MPS * config.change_time_s[1]
    gains = np.stack(
        [
            np.where(able, _gain(state, table, around, desired, side), -np.inf)
            for side in (-1, 1)
        ]
    )
    flat = np.moveaxis(gains, 0, 2).reshape(len(state.s), -1)
    best = np.argmax(flat, axis=1)
    for r in np.flatnonzero(flat[np.arange(len(flat)), best] > 0.0):
        slot, right = divmod(int(best[r]), 2)
        begin_change(
            state, int(r), slot, int(state.lane[r, slot]) + 2 * right - 1, clock
        )


def begin_change(state: State, r: int, slot: int, lane: int, clock: float) -> None:
    """From now on the car is in both lanes."""
    state.old_lane[r, slot] = state.lane[r, slot]
    state.lane[r, slot] = lane
    state.phase[r, slot] = 0.0
    state.changed[r, slot] = clock


def _gain(
    state: State, table: RoadTable, around: Neighbours, desired: np.ndarray, side: int
) -> np.ndarray:
    """MOBIL's incentive minus its threshold [m/s^2]; -inf where unsafe."""
    rows = np.arange(len(state.s))[:, None]
    here = 1 << state.lane
    target = state.lane + side
    exists = (target >= 0) & (target < table.num_lanes)
    there = np.where(exists, 1 << np.maximum(target, 0), 0)
    lead, to_lead = around.leader(here)
    behind, to_behind = around.follower(here)
    new_lead, to_new_lead = around.leader(there)
    new_behind, to_new_behind = around.follower(there)
    length = state.driver["length"]

    def follow(i: np.ndarray, leader: np.ndarray, distance: np.ndarray) -> np.ndarray:
        gap = distance - 0.5 * (length[rows, i] + length[rows, leader])
        return idm_acceleration(
            state.v[rows, i],
            desired[rows, i],
            gap,
            state.v[rows, leader],
            state.driver[rows, i],
        )

    me = np.broadcast_to(np.arange(state.s.shape[1]), state.s.shape)
    mine, mine_after = follow(me, lead, to_lead), follow(me, new_lead, to_new_lead)
    # followers that do not exist neither lose nor gain
    has_behind, has_new = np.isfinite(to_behind), np.isfinite(to_new_behind)
    old_now = follow(behind, me, to_behind)
    old_after = follow(behind, lead, to_behind + to_lead)
    new_now = follow(new_behind, new_lead, to_new_behind + to_new_lead)
    new_after = follow(new_behind, me, to_new_behind)
    others = np.where(has_new, new_after - new_now, 0.0)
    others += np.where(has_behind, old_after - old_now, 0.0)
    gain = mine_after - mine + state.driver["politeness"] * others
    # drivers near their destination work to the right
    near = state.driver["destination"] - state.s < GO_RIGHT_M
    near &= state.lane < table.num_lanes
    wish = np.where(near, side * GO_RIGHT_MPS2, 0.0)
    gain += wish - state.driver["threshold"]
    room = MIN_SIDE_GAP_M + SIDE_GAP_S * state.v
    room_behind = MIN_SIDE_GAP_M + SIDE_GAP_S * state.v[rows, new_behind]
    ahead = to_new_lead - 0.5 * (length + length[rows, new_lead])
    back = to_new_behind - 0.5 * (length + length[rows, new_behind])
    safe = exists & (ahead > room) & (mine_after > -OWN_BRAKING_MPS2)
    calm = (back > room_behind) & (new_after > -state.driver["safe"])
    return np.where(safe & (~has_new | calm), gain, -np.inf)


def pull_over(
    state: State, table: RoadTable, config: DriverConfig, clock: float
) -> None:
    """Move drivers at their destination off the right lane, or give it up.

    They give up if they are not in the right lane in time or if somebody
    stands where they want to.
    """
    left = state.driver["destination"] - state.s
    on_strip = state.lane >= table.num_lanes
    reach = np.maximum(PULL_OVER_S * state.v, state.v**2 / (2.0 * PULL_OVER_MPS2))
    near = state.alive & ~on_strip & (left < np.maximum(PULL_OVER_M, reach))
    for r, slot in zip(*np.nonzero(near), strict=True):
        if state.phase[r, slot] < 1.0 or state.lane[r, slot] < table.num_lanes[r] - 1:
            state.driver["destination"][r, slot] = np.inf
            continue
        strip = on_strip[r] & state.alive[r]
        behind = state.s[r] > state.s[r, slot] - STRIP_CLEAR_M
        before = state.s[r] < state.driver["destination"][r, slot] + STRIP_CLEAR_M
        if np.any(strip & behind & before):
            state.driver["destination"][r, slot] = np.inf
        else:
            begin_change(state, r, slot, int(table.num_lanes[r, 0]), clock)
            on_strip[r, slot] = True


# ----------------------------------------------------------------------- stops


def schedule(
    cycle: tuple[float, float, float], offset: float, end: float
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Starts [s] and colours of a light's intervals that cover 0 .. end s."""
    starts, colours = [], []
    start = -offset
    while start <= end:
        for colour, seconds in zip(COLOURS, cycle, strict=True):
            if start + seconds > 0.0 and start <= end:
                starts.append(max(start, 0.0))
                colours.append(colour)
            start += seconds
    return np.array(starts), tuple(colours)


def stop_acceleration(
    state: State, table: RoadTable, offsets: np.ndarray, clock: float, dt: float
) -> np.ndarray:
    """Bound [m/s^2] from stop lines and destinations; inf where nothing demands.

    A light that is not green is seen after the reaction time. The driver then
    decides once: brake, unless more than `dilemma` would be needed. At a stop
    sign the driver stands `sign_wait` at the line, then goes.

    Args:
      state: `next_stop`, `decided`, `committed`, `stood` are updated.
      table: the roads.
      offsets: [R, S + 1] s, of the lights.
      clock: s.
      dt: s.
    """
    rows = np.arange(len(state.s))[:, None]
    half = 0.5 * state.driver["length"]
    gap = table.stop_s[rows, state.next_stop] - state.s - half
    passed = gap < 0.0
    state.next_stop += passed
    for flags in (state.decided, state.committed):
        flags &= ~passed
    gap = table.stop_s[rows, state.next_stop] - state.s - half
    sign = table.stop_is_sign[rows, state.next_stop]
    seen = clock - state.driver["delay"]
    into = np.mod(seen + offsets[rows, state.next_stop], table.cycle)
    colour = (into >= table.green).astype(int) + (into >= table.green + table.yellow)
    demand = np.isfinite(gap) & (sign | (colour != GREEN))
    # yellow and red lights: brake or drive on
    lit = demand & ~sign
    needed = state.v**2 / (2.0 * np.maximum(gap - 0.5, 0.1))
    state.committed |= lit & ~state.decided & (needed > state.driver["dilemma"])
    state.committed &= lit & ~((colour == RED) & (needed < REVOKE_MPS2))
    state.decided = lit
    # stop signs: count the time at the line; after `sign_wait` it is done
    at_line = demand & sign & (gap < AT_LINE_M) & (state.v < AT_REST_MPS) & state.alive
    state.stood = np.where(at_line, state.stood + dt, 0.0)
    state.next_stop += at_line & (state.stood >= state.driver["sign_wait"])
    demand &= ~state.committed & (gap < STOP_AHEAD_M)
    gap = np.where(demand, gap, 1.0)
    bound = np.where(demand, line_acceleration(state.v, gap, state.driver), np.inf)
    left = state.driver["destination"] - state.s
    near = state.alive & (left < STOP_AHEAD_M)
    state.parked |= near & (np.abs(left) < ARRIVED_M) & (state.v < AT_REST_MPS)
    # the line is placed so that the gap left to it is used up at the destination
    gap = np.maximum(np.where(near, left + state.driver["line_gap"], 1.0), 0.05)
    at_destination = line_acceleration(state.v, gap, state.driver)
    return np.minimum(bound, np.where(near, at_destination, np.inf))


# ------------------------------------------------------------------ simulation


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunConfig:
    """One recording to be simulated."""

    road: str  # key of `ROADS`
    duration_s: float  # s, length of the recording
    density_veh_per_km: float  # vehicles per km and lane, at the speed limit
    seed: tuple[int, ...]  # of the recording's random stream
    rate_hz: float  # samples per second
    warmup_s: float  # s simulated before the recording starts


@dataclasses.dataclass(frozen=True, kw_only=True)
class Log:
    """Samples of one simulated recording: K times, n slots."""

    road: Road
    vehicle: np.ndarray  # [K, n] vehicle number, -1 where the slot is empty
    s: np.ndarray  # [K, n] m
    l: np.ndarray  # [K, n] m
    slope: np.ndarray  # [K, n] dl/ds
    v: np.ndarray  # [K, n] m/s
    drivers: np.ndarray  # [vehicles] of DRIVER, by vehicle number
    signal_offset: np.ndarray  # [stops] s into the cycle at the first sample


class _Source:
    """Random stream, drivers and arrivals of one recording."""

    def __init__(self, run: RunConfig, config: DriverConfig, road: Road) -> None:
        self.rng = np.random.default_rng(run.seed)
        self.config, self.road, self.density = config, road, run.density_veh_per_km
        self.pool = sample_drivers(self.rng, config, road, POOL)
        self.used = 0
        cycle = sum(road.cycle)
        self.signal_offset = self.rng.uniform(0.0, cycle, len(road.stops))
        self.next_arrival = -run.warmup_s + self._headways(road.num_lanes)
        alive = run.density_veh_per_km * road.num_lanes * road.length / 1000.0
        self.capacity = int(np.ceil(1.7 * alive)) + 10

    def _headways(self, count: int) -> np.ndarray:
        """Shifted exponential times between arrivals in a lane, s."""
        mean = 1000.0 / (self.density * float(self.road.limit[0]))
        rest = max(mean - MIN_HEADWAY_S, 0.1)
        return MIN_HEADWAY_S + self.rng.exponential(rest, count)

    def peek(self) -> np.ndarray:
        """Return the driver who enters next."""
        if self.used == len(self.pool):
            more = sample_drivers(self.rng, self.config, self.road, POOL)
            self.pool = np.concatenate([self.pool, more])
        return self.pool[self.used, ...]

    def arrived(self, lane: int, clock: float) -> None:
        """Draw the next arrival of a lane."""
        self.next_arrival[lane] = clock + self._headways(1)[0]
        self.used += 1


class Traffic:
    """Batch of simulated recordings; `step` advances all of them."""

    def __init__(self, runs: Sequence[RunConfig], config: DriverConfig) -> None:
        self.config = config
        self.substeps = int(np.ceil(STEP_HZ / runs[0].rate_hz))  # steps per sample
        self.dt = 1.0 / (runs[0].rate_hz * self.substeps)
        self.clock = -runs[0].warmup_s
        self.roads = [ROADS[run.road]() for run in runs]
        self.table = RoadTable(self.roads)
        self.sources = [
            _Source(run, config, road)
            for run, road in zip(runs, self.roads, strict=True)
        ]
        slots = max(source.capacity for source in self.sources)
        self.state = State(len(runs), slots)
        self.offsets = np.zeros(self.table.stop_s.shape)
        depth = int(np.ceil(max(HISTORY_S, config.delay_s[1]) / self.dt)) + 2
        self.past = np.zeros((2, depth, *self.state.s.shape))  # s and v
        self.count = 0
        for r, source in enumerate(self.sources):
            self.offsets[r, : source.signal_offset.size] = source.signal_offset
            self._fill(r)

    # ------------------------------------------------------------ vehicles

    def _fill(self, r: int) -> None:
        """Vehicles at the start, front to back, spaced by the density."""
        source, road = self.sources[r], self.roads[r]
        for lane in range(road.num_lanes):
            station = road.length - float(source.rng.uniform(20.0, 40.0))
            while station > ENTRY_M + FILL_LENGTH_M:
                driver = source.peek()
                v = self._cruise(r, driver, station)
                if not self.add(r, lane, station, min(v, float(road.limit.min()))):
                    return
                least = (
                    FILL_LENGTH_M
                    + driver["jam_gap"]
                    + v * (driver["headway"] + FILL_HEADWAY_S)
                )
                rest = max(1000.0 / source.density - least, 2.0)
                station -= float(least + source.rng.exponential(rest))

    def _cruise(self, r: int, driver: np.ndarray, station: float) -> float:
        rows, grid = self.table.index(np.full((len(self.roads), 1), station))
        limit, curve = (
            table[rows, grid][r, 0] for table in (self.table.limit, self.table.curve)
        )
        return float(desired_speed(driver, limit, curve, np.ones(())))

    def add(self, r: int, lane: int, station: float, v: float) -> bool:
        """Place the next vehicle of recording r; False if no slot is free."""
        state, source = self.state, self.sources[r]
        free = np.flatnonzero(state.vehicle[r, : source.capacity] < 0)
        if free.size == 0:
            return False
        slot = free[0]
        state.driver[r, slot] = source.peek()
        state.vehicle[r, slot] = source.used
        state.s[r, slot], state.v[r, slot], state.a[r, slot] = station, v, 0.0
        state.lane[r, slot] = state.old_lane[r, slot] = lane
        state.phase[r, slot], state.changed[r, slot] = 1.0, -np.inf
        state.stood[r, slot] = 0.0
        for flags in (state.decided, state.committed, state.parked):
            flags[r, slot] = False
        front = station + 0.5 * state.driver["length"][r, slot]
        state.next_stop[r, slot] = np.searchsorted(self.table.stop_s[r], front)
        # the past that others perceive: at constant speed
        depth = self.past.shape[1]
        age = np.mod(self.count - np.arange(depth), depth) * self.dt
        self.past[0, :, r, slot], self.past[1, :, r, slot] = station - v * age, v
        if state.driver["destination"][r, slot] < station + MIN_TRIP_M:
            state.driver["destination"][r, slot] = np.inf
        source.arrived(lane, self.clock)
        return True

    def _enter(self) -> None:
        """Vehicles that are due and find room."""
        state = self.state
        for r, source in enumerate(self.sources):
            for lane in np.flatnonzero(source.next_arrival <= self.clock):
                driver = source.peek()
                inside = (state.occupied()[r] & (1 << int(lane))) != 0
                v = self._cruise(r, driver, ENTRY_M)
                entry = v
                if inside.any():
                    last = np.flatnonzero(inside)[np.argmin(state.s[r][inside])]
                    lengths = driver["length"] + state.driver["length"][r, last]
                    gap = state.s[r, last] - ENTRY_M - 0.5 * lengths
                    room = max(gap - driver["jam_gap"], 0.0)
                    entry = min(v, room / driver["headway"])
                    leader = state.v[r, last] ** 2 + 2.0 * ENTRY_BRAKING_MPS2 * room
                    entry = min(entry, float(np.sqrt(leader)))
                if entry > MIN_ENTRY_SHARE * v:
                    self.add(r, int(lane), ENTRY_M, entry)

    def _leave(self) -> None:
        """Vehicles at the road's end; their last destination is kept."""
        state = self.state
        gone = state.alive & (state.s > self.table.length - EXIT_M)
        self.keep_destinations(gone)
        state.vehicle[gone] = -1

    def keep_destinations(self, of: np.ndarray) -> None:
        """Write back the destinations that drivers `of` [R, N] hold or gave up."""
        for r, slot in zip(*np.nonzero(of), strict=True):
            number = self.state.vehicle[r, slot]
            place = self.state.driver["destination"][r, slot]
            self.sources[r].pool["destination"][number] = place

    # --------------------------------------------------------------- motion

    def step(self) -> None:
        """Advance by dt."""
        self._enter()
        state, table = self.state, self.table
        depth = self.past.shape[1]
        self.past[0, self.count % depth] = state.s
        self.past[1, self.count % depth] = state.v
        rows, grid = table.index(state.s)
        offset, slope = state.lateral(table)
        stretch = 1.0 - table.kappa[rows, grid] * offset
        desired = self._desired(state.s, stretch)
        around = Neighbours(state, int(table.num_lanes.max()) + 1)
        wish = self._wish(around, desired, stretch)
        if self.count % max(int(round(CHANGE_EVERY_S / self.dt)), 1) == 0:
            pull_over(state, table, self.config, self.clock)
            change_lanes(state, table, around, desired, self.config, self.clock)
        self._move(wish, np.hypot(stretch, slope))
        self._leave()
        self.count += 1
        self.clock += self.dt

    def _desired(self, s: np.ndarray, stretch: np.ndarray) -> np.ndarray:
        """Desired speed [m/s] of every driver at stations s [R, N] m."""
        rows, grid = self.table.index(s)
        limit, curve = self.table.limit[rows, grid], self.table.curve[rows, grid]
        return desired_speed(self.state.driver, limit, curve, stretch)

    def _wish(
        self, around: Neighbours, desired: np.ndarray, stretch: np.ndarray
    ) -> np.ndarray:
        """Acceleration [m/s^2] the drivers want."""
        state, driver = self.state, self.state.driver
        leader, distance = around.leader(around.lanes)
        gap, leader_v = self._perceive(leader, distance, stretch)
        wish = idm_acceleration(state.v, desired, gap, leader_v, driver)
        stops = stop_acceleration(state, self.table, self.offsets, self.clock, self.dt)
        # keep to a falling desired speed, of curves and limits, by a profile of
        # constant braking without lag; the IDM's free term alone lags behind it
        ahead = self._desired(state.s + PREVIEW_S * state.v, stretch)
        profile = (ahead - state.v) / PREVIEW_S
        bounds = np.minimum(stops, np.maximum(profile, -driver["deceleration"]))
        wish = np.minimum(wish, bounds) + self._noise()
        wish = np.clip(wish, -self.config.emergency_mps2, driver["acceleration"])
        idle = wish < START_SHARE * driver["acceleration"]
        slow = state.v < CREEP_MPS
        wish = np.where(idle & slow, np.minimum(wish, -CREEP_MPS2), wish)
        return np.where(state.parked, -CREEP_MPS2, wish)

    def _perceive(
        self, leader: np.ndarray, distance: np.ndarray, stretch: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gap [m] and speed [m/s] of the leader as seen a reaction time ago.

        Drivers extrapolate what they saw at constant speed to the present
        (human driver model: Treiber, Kneuebuehl, Kesting 2006, sec. 3.4).
        """
        state, depth = self.state, self.past.shape[1]
        age = np.round(state.driver["delay"] / self.dt).astype(int)
        rows = np.arange(len(state.s))[:, None]
        then = np.mod(self.count - age, depth)
        seen_s, seen_v = self.past[:, then, rows, leader]
        length = state.driver["length"]
        apart = seen_s + seen_v * age * self.dt - state.s
        gap = apart * stretch - 0.5 * (length + length[rows, leader])
        return np.where(np.isfinite(distance), gap, np.inf), seen_v

    def _noise(self) -> np.ndarray:
        """Smooth acceleration noise [m/s^2]: Ornstein-Uhlenbeck, low-passed.

        The low-pass divides the variance by (tau + tau_lp) / tau; the drive
        makes up for it.
        """
        sd, tau = self.config.noise_mps2, self.config.noise_time_s
        drawn = np.zeros(self.state.s.shape)
        for r, source in enumerate(self.sources):
            drawn[r, : source.capacity] = source.rng.standard_normal(source.capacity)
        drive = sd * np.sqrt((tau + NOISE_LOWPASS_S) / tau * 2.0 * self.dt / tau)
        first, smooth = self.state.noise
        smooth += self.dt / NOISE_LOWPASS_S * (first - smooth)
        first += -self.dt / tau * first + drive * drawn
        return smooth

    def _move(self, wish: np.ndarray, stretch: np.ndarray) -> None:
        """Actuator with lag and bounded jerk, then positions.

        Args:
          wish: [R, N] m/s^2.
          stretch: [R, N] m of path per m of station.
        """
        state, dt = self.state, self.dt
        bound = np.where(
            wish < -HARD_BRAKING_MPS2, HARD_JERK_MPS3, self.config.jerk_mps3
        )
        jerk = np.clip((wish - state.a) / ACTUATOR_S, -bound, bound)
        state.a = state.a + jerk * dt
        v = np.maximum(state.v + state.a * dt, 0.0)
        moved = np.where(state.alive, 0.5 * (state.v + v) * dt / stretch, 0.0)
        state.a = np.where((v <= 0.0) & (state.a < 0.0), 0.0, state.a)
        rate = state.advance_per_metre()
        state.phase = np.minimum(state.phase + rate * moved, 1.0)
        state.s, state.v = state.s + moved, v


def simulate(runs: Sequence[RunConfig], config: DriverConfig) -> list[Log]:
    """Simulate recordings of equal duration, warm-up and rate together.

    Args:
      runs: one per recording.
      config: the drivers.

    Returns:
      One log per run, sampled at `rate_hz` from 0 s to `duration_s`.
    """
    traffic = Traffic(runs, config)
    for _ in range(int(round(runs[0].warmup_s / traffic.dt))):
        traffic.step()
    traffic.clock = 0.0
    rows = []
    for _ in range(int(round(runs[0].duration_s * runs[0].rate_hz))):
        state = traffic.state
        offset, slope = state.lateral(traffic.table)
        now = (state.vehicle, state.s, state.v)
        rows.append((*(x.copy() for x in now), offset, slope))
        for _ in range(traffic.substeps):
            traffic.step()
    traffic.keep_destinations(traffic.state.alive)
    vehicle, s, v, l, slope = map(np.stack, zip(*rows, strict=True))
    return [
        Log(
            road=source.road,
            vehicle=vehicle[:, r, : source.capacity],
            s=s[:, r, : source.capacity],
            l=l[:, r, : source.capacity],
            slope=slope[:, r, : source.capacity],
            v=v[:, r, : source.capacity],
            drivers=source.pool[: source.used],
            signal_offset=source.signal_offset,
        )
        for r, source in enumerate(traffic.sources)
    ]
