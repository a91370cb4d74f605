"""Closed loop: scan over time, vmap over cases, groups of one size on a CPU.

The only file of the simulator that names `jit`, `vmap` or `scan` over cases and time.
A policy is a pure function `(params, scene, key, before) -> Plan`, `before` being the
plan in force; between two plans the ego follows the plan. Weights and the manner of
driving are arguments: the compiled program serves every row of one policy and shape.

What is scanned is the step of all cases side by side: a scan under `vmap` would be
traced once for one case and again for many.
"""

import concurrent.futures
import dataclasses
import functools
import math
import os
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.planner.plan import (
    Plan,
    command,
    either,
    later,
    no_plan,
    stations_from_now,
)
from rcirl_jax.simulation.agents import colours
from rcirl_jax.simulation.cases import STEP_S, Case, Record, Snapshot, World
from rcirl_jax.simulation.world import Vehicle, observe, road_limit, start, step
from rcirl_jax.types import Scene

Params = Any  # a policy's weights: any pytree
Policy = Callable[..., Plan]  # (params, scene, key, plan in force) -> Plan
Logs = Any  # what a rollout returns: records, or what `reduce` made of them

SAMPLER_STREAM = 7  # fold_in number of the sampler's key
MAX_DELAY = 10  # steps by which commands may be late


@dataclasses.dataclass(frozen=True, kw_only=True)
class RolloutConfig:
    """The settings of a rollout; hashable. Its manner is data, the rest is static."""

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
    # steps that the policy, then the takeover policy drive in turn (where there is one)
    takeover_schedule: tuple[int, int] = (80, 140)
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
        if not 0 <= self.command_delay <= MAX_DELAY:
            raise InputError(
                f"command_delay: {self.command_delay}: expected 0 to {MAX_DELAY} steps"
            )

    def split(self) -> tuple["Manner", "RolloutConfig"]:
        """The manner, and the configuration that all manners share."""
        # a command held for a step moves the acceleration by this share of its way
        share = 1.0 - math.exp(-STEP_S / self.vehicle.acceleration_lag)
        jerk = math.inf if self.braking_jerk is None else self.braking_jerk
        manner = Manner(
            follow_log=jnp.asarray(self.follow_log),
            command_delay=jnp.asarray(self.command_delay),
            below=jnp.asarray(jerk * STEP_S / share, jnp.float32),
        )
        usual = {"follow_log": False, "command_delay": 0, "braking_jerk": None}
        return manner, dataclasses.replace(self, **usual)


class Manner(flax.struct.PyTreeNode, kw_only=True):
    """The part of a `RolloutConfig` that is data; all []."""

    follow_log: jax.Array  # bool
    command_delay: jax.Array  # steps
    below: jax.Array  # m/s^2 by which a command may be below the acceleration


def rollout(
    policy: Policy,
    params: Params,
    cases: Case,
    config: RolloutConfig,
    manner: Manner,
    takeover_policy: Policy | None = None,
) -> tuple[jax.Array, Scene | None]:
    """Drive cases [B] from start to end, side by side.

    With a `takeover_policy` the two drive in turn, the policy for
    `takeover_schedule[0]` steps, then the other for `takeover_schedule[1]`; `params` is
    then the pair of their weights.

    Returns:
      Record and, where the configuration asks for it, snapshot of every step as
      `_unpacked` reads them [S, B, L], and the planning frames [S / plan_every, B]
      where it asks for those; time comes first.
    """
    limits = jax.vmap(lambda case: road_limit(case.road))(cases)
    stream = lambda seed: jax.random.fold_in(jax.random.key(seed), SAMPLER_STREAM)  # noqa: E731
    keys = jax.vmap(stream)(cases.seed)

    def plan_of(scene: Scene, key: jax.Array, now: World, before: Plan) -> Plan:
        with jax.named_scope("policy"):
            draw = jax.random.fold_in(key, now.step)
            if takeover_policy is None:
                return policy(params, scene, draw, before)
            plan = policy(params[0], scene, draw, before)
            other = takeover_policy(params[1], scene, draw, before)
            first, second = config.takeover_schedule
            taken_over = now.step % (first + second) >= first
            return either(taken_over, other, plan)

    def tick(
        case: Case, now: World, waiting: jax.Array, plan: Plan
    ) -> tuple[tuple[World, jax.Array, Plan], jax.Array]:
        waiting = jnp.append(command(plan, now.ego.v), waiting[:-1])
        late = waiting[manner.command_delay]
        applied = jnp.maximum(late, now.ego.a - manner.below)
        after, record = step(
            case, now, applied, plan.fallback, config.vehicle, manner.follow_log
        )
        shot = _snapshot(case, now, after, plan) if config.snapshots else None
        return (after, waiting, later(plan, STEP_S)), _packed((record, shot))

    def plan_and_drive(carry: tuple, _: None) -> tuple[tuple, tuple]:
        worlds, waiting, before = carry
        scenes = jax.vmap(observe)(cases, worlds, limits)
        plans = jax.vmap(plan_of)(scenes, keys, worlds, before)
        carry, logs = jax.lax.scan(
            lambda now, _: jax.vmap(tick)(cases, *now),
            (worlds, waiting, plans),
            length=config.plan_every,
        )
        return carry, (logs, scenes if config.scenes else None)

    count = cases.steps.shape[0]
    nothing = jax.tree.map(lambda x: jnp.stack([x] * count), no_plan())
    begin = (jax.vmap(start)(cases), jnp.zeros((count, MAX_DELAY + 1)), nothing)
    plans = config.steps // config.plan_every
    _, (logs, scenes) = jax.lax.scan(plan_and_drive, begin, length=plans)
    return logs.reshape(config.steps, count, -1), scenes


def _snapshot(case: Case, now: World, after: World, plan: Plan) -> Snapshot:
    time = after.step * STEP_S
    _, red = colours(case.lines, time)
    sign = ~after.served & (case.lines.kind == 2)
    return Snapshot(
        agents=after.agents,
        plan_s=now.ego.s + stations_from_now(plan),
        line_red=red | sign,
    )


def _packed(logs: tuple[Record, Snapshot | None]) -> jax.Array:
    """The logs of a step as one array [L]: a loop writes it at once."""
    leaves = [jnp.ravel(x).astype(jnp.float32) for x in jax.tree.leaves(logs)]
    return jnp.concatenate(leaves)


def _unpacked(packed: Any, cases: Case, snapshots: bool) -> tuple:  # noqa: ANN401
    """Records and snapshots [...] of packed ones [..., L]; numpy's or JAX's."""
    given, case = jax.tree.flatten(cases)
    kinds = tuple(jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in given)
    leaves, tree = _layout(case, kinds, snapshots)
    ends = np.cumsum([leaf.size for leaf in leaves])
    parts = [
        packed[..., end - leaf.size : end]
        .reshape(*packed.shape[:-1], *leaf.shape)
        .astype(leaf.dtype)
        for leaf, end in zip(leaves, ends, strict=True)
    ]
    return jax.tree.unflatten(tree, parts)


@functools.lru_cache(maxsize=8)
def _layout(case: Any, kinds: tuple, snapshots: bool) -> tuple[list, Any]:  # noqa: ANN401
    """Returns what `_packed` packs of a case of such leaves: leaves, their tree."""

    def logged(case: Case) -> tuple[Record, Snapshot | None]:
        world = start(case)
        after, record = step(case, world, case.ego_v, case.ego_v > 0.0, Vehicle())
        shot = _snapshot(case, world, after, no_plan()) if snapshots else None
        return record, shot

    return jax.tree.flatten(jax.eval_shape(logged, jax.tree.unflatten(case, kinds)))


@functools.lru_cache(maxsize=32)
def _compiled(
    policy: Policy, config: RolloutConfig, takeover_policy: Policy | None
) -> Callable:
    def run(params: Params, cases: Case, manner: Manner) -> Logs:
        return rollout(policy, params, cases, config, manner, takeover_policy)

    return jax.jit(run)


@functools.lru_cache(maxsize=8)
def _reducer(reduce: Callable[[Record], Logs], snapshots: bool) -> Callable:
    """A program of its own: whoever drove, records are judged by the same."""

    def judge(packed: jax.Array, cases: Case) -> Logs:
        record, _ = _unpacked(packed, cases, snapshots)
        return jax.vmap(reduce, in_axes=1)(record)

    return jax.jit(judge)


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
    takeover_policy: Policy | None = None,
    *,
    keep: bool = False,
) -> Logs:
    """All cases [B]: (records, snapshots, scenes), or what `reduce` makes of them.

    On a CPU a batch that is a multiple of `LANES` runs in groups of that many, else
    all cases at once. With `reduce` the records never leave the device, and on a CPU
    there are snapshots too: so one program serves the suite and the pictures of its
    cases, and plots the same rollouts.

    Args:
      policy: who drives.
      params: its weights; with a takeover policy the pair of both.
      cases: leaves [B, ...].
      config: of the rollouts.
      reduce: record [S] -> what is wanted of it.
      takeover_policy: drives in turn with the policy.
      keep: with `reduce` (what it makes, logs with snapshots) instead.

    Returns:
      Leaves [B, ...]; records and snapshots [B, S, ...], as numpy arrays.
    """
    total = cases.steps.shape[0]
    in_groups = total % LANES == 0 and jax.default_backend() == "cpu"
    if reduce is not None and (keep or in_groups):
        config = dataclasses.replace(config, snapshots=True)
    manner, config = config.split()
    drive = _compiled(policy, config, takeover_policy)

    def group(first: int) -> Logs:
        lanes = slice(first, first + (LANES if in_groups else total))
        part = jax.tree.map(lambda leaf: leaf[lanes], cases)
        logs = jax.block_until_ready(drive(params, part, manner))
        made = reduce and _reducer(reduce, config.snapshots)(logs[0], part)
        if reduce and not keep:
            return jax.block_until_ready(made)
        # time comes first in the program: a view, where a program would copy
        by_case = lambda x: np.swapaxes(np.asarray(x), 0, 1)  # noqa: E731
        packed, scenes = jax.tree.map(by_case, logs)
        kept = *_unpacked(packed, part, config.snapshots), scenes
        return (made, kept) if keep else kept

    if not in_groups:
        return group(0)
    # a group keeps one core busy: its operations are too small to be shared
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        groups = list(pool.map(group, range(0, total, LANES)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *groups)
