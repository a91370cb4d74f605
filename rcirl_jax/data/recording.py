"""Invariants that every importer's Recording satisfies, checked in one place.

They catch what a wrong column or unit does to a log: feet read as metres, km/h
read as m/s, frames read as seconds. Each violation is one line that names the
file, the field, the value found and what was expected.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rcirl_jax.data.motion_checks import check_against_motion
from rcirl_jax.errors import InputError, as_input_error
from rcirl_jax.runtime.atomic_files import is_text
from rcirl_jax.types import Kind, Lane, MissingAgent, Recording, Signal, Track

# keys that an import adds to a spec
LEAVE_OUT = "leave_out"  # refused recordings are left out
PIECE = "piece"  # (first, last) scene of a part that is read in pieces
MAX_RATE_HZ = 1000.0  # 1/s, of the clock
MAX_SPEED_MPS = 90.0  # m/s, faster than any road user
LENGTH_RANGE_M = (0.2, 40.0)  # m
WIDTH_RANGE_M = (0.2, 6.0)  # m
MAX_SPAN_M = 1e6  # m between any two places of one recording
MAX_LANES_M = 1e7  # m, all lanes of one recording together
STATIC_RANGE_M = (0.01, 1000.0)  # m, standing objects: from posts to long walls
RATE_TOLERANCE = 0.12  # relative; timestamps rounded to 10 ms at 30 Hz pass
SERIES = ("t", "x", "y", "heading", "speed")
STATES = ("red", "yellow", "green", "off")


def accepted(
    make: Callable[[], Recording], name: str, file: object, spec: dict
) -> Recording:
    """A validated recording of several in one file.

    Args:
      make: reads it.
      name: of the recording, where it cannot be read.
      file: named in errors.
      spec: of the source; with `leave_out` what is refused becomes a recording
        without tracks that says why, and the next one can be read.

    Raises:
      InputError: as `validate_recording`, without `leave_out`.
    """
    try:
        with as_input_error(str(file), "a sound recording"):
            return validate_recording(make(), str(file))
    except InputError as error:
        if not spec.get(LEAVE_OUT):
            raise
        return refusal(name, error)


def refusal(name: str, error: InputError) -> Recording:
    """What stands for a recording that is left out."""
    return dataclasses.replace(empty_recording(name), refused=str(error))


def empty_recording(name: str, *notes: str) -> Recording:
    """What stands for a file in which nobody drives; imports count and skip it."""
    return Recording(
        name=name, source="", licence="", rate_hz=0.0, tracks=(), lanes=(), notes=notes
    )


def validate_recording(
    recording: Recording, file: str | Path | None = None
) -> Recording:
    """The recording with references to unknown lanes and signals dropped.

    One without traffic is no error: an import counts and skips it.

    Args:
      recording: what an importer read.
      file: named in errors; default: the recording's name.

    Raises:
      InputError: the first violation, as "FILE: field: value: expected".
    """
    name = str(file or recording.name)
    if not (np.isfinite(recording.rate_hz) and recording.rate_hz > 0.0):
        raise InputError(f"{name}: rate_hz: {recording.rate_hz}: expected > 0")
    if recording.rate_hz > MAX_RATE_HZ:
        raise InputError(
            f"{name}: rate_hz: {recording.rate_hz:g}: expected up to {MAX_RATE_HZ:g}"
        )
    if not recording.tracks:
        return recording  # counted as empty, and skipped
    _check_texts(name, recording)
    _check_unique(name, "track id", [track.id for track in recording.tracks])
    _check_unique(name, "lane id", [lane.id for lane in recording.lanes])
    _check_unique(name, "signal id", [signal.id for signal in recording.signals])
    for track in recording.tracks:
        _check_track(name, track)
    _check_rate(name, recording)
    begin = min(float(track.t[0]) for track in recording.tracks)
    for signal in recording.signals:
        _check_signal(name, signal, begin)
    for agent in recording.missing_agents:
        _check_missing_agent(name, agent)
    lanes = {lane.id for lane in recording.lanes}
    signals = {signal.id for signal in recording.signals}
    checked = [_check_lane(name, lane, lanes, signals) for lane in recording.lanes]
    _check_places(name, recording)
    check_against_motion(name, recording)
    return dataclasses.replace(recording, lanes=tuple(checked))


def _check_texts(name: str, recording: Recording) -> None:
    parts = (*recording.tracks, *recording.lanes, *recording.signals)
    texts = {
        "name": recording.name,
        "group": recording.group or "",
        "source": recording.source,
        "licence": recording.licence,
        "id": "".join(part.id for part in parts),
        "notes": "".join(recording.notes),
    }
    for field, text in texts.items():
        if not is_text(text):
            raise InputError(f"{name}: {field}: {text!a:.80}: expected UTF-8 text")


def _check_unique(name: str, field: str, ids: list[str]) -> None:
    seen: set[str] = set()
    for item in ids:
        if item in seen:
            raise InputError(f"{name}: {field}: {item}: met twice: expected once")
        seen.add(item)


def _check_track(name: str, track: Track) -> None:
    where = f"{name}: track {track.id}"
    sizes = sorted({getattr(track, field).shape for field in SERIES})
    if len(sizes) != 1 or track.t.ndim != 1 or track.t.size == 0:
        raise InputError(f"{where}: samples: {sizes}: expected equal, at least one")
    for field in SERIES:
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
    _check_driver(where, track)
    static = track.kind == Kind.STATIC
    for field, moving in (("length", LENGTH_RANGE_M), ("width", WIDTH_RANGE_M)):
        low, high = STATIC_RANGE_M if static else moving
        size = getattr(track, field)
        if not low <= size <= high:
            raise InputError(
                f"{where}: {field}: {size:g} m: expected {low:g} to {high:g} m"
            )
    fastest = float(np.max(np.abs(track.speed)))
    if fastest > MAX_SPEED_MPS:
        raise InputError(
            f"{where}: speed: {fastest:g} m/s: expected below {MAX_SPEED_MPS:g} m/s"
        )


def _check_driver(where: str, track: Track) -> None:
    place = track.destination
    if place is not None and not np.isfinite(place).all():
        raise InputError(f"{where}: destination: {place}: expected finite numbers")
    for field in ("automated", "leader_missing"):
        for low, high in getattr(track, field):
            if not low <= high:
                raise InputError(
                    f"{where}: {field}: {low} to {high} s: expected a span"
                )


def check_span(where: str, field: str, values: np.ndarray) -> None:
    """No place [m] is absurdly far from the others, as one wrong cell would be.

    Raises:
      InputError: naming the value farthest from the median.
    """
    if not values.size or np.ptp(values) <= MAX_SPAN_M:
        return
    middle = float(np.median(values))
    worst = values[np.argmax(np.abs(values - middle))]
    raise InputError(
        f"{where}: {field}: {worst:g} m, the median is {middle:g} m: expected places "
        f"within {MAX_SPAN_M:g} m"
    )


def check_lanes_length(where: str, total: float) -> None:
    """Lanes of `total` m together are no longer than roads are."""
    if total > MAX_LANES_M:
        raise InputError(
            f"{where}: lanes: {total:g} m long in all: expected up to {MAX_LANES_M:g} m"
        )


def _check_places(name: str, recording: Recording) -> None:
    """Tracks and lanes lie near each other, and lanes are no longer than roads are."""
    for place, axis in enumerate(("x", "y")):
        driven = [getattr(track, axis) for track in recording.tracks]
        check_span(f"{name}: tracks", axis, np.concatenate(driven))
        lanes = [lane.centre[:, place] for lane in recording.lanes]
        check_span(f"{name}: lanes", axis, np.concatenate([*lanes, np.zeros(0)]))
    total = sum(
        float(np.hypot(*np.diff(lane.centre, axis=0).T).sum())
        for lane in recording.lanes
    )
    check_lanes_length(name, total)


def _check_rate(name: str, recording: Recording) -> None:
    steps = np.concatenate([np.diff(track.t) for track in recording.tracks])
    if steps.size == 0:
        return
    step, expected = float(np.median(steps)), 1.0 / recording.rate_hz
    if abs(step / expected - 1.0) > RATE_TOLERANCE:
        raise InputError(
            f"{name}: t: median step {step:g} s: expected {expected:g} s "
            f"(rate_hz {recording.rate_hz:g})"
        )


def _check_signal(name: str, signal: Signal, begin: float) -> None:
    where = f"{name}: signal {signal.id}"
    if signal.start.size != len(signal.state) or signal.start.size == 0:
        raise InputError(
            f"{where}: state: {len(signal.state)} for {signal.start.size} starts: "
            "expected one each, at least one"
        )
    unknown = set(signal.state) - set(STATES)
    if unknown:
        raise InputError(f"{where}: state: {min(unknown)}: expected one of {STATES}")
    if not np.isfinite(signal.start).all() or np.any(np.diff(signal.start) <= 0.0):
        raise InputError(f"{where}: start: not increasing: expected increasing times")
    if signal.start[0] > begin:
        raise InputError(
            f"{where}: start: {signal.start[0]:g} s: "
            f"expected at or before the first track, {begin:g} s"
        )


def _check_missing_agent(name: str, agent: MissingAgent) -> None:
    values = (agent.t0, agent.t1, *agent.start, *agent.end)
    if not np.isfinite(values).all() or agent.t1 < agent.t0:
        raise InputError(f"{name}: missing agent: {values}: expected finite, t1 >= t0")


def _check_lane(name: str, lane: Lane, lanes: set[str], signals: set[str]) -> Lane:
    where = f"{name}: lane {lane.id}"
    shape = lane.centre.shape
    if len(shape) != 2 or shape[0] < 2 or shape[1] != 2:
        raise InputError(f"{where}: centre: {shape}: expected [m >= 2, 2] points")
    for field in ("centre", "left_width", "right_width"):
        values = getattr(lane, field)
        if len(values) != len(lane.centre) or not np.isfinite(values).all():
            raise InputError(
                f"{where}: {field}: {values.shape}: expected finite, one per point"
            )
    if not np.any(np.diff(lane.centre, axis=0)):
        raise InputError(f"{where}: centre: all points equal: expected a line")
    narrow = min(float(lane.left_width.min()), float(lane.right_width.min()))
    if narrow <= 0.0:
        raise InputError(f"{where}: width: {narrow:g} m: expected > 0")
    limit = lane.speed_limit
    if limit is not None and not 0.0 < limit < MAX_SPEED_MPS:
        raise InputError(
            f"{where}: speed_limit: {limit:g} m/s: expected 0 to {MAX_SPEED_MPS:g} m/s"
        )
    line = lane.stop_line
    if line is not None and (line.shape != (2, 2) or not np.isfinite(line).all()):
        raise InputError(f"{where}: stop_line: {line.shape}: expected two points")
    return dataclasses.replace(
        lane,
        successors=tuple(s for s in lane.successors if s in lanes),
        left=lane.left if lane.left in lanes else None,
        right=lane.right if lane.right in lanes else None,
        signal_ids=tuple(s for s in lane.signal_ids if s in signals),
    )
