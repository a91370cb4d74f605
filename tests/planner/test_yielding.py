"""The driver model: follows, stops at lines, gives way, goes when it may."""

import jax
import numpy as np
import pytest

from rcirl_jax.planner.baselines import (
    Idm,
    Yielding,
    acceleration,
    bodies_in_path,
    idm_acceleration,
)
from rcirl_jax.types import Kind
from rcirl_jax.units import TIMES_S
from tests.helpers.scenes import scene

DRIVER = Yielding()
ACCELERATE = jax.jit(lambda made: acceleration(made, DRIVER))


def crossing(arrives_s, lateral=5.0, station=40.0):
    """A car that crosses from the right, at l = 0 after `arrives_s`."""
    made = scene(v=10.0, speed_limit=12.0, boxes=[{"s": station, "width": 4.5}])
    o = made.obstacles
    shift = lateral * (TIMES_S - arrives_s)
    return made.replace(
        obstacles=o.replace(
            l_lower=o.l_lower.at[0].add(shift),
            l_upper=o.l_upper.at[0].add(shift),
            speed=o.speed.at[0].set(0.0),
        )
    )


def test_a_leader_is_followed_by_the_idm():
    made = scene(v=12.0, speed_limit=15.0, boxes=[{"s": 30.0, "speed": 8.0}])
    gap = 30.0 - 2.25 - 0.5 * float(made.ego.length)
    desired = DRIVER.limit_share * 15.0
    expected = idm_acceleration(12.0, gap, 4.0, desired, DRIVER.idm)
    assert ACCELERATE(made) == pytest.approx(float(expected), abs=1e-4)


def test_nobody_ahead_is_free_driving():
    free = ACCELERATE(scene(v=6.0, speed_limit=15.0))
    share = 6.0 / (DRIVER.limit_share * 15.0)
    assert free == pytest.approx(Idm().acceleration * (1.0 - share**4), rel=1e-3)
    beside = scene(v=6.0, speed_limit=15.0, boxes=[{"s": 15.0, "l": 3.6}])
    assert ACCELERATE(beside) == pytest.approx(float(free), rel=1e-3)


def test_gives_way_to_who_meets_it_and_to_nobody_else():
    free = float(ACCELERATE(scene(v=10.0, speed_limit=12.0)))
    assert ACCELERATE(crossing(3.0)) < -0.5
    # long through before the ego arrives
    assert ACCELERATE(crossing(-6.0)) == pytest.approx(free, abs=1e-3)


def test_goes_on_where_stopping_is_too_late():
    assert ACCELERATE(crossing(0.8, station=9.0)) > -1.0


def test_stops_for_a_line_that_demands_it():
    line = {"s": 25.0, "length": 0.2, "width": 4.0, "kind": Kind.STOP}
    assert ACCELERATE(scene(v=10.0, speed_limit=12.0, boxes=[line])) < -1.0


def test_bodies_in_path_counts_those_ahead_only():
    boxes = [{"s": 30.0, "speed": 5.0}, {"s": -15.0}, {"s": 30.0, "l": 3.6}]
    gap, speed = bodies_in_path(scene(v=10.0, boxes=boxes), DRIVER)
    gap = np.asarray(gap)
    assert np.isfinite(gap).sum() == 1
    assert speed[0] == 5.0
    assert gap[0] == pytest.approx(30.0 - 2.25 - 2.45, abs=1e-4)
