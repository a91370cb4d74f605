"""Families: stop lines and destinations; tags of the motion alone."""

import numpy as np

from rcirl_jax.evaluation.labels.cases.plans import (
    STILL,
    Rng,
    braking,
    ego_of,
    family,
    finish,
    lane_width,
    need,
    side_of,
    unsteady,
)
from rcirl_jax.evaluation.labels.cases.scenes import (
    HISTORY_S,
    LENGTH_M,
    ROAD_M,
    START_M,
    Case,
    Mover,
    at,
    drive,
    shift,
)
from rcirl_jax.types import Decision, Signal, Tag

# --------------------------------------------------------------------- lines


def _light(*phases: tuple[float, str]) -> Signal:
    """A signal from (time s, colour); the first colour holds from the start."""
    starts = [0.0] + [time + HISTORY_S for time, _ in phases[1:]]
    return Signal(
        id="light", start=np.array(starts), state=tuple(name for _, name in phases)
    )


def _before_line(rng: Rng, ego: Mover) -> float:
    """m, station of a line ahead of where the ego ends."""
    return float(ego.s[-1]) + 0.5 * ego.length + rng.uniform(0.5, 4.0)


@family
def red_light(rng: Rng) -> Case:
    """First at a red light: the ego brakes to a stand at the line, or stands."""
    s = drive(START_M, 0.0) if rng.random() < 0.25 else braking(rng)
    ego = ego_of(rng, s, STILL)
    return finish(
        rng, ego, [],
        "follower", line_m=_before_line(rng, ego), light=_light((0.0, "red")),
        line_truth=Decision.STOP, tags={Tag.RED_LIGHT: True},
    )  # fmt: skip


@family
def start_at_green(rng: Rng) -> Case:
    """The light turns green for a standing ego, who starts."""
    turns = rng.uniform(0.3, 3.0)
    go = turns + rng.uniform(0.5, 1.5)
    s = drive(START_M, 0.0, [(go, rng.uniform(1.2, 2.2)), (go + 5.0, 0.0)])
    ego = ego_of(rng, s, STILL)
    line = START_M + 0.5 * ego.length + rng.uniform(0.5, 4.0)
    return finish(
        rng, ego, [],
        "follower", line_m=line, light=_light((0.0, "red"), (turns, "green")),
        line_truth=Decision.STOP, tags={Tag.RED_LIGHT: True},
    )  # fmt: skip


@family
def rolls_to_green(rng: Rng) -> Case:
    """Near miss of stop: slows for red, which turns green before a stand."""
    v0, b = rng.uniform(9.0, 14.0), rng.uniform(1.0, 2.0)
    lasts = rng.uniform(1.5, 3.5)
    need(v0 - b * lasts > 3.0)
    s = drive(START_M, v0, [(0.3, -b), (0.3 + lasts, 1.2), (5.5, 0.0)])
    ego = ego_of(rng, s)
    turns = 0.3 + lasts - rng.uniform(0.2, 0.8)
    line = at(s, 0.3 + lasts) + 0.5 * ego.length + rng.uniform(4.0, 15.0)
    return finish(
        rng, ego, [],
        "follower", line_m=line, light=_light((0.0, "red"), (turns, "green")),
        line_truth=Decision.IGNORE, tags={Tag.RED_LIGHT: True},
    )  # fmt: skip


@family
def green_light(rng: Rng) -> Case:
    """Near miss of red light: green while the ego crosses, red afterwards."""
    ego = ego_of(rng, unsteady(rng, rng.uniform(6.0, 15.0), 0.8))
    crosses = rng.uniform(1.5, 5.0)
    line = at(ego.s, crosses) + 0.5 * ego.length
    light = _light((0.0, "green"), (crosses + rng.uniform(0.5, 2.0), "red"))
    return finish(
        rng, ego, [],
        "follower", line_m=line, light=light, line_truth=Decision.IGNORE
    )  # fmt: skip


@family
def waits_at_green(rng: Rng) -> Case:
    """Near miss of stop: stands far before the line, which is not why."""
    s = braking(rng)
    ego = ego_of(rng, s, STILL)
    stand = s[-1] + 0.5 * (ego.length + LENGTH_M) + rng.uniform(1.5, 3.0)
    lead = Mover(id="lead", s=STILL + stand, l=STILL)
    line = stand + 0.5 * LENGTH_M + rng.uniform(8.0, 20.0)
    return finish(
        rng, ego, [(lead, Decision.FOLLOW)], "follower", line_m=line,
        light=_light((0.0, "green"), (5.0, "red")), line_truth=Decision.IGNORE,
    )  # fmt: skip


@family
def stop_sign(rng: Rng) -> Case:
    """The ego stands at the line for a moment, then goes; there is no light."""
    v0, b = rng.uniform(5.0, 10.0), rng.uniform(1.5, 2.8)
    start, waits = rng.uniform(0.0, 1.0), rng.uniform(1.2, 2.5)
    ends = start + v0 / b
    need(ends + waits < 7.6)
    pieces = [(start, -b), (ends + waits, rng.uniform(1.0, 2.0))]
    s = drive(START_M, v0, pieces)
    ego = ego_of(rng, s, STILL)
    line = at(s, ends + 0.5) + 0.5 * ego.length + rng.uniform(0.5, 3.0)
    return finish(rng, ego, [], "", line_m=line, line_truth=Decision.STOP)


@family
def destination(rng: Rng) -> Case:
    """The ego ends its drive at its destination."""
    s = braking(rng)
    goal = float(s[-1]) + rng.uniform(-0.3, 0.5)
    ego = ego_of(rng, s, STILL)
    return finish(rng, ego, [], destination_m=goal, line_truth=Decision.STOP)


# ---------------------------------------------------------------------- tags


@family
def lane_change(rng: Rng) -> Case:
    """A lane change without others on that side."""
    width, side = lane_width(rng), side_of(rng)
    moved = shift(rng.uniform(0.0, 2.5), rng.uniform(3.0, 5.0), side * width)
    ego = ego_of(rng, unsteady(rng, rng.uniform(7.0, 20.0), 0.5), moved)
    lane = STILL - side * width
    other = Mover(id="pace", s=ego.s + rng.uniform(-30.0, 30.0), l=lane)
    others: list[tuple[Mover, Decision | None]] = [(other, Decision.IGNORE)]
    return finish(rng, ego, others, "", lane_m=width)


@family
def changes_behind(rng: Rng) -> Case:
    """Near miss of cut-in: the ego changes lane, behind a car that stays in its."""
    width, side = lane_width(rng), side_of(rng)
    v = rng.uniform(8.0, 18.0)
    moved = shift(rng.uniform(0.3, 2.5), rng.uniform(2.5, 4.0), side * width)
    ego = ego_of(rng, unsteady(rng, v, 0.4), moved)
    car = Mover(id="new lead", s=ego.s + rng.uniform(9.0, 30.0), l=STILL + side * width)
    return finish(rng, ego, [(car, None)], "", lane_m=width)


@family
def wanders(rng: Rng) -> Case:
    """Near miss of lane change: a third of a lane aside and back."""
    aside = side_of(rng) * rng.uniform(0.4, 1.0)
    moved = shift(rng.uniform(0.0, 2.0), 2.5, aside) - shift(5.0, 2.5, aside)
    ego = ego_of(rng, unsteady(rng, rng.uniform(7.0, 18.0), 0.5), moved)
    return finish(rng, ego, [], "follower")


@family
def cruise(rng: Rng) -> Case:
    """Even speed; others keep pace."""
    s = drive(START_M, rng.uniform(7.0, 22.0), [(0.0, rng.uniform(-0.08, 0.08))])
    return finish(rng, ego_of(rng, s), [])


def _turned(rng: Rng, degrees: float, *, s_shaped: bool = False) -> Case:
    """A road that turns by so much, driven through within eight seconds."""
    radius, sign = rng.uniform(14.0, 35.0), side_of(rng)
    arc = radius * np.deg2rad(degrees) * (2.0 if s_shaped else 1.0)
    v = rng.uniform(0.75, 1.0) * np.sqrt(2.0 * radius)
    begin = rng.uniform(0.5, 1.5) * v
    need(begin + arc < 7.0 * v)
    grid = np.arange(ROAD_M + 1.0) - START_M - begin
    kappa = np.where((grid >= 0.0) & (grid < arc), sign / radius, 0.0)
    if s_shaped:
        kappa = np.where(grid >= 0.5 * arc, -kappa, kappa)
    s = drive(START_M, v, [(0.0, rng.uniform(-0.1, 0.15))])
    return finish(rng, ego_of(rng, s), [], "follower", kappa=kappa)


@family
def turn(rng: Rng) -> Case:
    """A turn by 45 to 100 degrees."""
    return _turned(rng, rng.uniform(45.0, 100.0))


@family
def slight_bend(rng: Rng) -> Case:
    """Near miss of turn: 8 to 20 degrees."""
    return _turned(rng, rng.uniform(8.0, 20.0))


@family
def s_bend(rng: Rng) -> Case:
    """Near miss of turn: to one side and back."""
    return _turned(rng, rng.uniform(15.0, 40.0), s_shaped=True)
