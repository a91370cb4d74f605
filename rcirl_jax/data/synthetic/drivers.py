"""Human drivers: car following, lane changes, stop lines, and their spread.

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

import numpy as np

from rcirl_jax.data.synthetic.roads import LATERAL_REFERENCE_MPS2, Road

EXPONENT = 4.0  # 1, delta of the IDM (Treiber 2000)
MIN_GAP_M = 0.1  # m, gaps are not taken smaller in the IDM
NUM_WAVES = 3  # sinusoids that make up the drift inside the lane
TRUCK_SPEED = 0.85  # 1, a truck's desired speed over a car's
TRUCK_ACCELERATION = 0.55  # 1, a truck's acceleration over a car's
TRUCK_WIDTH_M = (2.3, 2.5)  # m, range (Directive 96/53/EC: 2.55 m at most)
SIDE_CLEARANCE_M = 1.0  # m kept between two such vehicles in neighbouring lanes

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
    for name, bounds in _ranges(config).items():
        drivers[name] = rng.uniform(*bounds, count)
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
    _add_drift(rng, config, road, drivers)
    return drivers


def _ranges(config: DriverConfig) -> dict[str, Range]:
    return {
        "jam_gap": config.jam_gap_m,
        "acceleration": config.acceleration_mps2,
        "deceleration": config.deceleration_mps2,
        "delay": config.delay_s,
        "lateral": config.lateral_mps2,
        "politeness": config.politeness,
        "threshold": config.threshold_mps2,
        "safe": config.safe_mps2,
        "change_time": config.change_time_s,
        "line_gap": config.line_gap_m,
        "sign_wait": config.sign_wait_s,
        "dilemma": config.dilemma_mps2,
    }


def _normal(rng: np.random.Generator, spread: Spread, count: int) -> np.ndarray:
    mean, sd, low, high = spread
    return np.clip(rng.normal(mean, sd, count), low, high)


def _add_drift(
    rng: np.random.Generator, config: DriverConfig, road: Road, drivers: np.ndarray
) -> None:
    """Drift l(s) = A sum_i sin(w_i s + p_i); variance 3 A^2 / 2 = drift_m^2.

    It runs with the distance, so that a standing car does not slide. Wide
    vehicles drift less: their peak 3 A leaves room for the neighbour.
    """
    count = drivers.size
    periods = rng.uniform(*config.drift_period_s, (count, NUM_WAVES))
    drivers["drift_wave"] = 2.0 * np.pi / (periods * float(road.limit.max()))
    drivers["drift_phase"] = rng.uniform(0.0, 2.0 * np.pi, (count, NUM_WAVES))
    amplitude = config.drift_m * np.sqrt(2.0 / NUM_WAVES)
    room = 0.5 * (road.lane_width - drivers["width"] - SIDE_CLEARANCE_M)
    least = min(amplitude, 0.1 / NUM_WAVES)
    drivers["drift"] = np.clip(room / NUM_WAVES, least, amplitude)


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
    return free_acceleration(v, desired, a, b) - interaction(
        v, gap, leader_v, a, b, driver["headway"], driver["jam_gap"]
    )


def free_acceleration(
    v: np.ndarray, desired: np.ndarray, a: np.ndarray, b: np.ndarray
) -> np.ndarray:
    """The IDM's free term [m/s^2]; below zero, and above -b, if v > v0."""
    desired = np.maximum(desired, 0.5)
    ratio = np.minimum(v / desired, 1.0)
    above = np.minimum(desired / np.maximum(v, desired), 1.0)
    return np.where(
        v <= desired, a * (1.0 - ratio**EXPONENT), b * (above ** (EXPONENT * a / b) - 1)
    )


def interaction(
    v: np.ndarray,
    gap: np.ndarray,
    leader_v: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    headway: np.ndarray | float,
    jam_gap: np.ndarray | float,
) -> np.ndarray:
    """The IDM's interaction term a (s*/g)^2 [m/s^2], >= 0."""
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
