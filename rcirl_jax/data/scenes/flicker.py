"""Clean the tracks of a flickering perception before they become obstacles.

Perception loses a standing body and finds it again under another number, and sees
bodies for a few frames that are none. Before scenes are cut, the fragments of a
standing body are joined, and what stays too short or too small is left out.
"""

import collections
import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.types import Kind, Recording, Track

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
        short = _life(track, begin, end) < config.min_life_s - 1e-6
        counts.update({SMALL: small, SHORT: short and not small})
        kept += [] if small or short else [track]
    counts = +counts
    if not counts:
        return recording, counts
    return dataclasses.replace(recording, tracks=tuple(kept)), counts


def note_of(counts: Mapping[str, int]) -> str:
    """One line for the report of a recording."""
    said = ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))
    return f"tracks that flicker: {said}"


def _life(track: Track, begin: float, end: float) -> float:
    """S from the first to the last sample; inf where the recording cuts it off.

    A piece of a longer log knows when the log first saw the track.
    """
    if track.t[0] - begin < EDGE_S or end - track.t[-1] < EDGE_S:
        return np.inf
    return float(track.t[-1]) - track.first_seen_s


def joined(tracks: Sequence[Track], gap_s: float) -> list[Track]:
    """The tracks, those in one piece that are fragments of one standing body.

    A track goes on for another one if both stand in the same place where they meet:
    it begins at most `gap_s` after the other ends, or while it is there.
    """
    order = sorted(range(len(tracks)), key=lambda i: float(tracks[i].t[0]))
    ends = np.array([_sample(track, -1) for track in tracks]).reshape(-1, 4)
    made: dict[int, Track] = {}
    for number in order:
        before = _goes_on_for(made, tracks[number], ends, gap_s)
        if before is None:
            made[number] = tracks[number]
        else:
            made[before] = _join(made[before], tracks[number])
            ends[before] = _sample(made[before], -1)
            ends[number] = -np.inf
    return [made[number] for number in sorted(made)]


def _goes_on_for(
    made: dict[int, Track], after: Track, ends: np.ndarray, gap_s: float
) -> int | None:
    """The number of the track that stands where another begins, or None."""
    t, x, y, speed = _sample(after, 0)
    if speed >= STANDING_MPS:
        return None
    near = (t <= ends[:, 0] + gap_s) & (ends[:, 3] < STANDING_MPS)
    near &= np.hypot(ends[:, 1] - x, ends[:, 2] - y) < SAME_PLACE_M
    for number in np.flatnonzero(near).tolist():
        if number in made and _is_same(made[number], after):
            return number
    return None


def _is_same(before: Track, after: Track) -> bool:
    """Whether a track stands where another begins, from then to its own end."""
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
    """One track: all of the first, then what the second has beyond its end."""
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
