"""Slots go to whom the human has to deal with, in logs and in the planner alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.data.scenes.motion import GRID_M
from rcirl_jax.geometry.relevance import relevance_distance
from rcirl_jax.planner.prediction import NUM_BODIES, Bodies, most_relevant
from rcirl_jax.types import Kind
from rcirl_jax.units import NUM_OBSTACLES, TIMES_S
from tests.helpers.roads import WIDTH, car, first_scene, recording
from tests.helpers.scenes import scene

HALF = 1.8  # m, both half widths
STRAIGHT = np.zeros(GRID_M.size)


def distance(s, l, path=STRAIGHT, seen=True):
    s, l = (np.broadcast_to(x, TIMES_S.shape)[None] for x in (s, l))
    seen = np.broadcast_to(seen, s.shape)
    return float(relevance_distance(s, l, seen, np.array([HALF]), 10.0, path)[0])


def test_distances():
    """The human drives 10 m/s; d = along + 16 m for each metre beside the path."""
    along = 10.0 * TIMES_S
    assert distance(30.0 + along, 0.0) == pytest.approx(30.0)
    assert distance(30.0 + along, 3.6) == pytest.approx(30.0 + 16 * 1.8)
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


def test_both_doors_choose_the_same_of_a_crowd():
    """Of twenty bodies that keep their speed, logs and planner put eight first."""
    rng = np.random.default_rng(5)
    ego, crowd = (60.0, 0.0, 12.0), []
    while len(crowd) < NUM_OBSTACLES + 4:
        side = rng.choice([-7.2, -WIDTH, 0.0, WIDTH, 7.2])
        speed = 12.5 if side == 0.0 else rng.uniform(6.0, 18.0)
        place = (rng.uniform(20.0, 200.0), side, speed)
        if all(abs(place[0] - s) > 7.0 or side != l for s, l, _ in [ego, *crowd]):
            crowd.append(place)
    cars = [
        car(f"c{i}" if i else "ego", lambda t, s=s, v=v: s + v * t, y=l)
        for i, (s, l, v) in enumerate([ego, *crowd])
    ]
    row = first_scene(recording(*cars))
    # the first scene begins half a second after the recording
    s, l, v = np.array([ego, *crowd]).T
    s = s + 0.5 * v
    one = jnp.ones(len(crowd))
    bodies = Bodies(
        s=jnp.asarray(s[1:] - s[0]), l=jnp.asarray(l[1:]), speed=jnp.asarray(v[1:]),
        l_dot=0 * one, a=0 * one, half_s=2.25 * one, half_l=0.9 * one,
        kind=jnp.full(len(crowd), Kind.VEHICLE), present=one > 0,
    )  # fmt: skip
    made = scene(v=v[0])
    human = made.ego.replace(length=jnp.asarray(4.5), width=jnp.asarray(1.8))
    chosen = jax.jit(most_relevant)(bodies, human, made.path) + 1
    assert row["obstacles.track"][:NUM_BODIES].tolist() == chosen.tolist()
