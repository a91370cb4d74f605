"""What all families share: the registry, and how drives are drawn.

A family is a function that draws one `Case` and states its truth. Others are
placed relative to the ego's own motion, so that the truth holds whatever the
numbers drawn. Plans that do not fit into eight seconds are drawn again.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from rcirl_jax.evaluation.labels.cases.scenes import (
    CLOCK,
    ROAD_M,
    START_M,
    Case,
    Mover,
    delayed,
    drive,
    speed,
)
from rcirl_jax.types import Decision

Rng = np.random.Generator
SEEN = (CLOCK >= 0.0) & (CLOCK <= 8.0)
STILL = np.zeros(CLOCK.size)  # m, no lateral motion
FAMILIES: dict[str, Callable[[Rng], Case]] = {}


class RedrawError(Exception):
    """The numbers drawn do not make the plan."""


def family(function: Callable[[Rng], Case]) -> Callable[[Rng], Case]:
    """Register under the function's name; redraws until the plan fits."""

    def drawn(rng: Rng) -> Case:
        for _ in range(1000):
            try:
                return dataclasses.replace(function(rng), family=function.__name__)
            except RedrawError:
                continue
        raise AssertionError(f"{function.__name__}: no plan in 1000 draws")

    FAMILIES[function.__name__] = drawn
    return function


def need(condition: bool | np.bool_ | np.ndarray) -> None:
    """Draw the plan again unless the condition (a scalar) holds."""
    if not condition:
        raise RedrawError


def side_of(rng: Rng) -> float:
    """+1: left, -1: right."""
    return float(rng.choice([-1.0, 1.0]))


def bend(rng: Rng) -> np.ndarray:
    """Curvature [1/m] of an ordinary road: radii above 500 m, or straight."""
    wave = 2.0 * np.pi * np.arange(ROAD_M + 1.0) / rng.uniform(200.0, 600.0)
    bent = rng.uniform(0.0, 0.002) * np.sin(wave + rng.uniform(0.0, 6.0))
    return bent * float(rng.random() < 0.5)


def lane_width(rng: Rng) -> float:
    """Width of a lane, m."""
    return float(rng.uniform(3.2, 3.8))


def unsteady(rng: Rng, v0: float, calm: float = 1.0) -> np.ndarray:
    """A drive with changing accelerations up to `calm` m/s^2."""
    starts = np.arange(0.0, 9.0, rng.uniform(1.5, 3.0))
    a = rng.uniform(-calm, calm, starts.size)
    return drive(START_M, v0, list(zip(starts, a, strict=True)))


def drift(rng: Rng) -> np.ndarray:
    """Wander inside the lane, m."""
    size, period = rng.uniform(0.0, 0.25), rng.uniform(6.0, 12.0)
    return size * np.sin(2.0 * np.pi * CLOCK / period + rng.uniform(0.0, 6.0))


def ego_of(rng: Rng, s: np.ndarray, l: np.ndarray | None = None) -> Mover:
    """The driver, of random size; wanders inside the lane unless `l` is given."""
    return Mover(
        id="ego",
        s=s,
        l=drift(rng) if l is None else l,
        length=float(rng.uniform(4.2, 5.0)),
        width=float(rng.uniform(1.7, 1.95)),
    )


def finish(
    rng: Rng,
    ego: Mover,
    others: list[tuple[Mover, Decision | None]],
    crowd: str = "follower left right",
    **more: object,
) -> Case:
    """The case with, at random, road users who are to be ignored.

    Args:
      rng: consumed.
      ego: the driver.
      others: with the truth of each; None is not scored.
      crowd: who may be added: a follower, cars that keep pace on a side.
      **more: fields of `Case`.
    """
    width = more.setdefault("lane_m", lane_width(rng))
    more.setdefault("kappa", bend(rng))
    others = list(others)
    for name in crowd.split():
        if rng.random() < 0.5:
            continue
        if name == "follower":
            s = delayed(ego.s, rng.uniform(1.0, 2.0), rng.uniform(7.0, 12.0))
            l = STILL
        else:
            s = ego.s + rng.uniform(-30.0, 30.0)
            l = STILL + (float(width) if name == "left" else -float(width))  # pyright: ignore[reportArgumentType]
        others.append((Mover(id=name, s=s, l=l), Decision.IGNORE))
    return Case(
        family="",
        ego=ego,
        others=tuple(mover for mover, _ in others),
        truth={m.id: truth for m, truth in others if truth is not None},
        **more,  # pyright: ignore[reportArgumentType]
    )


def enters_at(mover: Mover, ego: Mover) -> float:
    """s, when the other's side first reaches the ego's swept width."""
    apart = np.abs(mover.l - ego.l) - 0.5 * (mover.width + ego.width)
    inside = np.flatnonzero((apart < 0.0) & (CLOCK >= 0.0))
    need(inside.size > 0)
    return float(CLOCK[inside[0]])


def bumper_gap(ahead: Mover, behind: Mover) -> np.ndarray:
    """[n] m, bumper to bumper."""
    return ahead.s - behind.s - 0.5 * (ahead.length + behind.length)


def braking(rng: Rng) -> np.ndarray:
    """A drive [n] m that ends at a stand within the eight seconds."""
    v0, b = rng.uniform(6.0, 14.0), rng.uniform(1.2, 2.8)
    start = rng.uniform(0.0, 1.5)
    need(start + v0 / b < 7.3)
    return drive(START_M, v0, [(start, -b)])


def draw(name: str, rng: Rng) -> Case:
    """One case of a family."""
    case = FAMILIES[name](rng)
    assert np.all(np.diff(case.ego.s) >= -1e-9), name
    assert speed(case.ego.s).max() < 40.0, name
    return case
