"""The human's motion and path in the Frenet frame of a chain of lanes."""

import dataclasses

import numpy as np

from rcirl_jax.data.scenes.tracks import savgol
from rcirl_jax.units import HORIZON_S, NUM_STATIONS, STATION_STEP_M, TIMES_S

GRID_M = np.arange(NUM_STATIONS) * STATION_STEP_M  # [P] m, the station grid
MIN_PATH_ADVANCE_M = 0.5  # m between recorded points that shape the path
SLOPE_M = 6.0  # m at a track's end over which its slope is taken: three grid points
TURN_ALONG_M = 10.0  # m, within which a path turns along the line after its record
ACCELERATION_WINDOW_S = 0.7  # s, smoothing of the ego's acceleration


@dataclasses.dataclass(frozen=True, kw_only=True)
class Driver:
    """One track in a chain's frame, with the derivatives that all its scenes share."""

    s: np.ndarray  # [n] m
    l: np.ndarray  # [n] m
    speed: np.ndarray  # [n] m/s, along the line
    acceleration: np.ndarray  # [n] m/s^2
    l_dot: np.ndarray  # [n] m/s
    rate: float  # Hz


def driver_of(s: np.ndarray, l: np.ndarray, rate: float) -> Driver:
    """Returns the driver with stations s and offsets l [n] m, at `rate` Hz."""
    speed = np.gradient(s) * rate
    return Driver(
        s=s,
        l=l,
        speed=speed,
        acceleration=savgol(np.gradient(speed) * rate, rate, ACCELERATION_WINDOW_S),
        l_dot=np.gradient(l) * rate,
        rate=rate,
    )


def human_motion(driver: Driver, start: int, length: float) -> dict | None:
    """Returns the human's positions at TIMES_S and the ego's state at the frame.

    Speed and acceleration are the first and second derivative of the cubic fitted by
    the smoothing filter; all later derivatives are made by `sampling.kinematics`.

    Args:
      driver: the human.
      start: sample of the planning frame.
      length: m of the chain.

    Returns:
      Fields of a row: "ego.*"; "human.s" since the frame, continued at constant speed
      after the future, and "human.l" [T] m; "time_valid" [T]; "future_s", "s_at_5s" m;
      "s0" m, the frame's station. None if the driver leaves the chain's stations.
    """
    future = driver.s[start:]
    within = future[: int(HORIZON_S * driver.rate) + 2]
    if within.min() <= 0.0 or within.max() >= length:
        return None
    seconds = np.arange(future.size) / driver.rate
    future_s = float(min(seconds[-1], HORIZON_S))
    monotone = np.maximum.accumulate(future) - future[0]
    v_end = max(float(np.mean(driver.speed[-3:])), 0.0)
    beyond = np.maximum(TIMES_S - seconds[-1], 0.0)
    v0 = max(float(driver.speed[start]), 0.0)
    slope = float(np.clip(driver.l_dot[start] / v0, -0.3, 0.3)) if v0 > 1.0 else 0.0
    l = np.interp(TIMES_S, seconds, driver.l[start:])
    return {
        "s0": float(future[0]),
        "ego.s": 0.0,
        "ego.l": l[0],
        "ego.dl": slope,
        "ego.ddl": 0.0,
        "ego.v": v0,
        "ego.a": float(driver.acceleration[start]),
        "human.s": np.interp(TIMES_S, seconds, monotone) + v_end * beyond,
        "human.l": l,
        "future_s": future_s,
        "s_at_5s": float(np.interp(5.0, seconds, monotone)),
        "time_valid": future_s + 1e-6 >= TIMES_S,
    }


def given_path(
    driver: Driver, start: int, s0: float, length: float, grid: np.ndarray = GRID_M
) -> np.ndarray:
    """Lateral offset [g] m of the human's own path at stations `grid` [g] m.

    The whole rest of the track on the chain shapes it, not only the scene's
    horizon. After its end at s_e the path turns along the line, without a kink that
    would tell where the record ends:

        l(s) = l_e + m L (1 - exp(-(s - s_e) / L)),  m the slope over the last
        `SLOPE_M` metres, L = `TURN_ALONG_M`
    """
    s = np.maximum.accumulate(driver.s[start:]) - s0
    keep = np.concatenate([[True], np.diff(s // MIN_PATH_ADVANCE_M) > 0])
    keep &= s + s0 < length
    s, l = s[keep], driver.l[start:][keep]
    before = max(s[-1] - SLOPE_M, s[0])
    advance = s[-1] - before
    slope = (l[-1] - np.interp(before, s, l)) / advance if advance > 0.0 else 0.0
    beyond = np.maximum(grid - s[-1], 0.0) / TURN_ALONG_M
    return np.interp(grid, s, l) + slope * TURN_ALONG_M * (1.0 - np.exp(-beyond))
