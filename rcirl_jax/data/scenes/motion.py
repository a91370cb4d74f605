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
class FrameTracks:
    """All samples of a recording in one chain's Frenet frame."""

    s: list[np.ndarray]  # per track [n] m
    l: list[np.ndarray]  # per track [n] m
    tilt: list[np.ndarray]  # per track [n] rad, heading minus the line's, unwrapped
    # all samples, track after track, for reading many tracks at once: station m,
    # offset m, tilt rad, speed along the line m/s
    table: np.ndarray  # [samples, 4]

    def at(self, row: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, ...]:
        """(s, l, tilt, speed), each [...], between sample `row` and the next.

        Args:
          row: [...] int, index into `table`.
          share: [...] in [0, 1] of the way to the next sample; 0 at a track's last.
        """
        after = np.minimum(row + 1, len(self.table) - 1)
        mixed = self.table[row] * (1.0 - share[..., None])
        mixed += self.table[after] * share[..., None]
        return tuple(np.moveaxis(mixed, -1, 0))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Motion:
    """What the human did after the planning frame, in the scene's frame."""

    s0: float  # m, station of the planning frame on the chain
    s: np.ndarray  # [T] m since s0; continued at constant speed after the future
    l: np.ndarray  # [T] m
    v0: float  # m/s
    a0: float  # m/s^2
    dl0: float  # 1, dl/ds at the planning frame
    future_s: float  # s of recording after the frame, <= 8
    s_at_5s: float  # m


@dataclasses.dataclass(frozen=True, kw_only=True)
class Driver:
    """One track in a chain's frame, with the derivatives that all its scenes share."""

    s: np.ndarray  # [n] m
    l: np.ndarray  # [n] m
    speed: np.ndarray  # [n] m/s, along the line
    acceleration: np.ndarray  # [n] m/s^2
    l_dot: np.ndarray  # [n] m/s
    rate: float  # Hz


def driver_of(view: FrameTracks, number: int, rate: float) -> Driver:
    """Track `number` of a chain's frame as a driver; rate in Hz."""
    s, l = view.s[number], view.l[number]
    speed = np.gradient(s) * rate
    return Driver(
        s=s,
        l=l,
        speed=speed,
        acceleration=savgol(np.gradient(speed) * rate, rate, ACCELERATION_WINDOW_S),
        l_dot=np.gradient(l) * rate,
        rate=rate,
    )


def human_motion(driver: Driver, start: int, length: float) -> Motion | None:
    """Return the human's positions at TIMES_S and the ego's state at the frame.

    v0 and a0 are the first and second derivative of the cubic fitted by the
    smoothing filter; all later derivatives are made by `sampling.kinematics`.
    None if the driver leaves the chain's stations, 0 to `length` m.
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
    l_dot = float(driver.l_dot[start])
    return Motion(
        s0=float(future[0]),
        s=np.interp(TIMES_S, seconds, monotone) + v_end * beyond,
        l=np.interp(TIMES_S, seconds, driver.l[start:]),
        v0=v0,
        a0=float(driver.acceleration[start]),
        dl0=float(np.clip(l_dot / v0, -0.3, 0.3)) if v0 > 1.0 else 0.0,
        future_s=future_s,
        s_at_5s=float(np.interp(5.0, seconds, monotone)),
    )


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
