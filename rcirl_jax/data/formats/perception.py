"""Boxes and lights that a car's own perception saw, as tracks and signals.

L5, nuPlan, Apollo and ROS 2 logs hold what one car saw while it drove: boxes with an
id, a class that may be unknown, and gaps where the view was blocked. A reader gathers
them as `Boxes`; this module puts them onto a clock and makes tracks of them.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.options import USER_KEYS, number, positive, section, stated
from rcirl_jax.data.formats.shapes import local_origin
from rcirl_jax.data.formats.tracks import once_each, split_tracks
from rcirl_jax.data.recording import LENGTH_RANGE_M, MAX_SPEED_MPS, WIDTH_RANGE_M
from rcirl_jax.data.roads import roads_from_tracks
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, Signal, Track

UNKNOWN = -1  # kind of a box whose class the log does not know
UNKNOWN_CHOICES = ("auto", "drop", "static", "vehicle")
STANDING_M = 1.0  # m, an unknown object that moves less than this is static
MAX_OUTLIERS = 0.1  # share of tracks dropped as outliers; more is an error
ONE_OF = 5  # tracks of which one may always be an outlier
# m, [length, width] of road users of which none is known; others: 1 m
SIZES_M = {
    Kind.VEHICLE: (4.5, 1.8),
    Kind.CYCLIST: (1.8, 0.6),
    Kind.PEDESTRIAN: (0.5, 0.5),
}
OTHER_SIZE_M = (1.0, 1.0)  # m
MAX_SIZE_M = 200.0  # m, of a box; beyond it the file is wrong, not the tracker
SERIES = ("x", "y", "heading", "speed", "length", "width")
ARRAYS = ("ids", "t", *SERIES, "kind")
STATES = ("off", "red", "yellow", "green")  # of lights, by their numbers


@dataclasses.dataclass(frozen=True)
class Boxes:
    """Boxes of all road users of one recording, in any order."""

    ids: np.ndarray  # [n] int, the same for all boxes of one road user
    names: Sequence[str]  # name of each id: `names[ids]`
    t: np.ndarray  # [n] s
    x: np.ndarray  # [n] m, of the box centre
    y: np.ndarray  # [n] m
    heading: np.ndarray  # [n] rad
    speed: np.ndarray  # [n] m/s; NaN: from the positions
    length: np.ndarray  # [n] m; NaN: not known
    width: np.ndarray  # [n] m; NaN: not known
    kind: np.ndarray  # [n] int, `Kind` or UNKNOWN
    size_assumed: bool = False  # no log says the sizes


def ego_boxes(
    spec: Mapping,
    t: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    heading: np.ndarray,
    speed: np.ndarray,
) -> Boxes:
    """Makes boxes of the recording car, id "ego", from its poses.

    Args:
      spec: source TOML; the table `ego` has the car's measures in m: length, width,
        and how far ahead of a pose's place the box's centre lies.
      t: [n] s.
      x: [n] m.
      y: [n] m.
      heading: [n] rad.
      speed: [n] m/s; NaN: from the positions.
    """
    own = section(spec, "ego")
    ahead_of = "centre_ahead" if "centre_ahead" in own else "rear_axle_to_centre"
    length, width, ahead = (
        np.full(t.size, number(own, name)) for name in ("length", "width", ahead_of)
    )
    x, y = x + ahead * np.cos(heading), y + ahead * np.sin(heading)
    ids, kinds = np.zeros(t.size, np.int64), np.full(t.size, int(Kind.VEHICLE))
    is_assumed = "ego" not in spec.get(USER_KEYS, ())
    return Boxes(
        ids, ("ego",), t, x, y, heading, speed, length, width, kinds, is_assumed
    )


def on_clock(boxes: Boxes, rate_hz: float, max_gap_s: float) -> Boxes:
    """Resamples boxes at times k / rate_hz, within each gapless piece.

    Linear interpolation; headings are unwrapped first, series of which some values are
    not known are those of the row at or after the tick. A piece between two ticks of
    the clock gives nothing. Of several rows of one road user and time the first counts.
    """
    ids, t = boxes.ids, boxes.t
    order = np.lexsort((t, ids))
    step, same = np.diff(t[order]), np.diff(ids[order]) == 0
    order = order[np.concatenate([[True], ~same | (step > 0.0)])[: order.size]]
    step, same = np.diff(t[order]), np.diff(ids[order]) == 0
    breaks = np.flatnonzero(~same | (step > max_gap_s)) + 1
    parts = [{name: getattr(boxes, name)[:0] for name in ARRAYS}]
    for rows in np.split(order, breaks) if order.size else []:
        first = math.ceil(float(t[rows[0]]) * rate_hz - 1e-6)
        last = math.floor(float(t[rows[-1]]) * rate_hz + 1e-6)
        clock = np.arange(first, last + 1) / rate_hz
        at = np.minimum(np.searchsorted(t[rows], clock), rows.size - 1)
        part = {"ids": np.full(clock.size, ids[rows[0]]), "t": clock}
        for name in SERIES:
            values = getattr(boxes, name)[rows]
            values = np.unwrap(values) if name == "heading" else values
            known = not np.isnan(values).any()
            part[name] = np.interp(clock, t[rows], values) if known else values[at]
        parts.append({**part, "kind": boxes.kind[rows][at]})
    merged = {name: np.concatenate([part[name] for part in parts]) for name in ARRAYS}
    return dataclasses.replace(boxes, **merged)


def tracks_of(
    path: Path,
    boxes: Boxes,
    max_gap_s: float,
    unknown: str = "auto",
    automated: tuple[tuple[float, float], ...] = (),
) -> tuple[list[Track], list[str]]:
    """Makes tracks of boxes, in the order of their ids, and notes on what is left out.

    A gap longer than `max_gap_s` starts another track, "id#2". Size and class are the
    median and the most frequent of a track; where no size is known it is that of its
    class. Trackers lose objects now and then: tracks with an impossible size or speed
    are left out, unless they are more than a tenth, which points at a wrong file. A box
    that is met twice at one time counts once, likewise.

    Args:
      path: named in errors.
      boxes: at least none.
      max_gap_s: s without a box inside one track.
      unknown: what objects of unknown class become: "drop", "static",
        "vehicle", or by whether they moved ("auto").
      automated: of all tracks.

    Raises:
      InputError: a number that is not finite, an absurd size, or many times met
        twice by one id.
    """
    if unknown not in UNKNOWN_CHOICES:
        raise InputError(
            f"source TOML: unknown: {unknown}: expected one of {UNKNOWN_CHOICES}"
        )
    if boxes.t.size == 0:
        return [], []
    for field in ("t", "x", "y", "heading", "length", "width"):
        values = getattr(boxes, field)
        wrong, expected = ~np.isfinite(values), ": expected a finite number"
        if field in ("length", "width"):
            wrong = (values < 0.0) | (values > MAX_SIZE_M)  # NaN is not known
            expected = f" m: expected 0 to {MAX_SIZE_M:g} m"
        if wrong.any():
            row = np.flatnonzero(wrong)[0]
            name = boxes.names[int(boxes.ids[row])]
            raise InputError(f"{path}: id {name}: {field}: {values[row]:g}{expected}")
    kept, notes = once_each(boxes.ids, boxes.t)
    if notes:
        once = {name: getattr(boxes, name)[kept] for name in ARRAYS}
        boxes = dataclasses.replace(boxes, **once)
    tracks, dropped, seen = [], 0, {}
    for _, rows in split_tracks(path, boxes.ids, boxes.t, max_gap_s):
        name = boxes.names[int(boxes.ids[rows[0]])]
        seen[name] = seen.get(name, 0) + 1
        t, x, y, speed = boxes.t[rows], boxes.x[rows], boxes.y[rows], boxes.speed[rows]
        # most frequent class; the shift makes UNKNOWN a count of its own
        kind = int(np.argmax(np.bincount(boxes.kind[rows] - UNKNOWN))) + UNKNOWN
        size, assumed = [], boxes.size_assumed
        usual = SIZES_M.get(Kind(max(kind, 0)), OTHER_SIZE_M)
        for sizes, default in zip((boxes.length, boxes.width), usual, strict=True):
            known = sizes[rows][np.isfinite(sizes[rows])]
            size.append(float(np.median(known)) if known.size else default)
            assumed |= not known.size
        if kind == UNKNOWN and unknown == "drop":
            dropped += 1
            continue
        if kind == UNKNOWN:
            moved = np.hypot(np.ptp(x), np.ptp(y)) > STANDING_M
            by_motion = "vehicle" if moved else "static"
            kind = Kind[(by_motion if unknown == "auto" else unknown).upper()]
        lost = ~np.isfinite(speed)
        track = Track(
            id=name if seen[name] == 1 else f"{name}#{seen[name]}",
            kind=Kind(kind),
            length=max(size[0], LENGTH_RANGE_M[0]),
            width=max(size[1], WIDTH_RANGE_M[0]),
            size_assumed=assumed,
            t=t,
            x=x,
            y=y,
            heading=boxes.heading[rows],
            speed=np.where(lost, speed_of(t, x, y), speed) if lost.any() else speed,
            automated=automated,
        )
        tracks.append(track)
    tracks, outliers = without_outliers(tracks)
    left_out = [f"{dropped} tracks of unknown class left out"] if dropped else []
    return tracks, [*notes, *outliers, *left_out]


def speed_of(t: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Computes speed [n] m/s from positions by central differences."""
    if t.size < 2:
        return np.zeros(t.shape)
    return np.hypot(np.gradient(x, t), np.gradient(y, t))


def without_outliers(
    tracks: list[Track], is_possible: Callable[[Track], bool] | None = None
) -> tuple[list[Track], list[str]]:
    """Drops impossible tracks, with a note of their number.

    Keeps all, for validation to refuse, if more than MAX_OUTLIERS are impossible, and
    more than one of ONE_OF or more.
    """
    good = [track for track in tracks if (is_possible or _is_possible)(track)]
    lost = len(tracks) - len(good)
    allowed = max(MAX_OUTLIERS * len(tracks), float(len(tracks) >= ONE_OF))
    if lost == 0 or lost > allowed:
        return tracks, []
    return good, [f"{lost} tracks with an impossible size or speed left out"]


def has_possible_speed(track: Track) -> bool:
    """True if no sample is faster than any road user."""
    return not np.max(np.abs(track.speed)) > MAX_SPEED_MPS


def _is_possible(track: Track) -> bool:
    sizes = ((track.length, LENGTH_RANGE_M), (track.width, WIDTH_RANGE_M))
    return has_possible_speed(track) and (
        track.kind == Kind.STATIC
        or all(low <= size <= high for size, (low, high) in sizes)
    )


def placed(
    tracks: Sequence[Track],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Track]]:
    """Moves tracks to a local origin.

    Returns:
      x, y [n] m of all samples as they were, the origin [2] m, the tracks around it.
    """
    x = np.concatenate([track.x for track in tracks])
    y = np.concatenate([track.y for track in tracks])
    origin = local_origin(x, y)
    moved = [
        dataclasses.replace(track, x=track.x - origin[0], y=track.y - origin[1])
        for track in tracks
    ]
    return x, y, origin, moved


def fitted_lanes(
    tracks: Sequence[Track], spec: Mapping
) -> tuple[tuple[Lane, ...], str]:
    """Estimates lanes from all tracks, with a note on them.

    Their limit is what the user's own TOML states, if it does.
    """
    width = positive(spec, "lane_width_m")
    roads = roads_from_tracks(tracks, width=width, limit=stated(spec, "speed_limit"))
    return roads.lanes, roads.note


def held_states(
    clock: np.ndarray, seen: np.ndarray, states: np.ndarray, hold: float
) -> np.ndarray:
    """Holds the last state seen of a light: [T] numbers of STATES.

    Args:
      clock: [T] times, increasing.
      seen: [n] times, increasing, in the same unit.
      states: [n] numbers of STATES.
      hold: in the same unit; the light is off after it without any.
    """
    last = np.searchsorted(seen, clock, side="right") - 1
    fresh = (last >= 0) & (clock - seen[np.maximum(last, 0)] <= hold)
    return np.where(fresh, states[np.maximum(last, 0)], 0)


def signal_of(name: str, t: np.ndarray, states: np.ndarray) -> Signal:
    """Makes intervals of a light's states (numbers of STATES) at times t [T] s."""
    first = np.flatnonzero(np.diff(states, prepend=-1))
    return Signal(
        id=name, start=t[first], state=tuple(STATES[state] for state in states[first])
    )
