"""The simulation: vehicles enter, drive, change lanes, stop and leave.

Several recordings advance together as arrays [R, N]. Every recording draws from
its own random stream, so that it does not depend on the others of its batch.
Steps are at most 1 / STEP_HZ long; a first-order actuator with bounded jerk stands
between the driver model and the motion.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rcirl_jax.data.synthetic.drivers import (
    DriverConfig,
    desired_speed,
    idm_acceleration,
    sample_drivers,
)
from rcirl_jax.data.synthetic.lane_changes import change_lanes, pull_over
from rcirl_jax.data.synthetic.roads import ROADS, Road
from rcirl_jax.data.synthetic.state import Neighbours, State, road_table
from rcirl_jax.data.synthetic.stops import stop_acceleration

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


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunConfig:
    """One recording to be simulated."""

    road: str  # key of `ROADS`
    duration_s: float  # s, length of the recording
    density_veh_per_km: float  # vehicles per km and lane, at the speed limit
    seed: tuple[int, ...]  # of the recording's random stream
    rate_hz: float = 10.0  # samples per second
    warmup_s: float = 30.0  # s simulated before the recording starts


@dataclasses.dataclass(frozen=True, kw_only=True)
class Log:
    """Samples of one simulated recording: K times, n slots."""

    road: Road
    vehicle: np.ndarray  # [K, n] vehicle number, -1 where the slot is empty
    s: np.ndarray  # [K, n] m
    l: np.ndarray  # [K, n] m
    slope: np.ndarray  # [K, n] dl/ds
    v: np.ndarray  # [K, n] m/s
    lanes: np.ndarray  # [K, n] bit mask of the lanes it is in; two in a change
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
        """The driver who enters next."""
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
        self.table = road_table(self.roads)
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
        for r, slot in zip(*np.nonzero(gone), strict=True):
            self._keep_destination(r, slot)
            state.vehicle[r, slot] = -1

    def _keep_destination(self, r: int, slot: int) -> None:
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

    def _profile(self, stretch: np.ndarray) -> np.ndarray:
        """Bound [m/s^2] that keeps to a falling desired speed: curves, limits.

            (v_des(s + v P) - v) / P,  at least -b,  P = PREVIEW_S

        It follows a profile of constant braking without lag; the IDM's free term
        alone lags behind it.
        """
        state = self.state
        ahead = self._desired(state.s + PREVIEW_S * state.v, stretch)
        bound = (ahead - state.v) / PREVIEW_S
        return np.maximum(bound, -state.driver["deceleration"])

    def _wish(
        self, around: Neighbours, desired: np.ndarray, stretch: np.ndarray
    ) -> np.ndarray:
        """Acceleration [m/s^2] the drivers want."""
        state, driver = self.state, self.state.driver
        leader, distance = around.leader(around.lanes)
        gap, leader_v = self._perceive(leader, distance, stretch)
        wish = idm_acceleration(state.v, desired, gap, leader_v, driver)
        stops = stop_acceleration(state, self.table, self.offsets, self.clock, self.dt)
        bounds = np.minimum(stops, self._profile(stretch))
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

    def destinations(self) -> None:
        """Write back the destinations that drivers still hold or gave up."""
        for r, slot in zip(*np.nonzero(self.state.alive), strict=True):
            self._keep_destination(r, slot)


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
        now = (state.vehicle.copy(), state.s.copy(), state.v.copy(), state.occupied())
        rows.append((*now, offset, slope))
        for _ in range(traffic.substeps):
            traffic.step()
    traffic.destinations()
    columns = [np.stack(column) for column in zip(*rows, strict=True)]
    vehicle, s, v, lanes, l, slope = columns
    logs = []
    for r, source in enumerate(traffic.sources):
        n = source.capacity
        logs.append(
            Log(
                road=traffic.roads[r],
                vehicle=vehicle[:, r, :n],
                s=s[:, r, :n],
                l=l[:, r, :n],
                slope=slope[:, r, :n],
                v=v[:, r, :n],
                lanes=lanes[:, r, :n],
                drivers=source.pool[: source.used],
                signal_offset=source.signal_offset,
            )
        )
    return logs
