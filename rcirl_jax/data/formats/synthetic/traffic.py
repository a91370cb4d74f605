"""Synthetic human traffic: drivers, lane changes, stops, and the simulation.

Cars of several recordings advance together as one array. All that is random is drawn
when a recording is planned, from its own stream, so that it does not depend on the
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
from collections.abc import Mapping, Sequence

import numpy as np

from rcirl_jax.data.formats.synthetic.roads import GRID_M, LATERAL_REFERENCE_MPS2, ROADS

# name of a driver's parameter: bounds of what a TOML may give
DRIVER = {
    "speed_factor": (0.1, 3.0),  # 1, desired speed over the limit
    "headway_s": (0.1, 10.0),  # s, T
    "jam_gap_m": (0.1, 50.0),  # m, s0
    "acceleration_mps2": (0.1, 10.0),  # m/s^2, a
    "deceleration_mps2": (0.1, 10.0),  # m/s^2, b
    "emergency_mps2": (0.1, 20.0),  # m/s^2, the driver never brakes harder
    "delay_s": (0.0, 5.0),  # s, reaction time to lights
    "noise_mps2": (0.0, 2.0),  # m/s^2, sd of the acceleration noise
    "noise_period_s": (1.0, 1000.0),  # s, its periods
    "lateral_mps2": (0.1, 10.0),  # m/s^2, lateral acceleration accepted in curves
    "jerk_mps3": (0.1, 100.0),  # m/s^3, limit of the pedals in normal driving
    "politeness": (0.0, 10.0),  # 1, p
    "threshold_mps2": (0.0, 1e6),  # m/s^2
    "safe_mps2": (0.1, 20.0),  # m/s^2, b_safe
    "change_time_s": (1.0, 60.0),  # s, duration of a lane change
    "change_pause_s": (0.0, 1e6),  # s, least time between the starts of lane changes
    "drift_m": (0.0, 1.0),  # m, sd of the drift inside the lane
    "drift_period_s": (1.0, 1000.0),  # s, its periods at the speed limit
    "line_gap_m": (0.1, 20.0),  # m, left to a stop line
    "sign_wait_s": (0.0, 60.0),  # s, standing at a stop sign
    "dilemma_mps2": (0.1, 20.0),  # m/s^2, yellow: brakes if less than this is needed
    "destination_share": (0.0, 1.0),  # 1, probability of a stop on the way
    "car_length_m": (1.0, 20.0),  # m
    "car_width_m": (0.5, 3.0),  # m
}
NUM_WAVES = 3  # sinusoids that make up the drift inside the lane, and the noise
CAR = np.dtype(
    [(name, "f8") for name in DRIVER]
    + [(f"{of}_{what}", "f8", NUM_WAVES) for of in ("drift", "noise") for what in "wp"]
    + [
        ("recording", "i8"),  # number in the batch
        ("number", "i8"),  # of the car in its recording
        ("due", "f8"),  # s, when it arrives at ENTRY_M; -inf: there at the start
        ("destination", "f8"),  # m, station; inf without one
        ("row", "i8"),  # LANES * recording + lane, where the car is or changes to
        ("old_row", "i8"),  # where a change began
        ("phase", "f8"),  # of the lane change, 0 to 1; 1: none
        ("changed", "f8"),  # s, start of the last change
        ("s", "f8"),  # m, station of the box centre
        ("v", "f8"),  # m/s, along the own path
        ("a", "f8"),  # m/s^2
        ("next_stop", "i8"),  # index of the stop line ahead
        ("decided", "?"),  # saw that the light is not green
        ("committed", "?"),  # drives on although it is not
        ("stood", "f8"),  # s, standing at a stop sign
        ("parked", "?"),  # at the destination, for good
    ]
)
SAMPLED = ("recording", "number", "s", "v", "car_length_m", "car_width_m")
LANES = 8  # rows of a recording, more than any road has lanes
ROW_M = 1.0e5  # m, longer than any road: keeps the rows apart
CYCLE_S = (22.0, 4.0, 24.0)  # s of green, yellow and red
COLOURS = ("green", "yellow", "red")
GREEN, _, RED = range(3)
STEP_HZ = 20.0  # 1/s, least rate of the simulation steps

EXPONENT = 4.0  # 1, delta of the IDM (Treiber 2000)
MIN_GAP_M = 0.1  # m, gaps are not taken smaller in the IDM
TRUCK_SPEED = 0.85  # 1, a truck's desired speed over a car's
TRUCK_ACCELERATION = 0.55  # 1, a truck's acceleration over a car's
TRUCK_WIDTH_M = (2.3, 2.5)  # m, range (Directive 96/53/EC: 2.55 m at most)
SIDE_CLEARANCE_M = 1.0  # m kept between two such vehicles in neighbouring lanes
MIN_CHANGE_M = 20.0  # m, a slow car needs this much road to change lanes
MIN_CHANGE_MPS = 4.0  # m/s, slower cars do not begin a lane change
CHANGE_EVERY_S = 0.5  # s between two looks at the neighbouring lanes
SIDE_GAP_M, SIDE_GAP_S = 2.0, 0.25  # m and s of driving, left to others in a change
OWN_BRAKING_MPS2 = 2.0  # m/s^2, a change may cost its driver this much
GO_RIGHT_M = 500.0  # m before the destination: the driver works to the right
GO_RIGHT_MPS2 = 1.5  # m/s^2, incentive to do so
PULL_OVER_M = 30.0  # m before the destination, at least, the car pulls over
PULL_OVER_S = 3.2  # s before it, and
PULL_OVER_MPS2 = 1.5  # m/s^2, before more braking than this is needed
STRIP_CLEAR_M = 12.0  # m around the car's way on the strip that must be free
AT_LINE_M = 4.0  # m, standing closer than this counts as standing at the line
AT_REST_MPS = 0.1  # m/s
REVOKE_MPS2 = 1.5  # m/s^2, a light run is given up if this braking is enough
ARRIVED_M = 1.5  # m, standing closer than this to the destination is arriving
ACTUATOR_S = 0.25  # s, lag from the wish to the acceleration (nuPlan: 0.2 s)
HARD_BRAKING_MPS2 = 4.0  # m/s^2, beyond it the driver stamps on the pedal
HARD_JERK_MPS3 = 12.65  # m/s^3, then (UN R157 competent driver)
START_SHARE = 0.3  # a standing car starts if the wish exceeds this share of a
CREEP_MPS = 0.5  # m/s, slower cars that do not want to go come to rest
CREEP_MPS2 = 0.4  # m/s^2, with this braking
PREVIEW_S = 0.7  # s ahead at which a driver reads the desired speed
ENTRY_M = 12.0  # m, station where vehicles enter
MIN_HEADWAY_S = 1.0  # s, least time between two arrivals in a lane
MIN_ENTRY_SHARE = 0.4  # a vehicle waits to enter below this share of its speed
ENTRY_BRAKING_MPS2 = 1.0  # m/s^2, an entering vehicle must not need more
FILL_M, FILL_S = 18.0, 1.7  # m and s of driving between vehicles at the start, at least
MIN_TRIP_M = 150.0  # m, nearer destinations are dropped
EXIT_M = 2.0  # m before the road's end, vehicles leave here


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunConfig:
    """One recording to be simulated."""

    road: str  # key of `ROADS`
    duration_s: float  # s, length of the recording
    density_veh_per_km: float  # vehicles per km and lane, at the speed limit
    seed: tuple[int, ...]  # of the recording's random stream
    rate_hz: float  # samples per second
    warmup_s: float  # s simulated before the recording starts


def _draw(rng: np.random.Generator, spread: Sequence[float], count: int) -> np.ndarray:
    """Draws [count] of a number, [low, high] or [mean, sd, low, high]."""
    if len(spread) == 4:
        mean, sd, low, high = spread
        return np.clip(rng.normal(mean, sd, count), low, high)
    return rng.uniform(spread[0], spread[-1], count)


def plan(
    run: RunConfig, drivers: Mapping[str, Sequence[float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Draws all cars of a recording, and the offset of each light into its cycle.

    Returns:
      Cars [n] of CAR, by lane and time; offsets [lights] s.
    """
    rng, road = np.random.default_rng(run.seed), ROADS[run.road]
    spacing, limit = 1000.0 / run.density_veh_per_km, float(road.limit.min())
    least, total = FILL_M + FILL_S * limit, run.warmup_s + run.duration_s
    rows, stations, due = [], [], []
    for lane in range(road.num_lanes):
        rest = rng.exponential(max(spacing - least, 2.0), int(road.length / least) + 1)
        s = road.length - 20.0 - np.cumsum(least + rest)
        s = s[s > ENTRY_M + FILL_M]
        pause = spacing / float(road.limit[0])
        rest = max(pause - MIN_HEADWAY_S, 0.1)
        count = int(total / MIN_HEADWAY_S) + 1
        t = np.cumsum(MIN_HEADWAY_S + rng.exponential(rest, count)) - run.warmup_s
        t = t[t < run.duration_s]
        stations += [s, np.full(t.size, ENTRY_M)]
        due += [np.full(s.size, -np.inf), t]
        rows.append(np.full(s.size + t.size, lane))
    cars = np.zeros(sum(map(len, rows)), CAR)
    count, cars["row"] = cars.size, np.concatenate(rows)
    cars["s"], cars["due"] = np.concatenate(stations), np.concatenate(due)
    for name in DRIVER:
        cars[name] = _draw(rng, drivers[name], count)
    truck = rng.random(count) < road.truck_share
    cars["car_length_m"][truck] = rng.uniform(*road.truck_length, truck.sum())
    cars["car_width_m"][truck] = rng.uniform(*TRUCK_WIDTH_M, truck.sum())
    cars["speed_factor"][truck] *= TRUCK_SPEED
    cars["acceleration_mps2"][truck] *= TRUCK_ACCELERATION
    place = rng.choice(road.parking(), count)
    stops = (rng.random(count) < cars["destination_share"]) & ~truck
    stops &= place > cars["s"] + MIN_TRIP_M
    cars["destination"] = np.where(stops, place, np.inf)
    # A sum_i sin(w_i x + p_i) has the variance 3 A^2 / 2. The drift runs with the
    # distance, so that a standing car does not slide. Wide vehicles drift less: their
    # peak 3 A leaves room for the neighbour
    for of, unit in (("drift", float(road.limit.max())), ("noise", 1.0)):
        periods = [_draw(rng, drivers[f"{of}_period_s"], count) for _ in range(3)]
        cars[f"{of}_w"] = 2.0 * np.pi / (np.stack(periods, axis=1) * unit)
        cars[f"{of}_p"] = rng.uniform(0.0, 2.0 * np.pi, (count, NUM_WAVES))
    for name in ("drift_m", "noise_mps2"):
        cars[name] *= np.sqrt(2.0 / NUM_WAVES)
    room = 0.5 * (road.lane_width - cars["car_width_m"] - SIDE_CLEARANCE_M)
    cars["drift_m"] = np.minimum(cars["drift_m"], np.maximum(room, 0.1) / NUM_WAVES)
    cars["number"], cars["old_row"] = np.arange(count), cars["row"]
    cars["phase"], cars["changed"] = 1.0, -np.inf
    return cars, rng.uniform(0.0, sum(CYCLE_S), len(road.lights))


def schedule(offset: float, end: float) -> tuple[np.ndarray, tuple[str, ...]]:
    """Starts [s] and colours of a light's intervals that cover 0 .. end s."""
    lasts = np.tile(CYCLE_S, int((end + offset) / sum(CYCLE_S)) + 1)
    until = np.cumsum(lasts) - offset
    shown = (until > 0.0) & (until - lasts <= end)
    starts = np.maximum(until - lasts, 0.0)[shown]
    return starts, tuple(COLOURS[i % 3] for i in np.flatnonzero(shown))


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
      driver: [...] of CAR.
    """
    a, b = driver["acceleration_mps2"], driver["deceleration_mps2"]
    desired = np.maximum(desired, 0.5)
    below = np.minimum(v / desired, 1.0)
    above = np.minimum(desired / np.maximum(v, desired), 1.0)
    free = np.where(
        v <= desired, a * (1.0 - below**EXPONENT), b * (above ** (EXPONENT * a / b) - 1)
    )
    wanted = driver["jam_gap_m"] + np.maximum(
        0.0, v * driver["headway_s"] + v * (v - leader_v) / (2.0 * np.sqrt(a * b))
    )
    return free - a * (wanted / np.maximum(gap, MIN_GAP_M)) ** 2


def line_acceleration(v: np.ndarray, gap: np.ndarray, driver: np.ndarray) -> np.ndarray:
    """Acceleration bound [m/s^2] of a stop `gap` [m] before the front bumper.

    The IDM's interaction with a standing obstacle, with a short headway and not
    harder than 1.15 times the braking v^2 / (2 g) that is needed, plus 0.3: the
    IDM alone brakes far harder than a human when a light turns late.
    """
    a, b = driver["acceleration_mps2"], driver["deceleration_mps2"]
    wanted = driver["line_gap_m"] + v * 0.6 + v**2 / (2.0 * np.sqrt(a * b))
    idm = a - a * (wanted / np.maximum(gap, MIN_GAP_M)) ** 2
    room = np.maximum(gap - 0.5 * driver["line_gap_m"], 0.3)
    return np.maximum(idm, -(1.15 * v**2 / (2.0 * room) + 0.3))


class Neighbours:
    """Finds who is ahead and behind; a car that changes lanes is in both rows.

    Args:
      cars: [n] of CAR.
    """

    def __init__(self, cars: np.ndarray) -> None:
        self._s = cars["s"].copy()
        both = np.flatnonzero(cars["phase"] < 1.0)
        car = np.concatenate([np.arange(cars.size), both])
        rows = np.concatenate([cars["row"], cars["old_row"][both]])
        keys = rows * ROW_M + self._s[car]
        order = np.argsort(keys)
        self._keys, self._car, self._rows = keys[order], car[order], rows[order]

    def find(self, rows: np.ndarray, ahead: bool) -> tuple[np.ndarray, np.ndarray]:
        """Finds the nearest car ahead of, or behind, each car in the row given for it.

        Returns:
          Its index [n], and its distance [n] m from centre to centre; inf: nobody.
        """
        side, shift = ("right", 0) if ahead else ("left", -1)
        at = np.searchsorted(self._keys, rows * ROW_M + self._s, side) + shift
        inside = (at >= 0) & (at < self._keys.size)
        at = np.clip(at, 0, self._keys.size - 1)
        found, inside = self._car[at], inside & (self._rows[at] == rows)
        return found, np.where(inside, np.abs(self._s[found] - self._s), np.inf)


class Traffic:
    """Batch of simulated recordings of equal duration, rate and warm-up."""

    def __init__(
        self, runs: Sequence[RunConfig], drivers: Mapping[str, Sequence[float]]
    ) -> None:
        substeps = int(np.ceil(STEP_HZ / runs[0].rate_hz))
        self.steps_per_sample, self.dt = substeps, 1.0 / (runs[0].rate_hz * substeps)
        self.count, self.clock = 0, -runs[0].warmup_s
        roads = [ROADS[run.road] for run in runs]
        # tables of all roads, one after the other
        self._start = np.cumsum([0, *(road.x.size for road in roads)])
        self._limit = np.concatenate([road.limit_envelope() for road in roads])
        self._curve = np.concatenate([road.curve_envelope() for road in roads])
        self._kappa = np.concatenate([road.kappa for road in roads])
        self._calm = np.concatenate([road.changes_allowed() for road in roads])
        self._length = np.array([road.length for road in roads])
        self._num_lanes = np.array([road.num_lanes for road in roads])
        self._lane_width = np.array([road.lane_width for road in roads])
        lines = max(road.stops.size for road in roads) + 1
        self._stop_s = np.full((len(roads), lines), np.inf)  # m, inf after the last
        self._is_sign = np.zeros((len(roads), lines), bool)
        self._cycle_at = np.zeros((len(roads), lines))  # s into the cycle at 0 s
        self.light_offsets, planned = [], []
        for r, (run, road) in enumerate(zip(runs, roads, strict=True)):
            cars, offsets = plan(run, drivers)
            cars["recording"] = r
            for name in ("row", "old_row"):
                cars[name] += LANES * r
            self._stop_s[r, : road.stops.size] = road.stops
            self._is_sign[r, len(road.lights) : road.stops.size] = True
            self._cycle_at[r, : offsets.size] = offsets
            self.light_offsets.append(offsets)
            front = cars["s"] + 0.5 * cars["car_length_m"]
            cars["next_stop"] = np.searchsorted(self._stop_s[r], front)
            planned.append(cars)
        cars = np.concatenate(planned)
        there = np.isneginf(cars["due"])
        self.cars, self._waiting = cars[there], cars[~there]
        slow = np.array([road.limit.min() for road in roads])[self.cars["recording"]]
        self.cars["v"] = np.minimum(self._desired(self.cars, self.cars["s"]), slow)
        # the queue of each row is waiting[next:end]
        rows = np.arange(LANES * len(roads))
        self._next = np.searchsorted(self._waiting["row"], rows)
        self._end = np.searchsorted(self._waiting["row"], rows, side="right")

    def _grid(self, cars: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Returns the index [n] of stations [n] m in the tables."""
        start, end = (self._start[cars["recording"] + i] for i in (0, 1))
        return np.clip(start + (s / GRID_M).astype(int), start, end - 1)

    def _desired(
        self, cars: np.ndarray, s: np.ndarray, stretch: np.ndarray | float = 1.0
    ) -> np.ndarray:
        """Desired speed [n] m/s at stations s [n] m, from the limit and curve ahead.

        `stretch` is 1 - kappa l: radius of the own path over the line's.
        """
        at = self._grid(cars, s)
        curve = np.sqrt(cars["lateral_mps2"] / LATERAL_REFERENCE_MPS2 * stretch)
        limit = cars["speed_factor"] * self._limit[at]
        return np.minimum(limit, curve * self._curve[at])

    def _offset(self, rows: np.ndarray) -> np.ndarray:
        """Lateral offset [n] m of the rows' centres."""
        road, lane = np.divmod(rows, LANES)
        return (0.5 * (self._num_lanes[road] - 1) - lane) * self._lane_width[road]

    def _phase_per_metre(self) -> np.ndarray:
        """d(phase)/ds of lane changes [n], 1/m; done before a destination."""
        cars = self.cars
        metres = np.maximum(cars["v"] * cars["change_time_s"], MIN_CHANGE_M)
        left = np.maximum(cars["destination"] - cars["s"] - 1.0, 2.0)
        return np.maximum(1.0 / metres, (1.0 - cars["phase"]) / left)

    def lateral(self) -> tuple[np.ndarray, np.ndarray]:
        """Offset [n] m and slope dl/ds [n] of all cars.

        A change follows the quintic q = 10 p^3 - 15 p^4 + 6 p^5 of its phase p.
        """
        cars = self.cars
        p, start = cars["phase"], self._offset(cars["old_row"])
        aside = self._offset(cars["row"]) - start
        q, rate = p**3 * (10.0 - 15.0 * p + 6.0 * p**2), 30.0 * p**2 * (1.0 - p) ** 2
        angle = cars["drift_w"] * cars["s"][:, None] + cars["drift_p"]
        drift = cars["drift_m"] * np.sin(angle).sum(axis=1)
        tilt = cars["drift_m"] * (cars["drift_w"] * np.cos(angle)).sum(axis=1)
        slope = aside * rate * self._phase_per_metre() + tilt
        return start + aside * q + drift, slope

    def _enter(self) -> None:
        """Lets in the first of each row's queue that is due and finds room."""
        rows = np.flatnonzero(self._next < self._end)
        rows = rows[self._waiting["due"][self._next[rows]] <= self.clock]
        if rows.size == 0:
            return
        cars, new = self.cars, self._waiting[self._next[rows]]
        rear = np.full(self._next.size, np.inf)  # m, of the last car in each row
        speed = np.zeros(self._next.size)
        taken = np.concatenate([cars["row"], cars["old_row"]])
        order = np.argsort(np.tile(-cars["s"], 2), kind="stable")  # the last one stays
        rear[taken[order]] = np.tile(cars["s"] - 0.5 * cars["car_length_m"], 2)[order]
        speed[taken[order]] = np.tile(cars["v"], 2)[order]
        room = rear[rows] - ENTRY_M - 0.5 * new["car_length_m"] - new["jam_gap_m"]
        room = np.maximum(room, 0.0)
        cruise = self._desired(new, new["s"])
        braked = np.sqrt(speed[rows] ** 2 + 2.0 * ENTRY_BRAKING_MPS2 * room)
        new["v"] = np.minimum(np.minimum(cruise, room / new["headway_s"]), braked)
        enters = new["v"] > MIN_ENTRY_SHARE * cruise
        self._next[rows[enters]] += 1
        self.cars = np.concatenate([cars, new[enters]])

    def _gain(self, near: Neighbours, desired: np.ndarray, side: int) -> np.ndarray:
        """MOBIL's incentive minus its threshold [n] m/s^2; -inf where unsafe."""
        cars, me = self.cars, np.arange(self.cars.size)
        v, length, row = cars["v"], cars["car_length_m"], cars["row"]
        lead, to_lead = near.find(row, ahead=True)
        behind, to_behind = near.find(row, ahead=False)
        new_lead, to_new_lead = near.find(row + side, ahead=True)
        new_behind, to_new_behind = near.find(row + side, ahead=False)

        def follow(i: np.ndarray, j: np.ndarray, distance: np.ndarray) -> np.ndarray:
            gap = distance - 0.5 * (length[i] + length[j])
            return idm_acceleration(v[i], desired[i], gap, v[j], cars[i])

        mine_after = follow(me, new_lead, to_new_lead)
        gain = mine_after - follow(me, lead, to_lead)
        # followers that do not exist neither lose nor gain
        has_behind, has_new = np.isfinite(to_behind), np.isfinite(to_new_behind)
        new_after = follow(new_behind, me, to_new_behind)
        new_now = follow(new_behind, new_lead, to_new_behind + to_new_lead)
        old_now = follow(behind, me, to_behind)
        old_after = follow(behind, lead, to_behind + to_lead)
        others = np.where(has_new, new_after - new_now, 0.0)
        others += np.where(has_behind, old_after - old_now, 0.0)
        gain += cars["politeness"] * others - cars["threshold_mps2"]
        # drivers near their destination work to the right
        near_end = cars["destination"] - cars["s"] < GO_RIGHT_M
        gain += np.where(near_end, side * GO_RIGHT_MPS2, 0.0)
        ahead = to_new_lead - 0.5 * (length + length[new_lead])
        back = to_new_behind - 0.5 * (length + length[new_behind])
        safe = ahead > SIDE_GAP_M + SIDE_GAP_S * v
        safe &= back > SIDE_GAP_M + SIDE_GAP_S * np.where(has_new, v[new_behind], 0.0)
        safe &= mine_after > -OWN_BRAKING_MPS2
        safe &= ~has_new | (new_after > -cars["safe_mps2"])
        return np.where(safe, gain, -np.inf)

    def _change_lanes(self, near: Neighbours, desired: np.ndarray) -> None:
        """Begins at most one lane change per recording: the most wanted safe one.

        One at a time, so that two cars never choose the same gap at once. A car at its
        destination pulls over, or gives it up if it is not in the right lane in time or
        somebody stands on the strip.
        """
        cars, (road, lane) = self.cars, np.divmod(self.cars["row"], LANES)
        v, last, straight = cars["v"], self._num_lanes[road] - 1, cars["phase"] >= 1.0
        able = straight & (v > MIN_CHANGE_MPS) & (lane <= last)
        able &= self.clock - cars["changed"] > cars["change_pause_s"]
        able &= self._calm[self._grid(cars, cars["s"])]
        way = 2.0 * MIN_CHANGE_MPS * cars["change_time_s"]
        able &= cars["s"] < self._length[road] - way
        gains = np.stack([self._gain(near, desired, side) for side in (-1, 1)])
        gains[0, ~able | (lane == 0)] = gains[1, ~able | (lane >= last)] = -np.inf
        left = cars["destination"] - cars["s"]
        reach = np.maximum(PULL_OVER_S * v, v**2 / (2.0 * PULL_OVER_MPS2))
        due = (lane <= last) & (left < np.maximum(PULL_OVER_M, reach))
        strip = LANES * road + last + 1
        clear = near.find(strip, ahead=True)[1] > left + STRIP_CLEAR_M
        clear &= near.find(strip, ahead=False)[1] > STRIP_CLEAR_M
        over = due & straight & (lane == last) & clear
        cars["destination"][due & ~over] = np.inf
        gains[0, over], gains[1, over] = -np.inf, np.inf
        best, right = gains.max(axis=0), gains[1] > gains[0]
        order = np.argsort(-best, kind="stable")
        chosen = order[np.unique(road[order], return_index=True)[1]]
        chosen = chosen[best[chosen] > 0.0]
        cars["old_row"][chosen] = cars["row"][chosen]
        cars["row"][chosen] += np.where(right[chosen], 1, -1)
        cars["phase"][chosen], cars["changed"][chosen] = 0.0, self.clock

    def _stop_acceleration(self) -> np.ndarray:
        """Bound [n] m/s^2 from stop lines and destinations; inf where none demands.

        A light that is not green is seen after the reaction time. The driver then
        decides once: brake, unless more than `dilemma_mps2` would be needed. At a stop
        sign the driver stands `sign_wait_s` at the line, then goes.
        """
        cars, road, v = self.cars, self.cars["recording"], self.cars["v"]
        front = cars["s"] + 0.5 * cars["car_length_m"]
        passed = self._stop_s[road, cars["next_stop"]] < front
        cars["next_stop"] += passed
        cars["decided"] &= ~passed
        cars["committed"] &= ~passed
        line = road, cars["next_stop"]
        gap, sign = self._stop_s[line] - front, self._is_sign[line]
        into = np.mod(self.clock - cars["delay_s"] + self._cycle_at[line], sum(CYCLE_S))
        colour = np.searchsorted(np.cumsum(CYCLE_S[:2]), into, side="right")
        lit = np.isfinite(gap) & ~sign & (colour != GREEN)
        needed = v**2 / (2.0 * np.maximum(gap - 0.5, 0.1))
        cars["committed"] |= lit & ~cars["decided"] & (needed > cars["dilemma_mps2"])
        cars["committed"] &= lit & ~((colour == RED) & (needed < REVOKE_MPS2))
        cars["decided"] = lit
        at_line = sign & (gap < AT_LINE_M) & (v < AT_REST_MPS)
        cars["stood"] = np.where(at_line, cars["stood"] + self.dt, 0.0)
        cars["next_stop"] += at_line & (cars["stood"] >= cars["sign_wait_s"])
        demands = sign | (lit & ~cars["committed"])
        bound = np.where(demands, line_acceleration(v, gap, cars), np.inf)
        left = cars["destination"] - cars["s"]
        cars["parked"] |= (np.abs(left) < ARRIVED_M) & (v < AT_REST_MPS)
        # the line is placed so that the gap left to it is used up at the destination
        return np.minimum(bound, line_acceleration(v, left + cars["line_gap_m"], cars))

    def step(self) -> None:
        """Advances by dt: who enters, what each driver wants, what the cars do."""
        self._enter()
        cars, dt, v = self.cars, self.dt, self.cars["v"]
        a, length = cars["acceleration_mps2"], cars["car_length_m"]
        offset, slope = self.lateral()
        stretch = 1.0 - self._kappa[self._grid(cars, cars["s"])] * offset
        desired = self._desired(cars, cars["s"], stretch)
        near = Neighbours(cars)
        leader, distance = near.find(cars["row"], ahead=True)
        other, aside = near.find(cars["old_row"], ahead=True)
        leader = np.where(aside < distance, other, leader)
        gap = np.minimum(distance, aside) * stretch
        gap -= 0.5 * (length + length[leader])
        wish = idm_acceleration(v, desired, gap, v[leader], cars)
        # keep to a falling desired speed, of curves and limits, by a profile of
        # constant braking without lag; the IDM's free term alone lags behind it
        ahead = self._desired(cars, cars["s"] + PREVIEW_S * v, stretch)
        profile = np.maximum((ahead - v) / PREVIEW_S, -cars["deceleration_mps2"])
        wish = np.minimum(np.minimum(wish, profile), self._stop_acceleration())
        angle = cars["noise_w"] * self.clock + cars["noise_p"]
        wish += cars["noise_mps2"] * np.sin(angle).sum(axis=1)
        wish = np.clip(wish, -cars["emergency_mps2"], a)
        idle = (wish < START_SHARE * a) & (v < CREEP_MPS)
        wish = np.where(idle, np.minimum(wish, -CREEP_MPS2), wish)
        wish = np.where(cars["parked"], -CREEP_MPS2, wish)
        if self.count % max(int(round(CHANGE_EVERY_S / dt)), 1) == 0:
            self._change_lanes(near, desired)
        # actuator with lag and bounded jerk
        bound = np.where(wish < -HARD_BRAKING_MPS2, HARD_JERK_MPS3, cars["jerk_mps3"])
        cars["a"] += np.clip((wish - cars["a"]) / ACTUATOR_S, -bound, bound) * dt
        after = np.maximum(v + cars["a"] * dt, 0.0)
        moved = 0.5 * (v + after) * dt / np.hypot(stretch, slope)
        cars["a"][(after <= 0.0) & (cars["a"] < 0.0)] = 0.0
        phase = np.minimum(cars["phase"] + self._phase_per_metre() * moved, 1.0)
        cars["phase"], cars["v"], cars["s"] = phase, after, cars["s"] + moved
        cars["old_row"] = np.where(phase < 1.0, cars["old_row"], cars["row"])
        self.cars = cars[cars["s"] < self._length[cars["recording"]] - EXIT_M]
        self.count += 1
        self.clock += dt


def simulate(
    runs: Sequence[RunConfig], drivers: Mapping[str, Sequence[float]]
) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """Simulates recordings of equal duration, warm-up and rate together.

    Returns:
      Samples [m] at `rate_hz` from 0 s to `duration_s`, by recording, car and time:
      "t" s, "l" m, "slope", "destination" m as last held, and the fields SAMPLED;
      offsets [lights] s into the cycle at 0 s, of each recording.
    """
    traffic = Traffic(runs, drivers)
    for _ in range(int(round(runs[0].warmup_s / traffic.dt))):
        traffic.step()
    traffic.clock, found = 0.0, []
    for sample in range(int(round(runs[0].duration_s * runs[0].rate_hz))):
        cars = traffic.cars
        l, slope = traffic.lateral()
        t = np.full(cars.size, sample / runs[0].rate_hz)
        row = {"t": t, "l": l, "slope": slope}
        found.append(row | {k: cars[k].copy() for k in (*SAMPLED, "destination")})
        for _ in range(traffic.steps_per_sample):
            traffic.step()
    made = {name: np.concatenate([row[name] for row in found]) for name in found[0]}
    order = np.lexsort((made["t"], made["number"], made["recording"]))
    return {k: x[order] for k, x in made.items()}, traffic.light_offsets
