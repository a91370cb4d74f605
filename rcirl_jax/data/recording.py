"""Invariants that every importer's Recording satisfies, checked in one place.

They catch what a wrong column or unit does to a log: feet read as metres, km/h
read as m/s, frames read as seconds. Each violation is one line that names the
file, the field, the value found and what was expected.
"""

import collections
import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.errors import InputError, as_input_error
from rcirl_jax.runtime.atomic_files import is_text
from rcirl_jax.types import Kind, Lane, Recording, Signal, Track
from rcirl_jax.units import FOOT_M, MPH_MPS

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
# vehicles needed to judge; two lorries, or one that reverses, are no error
MIN_CARS = 3
# m, of the median vehicle: below it lengths were taken for feet; above it they are in
# feet, if those of a quarter from the shortest are too (a car is 4-5 m, a bus 12)
MEDIAN_CAR_M = (2.0, 9.0)
WIDEST_IN_LANE = 1.0  # median vehicle's width over the median lane's
MOVING_MPS = 2.0  # m/s, speeds and headings are compared only above this
WINDOW_S = 0.5  # s, position noise averages out over it
SPEED_RATIO_RANGE = (0.5, 2.0)  # recorded speed over speed from positions
MIN_MOVING_SAMPLES = 10  # samples needed to judge speeds and headings
# what a ratio near one of these means (recorded speed over that of positions)
RATIO_HINTS = {
    FOOT_M: "feet taken for metres?",
    1.0 / FOOT_M: "feet taken for metres?",
    3.6: "km/h taken for m/s?",
    1.0 / MPH_MPS: "mph taken for m/s?",
}
HINT_TOLERANCE = 0.08  # relative; 3.28 and 3.6 stay apart
HEADING_FITS = math.radians(15.0)  # rad from the direction of travel, in the median
HEADING_FITS_WELL = math.radians(8.0)  # rad, of a convention that is named as the cause
# how an angle in a file may become a heading: sign * unit * angle + zero [rad]
DIRECTIONS = (
    ("counter-clockwise from +x", 1.0, 0.0),
    ("clockwise from north (a compass)", -1.0, 0.5 * math.pi),
    ("clockwise from +x", -1.0, 0.0),
    ("counter-clockwise from north", 1.0, 0.5 * math.pi),
    ("counter-clockwise from -x (half a turn off)", 1.0, math.pi),
)
UNITS = (
    ("radians", 1.0),
    ("degrees", math.pi / 180.0),
    ("radians, converted as if they were degrees", 180.0 / math.pi),
)


def accepted(
    make: Callable[[], Recording], name: str, file: object, spec: dict
) -> Recording:
    """Return a validated recording of several in one file.

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
    """Return what stands for a recording that is left out."""
    return dataclasses.replace(empty_recording(name), refused=str(error))


def empty_recording(name: str, *notes: str) -> Recording:
    """Return what stands for a file in which nobody drives; imports skip it."""
    return Recording(
        name=name, source="", licence="", rate_hz=0.0, tracks=(), lanes=(), notes=notes
    )


def validate_recording(
    recording: Recording, file: str | Path | None = None
) -> Recording:
    """Check a recording; references to unknown lanes and signals are dropped.

    One without traffic is no error: an import counts and skips it.

    Args:
      recording: what an importer read.
      file: named in errors; default: the recording's name.

    Raises:
      InputError: the first violation, as "FILE: field: value: expected".
    """
    name = str(file or recording.name)
    rate, tracks = recording.rate_hz, recording.tracks
    _check(rate > 0.0, name, "rate_hz", rate, "> 0")
    fits = rate <= MAX_RATE_HZ
    _check(fits, name, "rate_hz", f"{rate:g}", f"up to {MAX_RATE_HZ:g}")
    if not tracks:
        return recording  # counted as empty, and skipped
    lanes, signals = recording.lanes, recording.signals
    texts = {
        "name": recording.name,
        "group": recording.group or "",
        "source": recording.source,
        "licence": recording.licence,
        "id": "".join(part.id for part in (*tracks, *lanes, *signals)),
        "notes": "".join(recording.notes),
    }
    for field, text in texts.items():
        _check(is_text(text), name, field, f"{text!a:.80}", "UTF-8 text")
    for what, parts in (("track", tracks), ("lane", lanes), ("signal", signals)):
        for number, count in collections.Counter(part.id for part in parts).items():
            _check(count == 1, name, f"{what} id", f"{number}: met twice", "once")
    for track in tracks:
        _check_track(f"{name}: track {track.id}", track)
    steps = np.concatenate([np.diff(track.t) for track in tracks])
    step = float(np.median(steps)) * rate if steps.size else 1.0  # in samples
    _check(
        abs(step - 1.0) <= RATE_TOLERANCE, name, "t", f"median step {step / rate:g} s",
        f"{1.0 / rate:g} s (rate_hz {rate:g})",
    )  # fmt: skip
    begin = min(float(track.t[0]) for track in tracks)
    for signal in signals:
        _check_signal(f"{name}: signal {signal.id}", signal, begin)
    for agent in recording.missing_agents:
        values = (agent.t0, agent.t1, *agent.start, *agent.end)
        good = bool(np.isfinite(values).all()) and agent.t1 >= agent.t0
        _check(good, name, "missing agent", values, "finite, t1 >= t0")
    lane_ids, signal_ids = {lane.id for lane in lanes}, {x.id for x in signals}
    checked = [_check_lane(name, lane, lane_ids, signal_ids) for lane in lanes]
    for place, axis in enumerate(("x", "y")):
        driven = [getattr(track, axis) for track in tracks]
        check_span(f"{name}: tracks", axis, np.concatenate(driven))
        centres = [lane.centre[:, place] for lane in lanes]
        check_span(f"{name}: lanes", axis, np.concatenate([*centres, np.zeros(0)]))
    lengths = (np.hypot(*np.diff(lane.centre, axis=0).T).sum() for lane in lanes)
    check_lanes_length(name, sum(map(float, lengths)))
    # positions are rarely wrong: sizes, speeds and headings that contradict them are
    # refused, and the likely cause is named; few moving road users are not judged
    cars = [track for track in tracks if track.kind == Kind.VEHICLE]
    if len(cars) >= MIN_CARS:
        _check_sizes(name, cars, lanes)
    _check_speeds(name, recording)
    if len(cars) >= MIN_CARS:
        _check_headings(name, cars, rate)
    return dataclasses.replace(recording, lanes=tuple(checked))


def _check(good: bool, where: str, field: str, value: object, expected: str) -> None:
    """Raises the one line of a value that does not hold."""
    if not good:
        raise InputError(f"{where}: {field}: {value}: expected {expected}")


def _check_track(where: str, track: Track) -> None:
    sizes = sorted({getattr(track, field).shape for field in SERIES})
    equal = len(sizes) == 1 and track.t.ndim == 1 and track.t.size > 0
    _check(equal, where, "samples", sizes, "equal, at least one")
    for field in SERIES:
        values = getattr(track, field)
        bad = values[~np.isfinite(values)]
        _check(not bad.size, where, field, bad[:1].sum(), "a finite number")
    back = int(np.argmin(np.diff(track.t))) if track.t.size > 1 else 0
    before, after = track.t[back : back + 2] if track.t.size > 1 else (-1.0, 0.0)
    _check(
        after > before,
        where,
        "t",
        f"{after:g} s after {before:g} s",
        "increasing times",
    )
    place = track.destination
    known = place is None or bool(np.isfinite(place).all())
    _check(known, where, "destination", place, "finite numbers")
    for field in ("automated", "leader_missing"):
        for low, high in getattr(track, field):
            _check(low <= high, where, field, f"{low} to {high} s", "a span")
    static = track.kind == Kind.STATIC
    for field, moving in (("length", LENGTH_RANGE_M), ("width", WIDTH_RANGE_M)):
        (low, high), size = STATIC_RANGE_M if static else moving, getattr(track, field)
        _check(
            low <= size <= high, where, field, f"{size:g} m", f"{low:g} to {high:g} m"
        )
    fast, most = float(np.max(np.abs(track.speed))), MAX_SPEED_MPS
    _check(fast <= most, where, "speed", f"{fast:g} m/s", f"below {most:g} m/s")


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
    """Check that lanes of `total` m together are no longer than roads are."""
    if total > MAX_LANES_M:
        raise InputError(
            f"{where}: lanes: {total:g} m long in all: expected up to {MAX_LANES_M:g} m"
        )


def _check_signal(where: str, signal: Signal, begin: float) -> None:
    start, state = signal.start, signal.state
    one_each = f"{len(state)} for {start.size} starts"
    equal = start.size == len(state) > 0
    _check(equal, where, "state", one_each, "one each, at least one")
    unknown = set(state) - set(STATES)
    _check(not unknown, where, "state", min(unknown, default=""), f"one of {STATES}")
    rises = bool(np.isfinite(start).all() and np.all(np.diff(start) > 0.0))
    _check(rises, where, "start", "not increasing", "increasing times")
    early, expected = (
        bool(start[0] <= begin),
        f"at or before the first track, {begin:g} s",
    )
    _check(early, where, "start", f"{start[0]:g} s", expected)


def _check_lane(name: str, lane: Lane, lanes: set[str], signals: set[str]) -> Lane:
    where, shape = f"{name}: lane {lane.id}", lane.centre.shape
    points = len(shape) == 2 and shape[0] >= 2 and shape[1] == 2
    _check(points, where, "centre", shape, "[m >= 2, 2] points")
    for field in ("centre", "left_width", "right_width"):
        values = getattr(lane, field)
        good = len(values) == shape[0] and bool(np.isfinite(values).all())
        _check(good, where, field, values.shape, "finite, one per point")
    is_line = bool(np.any(np.diff(lane.centre, axis=0)))
    _check(is_line, where, "centre", "all points equal", "a line")
    narrow = min(float(lane.left_width.min()), float(lane.right_width.min()))
    _check(narrow > 0.0, where, "width", f"{narrow:g} m", "> 0")
    limit, most, line = lane.speed_limit, MAX_SPEED_MPS, lane.stop_line
    if limit is not None:
        said = f"{limit:g} m/s"
        _check(0.0 < limit < most, where, "speed_limit", said, f"0 to {most:g} m/s")
    if line is not None:
        two = line.shape == (2, 2) and bool(np.isfinite(line).all())
        _check(two, where, "stop_line", line.shape, "two points")
    return dataclasses.replace(
        lane,
        successors=tuple(s for s in lane.successors if s in lanes),
        left=lane.left if lane.left in lanes else None,
        right=lane.right if lane.right in lanes else None,
        signal_ids=tuple(s for s in lane.signal_ids if s in signals),
    )


# --------------------------------------------------------- against the motion


def _check_sizes(name: str, cars: Sequence[Track], lanes: Sequence[Lane]) -> None:
    """Check the median vehicle: as long as a car, narrower than its lane."""
    lengths = [track.length for track in cars]
    length = float(np.median(lengths))
    width = float(np.median([track.width for track in cars]))
    low, high = MEDIAN_CAR_M
    if length < low or min(length, float(np.quantile(lengths, 0.25))) > high:
        wrong = "feet taken for metres" if length > high else "metres taken for feet"
        raise InputError(
            f"{name}: length: median {length:.1f} m: "
            f"expected {low:g} to {high:g} m; {wrong}?"
        )
    if width > length:
        raise InputError(
            f"{name}: width: median {width:.2f} m, of length {length:.2f} m: expected "
            "vehicles longer than wide; are the two columns exchanged?"
        )
    room = [float(np.median(lane.left_width + lane.right_width)) for lane in lanes]
    lane_width = float(np.median(room)) if room else math.inf
    if width > WIDEST_IN_LANE * lane_width:
        raise InputError(
            f"{name}: width: median {width:.2f} m, of lanes {lane_width:.2f} m: "
            "expected vehicles narrower than their lanes; feet taken for metres, or "
            "half the width of a lane given as the whole?"
        )


def _windows(track: Track, rate_hz: float) -> tuple[int, np.ndarray, np.ndarray]:
    """Return samples in a window; of each, displacement [m, 2] m and duration [m] s."""
    span = min(max(round(WINDOW_S * rate_hz), 1), track.t.size - 1)
    if span < 1:
        return 0, np.zeros((0, 2)), np.zeros(0)
    place = np.stack([track.x, track.y], axis=-1)
    return span, place[span:] - place[:-span], track.t[span:] - track.t[:-span]


def _check_speeds(name: str, recording: Recording) -> None:
    """Check the recorded speed over that of positions, in windows with motion.

    ratio = integral of |speed| dt / distance between the window's ends
    """
    found = [np.zeros(0)]
    for track in recording.tracks:
        span, moved, lasted = _windows(track, recording.rate_hz)
        if track.kind != Kind.STATIC and span:
            speed = np.abs(track.speed)
            mean = 0.5 * (speed[1:] + speed[:-1])
            path = np.concatenate([[0.0], np.cumsum(mean * np.diff(track.t))])
            recorded, distance = path[span:] - path[:-span], np.hypot(*moved.T)
            moving = np.maximum(recorded, distance) > MOVING_MPS * lasted
            found.append(recorded[moving] / np.maximum(distance[moving], 1e-9))
    ratios = np.concatenate(found)
    if ratios.size < MIN_MOVING_SAMPLES:
        return
    ratio = float(np.median(ratios))
    low, high = SPEED_RATIO_RANGE
    if not low <= ratio <= high:
        known = min(RATIO_HINTS, key=lambda value: abs(ratio / value - 1.0))
        near = abs(ratio / known - 1.0) < HINT_TOLERANCE
        raise InputError(
            f"{name}: speed: {ratio:.4g} times the speed of the positions: "
            f"expected {low:g} to {high:g}{'; ' + RATIO_HINTS[known] if near else ''}"
        )


def _check_headings(name: str, cars: Sequence[Track], rate_hz: float) -> None:
    """Check headings against directions of travel; name the convention that fits."""
    travels, angles = [], []
    for track in cars:
        span, moved, lasted = _windows(track, rate_hz)
        moving = np.hypot(*moved.T) > MOVING_MPS * lasted
        if moving.any():
            middle = track.heading[span // 2 : span // 2 + lasted.size]
            travels.append(np.arctan2(moved[moving, 1], moved[moving, 0]))
            angles.append(middle[moving])
    if len(travels) < MIN_CARS or sum(map(len, travels)) < MIN_MOVING_SAMPLES:
        return
    travel, angle = np.concatenate(travels), np.concatenate(angles)
    apart = {}  # rad in the median, by convention
    for (unit_words, unit), (words, sign, zero) in itertools.product(UNITS, DIRECTIONS):
        turn = np.exp(1j * (sign * unit * angle + zero - travel))
        apart[f"{words} in {unit_words}"] = float(np.median(np.abs(np.angle(turn))))
    usual = apart.pop(next(iter(apart)))
    if usual <= HEADING_FITS:
        return
    best = min(apart, key=apart.__getitem__)
    fits = apart[best] <= HEADING_FITS_WELL
    raise InputError(
        f"{name}: heading: {math.degrees(usual):.0f} degrees from the direction of "
        f"travel in the median: expected up to {math.degrees(HEADING_FITS):.0f}, as "
        "radians counter-clockwise from +x"
        + (f"; the file's angles seem to be {best}" if fits else "")
    )
