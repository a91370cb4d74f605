"""What a recording says of its road users, checked against how they moved.

Positions are rarely wrong. Recorded speeds, headings and box sizes that contradict them
are refused, and the likely cause is named. A recording with few moving road users is
not judged.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, Recording, Track
from rcirl_jax.units import FOOT_M, MPH_MPS

MIN_CARS = (
    3  # vehicles needed to judge; two lorries, or one that reverses, are no error
)
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
DEGREES = math.pi / 180.0  # rad


@dataclasses.dataclass(frozen=True)
class Convention:
    """How an angle in a file becomes radians, counter-clockwise from +x (north is +y).

    heading = sign * unit * angle + zero
    """

    words: str
    sign: float
    zero: float  # rad
    unit: float = 1.0  # rad

    def radians(self, angles: np.ndarray) -> np.ndarray:
        """Angles [n] as headings [n] in radians."""
        return self.sign * self.unit * angles + self.zero


DIRECTIONS = (
    ("counter-clockwise from +x", 1.0, 0.0),
    ("clockwise from north (a compass)", -1.0, 0.5 * math.pi),
    ("clockwise from +x", -1.0, 0.0),
    ("counter-clockwise from north", 1.0, 0.5 * math.pi),
    ("counter-clockwise from -x (half a turn off)", 1.0, math.pi),
)
UNIT_WORDS = (
    ("radians", 1.0),
    ("degrees", DEGREES),
    ("radians, converted as if they were degrees", 1 / DEGREES),
)
CONVENTIONS = tuple(
    Convention(f"{words} in {unit_words}", sign, zero, unit)
    for (unit_words, unit), (words, sign, zero) in itertools.product(
        UNIT_WORDS, DIRECTIONS
    )
)


def check_against_motion(name: str, recording: Recording) -> None:
    """Sizes, speeds and headings agree with the positions and the lanes.

    Args:
      name: file, stands first in errors.
      recording: whose tracks each are sound.

    Raises:
      InputError: the first contradiction, and its likely cause.
    """
    cars = [track for track in recording.tracks if track.kind == Kind.VEHICLE]
    if len(cars) >= MIN_CARS:
        _check_lengths(name, cars)
        _check_widths(name, cars, recording.lanes)
    _check_speeds(name, recording)
    if len(cars) >= MIN_CARS:
        _check_headings(name, cars, recording.rate_hz)


def _check_lengths(name: str, cars: Sequence[Track]) -> None:
    lengths = [track.length for track in cars]
    median = float(np.median(lengths))
    low, high = MEDIAN_CAR_M
    short = float(np.quantile(lengths, 0.25))
    if median < low or min(median, short) > high:
        wrong = "feet taken for metres" if median > high else "metres taken for feet"
        raise InputError(
            f"{name}: length: median {median:.1f} m: "
            f"expected {low:g} to {high:g} m; {wrong}?"
        )


def _check_widths(name: str, cars: Sequence[Track], lanes: Sequence[Lane]) -> None:
    """The median vehicle is narrower than it is long, and than the median lane."""
    length = float(np.median([track.length for track in cars]))
    width = float(np.median([track.width for track in cars]))
    if width > length:
        raise InputError(
            f"{name}: width: median {width:.2f} m, of length {length:.2f} m: expected "
            "vehicles longer than wide; are the two columns exchanged?"
        )
    if not lanes:
        return
    room = [float(np.median(lane.left_width + lane.right_width)) for lane in lanes]
    lane_width = float(np.median(room))
    if width > WIDEST_IN_LANE * lane_width:
        raise InputError(
            f"{name}: width: median {width:.2f} m, of lanes {lane_width:.2f} m: "
            "expected vehicles narrower than their lanes; feet taken for metres, or "
            "half the width of a lane given as the whole?"
        )


def _windows(track: Track, rate_hz: float) -> tuple[int, np.ndarray, np.ndarray]:
    """Samples in a window; of each, displacement [m, 2] m and duration [m] s."""
    span = min(max(round(WINDOW_S * rate_hz), 1), track.t.size - 1)
    if span < 1:
        return 0, np.zeros((0, 2)), np.zeros(0)
    place = np.stack([track.x, track.y], axis=-1)
    return span, place[span:] - place[:-span], track.t[span:] - track.t[:-span]


def _speed_ratios(track: Track, rate_hz: float) -> np.ndarray:
    """Recorded speed over speed from positions, over windows where it moves.

    ratio = integral of |speed| dt / distance between the window's ends
    """
    span, moved, lasted = _windows(track, rate_hz)
    if not span:
        return np.zeros(0)
    speed = np.abs(track.speed)
    mean = 0.5 * (speed[1:] + speed[:-1])
    path = np.concatenate([[0.0], np.cumsum(mean * np.diff(track.t))])
    recorded, distance = path[span:] - path[:-span], np.hypot(*moved.T)
    moving = np.maximum(recorded, distance) > MOVING_MPS * lasted
    return recorded[moving] / np.maximum(distance[moving], 1e-9)


def _check_speeds(name: str, recording: Recording) -> None:
    ratios = np.concatenate(
        [
            _speed_ratios(track, recording.rate_hz)
            for track in recording.tracks
            if track.kind != Kind.STATIC
        ]
        or [np.zeros(0)]
    )
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


def directions(track: Track, rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Where a road user moves, directions of travel [m] and headings [m] rad."""
    span, moved, lasted = _windows(track, rate_hz)
    moving = np.hypot(*moved.T) > MOVING_MPS * lasted
    middle = track.heading[span // 2 : span // 2 + lasted.size]
    return np.arctan2(moved[moving, 1], moved[moving, 0]), middle[moving]


def apart(convention: Convention, angles: np.ndarray, travel: np.ndarray) -> float:
    """Median angle [rad] between headings so understood and directions of travel."""
    turn = convention.radians(angles) - travel
    return float(np.median(np.abs(np.angle(np.exp(1j * turn)))))


def _moving(cars: Sequence[Track], rate_hz: float) -> Iterator[np.ndarray]:
    """Per vehicle that moves [2, m]: directions of travel and headings."""
    for track in cars:
        travel, heading = directions(track, rate_hz)
        if travel.size:
            yield np.stack([travel, heading])


def _check_headings(name: str, cars: Sequence[Track], rate_hz: float) -> None:
    moving = list(_moving(cars, rate_hz))
    if len(moving) < MIN_CARS:
        return
    travel, heading = np.concatenate(moving, axis=-1)
    if travel.size < MIN_MOVING_SAMPLES:
        return
    usual = apart(CONVENTIONS[0], heading, travel)
    if usual <= HEADING_FITS:
        return
    best = min(CONVENTIONS[1:], key=lambda one: apart(one, heading, travel))
    hint = ""
    if apart(best, heading, travel) <= HEADING_FITS_WELL:
        hint = f"; the file's angles seem to be {best.words}"
    raise InputError(
        f"{name}: heading: {math.degrees(usual):.0f} degrees from the direction of "
        f"travel in the median: expected up to {math.degrees(HEADING_FITS):.0f}, as "
        f"radians counter-clockwise from +x{hint}"
    )
