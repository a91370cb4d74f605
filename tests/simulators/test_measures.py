"""Contacts, faults and the measures of a drive made by hand."""

import dataclasses
import math

import numpy as np
import pytest

from rcirl_jax.export.own_planner.inputs import Body, Car, CentreLine
from rcirl_jax.simulators.measures import contact, log_of, measure, sample
from rcirl_jax.simulators.simulators import View

EGO = Car(x=100.0, y=50.0, heading=0.5 * math.pi, speed=10.0, length=5.0, width=2.0)
ROAD = CentreLine(points=[[100.0, 0.0], [100.0, 500.0]], speed_limit=15.0)


def seen(ego, *bodies):
    return View(ego=ego, centre_line=ROAD, obstacles=bodies, way=0.0, speed_limit=15.0)


def other(along, across, heading=0.0, speed=5.0):
    """A car seen by the ego, which drives north: along is y, across to its left."""
    return Body(
        x=EGO.x - across,
        y=EGO.y + along,
        heading=EGO.heading + heading,
        speed=speed,
        length=4.0,
        width=2.0,
    )


def test_apart_is_no_contact():
    assert contact(seen(EGO, other(4.6, 0.0), other(0.0, 2.1))) is None
    # tilted by 45 degrees, its corner's neighbourhood: only the box's own axis says so
    assert contact(seen(EGO, other(4.2, 2.4, heading=0.25 * math.pi))) is None


@pytest.mark.parametrize(
    ("body", "fault"),
    [
        (other(4.4, 0.0), True),  # runs into who is ahead
        (other(-4.4, 0.0, speed=15.0), False),  # is run into
        (other(0.0, 1.9, speed=10.0), False),  # side by side
        (other(2.0, 1.5, heading=-0.5 * math.pi), True),  # crosses before the front
        (other(-2.4, 2.5, heading=-0.5 * math.pi), False),  # drives into its side
        (other(0.0, 1.9, speed=0.0), True),  # scrapes one that stands
    ],
)
def test_whose_fault_a_contact_is(body, fault):
    assert contact(seen(EGO, body)).at_fault is fault
    standing = dataclasses.replace(EGO, speed=0.0)
    assert not contact(seen(standing, body)).at_fault


def test_relative_speed_and_the_worst_of_two():
    found = contact(seen(EGO, other(-4.4, 0.0, speed=15.0), other(4.4, 0.0)))
    assert found.at_fault
    assert found.relative_speed == pytest.approx(5.0)
    across = contact(seen(EGO, other(2.0, 1.5, heading=-0.5 * math.pi)))
    assert across.relative_speed == pytest.approx(math.hypot(10.0, 5.0))


def drive(v, *bodies, passed_red=()):
    """The log of a drive with speeds v [S] m/s that ends beside some bodies."""
    samples, way, begin = [], 0.0, v[0]
    for n, speed in enumerate(v):
        way += speed * 0.1
        ego = dataclasses.replace(EGO, speed=float(speed))
        after = dataclasses.replace(
            seen(ego, *(bodies if n == len(v) - 1 else ())),
            way=way,
            passed_red=int(n in passed_red),
        )
        before = seen(dataclasses.replace(EGO, speed=float(begin)))
        samples.append(sample(before, after, math.inf, 0.0, math.inf, False))
        begin = speed
    return log_of(samples)


def test_a_drive_made_by_hand():
    slow = np.full(30, 10.0)
    hard = np.concatenate([slow, 10.0 - 0.5 * np.arange(1, 11), np.full(20, 5.0)])
    found = measure([drive(slow, passed_red=[3]), drive(hard)])
    assert found.mean_speed == pytest.approx([10.0, hard.mean()], abs=1e-4)
    assert found.progress == pytest.approx([30.0, hard.sum() * 0.1], abs=1e-3)
    np.testing.assert_array_equal(found.red_lights, [1, 0])
    np.testing.assert_array_equal(found.at_fault, [0, 0])
    assert found.min_a == pytest.approx([0.0, -5.0], abs=1e-4)
    # columns: no fault, limit, |a| < 4, across, |jerk| < 6, across
    np.testing.assert_array_equal(found.holds[0], [1, 1, 1, 1, 1, 1])
    np.testing.assert_array_equal(found.holds[1], [1, 1, 0, 1, 0, 1])


def test_a_crash_ends_the_record_and_is_counted_by_its_fault():
    ahead, behind = other(4.4, 0.0), other(-4.4, 0.0, speed=15.0)
    found = measure([drive([10.0] * 30, ahead), drive([9.0] * 7, behind)])
    np.testing.assert_array_equal(found.collisions, [1, 1])
    np.testing.assert_array_equal(found.at_fault, [1, 0])
    np.testing.assert_array_equal(found.samples, [30, 7])
    assert found.impact_speed == pytest.approx([5.0, 6.0])
