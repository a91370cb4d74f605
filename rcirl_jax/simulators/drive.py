"""Episodes of a simulator, driven by a row or by one of the simulator's own drivers.

A row of the closed-loop tables is a policy with its weights behind the same sampler and
safety filter, planning at 10 Hz with plans that are kept. The ego follows its plan as
the ego of the package's own simulator does, through a drive train with a lag; where
paths are planned, it is as far beside its centre line as the plan says. `drive` is the
loop: look, plan for all episodes at once, step.
"""

import dataclasses
import functools
import math
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.export.own_planner.builder import LineFrame, Parts, scene_of
from rcirl_jax.geometry.frenet import ReferenceLine, project_lanes
from rcirl_jax.planner.plan import (
    Plan,
    beside,
    command,
    later,
    no_plan,
    path_at,
    stations_from_now,
)
from rcirl_jax.planner.rank import Policy
from rcirl_jax.simulation.rows import Row
from rcirl_jax.simulation.world import Vehicle
from rcirl_jax.simulators.measures import EpisodeLog, log_of, sample
from rcirl_jax.simulators.simulators import STEP_S, Move, Simulator, View
from rcirl_jax.types import Kind, Scene
from rcirl_jax.units import STATION_STEP_M, TIMES_S

SLOTS = 32  # bodies of a view that are looked at, the nearest ones
MOST_LINES = 6  # signals likewise
GRID = 1280  # points of a line's grid: 2.56 km
CORRIDOR_MARGIN_M = 0.2  # m beside the ego's width within which a body is ahead of it


class Free(flax.struct.PyTreeNode, kw_only=True):
    """The free way ahead of the front bumper in the ego's corridor; inf: nothing."""

    body: jax.Array  # [] m, the rear of the nearest body
    speed: jax.Array  # [] m/s of that body along the road; 0 without one
    line: jax.Array  # [] m, a line that demands a stop


class Seen:
    """Views as planning frames in a batch; a line's frame is made once.

    Args:
      lanes: views in a batch.
    """

    def __init__(self, lanes: int) -> None:
        self._frames: list[LineFrame | None] = [None] * lanes
        self._last: list[View | None] = [None] * lanes
        self._lines: ReferenceLine | None = None  # of all lanes

    def scenes(self, views: Sequence[View | None]) -> tuple[Scene, Free]:
        """Return scenes [B] and what is ahead; who is over keeps its last one."""
        for n, view in enumerate(views):
            if view is not None:
                self._last[n] = _with_few(view)
        some = next(view for view in self._last if view is not None)
        every = [some if view is None else view for view in self._last]
        frames = [self._frame(n, view) for n, view in enumerate(every)]
        if self._lines is None:
            lines = [frame.line for frame in frames]
            self._lines = jax.tree.map(lambda *x: jnp.stack(x), *lines)
        points = np.zeros((len(every), SLOTS + MOST_LINES + 2, 2), np.float32)
        near, counts = np.zeros(points.shape[:2], np.int32), []
        for n, (frame, view) in enumerate(zip(frames, every, strict=True)):
            seen = view.ego, view.obstacles, view.signals, view.destination
            given = frame.points(*seen)
            counts.append(len(given))
            points[n, : len(given)] = given
            near[n, : len(given)] = frame.tree.query(given)[1]
        placed = project_lanes(self._lines, points[..., 0], points[..., 1], near)
        s, l = jax.device_get(placed)
        parts = [
            frame.parts(
                s[n, : counts[n]],
                l[n, : counts[n]],
                view.ego,
                view.obstacles,
                view.signals,
                slots=SLOTS,
            )
            for n, (frame, view) in enumerate(zip(frames, every, strict=True))
        ]
        scenes, free = _scenes(jax.tree.map(lambda *x: np.stack(x), *parts))
        return scenes, jax.device_get(free)

    def _frame(self, lane: int, view: View) -> LineFrame:
        """Return the frame of a lane's line, made where the line is another one."""
        frame = self._frames[lane]
        if frame is None or frame.road is not view.centre_line:
            frame = LineFrame(view.centre_line, (view.ego.x, view.ego.y), GRID)
            if frame.grid.size > GRID:
                raise InputError(
                    f"centre line: {frame.length:.0f} m long: expected at most "
                    f"{GRID * STATION_STEP_M:.0f} m, the part that is driven"
                )
            self._frames[lane], self._lines = frame, None
        return frame


def _with_few(view: View) -> View:
    """Return the view with as many bodies and signals, the nearest, as fit a batch."""

    def away(x: Any) -> float:  # noqa: ANN401
        return math.hypot(x.x - view.ego.x, x.y - view.ego.y)

    return dataclasses.replace(
        view,
        obstacles=sorted(view.obstacles, key=away)[:SLOTS],
        signals=sorted(view.signals, key=away)[:MOST_LINES],
    )


@jax.jit
@jax.vmap
def _scenes(parts: Parts) -> tuple[Scene, Free]:
    """Complete scenes; find the nearest body and stop line in the ego's corridor."""
    scene = scene_of(parts)
    obstacles, ego = scene.obstacles, scene.ego
    aside = jnp.maximum(
        obstacles.l_lower[:, 0] - ego.l, ego.l - obstacles.l_upper[:, 0]
    )
    known = obstacles.valid[:, 0] & (obstacles.kind != Kind.NONE)
    in_way = known & (aside < 0.5 * ego.width + CORRIDOR_MARGIN_M)
    in_way = in_way & (obstacles.s_upper[:, 0] > ego.s)
    gap = obstacles.s_lower[:, 0] - ego.s - 0.5 * ego.length
    is_line = obstacles.kind == Kind.STOP
    is_body = ~is_line & (obstacles.kind != Kind.VIRTUAL)
    to_body = jnp.where(in_way & is_body, gap, jnp.inf)
    first = jnp.argmin(to_body)
    speed = jnp.where((in_way & is_body)[first], obstacles.speed[first, 0], 0.0)
    line = jnp.min(jnp.where(in_way & is_line, gap, jnp.inf))
    return scene, Free(body=jnp.min(to_body), speed=speed, line=line)


class Next(flax.struct.PyTreeNode, kw_only=True):
    """A step of the ego that follows its plan, and the plan from then on."""

    way: jax.Array  # [] m
    speed: jax.Array  # [] m/s
    acceleration: jax.Array  # [] m/s^2
    future: jax.Array  # [T, 3] t s, way m, speed m/s
    beside: jax.Array | None  # [3] offset m, slope 1, second derivative 1/m
    fallback: jax.Array  # [] bool, no candidate was admissible


def follow(plan: Plan, v: jax.Array, a: jax.Array, vehicle: Vehicle) -> Next:
    """Advance 0.1 s along a plan by the drive train of `simulation.world`.

    Args:
      plan: in force.
      v: [] m/s, speed now.
      a: [] m/s^2, acceleration now.
      vehicle: limits and lag of the drive train.
    """
    asked = command(plan, v)
    asked = jnp.clip(asked, vehicle.min_acceleration, vehicle.max_acceleration)
    took = a + (1.0 - math.exp(-STEP_S / vehicle.acceleration_lag)) * (asked - a)
    speed = jnp.maximum(v + 0.5 * (a + took) * STEP_S, 0.0)
    took = jnp.where(speed > 0.0, took, jnp.maximum(took, 0.0))
    times = jnp.asarray(TIMES_S)
    rates = jnp.interp(times + plan.since, times, plan.v)
    return Next(
        way=0.5 * (v + speed) * STEP_S,
        speed=speed,
        acceleration=took,
        future=jnp.stack([times, stations_from_now(plan), rates], axis=1),
        beside=None if plan.path is None else path_at(plan, STEP_S),
        fallback=plan.fallback,
    )


@functools.lru_cache(maxsize=16)
def _step_of(policy: Policy, vehicle: Vehicle) -> Callable[..., tuple[Next, Plan]]:
    """Return the compiled step [B] of a policy: plan, then follow for 0.1 s."""

    def step(
        params: Any,  # noqa: ANN401
        scene: Scene,
        key: jax.Array,
        before: Plan,
        aside: jax.Array,
    ) -> Any:  # noqa: ANN401
        plan = policy(params, scene, key, beside(before, aside))
        return follow(plan, scene.ego.v, scene.ego.a, vehicle), later(plan, STEP_S)

    return jax.jit(jax.vmap(step, in_axes=(None, 0, 0, 0, 0)))


_fold_in = jax.jit(jax.vmap(jax.random.fold_in, in_axes=(0, None)))


class Driver:
    """A row that drives some episodes in lock step.

    Args:
      row: who.
      seeds: of the sampler, one an episode.
    """

    def __init__(self, row: Row, seeds: Sequence[int]) -> None:
        self._row, self._step = row, _step_of(row.policy, Vehicle())
        self._plans = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (len(seeds), *jnp.shape(x))),
            no_plan(row.steers),
        )
        self._keys = jax.vmap(jax.random.key)(np.asarray(seeds, np.uint32))
        self._time = 0

    def moves(self, scenes: Scene, aside: np.ndarray) -> tuple[list[Move], np.ndarray]:
        """Return each ego's next move, and whether nothing was admissible [B].

        Args:
          scenes: [B].
          aside: [B] m, `View.aside`.
        """
        keys = _fold_in(self._keys, self._time)
        self._time += 1
        given = self._row.params, scenes, keys, self._plans, aside
        made, self._plans = self._step(*given)
        made = jax.device_get(made)
        moves = [
            Move(
                way=float(made.way[n]),
                speed=float(made.speed[n]),
                acceleration=float(made.acceleration[n]),
                future=made.future[n],
                beside=None if made.beside is None else tuple(made.beside[n].tolist()),
            )
            for n in range(len(made.way))
        ]
        return moves, made.fallback


def refuse_paths(row: Row, simulator: str) -> None:
    """Refuse a row that plans paths where egos stay in the middle of their lane.

    Raises:
      InputError: it does.
    """
    if row.steers:
        raise InputError(
            f"{row.name}: mode: path_speed: expected speed: in {simulator} rows of "
            "ours drive along given paths"
        )


def drive(
    simulator: Simulator, who: Row | str, episodes: Sequence[str], seconds: float
) -> dict[str, EpisodeLog]:
    """Drive some episodes in lock step; return a log for each.

    Args:
      simulator: where.
      who: a row of ours, or the name of one of the simulator's own drivers.
      episodes: names from `simulator.episodes`, `simulator.together` at most: what
        runs together may depend on each other, so it is always the same.
      seconds: that an episode lasts; a collision ends it earlier.
    """
    row = None if isinstance(who, str) else who
    if row is not None and not simulator.changes_lanes:
        refuse_paths(row, simulator.name)
    running = simulator.start(episodes, who if isinstance(who, str) else None)
    # batches have one size, so that each row is compiled once
    lanes = simulator.together
    seen, samples = Seen(lanes), [[] for _ in episodes]
    seeds = [zlib.crc32(name.encode()) for name in episodes]
    driver = row and Driver(row, seeds + [0] * (lanes - len(seeds)))
    crashed = [False] * len(episodes)
    try:
        for _ in range(round(seconds / STEP_S)):
            views = [
                None if out else view
                for view, out in zip(running.look(), crashed, strict=True)
            ]
            if not any(views):
                break
            scenes, free = seen.scenes(views + [None] * (lanes - len(views)))
            moves, fallback = [None] * len(views), np.zeros(lanes, bool)
            if driver:
                aside = np.zeros(lanes, np.float32)
                aside[: len(views)] = [0.0 if x is None else x.aside for x in views]
                made, fallback = driver.moves(scenes, aside)
                moves = [view and move for view, move in zip(views, made, strict=False)]
            running.step(moves)
            for n, (view, after) in enumerate(zip(views, running.look(), strict=True)):
                if view is None or after is None:
                    continue
                gaps = float(free.body[n]), float(free.speed[n]), float(free.line[n])
                samples[n].append(sample(view, after, *gaps, bool(fallback[n])))
                crashed[n] = samples[n][-1]["collision"] > 0
    finally:
        running.close()
    return {name: log_of(s) for name, s in zip(episodes, samples, strict=True)}
