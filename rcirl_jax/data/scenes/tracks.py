"""Recorded tracks before scenes are cut out of them: cleaned, resampled, smoothed.

Perception that flickers loses a standing body and finds it again under another number,
and sees bodies for a few frames that are none: the fragments of a standing body are
joined, and what stays too short or too small is left out.

Positions are smoothed first and differentiated afterwards. Differentiating the
raw positions of camera data gives noise: in NGSIM 8 % of the raw |a| exceed
3 m/s^2. Both figures are reported with every import.
"""

import collections
import dataclasses
import functools
from collections.abc import Mapping, Sequence

import numpy as np

from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.types import Kind, Recording, Track

POLYNOMIAL_ORDER = 3  # Savitzky-Golay order; keeps constant-jerk motion exact
HARSH_MPS2 = 3.0  # m/s^2, the threshold of the noise figures (Punzo et al. 2011)
STANDING_MPS = 0.5  # m/s, at the end that meets the other fragment
SAME_PLACE_M = 1.0  # m between the centres, at most, and
SAME_PLACE = 0.5  # of the smaller one's longer side: two bodies are farther apart
HULKS = (Kind.VEHICLE, Kind.STATIC)  # perception takes a parked car for either
EDGE_S = 0.25  # s from the recording's ends: such a track may have been longer
SERIES = ("t", "x", "y", "heading", "speed")
JOINED, SHORT, SMALL = "fragments joined", "too short", "too small"


def steady_tracks(
    recording: Recording, config: CollectConfig
) -> tuple[Recording, collections.Counter[str]]:
    """The recording without flicker, and how many tracks were joined or left out."""
    tracks = joined(recording.tracks, config.join_gap_s)
    counts = collections.Counter({JOINED: len(recording.tracks) - len(tracks)})
    begin = min((float(track.t[0]) for track in tracks), default=0.0)
    end = max((float(track.t[-1]) for track in tracks), default=0.0)
    kept = []
    for track in tracks:
        small = max(track.length, track.width) < config.min_size_m
        # whole, and not cut off by the recording's ends; a piece of a longer log knows
        # when the log first saw the track
        whole = track.t[0] - begin >= EDGE_S and end - track.t[-1] >= EDGE_S
        life = float(track.t[-1]) - track.first_seen_s
        short = bool(whole) and life < config.min_life_s - 1e-6
        counts.update({SMALL: small, SHORT: short and not small})
        kept += [] if small or short else [track]
    counts = +counts
    if not counts:
        return recording, counts
    return dataclasses.replace(recording, tracks=tuple(kept)), counts


def note_of(counts: Mapping[str, int]) -> str:
    """Return one line for the report of a recording."""
    said = ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))
    return f"tracks that flicker: {said}"


def joined(tracks: Sequence[Track], gap_s: float) -> list[Track]:
    """Return the tracks, those in one piece that are fragments of one standing body.

    A track goes on for another one if both stand in the same place where they meet:
    it begins at most `gap_s` after the other ends, or while it is there.
    """
    order = sorted(range(len(tracks)), key=lambda i: float(tracks[i].t[0]))
    ends = np.array([_sample(track, -1) for track in tracks]).reshape(-1, 4)
    made: dict[int, Track] = {}
    for number in order:
        after = made[number] = tracks[number]
        t, x, y, speed = _sample(after, 0)
        if speed >= STANDING_MPS:
            continue
        near = (t <= ends[:, 0] + gap_s) & (ends[:, 3] < STANDING_MPS)
        near &= np.hypot(ends[:, 1] - x, ends[:, 2] - y) < SAME_PLACE_M
        for before in np.flatnonzero(near).tolist():
            if before in made and _is_same(made[before], after):
                made[before] = _join(made[before], after)
                ends[before] = _sample(made[before], -1)
                ends[number] = -np.inf
                del made[number]
                break
    return [made[number] for number in sorted(made)]


def _is_same(before: Track, after: Track) -> bool:
    """Return whether a track stands where another begins, from then to its own end."""
    alike = before.kind == after.kind or {before.kind, after.kind} <= {*HULKS}
    t, x, y, _ = _sample(after, 0)
    if before.t[0] >= t or not alike:
        return False
    size = min(max(track.length, track.width) for track in (before, after))
    reach = min(SAME_PLACE_M, SAME_PLACE * size)
    rest = slice(int(np.searchsorted(before.t, t, side="right")) - 1, None)
    near = np.hypot(before.x[rest] - x, before.y[rest] - y) < reach
    return bool(near.all() and (np.abs(before.speed[rest]) < STANDING_MPS).all())


def _sample(track: Track, at: int) -> tuple[float, float, float, float]:
    """T s, x m, y m and speed m/s of one sample."""
    return track.t[at], track.x[at], track.y[at], abs(track.speed[at])


def _join(before: Track, after: Track) -> Track:
    """Return one track: all of the first, then what the second has beyond its end."""
    later = after.t > before.t[-1]
    series = {
        name: np.concatenate([getattr(before, name), getattr(after, name)[later]])
        for name in SERIES
    }
    longer = max(before, after, key=lambda track: track.t.size)
    return dataclasses.replace(
        before,
        kind=longer.kind,
        length=longer.length,
        width=longer.width,
        destination=after.destination or before.destination,
        automated=before.automated + after.automated,
        leader_missing=before.leader_missing + after.leader_missing,
        **series,
    )


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
    """Return how many |d(speed)/dt| exceed HARSH_MPS2, and of how many."""
    if x.size < 3:
        return 0, 0
    speed = np.hypot(np.diff(x), np.diff(y)) * rate_hz
    acceleration = np.diff(speed) * rate_hz
    return int(np.sum(np.abs(acceleration) > HARSH_MPS2)), acceleration.size
