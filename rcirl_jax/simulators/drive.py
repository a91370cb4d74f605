"""Episodes of a simulator, driven by a row or by one of its own drivers.

The only loop over time of this room: look, plan for all episodes at once, step.
"""

import dataclasses
import zlib
from collections.abc import Sequence

import numpy as np

from rcirl_jax.simulation.rows import Row
from rcirl_jax.simulators.drivers import Driver, Free, Seen
from rcirl_jax.simulators.measures import Drive, Sample, contact
from rcirl_jax.simulators.simulators import STEP_S, Simulator, View


@dataclasses.dataclass(frozen=True, kw_only=True)
class Entrant:
    """Who drives: a row of ours, or a simulator's own driver (`row` None)."""

    name: str
    row: Row | None = None


def entrants(simulator: Simulator, rows: Sequence[Row]) -> list[Entrant]:
    """Our rows, then the simulator's own drivers."""
    ours = [Entrant(name=row.name, row=row) for row in rows]
    return ours + [Entrant(name=name) for name in simulator.own_drivers]


def groups(simulator: Simulator, episodes: Sequence[str]) -> list[Sequence[str]]:
    """Episodes as they run in lock step; who drives them depends on nothing else."""
    size = simulator.together
    return [episodes[n : n + size] for n in range(0, len(episodes), size)]


def drive(
    simulator: Simulator, entrant: Entrant, episodes: Sequence[str], seconds: float
) -> list[Drive]:
    """One of `groups`, driven by somebody.

    Args:
      simulator: where.
      entrant: who.
      episodes: names from `simulator.episodes`.
      seconds: that an episode lasts; a collision ends it earlier.
    """
    row, steps = entrant.row, round(seconds / STEP_S)
    running = simulator.start(episodes, entrant.name if row is None else None)
    # batches have one size, so that each row is compiled once
    lanes = simulator.together
    seen, logs = Seen(lanes), [[] for _ in episodes]
    seeds = [zlib.crc32(name.encode()) for name in episodes]
    driver = row and Driver(row, seeds + [0] * (lanes - len(seeds)))
    crashed = np.zeros(len(episodes), bool)
    try:
        for _ in range(steps):
            views = _without(running.look(), crashed)
            if not any(views):
                break
            scenes, free = seen.scenes(views + [None] * (lanes - len(views)))
            moves, fallback = [None] * len(views), np.zeros(lanes, bool)
            if driver:
                made, fallback = driver.moves(scenes)
                moves = [view and move for view, move in zip(views, made, strict=False)]
            running.step(moves)
            after = running.look()
            crashed |= _log(logs, views, after, free, fallback)
    finally:
        running.close()
    return [Drive.of(name, log) for name, log in zip(episodes, logs, strict=True)]


def _without(views: Sequence[View | None], crashed: np.ndarray) -> list[View | None]:
    """Views of those that have not crashed."""
    return [None if out else view for view, out in zip(views, crashed, strict=True)]


def _log(
    logs: list[list[Sample]],
    views: Sequence[View | None],
    after: Sequence[View | None],
    free: Free,
    fallback: np.ndarray,
) -> np.ndarray:
    """Append a sample to the log of each that drives; who crashed now [B]."""
    crashed = np.zeros(len(views), bool)
    for n, (view, later) in enumerate(zip(views, after, strict=True)):
        if view is None or later is None:
            continue
        hit = contact(later)
        crashed[n] = hit is not None
        logs[n].append(
            Sample(
                view=view,
                way=later.way,
                speed=later.ego.speed,
                passed_red=later.passed_red,
                hit=hit,
                gap=float(free.body[n]),
                gap_speed=float(free.speed[n]),
                line=float(free.line[n]),
                fallback=bool(fallback[n]),
            )
        )
    return crashed
