"""Families: who is ahead, who crosses, who merges, who is overtaken."""

import dataclasses

import numpy as np

from rcirl_jax.evaluation.labels.cases.plans import (
    SEEN,
    STILL,
    Rng,
    bumper_gap,
    drift,
    ego_of,
    enters_at,
    family,
    finish,
    lane_width,
    need,
    side_of,
    unsteady,
)
from rcirl_jax.evaluation.labels.cases.scenes import (
    CLOCK,
    LENGTH_M,
    START_M,
    WIDTH_M,
    Case,
    Mover,
    at,
    delayed,
    drive,
    shift,
)
from rcirl_jax.types import Decision, Kind, Tag

# kind: length m, width m, speeds m/s of those who cross
CROSSERS = {
    Kind.VEHICLE: (LENGTH_M, WIDTH_M, 4.0, 18.0),
    Kind.CYCLIST: (1.8, 0.6, 3.0, 7.0),
    Kind.PEDESTRIAN: (0.6, 0.6, 1.0, 2.0),
}
# -------------------------------------------------------------------- follow


@family
def follow(rng: Rng) -> Case:
    """A lead with changing speed, followed as Newell's model does."""
    lead = unsteady(rng, rng.uniform(6.0, 20.0))
    s = delayed(lead, rng.uniform(0.8, 2.0), rng.uniform(7.0, 10.0))
    shift_m = START_M - at(s, 0.0)
    ahead = Mover(id="lead", s=lead + shift_m, l=drift(rng))
    return finish(rng, ego_of(rng, s + shift_m), [(ahead, Decision.FOLLOW)])


@family
def standing_queue(rng: Rng) -> Case:
    """A queue stands; the ego stands in it."""
    s = drive(START_M, 0.0)
    ahead = [
        (Mover(id=f"lead{i}", s=s + (i + 1) * rng.uniform(6.5, 8.0), l=STILL), truth)
        for i, truth in enumerate([Decision.FOLLOW, None][: rng.integers(1, 3)])
    ]
    return finish(rng, ego_of(rng, s, STILL + rng.uniform(-0.3, 0.3)), ahead)


@family
def join_queue(rng: Rng) -> Case:
    """The ego brakes to a stand behind a standing car."""
    v0, b = rng.uniform(6.0, 14.0), rng.uniform(1.2, 2.8)
    start = rng.uniform(0.2, 1.5)
    need(start + v0 / b < 7.3)
    s = drive(START_M, v0, [(start, -b)])
    ego = ego_of(rng, s)
    stand = s[-1] + 0.5 * (ego.length + LENGTH_M) + rng.uniform(1.5, 4.0)
    lead = Mover(id="lead", s=STILL + stand, l=STILL + rng.uniform(-0.3, 0.3))
    return finish(rng, ego, [(lead, Decision.FOLLOW)])


@family
def stop_and_go(rng: Rng) -> Case:
    """A queue dissolves: the lead starts, the ego a reaction later."""
    starts = rng.uniform(-0.5, 2.5)
    lead = drive(START_M, 0.0, [(starts, rng.uniform(1.0, 2.0)), (starts + 4.0, 0.0)])
    s = delayed(lead, rng.uniform(1.0, 1.8), rng.uniform(6.5, 8.5))
    shift_m = START_M - at(s, 0.0)
    ahead = Mover(id="lead", s=lead + shift_m, l=STILL)
    return finish(rng, ego_of(rng, s + shift_m), [(ahead, Decision.FOLLOW)])


@family
def lead_leaves_late(rng: Rng) -> Case:
    """Followed for four seconds or more, then the lead leaves the lane."""
    width, v0 = lane_width(rng), rng.uniform(8.0, 18.0)
    ego = ego_of(rng, unsteady(rng, v0, 0.4))
    way = side_of(rng) * width + shift(0.0, 1.0, 0.0)
    moved = shift(rng.uniform(3.5, 5.0), rng.uniform(2.5, 4.0), 1.0) * way
    lead = Mover(id="lead", s=ego.s + rng.uniform(16.0, 35.0), l=moved)
    others: list[tuple[Mover, Decision | None]] = [(lead, Decision.FOLLOW)]
    return finish(rng, ego, others, "follower", lane_m=width)


@family
def lead_leaves_soon(rng: Rng) -> Case:
    """Apollo: in the way from the start, but for less than 2 s: not followed."""
    width, v0 = lane_width(rng), rng.uniform(8.0, 18.0)
    ego = ego_of(rng, unsteady(rng, v0, 0.4), STILL)
    moved = shift(rng.uniform(-1.6, -1.3), 3.0, side_of(rng) * width)
    lead = Mover(id="lead", s=ego.s + rng.uniform(16.0, 35.0), l=moved)
    apart = np.abs(moved) - 0.5 * (lead.width + ego.width)
    need(at(apart, 0.0) < -0.1 and at(apart, 1.2) > 0.3)
    tags: dict[Tag, bool | None] = {Tag.YIELDING: None}
    others: list[tuple[Mover, Decision | None]] = [(lead, Decision.YIELD)]
    return finish(rng, ego, others, "follower", lane_m=width, tags=tags)


# ------------------------------------------------------------ yield, overtake


def _crosser(
    rng: Rng, ego: Mover, middle: float, stops_m: float | None = None
) -> tuple[Mover, float, float]:
    """Somebody who crosses the ego's path, and when: in, out [s].

    Args:
      rng: consumed.
      ego: the driver.
      middle: s, when the crosser is on the path.
      stops_m: m, lateral gap to the ego at which it comes to a stand instead.

    Returns:
      The crosser, at station 0 yet, and the times between which its box is
      inside the ego's swept width.
    """
    kind = Kind(int(rng.choice(list(CROSSERS), p=[0.6, 0.2, 0.2])))
    length, width, slow, fast = CROSSERS[kind]
    u, side = rng.uniform(slow, fast), side_of(rng)
    reach = 0.5 * (length + ego.width)
    way = u * (middle - CLOCK)
    if stops_m is not None:
        stand, b = reach + stops_m, rng.uniform(1.0, 3.0)
        way = drive(0.0, u, [(middle - u / b, -b)])
        way = stand + way[-1] - way
    slant = rng.uniform(-0.25, 0.25)
    mover = Mover(
        id="crosser",
        s=slant * way,
        l=side * way,
        kind=kind,
        length=length,
        width=width,
        rest=float(np.arctan2(-side, -slant)),
    )
    half = (reach + 0.5 * abs(slant) * (length + ego.width)) / u
    return mover, middle - half, middle + half


def _extent(mover: Mover) -> float:
    """m, half of a crosser's extent along the road."""
    return 0.5 * mover.width + 0.25 * mover.length


@family
def crossing_yield(rng: Rng) -> Case:
    """Somebody crosses ahead; the ego slows and passes behind, or waits."""
    v0, b = rng.uniform(6.0, 14.0), rng.uniform(1.0, 3.0)
    start, lasts = rng.uniform(0.0, 1.0), rng.uniform(1.5, 5.0)
    s = drive(START_M, v0, [(start, -b), (start + lasts, 1.2), (start + lasts + 4, 0)])
    ego = ego_of(rng, s)
    crosser, enters, leaves = _crosser(rng, ego, rng.uniform(2.0, 6.0))
    need(enters > 0.8 and leaves < 7.3)
    station = at(s, leaves) + 0.5 * ego.length + _extent(crosser)
    station += rng.uniform(1.0, 8.0)
    crosser = dataclasses.replace(crosser, s=crosser.s + station)
    return finish(rng, ego, [(crosser, Decision.YIELD)], "follower")


@family
def crossing_passed(rng: Rng) -> Case:
    """The ego drives through first; the crossing happens behind it."""
    ego = ego_of(rng, unsteady(rng, rng.uniform(7.0, 16.0), 0.8))
    crosser, enters, leaves = _crosser(rng, ego, rng.uniform(2.5, 6.8))
    need(enters > 1.8 and leaves < 7.6)
    station = at(ego.s, enters) - 0.5 * ego.length - _extent(crosser)
    station -= rng.uniform(1.0, 10.0)
    need(station > at(ego.s, 0.0) + 6.0)
    crosser = dataclasses.replace(crosser, s=crosser.s + station)
    return finish(rng, ego, [(crosser, Decision.OVERTAKE)], "")


@family
def crossing_waits(rng: Rng) -> Case:
    """Near miss: the crossing road user stops 4 m or more beside the path."""
    ego = ego_of(rng, unsteady(rng, rng.uniform(7.0, 16.0), 0.8))
    middle = rng.uniform(1.0, 4.0)
    crosser, _, _ = _crosser(rng, ego, middle, rng.uniform(4.0, 6.0))
    station = at(ego.s, middle + rng.uniform(0.0, 2.0))
    crosser = dataclasses.replace(crosser, s=crosser.s + station)
    return finish(rng, ego, [(crosser, Decision.IGNORE)], "follower")


@family
def left_turner(rng: Rng) -> Case:
    """Oncoming, and turns left across the ego's path before the ego is there."""
    width = lane_width(rng)
    v0, b = rng.uniform(6.0, 14.0), rng.uniform(1.0, 2.5)
    ego = ego_of(rng, drive(START_M, v0, [(0.2, -b), (4.0, 1.0), (7.0, 0.0)]))
    u, turns = rng.uniform(4.0, 7.0), rng.uniform(0.5, 2.5)
    # towards the ego first, then across to its right
    angle = np.pi + 0.5 * np.pi * np.clip((CLOCK - turns) / 1.8, 0.0, 1.0)
    s, l = (np.cumsum(u * wave) * 0.1 for wave in (np.cos(angle), np.sin(angle)))
    l = l - at(l, turns) + width
    inside = np.abs(l - ego.l) < 0.5 * (LENGTH_M + ego.width)
    times = np.flatnonzero(inside & (turns < CLOCK))
    need(times.size > 0 and CLOCK[times[-1]] < 7.3)
    leaves = float(CLOCK[times[-1]])
    rear = s[times].min() - 0.5 * LENGTH_M
    station = at(ego.s, leaves) + 0.5 * ego.length + rng.uniform(1.0, 8.0) - rear
    turner = Mover(id="turner", s=s + station, l=l, rest=float(np.pi))
    return finish(rng, ego, [(turner, Decision.YIELD)], "follower", lane_m=width)


@family
def cut_in(rng: Rng) -> Case:
    """A car from the next lane enters ahead; the ego adapts its speed."""
    width, side = lane_width(rng), side_of(rng)
    begin, lasts = rng.uniform(0.0, 3.0), rng.uniform(2.5, 4.5)
    v = rng.uniform(7.0, 18.0)
    faster, slows = rng.uniform(-1.0, 2.5), rng.uniform(2.0, 4.0)
    react = begin + rng.uniform(0.3, 1.0)
    pieces = [(react, -(faster + 0.5) / slows), (react + slows, 0.0)]
    ego = ego_of(rng, drive(START_M, v + faster, pieces))
    other = Mover(
        id="cutter",
        s=unsteady(rng, v, 0.3),
        l=side * width - shift(begin, lasts, 1.0) * side * width,
    )
    enters = enters_at(other, ego)
    need(enters > 0.8)
    gap = bumper_gap(other, ego)
    move = rng.uniform(4.0, 18.0) - gap[(enters <= CLOCK) & SEEN].min()
    other = dataclasses.replace(other, s=other.s + move)
    need(at(bumper_gap(other, ego), 0.0) > -6.0)
    crowd = "follower " + ("right" if side > 0.0 else "left")
    tags: dict[Tag, bool | None] = {Tag.CUT_IN: True}
    others: list[tuple[Mover, Decision | None]] = [(other, Decision.YIELD)]
    return finish(rng, ego, others, crowd, lane_m=width, tags=tags)


@family
def merge_passed(rng: Rng) -> Case:
    """A car from the next lane merges behind the ego, who went first."""
    width, side = lane_width(rng), side_of(rng)
    v = rng.uniform(7.0, 18.0)
    ego = ego_of(rng, unsteady(rng, v, 0.3))
    begin, lasts = rng.uniform(1.0, 4.0), rng.uniform(2.5, 4.0)
    slower = rng.uniform(1.0, 4.0)
    other = Mover(
        id="merger",
        s=drive(START_M, v - slower),
        l=side * width - shift(begin, lasts, side * width),
    )
    enters = enters_at(other, ego)
    need(1.0 < enters < 6.5)
    behind = bumper_gap(ego, other)
    move = behind[(enters <= CLOCK) & SEEN].min() - rng.uniform(2.0, 10.0)
    other = dataclasses.replace(other, s=other.s + move)
    return finish(rng, ego, [(other, Decision.OVERTAKE)], "", lane_m=width)


@family
def overtake_out(rng: Rng) -> Case:
    """A slower lead is overtaken by one lane change."""
    return _overtaking(rng, back=False)


@family
def overtake_out_and_back(rng: Rng) -> Case:
    """Out, past the slower lead, and back into its lane."""
    return _overtaking(rng, back=True)


def _overtaking(rng: Rng, *, back: bool) -> Case:
    width, side = lane_width(rng), side_of(rng)
    begin, lasts = rng.uniform(0.6, 2.0), rng.uniform(2.5, 4.0)
    slower = rng.uniform(7.0, 12.0) if back else rng.uniform(3.5, 9.0)
    v = rng.uniform(slower + 3.0, slower + 12.0)
    ego = ego_of(
        rng, drive(START_M, v, [(0.0, 0.3)]), shift(begin, lasts, side * width)
    )
    lead = Mover(id="lead", s=drive(0.0, v - slower), l=STILL + rng.uniform(-0.2, 0.2))
    apart = np.abs(lead.l - ego.l) - 0.5 * (lead.width + ego.width)
    clear = float(CLOCK[np.flatnonzero((apart > 0.3) & (begin < CLOCK))[0]])
    gap = at(bumper_gap(lead, ego), clear)
    lead = dataclasses.replace(lead, s=lead.s + rng.uniform(1.5, 8.0) - gap)
    ahead = np.flatnonzero(bumper_gap(ego, lead) > 1.0)
    need(ahead.size > 0 and CLOCK[ahead[0]] < 7.3)
    if back:
        out = float(CLOCK[ahead[0]]) + rng.uniform(0.0, 0.5)
        need(out < 4.8)
        ego = dataclasses.replace(ego, l=ego.l - shift(out, 3.0, side * width))
    tags: dict[Tag, bool | None] = {Tag.NUDGING: None}
    others: list[tuple[Mover, Decision | None]] = [(lead, Decision.OVERTAKE)]
    return finish(rng, ego, others, "", lane_m=width, tags=tags)
