"""Every importer's recordings are judged by the same checks against their positions."""

import dataclasses
import math

import numpy as np
import pytest

from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind
from tests.helpers import roads
from tests.helpers.roads import recording

ROAD = math.radians(25.0)  # direction of travel


def car(number, *, speed=15.0, kind=Kind.VEHICLE, backwards=False):
    """For 5 s along the road; backwards it still looks ahead."""
    way = -speed if backwards else speed
    made = roads.car(
        f"{number}", lambda t: way * t, y=3.5 * number, seconds=4.9, kind=kind
    )
    x = made.x * math.cos(ROAD) - made.y * math.sin(ROAD)
    y = made.x * math.sin(ROAD) + made.y * math.cos(ROAD)
    return dataclasses.replace(made, x=x, y=y, heading=made.heading + ROAD)


def lane(width):
    made = roads.lane("a", np.array([0.0, 100.0]), np.array([0.0, 80.0]), limit=None)
    half = np.full(2, width / 2)
    return dataclasses.replace(made, left_width=half, right_width=half)


def changed(change, count=4):
    return [dataclasses.replace(car(i), **change(car(i))) for i in range(count)]


def test_a_true_recording_passes():
    validate_recording(recording(*map(car, range(4)), lanes=(lane(3.5),)))


@pytest.mark.parametrize(
    ("angles", "words"),
    [
        (lambda h: np.degrees(h), "counter-clockwise from +x in degrees"),
        (lambda h: np.pi / 2 - h, "clockwise from north (a compass) in radians"),
        (lambda h: h + np.pi, "half a turn off"),
    ],
)
def test_headings_in_another_convention_are_named(angles, words):
    wrong = changed(lambda track: {"heading": angles(track.heading)})
    with pytest.raises(InputError, match=r"^hand: heading: \d+ degrees") as error:
        validate_recording(recording(*wrong))
    assert words in str(error.value)


def test_who_reverses_stands_or_walks_is_not_judged():
    turned = {"heading": np.full(50, ROAD + 1.5)}
    others = [
        car(1, backwards=True),
        dataclasses.replace(car(2, speed=0.5), **turned),
        dataclasses.replace(car(3, kind=Kind.PEDESTRIAN, speed=3.0), **turned),
    ]
    validate_recording(recording(*others, *map(car, range(4, 7))))


@pytest.mark.parametrize(
    ("change", "lane_width", "words"),
    [
        ({"length": 14.0}, 3.5, "feet taken for metres"),
        ({"length": 2.1, "width": 4.9}, 5.0, "columns exchanged"),
        ({"width": 4.0, "length": 4.5}, 3.5, "narrower than their lanes"),
        ({}, 1.75, "half the width"),
    ],
)
def test_sizes_are_judged_by_each_other_and_by_the_lanes(change, lane_width, words):
    wrong = changed(lambda track: change)
    with pytest.raises(InputError, match=r"^hand: (length|width): median") as error:
        validate_recording(recording(*wrong, lanes=(lane(lane_width),)))
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("factor", "words"),
    [(3.6, "km/h"), (1 / 0.44704, "mph"), (1 / 0.3048, "feet"), (10.0, "expected 0.5")],
)
def test_speeds_in_another_unit_are_named(factor, words):
    wrong = changed(lambda track: {"speed": factor * np.full(50, 8.0)})
    slow = [
        dataclasses.replace(one, x=one.x * 8 / 15, y=one.y * 8 / 15) for one in wrong
    ]
    with pytest.raises(InputError, match=r"^hand: speed: ") as error:
        validate_recording(recording(*slow))
    assert words in str(error.value)
