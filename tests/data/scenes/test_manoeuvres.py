"""Labels say what happened: cars on a straight road whose truth is in their motion."""

import dataclasses

import numpy as np
import pytest

from rcirl_jax.types import Decision, Kind, Tag
from tests.helpers.roads import (
    WIDTH,
    car,
    first_scene,
    lane,
    recording,
    smooth_step,
    speeding_up,
    steady,
)

D = Decision


def entering(t):
    """From the left lane into the middle one between 2 and 5 s."""
    return WIDTH * (1.0 - smooth_step(t, 2, 3))


def leaving(t):
    return WIDTH - entering(t)


def swerving(metres, back=True):
    """Aside to the left by 3 s, and back after 5 s."""
    return lambda t: metres * (smooth_step(t, 1, 2) - back * smooth_step(t, 5, 2))


def slowing(start, after, by, v=12.0):
    """Gives up `by` m/s in 2 s."""

    def s(t):
        brakes, later = np.clip(t - after, 0.0, 2.0), np.maximum(t - after - 2.0, 0.0)
        return start + v * t - by * (0.25 * brakes**2 + later)

    return s


def parked(side, at=70.0):
    return car("other", lambda t: at, y=side, kind=Kind.STATIC)


def walker(v):
    """A pedestrian that crosses from the right at 40 m."""
    made = car("other", lambda t: 40.0, y=lambda t: -8.0 + v * t, kind=Kind.PEDESTRIAN)
    return dataclasses.replace(made, length=0.6, width=0.6)


EGO = car("ego", steady(20.0))
OUT = car("ego", steady(20.0), y=lambda t: WIDTH * smooth_step(t, 1, 3))
# ego, the other, what happened, tags
SITUATIONS = {
    "a lead": (EGO, car("other", steady(50.0)), D.FOLLOW, {Tag.FOLLOWING}),
    "a lead that turns into the next lane after 2 s": (
        *(EGO, car("other", steady(50.0), y=leaving)),
        *(D.FOLLOW, {Tag.FOLLOWING}),
    ),
    "behind all the time": (EGO, car("other", steady(5.0)), D.IGNORE, set()),
    "comes into the lane behind": (
        *(EGO, car("other", steady(5.0), y=entering)),
        *(D.IGNORE, set()),
    ),
    "a cut-in without a reaction": (
        *(EGO, car("other", steady(40.0), y=entering)),
        *(D.FOLLOW, {Tag.CUT_IN, Tag.FOLLOWING}),
    ),
    "a cut-in, and the human brakes": (
        *(car("ego", slowing(20.0, 3.0, 2.0)), car("other", steady(38.0), y=entering)),
        *(D.YIELD, {Tag.CUT_IN, Tag.YIELDING}),
    ),
    "a cut-in far away": (
        *(EGO, car("other", steady(100.0), y=entering)),
        *(D.FOLLOW, {Tag.FOLLOWING}),
    ),
    "the human brakes for something else, later": (
        *(car("ego", slowing(20.0, 9.5, 2.0)), car("other", steady(38.0), y=entering)),
        *(D.FOLLOW, {Tag.CUT_IN, Tag.FOLLOWING}),
    ),
    "a pedestrian crosses, and the human brakes": (
        *(car("ego", slowing(0.0, 1.5, 7.0, v=9.0)), walker(1.5)),
        *(D.YIELD, {Tag.YIELDING}),
    ),
    "overtaken by a change of lane": (
        *(OUT, car("other", steady(45.0, v=8.0))),
        *(D.OVERTAKE, {Tag.OVERTAKING, Tag.LANE_CHANGE}),
    ),
    "a change of lane past who is still ahead at the end": (
        *(OUT, car("other", steady(45.0, v=10.0))),
        *(D.FOLLOW, {Tag.FOLLOWING, Tag.LANE_CHANGE}),
    ),
    "passed in the next lane": (
        *(EGO, car("other", steady(45.0, v=8.0), y=WIDTH)),
        *(D.IGNORE, set()),
    ),
    "passed in the next lane, then comes in behind": (
        *(EGO, car("other", steady(32.0, v=8.0), y=lambda t: entering(t - 3.3))),
        *(D.OVERTAKE, {Tag.OVERTAKING}),
    ),
    "met": (EGO, car("other", steady(150.0, v=-12.0), y=2.5), D.IGNORE, set()),
    "a parked car beside, passed straight on": (EGO, parked(-2.0), D.IGNORE, set()),
    "round a parked car": (
        *(car("ego", steady(20.0), y=swerving(0.8)), parked(-2.0)),
        *(D.NUDGE_LEFT, {Tag.NUDGING}),
    ),
    "round a parked car, to the right": (
        *(car("ego", steady(20.0), y=swerving(-0.8)), parked(2.0)),
        *(D.NUDGE_RIGHT, {Tag.NUDGING}),
    ),
    "aside, far from a parked car": (
        *(car("ego", steady(20.0), y=swerving(0.8)), parked(-4.0)),
        *(D.IGNORE, set()),
    ),
    "towards a parked car": (
        *(car("ego", steady(20.0), y=swerving(0.5)), parked(3.0)),
        *(D.IGNORE, set()),
    ),
}
SAID = {
    *(Tag.FOLLOWING, Tag.YIELDING, Tag.OVERTAKING, Tag.NUDGING),
    *(Tag.CUT_IN, Tag.LANE_CHANGE),
}


@pytest.mark.parametrize("name", SITUATIONS)
def test_what_happened(name):
    ego, other, decision, tags = SITUATIONS[name]
    row = first_scene(recording(ego, other))
    (slot,) = np.flatnonzero(row["obstacles.kind"])
    assert Decision(row["decisions"][slot]) == decision
    assert {tag for tag in SAID if row["tags"][tag]} == tags


def test_a_single_lane_has_no_change_of_lane():
    """Positions that wander by half a lane change none where there is no other."""
    x = np.arange(0.0, 501.0, 5.0)
    wander = car("ego", speeding_up(20.0), y=lambda t: 2.2 * smooth_step(t, 1, 5) - 1.0)
    lead = car("lead", speeding_up(60.0))
    back = car("ego", speeding_up(20.0), y=lambda t: 2.1 - 2.1 * smooth_step(t, 1, 5))
    for one in (wander, back):
        row = first_scene(recording(one, lead, lanes=(lane("only", x, 0.0),)))
        assert not row["tags"][Tag.LANE_CHANGE]
    assert first_scene(recording(wander, lead))["tags"][Tag.LANE_CHANGE]
