"""Families: who is passed beside, and who is to be ignored."""

import dataclasses

import numpy as np

from rcirl_jax.evaluation.labels.cases.plans import (
    STILL,
    Rng,
    drift,
    ego_of,
    family,
    finish,
    lane_width,
    side_of,
    unsteady,
)
from rcirl_jax.evaluation.labels.cases.scenes import (
    CLOCK,
    START_M,
    WIDTH_M,
    Case,
    Mover,
    at,
    drive,
    shift,
)
from rcirl_jax.types import Decision, Kind

# --------------------------------------------------------------------- nudge


def nudge(side: float) -> Decision:
    """Of an obstacle on a side: the ego passes on the other one."""
    return Decision.NUDGE_RIGHT if side > 0.0 else Decision.NUDGE_LEFT


@family
def slower_beside(rng: Rng) -> Case:
    """A slower car on the next lane is passed."""
    width, side = float(rng.uniform(3.2, 3.8)), side_of(rng)
    v, slower = rng.uniform(8.0, 20.0), rng.uniform(3.2, 7.5)
    ego = ego_of(rng, unsteady(rng, v, 0.3))
    other = Mover(id="beside", s=drive(0.0, v - slower), l=drift(rng) + side * width)
    abreast = rng.uniform(1.0, 6.5)
    move = at(ego.s, abreast) - at(other.s, abreast)
    other = dataclasses.replace(other, s=other.s + move)
    crowd = "follower " + ("right" if side > 0.0 else "left")
    return finish(rng, ego, [(other, nudge(side))], crowd, lane_m=width)


def _parked(rng: Rng, low: float, high: float, aside: float) -> Case:
    """A parked car that the ego passes with a gap from low to high m."""
    side, v = side_of(rng), rng.uniform(5.0, 20.0)
    s = unsteady(rng, v, 0.6)
    when = rng.uniform(1.5, 6.0)
    swerve = shift(when - 3.0, 2.5, -side * aside) + shift(
        when + 0.8, 2.5, side * aside
    )
    ego = ego_of(rng, s, swerve)
    kind = Kind.STATIC if rng.random() < 0.5 else Kind.VEHICLE
    gap = rng.uniform(low, high) + 0.5 * (ego.width + WIDTH_M)
    parked = Mover(
        id="parked",
        s=STILL + at(s, when),
        l=STILL + at(swerve, when) + side * gap,
        kind=kind,
    )
    return finish(rng, ego, [(parked, nudge(side))], "follower")


@family
def parked_beside(rng: Rng) -> Case:
    """A parked car is passed, with or without a swerve."""
    return _parked(rng, 0.4, 2.2, rng.choice([0.0, 0.5, 1.0]))


@family
def parked_tight(rng: Rng) -> Case:
    """A parked car is passed within the lateral buffer of 0.2 m."""
    return _parked(rng, 0.06, 0.17, rng.choice([0.5, 1.0]))


@family
def stalled_lead(rng: Rng) -> Case:
    """A car stands in the ego's lane; the ego drives around it."""
    width, side = lane_width(rng), side_of(rng)
    v = rng.uniform(5.0, 12.0)
    begin, lasts = rng.uniform(0.3, 1.5), rng.uniform(2.5, 3.5)
    moved = shift(begin, lasts, side * rng.uniform(0.85, 1.0) * width)
    ego = ego_of(rng, drive(START_M, v), moved)
    when = begin + lasts + rng.uniform(0.3, 1.5)
    stalled = Mover(id="stalled", s=STILL + at(ego.s, when), l=STILL)
    others: list[tuple[Mover, Decision | None]] = [(stalled, nudge(-side))]
    return finish(rng, ego, others, "", lane_m=width)


@family
def cyclist_nudged(rng: Rng) -> Case:
    """A slower cyclist at the lane's edge; the ego swerves inside its lane."""
    v, slower = rng.uniform(8.0, 14.0), rng.uniform(3.5, 7.0)
    when, side = rng.uniform(2.0, 5.0), side_of(rng)
    aside = rng.uniform(0.7, 1.2)
    swerve = shift(when - 2.8, 2.0, -side * aside) + shift(
        when + 2.2, 2.5, side * aside
    )
    ego = ego_of(rng, drive(START_M, v, [(0.0, 0.1)]), swerve)
    gap = 0.5 * (ego.width + 0.6) + rng.uniform(0.5, 1.2)
    s = drive(0.0, v - slower)
    cyclist = Mover(
        id="cyclist",
        s=s + at(ego.s, when) - at(s, when),
        l=STILL + at(swerve, when) + side * gap,
        kind=Kind.CYCLIST,
        length=1.8,
        width=0.6,
    )
    return finish(rng, ego, [(cyclist, nudge(side))], "follower", lane_m=3.6)


# -------------------------------------------------------------------- ignore


@family
def pace_beside(rng: Rng) -> Case:
    """Near miss of nudge: abreast at the same speed, or up to 1 m/s slower."""
    width, side = lane_width(rng), side_of(rng)
    s = unsteady(rng, rng.uniform(7.0, 18.0), 0.5)
    slower = rng.uniform(-0.8, 0.8) * CLOCK
    other = Mover(
        id="beside", s=s - slower + rng.uniform(-3.0, 3.0), l=STILL + side * width
    )
    others: list[tuple[Mover, Decision | None]] = [(other, Decision.IGNORE)]
    return finish(rng, ego_of(rng, s), others, "follower", lane_m=width)


@family
def passed_by(rng: Rng) -> Case:
    """A faster car on the next lane passes the ego; the ego may stand."""
    width, side = lane_width(rng), side_of(rng)
    v = float(rng.choice([0.0, rng.uniform(6.0, 16.0)]))
    ego = ego_of(rng, drive(START_M, v), None if v > 0.0 else STILL)
    when, faster = rng.uniform(1.0, 7.0), rng.uniform(3.0, 9.0)
    other = Mover(
        id="beside", s=ego.s + faster * (CLOCK - when), l=STILL + side * width
    )
    others: list[tuple[Mover, Decision | None]] = [(other, Decision.IGNORE)]
    return finish(rng, ego, others, "follower", lane_m=width)


@family
def two_lanes_over(rng: Rng) -> Case:
    """Near miss of nudge: slower, but more than 3 m beside; may change lane."""
    width, side = float(rng.uniform(3.3, 3.8)), side_of(rng)
    v, slower = rng.uniform(8.0, 20.0), rng.uniform(3.2, 7.0)
    ego = ego_of(rng, unsteady(rng, v, 0.3))
    other = Mover(id="far", s=drive(0.0, v - slower), l=STILL + side * 2.0 * width)
    when = rng.uniform(1.0, 7.0)
    other = dataclasses.replace(other, s=other.s + at(ego.s, when) - at(other.s, when))
    others: list[tuple[Mover, Decision | None]] = [(other, Decision.IGNORE)]
    return finish(rng, ego, others, "follower", lane_m=width)


@family
def far_merge(rng: Rng) -> Case:
    """Near miss of cut-in: from two lanes over into the next lane, not farther."""
    width, side = lane_width(rng), side_of(rng)
    v = rng.uniform(8.0, 18.0)
    ego = ego_of(rng, unsteady(rng, v, 0.3))
    moved = side * (2.0 * width - shift(rng.uniform(0.5, 3.0), 3.0, width))
    other = Mover(id="far", s=ego.s + rng.uniform(-20.0, 30.0), l=moved)
    others: list[tuple[Mover, Decision | None]] = [(other, Decision.IGNORE)]
    return finish(rng, ego, others, "follower", lane_m=width)


@family
def oncoming(rng: Rng) -> Case:
    """Near miss of nudge: oncoming cars on the next lane."""
    width = lane_width(rng)
    ego = ego_of(rng, unsteady(rng, rng.uniform(6.0, 14.0), 0.6))
    when = rng.uniform(1.0, 6.5)
    back = rng.uniform(6.0, 14.0) * (CLOCK - when)
    other = Mover(
        id="oncoming", s=at(ego.s, when) - back, l=STILL + width, rest=float(np.pi)
    )
    others: list[tuple[Mover, Decision | None]] = [(other, Decision.IGNORE)]
    return finish(rng, ego, others, "follower right", lane_m=width)
