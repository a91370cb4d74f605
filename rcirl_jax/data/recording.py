"""Invariants that every importer's Recording satisfies, checked in one place."""

import dataclasses

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, Recording, Track
from rcirl_jax.units import FOOT_M

MAX_SPEED_MPS = 90.0  # m/s, faster than any road user
LENGTH_RANGE_M = (0.2, 40.0)  # m
WIDTH_RANGE_M = (0.2, 6.0)  # m
MAX_MEDIAN_CAR_M = 9.0  # m; a median above it means feet (a car is 4-5 m)
MOVING_MPS = 2.0  # m/s, speeds compared with positions only above this
SPEED_RATIO_RANGE = (0.5, 2.0)  # recorded speed over speed from positions
MIN_MOVING_SAMPLES = 20  # samples needed to judge the ratio


def validate_recording(recording: Recording) -> Recording:
    """The recording with unknown lane references dropped.

    Raises:
      InputError: the first violation, as "RECORDING: field: value: expected".
    """
    name = recording.name
    if not recording.tracks:
        raise InputError(f"{name}: tracks: none: expected at least one road user")
    ids = [track.id for track in recording.tracks]
    if len(set(ids)) != len(ids):
        twice = next(i for i in ids if ids.count(i) > 1)
        raise InputError(f"{name}: id: {twice}: met twice: expected unique ids")
    for track in recording.tracks:
        _check_track(name, track, recording.rate_hz)
    _check_lengths(name, recording.tracks)
    _check_speeds(name, recording.tracks)
    known = {lane.id for lane in recording.lanes}
    if len(known) != len(recording.lanes):
        raise InputError(f"{name}: lanes: an id is met twice: expected unique ids")
    lanes = tuple(_check_lane(name, lane, known) for lane in recording.lanes)
    return dataclasses.replace(recording, lanes=lanes)


def _check_track(name: str, track: Track, rate_hz: float) -> None:
    where = f"{name}: track {track.id}"
    sizes = {getattr(track, k).shape for k in ("t", "x", "y", "heading", "speed")}
    if len(sizes) != 1 or track.t.size == 0:
        raise InputError(f"{where}: samples: {sizes}: expected equal, at least one")
    for field in ("t", "x", "y", "heading", "speed"):
        values = getattr(track, field)
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            found = values[bad[0]]
            raise InputError(f"{where}: {field}: {found}: expected a finite number")
    backwards = np.flatnonzero(np.diff(track.t) <= 0.0)
    if backwards.size:
        before, after = track.t[backwards[0]], track.t[backwards[0] + 1]
        raise InputError(
            f"{where}: t: {after:g} s after {before:g} s: expected increasing times"
        )
    for field, (low, high) in (("length", LENGTH_RANGE_M), ("width", WIDTH_RANGE_M)):
        size = getattr(track, field)
        if not low <= size <= high:
            raise InputError(
                f"{where}: {field}: {size:g} m: expected {low:g} to {high:g} m"
            )
    fastest = float(np.max(np.abs(track.speed)))
    if fastest > MAX_SPEED_MPS:
        raise InputError(
            f"{where}: speed: {fastest:g} m/s: expected below {MAX_SPEED_MPS:g}"
        )
    if track.t.size > 1:
        step = float(np.median(np.diff(track.t)))
        if abs(step * rate_hz - 1.0) > 0.1:
            raise InputError(
                f"{where}: t: steps of {step:g} s: expected {1 / rate_hz:g} s"
            )


def _check_lengths(name: str, tracks: tuple[Track, ...]) -> None:
    lengths = [track.length for track in tracks if track.kind == Kind.VEHICLE]
    if lengths and np.median(lengths) > MAX_MEDIAN_CAR_M:
        raise InputError(
            f"{name}: length: median {np.median(lengths):.1f} m: expected 3 to 9 m; "
            "feet taken for metres?"
        )


def _check_speeds(name: str, tracks: tuple[Track, ...]) -> None:
    """Recorded speed against differences of positions, over all moving samples."""
    ratios = []
    for track in tracks:
        if track.t.size < 2:
            continue
        moved = np.hypot(np.diff(track.x), np.diff(track.y)) / np.diff(track.t)
        recorded = 0.5 * (track.speed[1:] + track.speed[:-1])
        moving = (moved > MOVING_MPS) & (recorded > 0.0)
        ratios.append(recorded[moving] / moved[moving])
    both = np.concatenate(ratios) if ratios else np.zeros(0)
    if both.size < MIN_MOVING_SAMPLES:
        return
    ratio = float(np.median(both))
    low, high = SPEED_RATIO_RANGE
    if not low <= ratio <= high:
        foot = min(abs(ratio - FOOT_M), abs(ratio - 1.0 / FOOT_M)) < 0.4
        hint = "; feet taken for metres?" if foot else ""
        raise InputError(
            f"{name}: speed: {ratio:.2f} times the speed of the positions: "
            f"expected about 1{hint}"
        )


def _check_lane(name: str, lane: Lane, known: set[str]) -> Lane:
    where = f"{name}: lane {lane.id}"
    if lane.centre.ndim != 2 or lane.centre.shape[0] < 2 or lane.centre.shape[1] != 2:
        raise InputError(f"{where}: centre: {lane.centre.shape}: expected [m >= 2, 2]")
    for field in ("centre", "left_width", "right_width"):
        values = getattr(lane, field)
        if len(values) != len(lane.centre) or not np.isfinite(values).all():
            raise InputError(f"{where}: {field}: expected finite, one per point")
    narrow = min(float(lane.left_width.min()), float(lane.right_width.min()))
    if narrow <= 0.0:
        raise InputError(f"{where}: width: {narrow:g} m: expected > 0")
    return dataclasses.replace(
        lane,
        successors=tuple(s for s in lane.successors if s in known),
        left=lane.left if lane.left in known else None,
        right=lane.right if lane.right in known else None,
    )
