"""Inputs of `scene_from` and their checks: SI, radians, Cartesian."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from rcirl_jax.errors import InputError, did_you_mean

BODY_KINDS = ("vehicle", "cyclist", "pedestrian", "static")
MOST = 1e9  # of any number
MOST_RAD = 4.0 * math.pi  # of a heading
SAME_PLACE_M = 1e-3  # m, a step of a line that is none
LONGEST_M = 1e5  # m, line
STATES = ("red", "stop", "yellow", "green", "off")  # of a signal; "stop": a sign


@dataclasses.dataclass(frozen=True, kw_only=True)
class Car:
    """The ego now; x, y of its box's centre."""

    x: float  # m
    y: float  # m
    heading: float  # rad, counter-clockwise from the x axis
    speed: float  # m/s, >= 0
    acceleration: float = 0.0  # m/s^2 along its heading
    curvature: float = 0.0  # 1/m, of the way it drives, left positive
    length: float  # m
    width: float  # m


@dataclasses.dataclass(frozen=True, kw_only=True)
class CentreLine:
    """The middle of the ego's lane, from behind the ego to as far as it may drive."""

    points: Any  # [m, 2] m, in driving direction
    speed_limit: Any  # m/s, posted: one, or one for each point from which it holds
    lane_width: float = 3.6  # m
    road_left: float | None = (
        None  # m from the line to the road's left edge; None: lane
    )
    road_right: float | None = None  # m to its right edge


@dataclasses.dataclass(frozen=True, kw_only=True)
class Body:
    """One of the others now; x, y of its box's centre."""

    kind: str = "vehicle"  # of BODY_KINDS
    x: float  # m
    y: float  # m
    heading: float  # rad
    speed: float = 0.0  # m/s along its heading
    acceleration: float = 0.0  # m/s^2 along its heading
    length: float  # m
    width: float  # m


@dataclasses.dataclass(frozen=True, kw_only=True)
class Signal:
    """A stop line of the ego's lane and what it says now."""

    x: float  # m, where the line crosses the lane
    y: float  # m
    state: (
        str  # "red" or "stop" (a sign) demand a stop; "yellow", "green", "off" do not
    )


def check(field: str, value: object, good: object, expected: str) -> None:
    """Refuse a field in one line where it is not good.

    Raises:
      InputError: "scene_from: FIELD: VALUE: expected EXPECTED".
    """
    if not good:
        raise InputError(f"scene_from: {field}: {value}: expected {expected}")


def check_one_of(field: str, value: object, known: Sequence[str]) -> None:
    """Refuse a name that is not known."""
    if value not in known:
        names = ", ".join(known)
        check(field, value, False, f"one of {names}{did_you_mean(str(value), known)}")


def floats(field: str, given: Any) -> np.ndarray:  # noqa: ANN401
    """Return finite float64 numbers that a road may have."""
    try:
        array = np.asarray(given, float)
    except (TypeError, ValueError):
        raise InputError(f"scene_from: {field}: {given}: expected numbers") from None
    good = np.all(np.abs(array) <= MOST)  # a NaN is not
    check(field, given, good, f"finite numbers up to {MOST:g}")
    return array


def table(field: str, given: Any, columns: int) -> np.ndarray:  # noqa: ANN401
    """Return finite numbers [n, columns], n at least 1."""
    array = floats(field, given)
    good = array.ndim == 2 and array.shape[1] == columns and len(array) > 0
    check(field, f"shape {array.shape}", good, f"rows of {columns} numbers")
    return array


def polyline(field: str, given: Any) -> np.ndarray:  # noqa: ANN401
    """Return points [m, 2] of a line; steps below a millimetre do not count."""
    points = table(field, given, 2)
    steps = np.hypot(*np.diff(points, axis=0).T)
    length = float(np.sum(steps[steps > SAME_PLACE_M]))
    found = f"{len(points)} points, {length:.3g} m long"
    check(field, found, 1.0 <= length <= LONGEST_M, "a line of 1 m to 100 km")
    return points


def check_numbers(name: str, given: Car | Body | Signal) -> None:
    """Check that every number of a car, a body or a signal is finite, in range."""
    for field in _number_fields(type(given)):
        value = getattr(given, field)
        if type(value) is not float or not abs(value) <= MOST:
            place = f"{name}.{field}"
            check(place, value, floats(place, value).ndim == 0, "a number")
        if field in ("length", "width") and not value > 0.0:
            check(f"{name}.{field}", value, False, "over 0 m")
        if field == "heading" and abs(value) > MOST_RAD:
            check_radians(f"{name}.{field}", value)


@functools.cache
def _number_fields(kind: type) -> tuple[str, ...]:
    return tuple(f.name for f in dataclasses.fields(kind) if f.type is float)


def check_radians(field: str, heading: float) -> None:
    """Refuse a heading of many turns: it is one in degrees."""
    good = abs(heading) <= MOST_RAD
    check(field, f"{heading:g}", good, "radians, not degrees")
