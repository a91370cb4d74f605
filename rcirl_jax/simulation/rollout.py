"""Closed loop: scan over time, vmap over cases, chunks to bound memory.

The only file of the simulator that names `jit`, `vmap` or `scan` over cases and time.
A policy is a pure function `(params, scene, key, before) -> Plan`, `before` being the
plan in force; between two plans the ego follows the plan. Weights are arguments, so the
compiled program serves every weights file of one shape.
"""

import concurrent.futures
import dataclasses
import functools
import math
import os
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

from rcirl_jax.errors import InputError
from rcirl_jax.planner.plan import Plan, command, later, no_plan, stations_from_now
from rcirl_jax.simulation.cases import STEP_S, Case, Record, Snapshot, World
from rcirl_jax.simulation.world import lines as signals
from rcirl_jax.simulation.world.observe import observe, road_limit
from rcirl_jax.simulation.world.step import start, step
from rcirl_jax.simulation.world.vehicle import Vehicle
from rcirl_jax.types import Scene

Params = Any  # a policy's weights: any pytree
Policy = Callable[..., Plan]  # (params, scene, key, plan in force) -> Plan
Logs = Any  # what a rollout returns: records, or what `reduce` made of them

SAMPLER_STREAM = 7  # fold_in number of the sampler's key


@dataclasses.dataclass(frozen=True, kw_only=True)
class RolloutConfig:
    """How a case is driven; hashable, a static argument."""

    # steps between two plans: 1 plans at 10 Hz
    plan_every: int = 1
    # steps of the run; cases with fewer are padded
    steps: int = 1200
    # the ego is the recorded human (cases with a replay only)
    follow_log: bool = False
    # steps by which the ego's commands are late: a driver's reaction time
    command_delay: int = 0
    # m/s^3, how fast the ego's braking may build up; None: as the actuator does
    braking_jerk: float | None = None
    # steps that the policy, then the relief drive in turn (with a relief only)
    turns: tuple[int, int] = (80, 140)
    # keep the agents and plans for pictures
    snapshots: bool = False
    # keep the planning frames, one per plan
    scenes: bool = False
    vehicle: Vehicle = dataclasses.field(default_factory=Vehicle)

    def __post_init__(self) -> None:
        """Reject what does not divide."""
        if not 1 <= self.plan_every <= 50:
            raise InputError(
                f"plan_every: {self.plan_every}: expected 1 to 50 steps of 0.1 s"
            )
        if self.steps < 1 or self.steps % self.plan_every:
            raise InputError(
                f"plan_every: {self.plan_every}: expected a divisor of the "
                f"{self.steps} steps"
            )


def drive_case(
    policy: Policy,
    params: Params,
    case: Case,
    config: RolloutConfig,
    relief: Policy | None = None,
) -> tuple[Record, Snapshot | None, Scene | None]:
    """One case from start to end.

    With a `relief` the two drive in turn, the policy for `turns[0]` steps, then the
    relief for `turns[1]`; `params` is then the pair of their weights.

    Returns:
      The record [S], and where the configuration asks for them the snapshots
      [S] and the planning frames [S / plan_every].
    """
    limit = road_limit(case.road)
    key = jax.random.fold_in(jax.random.key(case.seed), SAMPLER_STREAM)

    def plan_and_drive(carry: tuple, _: None) -> tuple[tuple, tuple]:
        world, queue, before = carry
        scene = observe(case, world, limit)
        with jax.named_scope("policy"):
            draw = jax.random.fold_in(key, world.step)
            own = params if relief is None else params[0]
            plan = policy(own, scene, draw, before)
            if relief is not None:
                relieved = world.step % sum(config.turns) >= config.turns[0]
                other = relief(params[1], scene, draw, before)
                plan = jax.tree.map(
                    lambda yes, no: jnp.where(relieved, yes, no), other, plan
                )

        def tick(carry: tuple, _: None) -> tuple[tuple, tuple]:
            now, waiting, ahead = carry
            asked = command(ahead, now.ego.v)
            waiting = jnp.concatenate([asked[None], waiting])
            late, waiting = waiting[-1], waiting[:-1]
            after, record = step(
                case,
                now,
                _build_up(late, now.ego.a, config),
                ahead.fallback,
                config.vehicle,
                config.follow_log,
            )
            shot = _snapshot(case, now, after, ahead) if config.snapshots else None
            ahead = later(ahead, STEP_S)
            return (after, waiting, ahead), (record, shot)

        begin = (world, queue, plan)
        carry, logs = jax.lax.scan(tick, begin, None, length=config.plan_every)
        return carry, (logs, scene if config.scenes else None)

    plans = config.steps // config.plan_every
    begin = (start(case), jnp.zeros((config.command_delay,)), no_plan())
    _, (logs, scenes) = jax.lax.scan(plan_and_drive, begin, None, length=plans)
    flat = lambda x: x.reshape(config.steps, *x.shape[2:])  # noqa: E731
    return *jax.tree.map(flat, logs), scenes


def _build_up(command: jax.Array, a: jax.Array, config: RolloutConfig) -> jax.Array:
    """The command, no farther below the present acceleration than the jerk allows."""
    if config.braking_jerk is None:
        return command
    lag = config.vehicle.acceleration_lag
    reach = STEP_S / (1.0 - math.exp(-STEP_S / lag))
    return jnp.maximum(command, a - config.braking_jerk * reach)


def _snapshot(case: Case, now: World, after: World, plan: Plan) -> Snapshot:
    time = after.step * STEP_S
    _, red = signals.colours(case.lines, time)
    sign = ~after.served & (case.lines.kind == 2)
    return Snapshot(
        agents=after.agents,
        plan_s=now.ego.s + stations_from_now(plan),
        line_red=red | sign,
    )


@functools.lru_cache(maxsize=32)
def _compiled(
    policy: Policy,
    reduce: Callable[[Record], Logs] | None,
    config: RolloutConfig,
    relief: Policy | None,
    keep: bool,
) -> Callable:
    def run(params: Params, case: Case) -> Logs:
        logs = drive_case(policy, params, case, config, relief)
        if reduce is None:
            return logs
        return (reduce(logs[0]), logs) if keep else reduce(logs[0])

    return jax.jit(jax.vmap(run, in_axes=(None, 0)))


# Cases a CPU drives side by side. XLA compiles other code for other shapes and
# rounds the last digit differently, and traffic is chaotic: only with one shape
# does a case come out the same in every batch.
LANES = 30


def drive_cases(
    policy: Policy,
    params: Params,
    cases: Case,
    config: RolloutConfig,
    reduce: Callable[[Record], Logs] | None = None,
    relief: Policy | None = None,
    *,
    keep: bool = False,
) -> Logs:
    """All cases [B]: (records, snapshots, scenes), or what `reduce` makes of them.

    On a CPU a batch that is a multiple of `LANES` runs in groups of that many, else
    all cases at once. With `reduce` the records never leave the device; on a CPU,
    where they need not move, they are made and dropped: so one program serves the
    suite and the pictures of its cases, and draws the very drives.

    Args:
      policy: who drives.
      params: its weights; with a relief the pair of both.
      cases: leaves [B, ...].
      config: of the rollouts.
      reduce: record [S] -> what is wanted of it.
      relief: drives in turn with the policy.
      keep: with `reduce` (what it makes, logs with snapshots) instead.
    """
    total = cases.steps.shape[0]
    in_groups = total % LANES == 0 and jax.default_backend() == "cpu"
    keeps = reduce is not None and (keep or in_groups)
    if keeps:
        config = dataclasses.replace(config, snapshots=True)
    drive = _compiled(policy, reduce, config, relief, keeps)
    if not in_groups:
        return drive(params, cases)

    def group(first: int) -> Logs:
        lanes = slice(first, first + LANES)
        part = jax.tree.map(lambda leaf: leaf[lanes], cases)
        made = jax.block_until_ready(drive(params, part))
        return made[0] if keeps and not keep else made

    # a group keeps one core busy: its operations are too small to be shared
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        groups = list(pool.map(group, range(0, total, LANES)))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *groups)


def chunks(cases: Case, size: int) -> Iterator[tuple[Case, int]]:
    """Cases in chunks of one size; the last is filled up with its first case.

    Yields:
      (chunk, count): only the first `count` cases of the chunk are new.
    """
    total = cases.steps.shape[0]
    for first in range(0, total, size):
        count = min(size, total - first)
        index = jnp.minimum(jnp.arange(size) + first, first + count - 1)
        yield jax.tree.map(lambda x, i=index: jnp.asarray(x)[i], cases), count
