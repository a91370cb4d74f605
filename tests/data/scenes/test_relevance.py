"""Slots go to whom the human has to deal with, not to the nearest."""

import numpy as np
import pytest

from rcirl_jax.data.scenes.motion import GRID_M
from rcirl_jax.data.scenes.relevance import distances
from rcirl_jax.types import Kind
from rcirl_jax.units import NUM_OBSTACLES, TIMES_S
from tests.helpers.roads import WIDTH, car, first_scene, recording

HALF = 1.8  # m, both half widths
STRAIGHT = np.zeros(GRID_M.size)


def distance(s, l, path=STRAIGHT, seen=True):
    s, l = (np.broadcast_to(x, TIMES_S.shape)[None] for x in (s, l))
    seen = np.broadcast_to(seen, s.shape)
    return float(distances(s, l, seen, np.array([HALF]), 10.0, path)[0])


def test_distances():
    """The human drives 10 m/s; d = along + 4 m for each metre beside the path."""
    along = 10.0 * TIMES_S
    assert distance(30.0 + along, 0.0) == pytest.approx(30.0)
    assert distance(30.0 + along, 3.6) == pytest.approx(30.0 + 4 * 1.8)
    assert distance(-15.0 + along, 0.0) == pytest.approx(30.0)  # behind counts twice
    assert distance(60.0 + 2.0 * TIMES_S, 0.0) == pytest.approx(0.0, abs=4.0)  # closing
    assert distance(30.0 + 15.0 * TIMES_S, 0.0) == pytest.approx(30.0)  # drives off
    assert distance(30.0 + along, 3.6, seen=False) == np.inf
    # who is in the lane that the human changes into
    path = np.where(GRID_M > 20.0, 3.6, 0.0)
    assert distance(30.0 + along, 3.6, path) == pytest.approx(30.0)


def test_the_lead_keeps_its_slot_in_a_crowd():
    """Twenty bodies beside the road, nearer than the lead, which closes in."""
    crowd = [
        car(f"c{i}", lambda t, i=i: 22.0 + 4.0 * i, y=9.0, kind=Kind.PEDESTRIAN)
        for i in range(NUM_OBSTACLES + 4)
    ]
    lead = car("lead", lambda t: 88.0 + 5.0 * t)
    row = first_scene(recording(car("ego", lambda t: 20.0 + 12.0 * t), *crowd, lead))
    assert row["obstacles.track"][0] == len(crowd) + 1
    assert (row["obstacles.kind"] != Kind.NONE).all()


def test_beside_is_after_ahead_and_before_behind():
    ego = car("ego", lambda t: 60.0 + 12.0 * t)
    others = [
        car("behind", lambda t: 40.0 + 12.0 * t),
        car("beside", lambda t: 85.0 + 12.0 * t, y=WIDTH),
        car("ahead", lambda t: 90.0 + 12.0 * t),
    ]
    row = first_scene(recording(ego, *others))
    assert row["obstacles.track"][:3].tolist() == [3, 2, 1]
