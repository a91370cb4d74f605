"""Uniform resampling and smoothing of recorded tracks.

Positions are smoothed first and differentiated afterwards. Differentiating the
raw positions of camera data gives noise: in NGSIM 8 % of the raw |a| exceed
3 m/s^2. Both figures are reported with every import.
"""

import dataclasses
import functools

import numpy as np

from rcirl_jax.types import Track

POLYNOMIAL_ORDER = 3  # Savitzky-Golay order; keeps constant-jerk motion exact
HARSH_MPS2 = 3.0  # m/s^2, the threshold of the noise figures (Punzo et al. 2011)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SmoothTrack:
    """A track on the recording's uniform clock, smoothed."""

    track: Track  # as recorded
    first_frame: int  # frame number of the first sample
    x: np.ndarray  # [n] m
    y: np.ndarray  # [n] m
    heading: np.ndarray  # [n] rad, of the box, unwrapped
    raw_x: np.ndarray  # [n] m, resampled but not smoothed
    raw_y: np.ndarray  # [n] m

    @property
    def num_frames(self) -> int:
        """Number of samples n."""
        return self.x.size


def smooth_track(track: Track, rate_hz: float, window_s: float) -> SmoothTrack:
    """Resample to the uniform clock and smooth positions (Savitzky-Golay).

    Args:
      track: any track with at least one sample.
      rate_hz: the clock, 1/s.
      window_s: length of the filter window, s; tracks shorter than the window
        get the longest odd window that fits, or none below 5 samples.

    Returns:
      The smoothed track; gaps are bridged linearly.
    """
    first = int(round(track.t[0] * rate_hz))
    last = int(round(track.t[-1] * rate_hz))
    clock = np.arange(first, last + 1) / rate_hz
    raw_x = np.interp(clock, track.t, track.x)
    raw_y = np.interp(clock, track.t, track.y)
    heading = np.interp(clock, track.t, np.unwrap(track.heading))
    return SmoothTrack(
        track=track,
        first_frame=first,
        x=savgol(raw_x, rate_hz, window_s),
        y=savgol(raw_y, rate_hz, window_s),
        heading=heading,
        raw_x=raw_x,
        raw_y=raw_y,
    )


def savgol(values: np.ndarray, rate_hz: float, window_s: float) -> np.ndarray:
    """Savitzky-Golay filter of order 3; polynomial ends; short inputs shrink it."""
    window = int(round(window_s * rate_hz)) | 1
    window = min(window, values.size - 1 + values.size % 2)
    if window <= POLYNOMIAL_ORDER + 1:
        return values.copy()
    half, (inner, first, last) = window // 2, _filters(window)
    smooth = np.empty(values.size)
    smooth[half : values.size - half] = np.convolve(values, inner, mode="valid")
    smooth[:half] = first @ values[:window]
    smooth[values.size - half :] = last @ values[-window:]
    return smooth


@functools.cache
def _filters(window: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights of the middle [w], and of the first and last w // 2 samples [w//2, w].

    All are rows of the matrix that fits a polynomial to a window and evaluates it.
    """
    half = window // 2
    at = np.arange(-half, half + 1) / half
    powers = np.vander(at, POLYNOMIAL_ORDER + 1)
    smoother = powers @ np.linalg.pinv(powers)  # [w, w], symmetric
    return smoother[half][::-1].copy(), smoother[:half], smoother[half + 1 :]


def harsh_share(x: np.ndarray, y: np.ndarray, rate_hz: float) -> tuple[int, int]:
    """How many accelerations exceed HARSH_MPS2 in magnitude, and of how many.

    a = d(speed)/dt with the speed from differences of positions.
    """
    if x.size < 3:
        return 0, 0
    speed = np.hypot(np.diff(x), np.diff(y)) * rate_hz
    acceleration = np.diff(speed) * rate_hz
    return int(np.sum(np.abs(acceleration) > HARSH_MPS2)), acceleration.size
