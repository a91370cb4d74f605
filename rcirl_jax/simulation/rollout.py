"""Closed loop: scan over time, vmap over cases, groups of one size on a CPU.

The only file of the simulator that names `jit`, `vmap` or `scan` over cases and time.
A policy is a pure function `(params, scene, key, before) -> Plan`, `before` being the
plan in force; between two plans the ego follows the plan, along the given path unless
the policy `steers`. One with a method `in_case` is given number and step of the case
besides.

What is compiled is a span of half a second for a group of cases. Longer drives are the
same program called again, so that one serves the suite, held-out drives, demonstrations
and pictures, whatever they last and whoever takes turns. Weights and the manner of
driving are arguments, and cases of the catalogue have a replay without anybody in it.

What is scanned is the step of all cases side by side: a scan under `vmap` would be
traced once for one case and again for many.
"""

import concurrent.futures
import dataclasses
import functools
import math
import os
from collections.abc import Callable, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.planner.plan import (
    Plan,
    beside,
    command,
    later,
    no_plan,
    path_at,
    stations_from_now,
)
from rcirl_jax.simulation.agents import colours
from rcirl_jax.simulation.cases import (
    STEP_S,
    Case,
    Record,
    Snapshot,
    World,
    nobody_recorded,
)
from rcirl_jax.simulation.world import (
    Vehicle,
    lane_centre,
    observe,
    road_limit,
    start,
    steering_lead,
    step,
)
from rcirl_jax.types import Scene
from rcirl_jax.units import TIMES_S

Params = Any  # a policy's weights: any pytree
Policy = Callable[..., Plan]  # (params, scene, key, plan in force) -> Plan
Logs = Any  # what a rollout returns: records, or what `reduce` made of them

SAMPLER_STREAM = 7  # fold_in number of the sampler's key
MAX_DELAY = 10  # steps by which commands may be late
SPAN = 5  # steps of one call, at least


@dataclasses.dataclass(frozen=True, kw_only=True)
class RolloutConfig:
    """The settings of a rollout; hashable."""

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
    # steps between two planning frames that are kept; 0: none
    frames_every: int = 0
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
        if self.frames_every % self.span:
            raise InputError(
                f"frames_every: {self.frames_every}: expected a multiple of "
                f"{self.span} steps"
            )

    @property
    def span(self) -> int:
        """The steps of one call: `SPAN`, or the next multiple of `plan_every`."""
        return -(-SPAN // self.plan_every) * self.plan_every

    def manner(self) -> "Manner":
        """The part of the settings that is data."""
        # a command held for a step moves the acceleration by this share of its way
        share = 1.0 - math.exp(-STEP_S / self.vehicle.acceleration_lag)
        jerk = math.inf if self.braking_jerk is None else self.braking_jerk
        return Manner(
            follow_log=jnp.asarray(self.follow_log),
            command_delay=jnp.asarray(self.command_delay),
            below=jnp.asarray(jerk * STEP_S / share, jnp.float32),
        )


class Manner(flax.struct.PyTreeNode, kw_only=True):
    """The manner in which the ego follows its commands; all []."""

    follow_log: jax.Array  # bool
    command_delay: jax.Array  # steps
    below: jax.Array  # m/s^2 by which a command may be below the acceleration


class Now(flax.struct.PyTreeNode, kw_only=True):
    """The state that one span hands to the next."""

    worlds: World  # leaves [B, ...]
    waiting: jax.Array  # [B, MAX_DELAY + 1] m/s^2, commands, newest first
    plan: Plan  # in force, leaves [B, ...], offsets from the road's reference line


def _steers(policy: Policy) -> bool:
    """True if a policy plans paths."""
    return getattr(policy, "steers", False)


@functools.partial(jax.jit, static_argnames="steers")
def _begin(cases: Case, steers: bool = False) -> tuple[Now, jax.Array]:
    """The start of cases [B], and the speed limits [B, R] m/s that the planner gets."""
    count = cases.steps.shape[0]
    now = Now(
        worlds=jax.vmap(start)(cases),
        waiting=jnp.zeros((count, MAX_DELAY + 1)),
        plan=jax.tree.map(lambda x: jnp.stack([x] * count), no_plan(steers)),
    )
    # numbers of Python are of a weaker type, and would compile the first span alone
    now = jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), now)
    return now, jax.vmap(lambda case: road_limit(case.road, steers))(cases)


@functools.partial(jax.jit, static_argnames="steers")
def _seen(cases: Case, worlds: World, limits: jax.Array, steers: bool = False) -> Scene:
    """The planning frames [B] of worlds [B]."""
    see = functools.partial(observe, steers=steers)
    return jax.vmap(see)(cases, worlds, limits)


def first_scenes(cases: Case, steers: bool = False) -> Scene:
    """The first planning frame of each case [B], of a planner that `steers` or not."""
    cases = _completed(cases)
    now, limits = _begin(cases, steers)
    return _seen(cases, now.worlds, limits, steers)


def _completed(cases: Case) -> Case:
    """Cases [B] of one structure and type, whatever their source."""
    count = cases.steps.shape[0]
    nobody = jax.tree.map(
        lambda x: np.broadcast_to(x, (count, *x.shape)), nobody_recorded()
    )
    cases = cases.replace(
        replay=cases.replay or nobody,
        ego_a=np.zeros(count, np.float32) if cases.ego_a is None else cases.ego_a,
    )
    return jax.tree.map(jnp.asarray, cases)


@functools.lru_cache(maxsize=32)
def _compiled(policy: Policy, plan_every: int, length: int, vehicle: Vehicle) -> Any:  # noqa: ANN401
    """The program of a span of `length` steps."""
    steers = _steers(policy)
    lead = np.array([0.0, steering_lead(vehicle)])

    def tick(case: Case, manner: Manner, now: Now) -> tuple[Now, jax.Array]:
        world, plan = now.worlds, now.plan
        waiting = jnp.append(command(plan, world.ego.v), now.waiting[:-1])
        late = waiting[manner.command_delay]
        applied = jnp.maximum(late, world.ego.a - manner.below)
        planned = path_at(plan, lead) if steers else None
        after, record = step(
            case, world, applied, plan.fallback, vehicle, manner.follow_log, planned
        )
        shot = _snapshot(case, world, after, plan)
        plan = later(plan, STEP_S)
        return Now(worlds=after, waiting=waiting, plan=plan), _packed((record, shot))

    def run(
        params: Params, cases: Case, manner: Manner, limits: jax.Array, now: Now
    ) -> tuple[Now, jax.Array]:
        stream = lambda seed: jax.random.fold_in(jax.random.key(seed), SAMPLER_STREAM)  # noqa: E731
        keys = jax.vmap(stream)(cases.seed)

        def plan_of(
            scene: Scene, key: jax.Array, world: World, before: Plan, seed: jax.Array
        ) -> Plan:
            key = jax.random.fold_in(key, world.step)
            with jax.named_scope("policy"):
                if in_case := getattr(policy, "in_case", None):
                    return in_case(params, scene, key, before, seed, world.step)
                return policy(params, scene, key, before)

        def plan_and_drive(now: Now, _: None) -> tuple[Now, jax.Array]:
            see = functools.partial(observe, steers=steers)
            scenes = jax.vmap(see)(cases, now.worlds, limits)
            plan = jax.vmap(plan_of)
            if steers:  # a scene's offsets are from the middle of a lane
                middle = jax.vmap(lane_centre)(cases.road, now.worlds.ego)
                before = jax.vmap(beside)(now.plan, middle)
                plans = plan(scenes, keys, now.worlds, before, cases.seed)
                plans = jax.vmap(beside)(plans, -middle)
            else:
                plans = plan(scenes, keys, now.worlds, now.plan, cases.seed)
            now = now.replace(plan=plans)
            drive = jax.vmap(tick, in_axes=(0, None, 0))
            return jax.lax.scan(
                lambda now, _: drive(cases, manner, now), now, length=plan_every
            )

        now, logs = jax.lax.scan(plan_and_drive, now, length=length // plan_every)
        return now, logs.reshape(length, *logs.shape[2:])

    return jax.jit(run)


def rollout(
    policy: Policy, params: Params, cases: Case, config: RolloutConfig
) -> tuple[list[jax.Array], list[Scene]]:
    """Drive cases [B] from start to end, side by side.

    Args:
      policy: who drives.
      params: its weights.
      cases: leaves [B, ...].
      config: of the rollout.

    Returns:
      Record and snapshot of every step, as `_unpacked` reads them, in spans
      [span, B, L], which may end after the run, and the planning frames [B] that the
      configuration asks for.
    """
    cases, length = _completed(cases), config.span
    program = _compiled(policy, config.plan_every, length, config.vehicle)
    manner, steers = config.manner(), _steers(policy)
    now, limits = _begin(cases, steers)
    logs, frames = [], []
    for at in range(0, config.steps, length):
        if config.frames_every and at % config.frames_every == 0:
            frames.append(_seen(cases, now.worlds, limits, steers))
        now, made = program(params, cases, manner, limits, now)
        logs.append(made)
    return logs, frames


def plans_along(
    policy: Policy, params: Sequence[Params], cases: Case, config: RolloutConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Plans by several weights of one policy along the drives of the first.

    At every moment that is looked at (`frames_every` steps) each of them chooses in the
    same scene, among the same candidates and with the same plan in force, as if a
    choice were due. The programs are those of the drives.

    Args:
      policy: who drives, and whose choices are compared.
      params: P of its weights; the first drive.
      cases: leaves [B, ...].
      config: of the drives; with `frames_every`.

    Returns:
      Planned stations and, where paths are planned, offsets [P, B, M, 2, T] m, and
      [B, M] bool: the drive lasts.
    """
    cases, length = _completed(cases), config.span
    program = _compiled(policy, config.plan_every, length, config.vehicle)
    manner, steers = config.manner(), _steers(policy)
    now, limits = _begin(cases, steers)
    places, lasts = [], []
    for at in range(0, config.steps, length):
        if at % config.frames_every == 0:
            long_ago = jnp.full_like(now.plan.since_choice, math.inf)
            due = now.replace(plan=now.plan.replace(since_choice=long_ago))
            made = [program(x, cases, manner, limits, due)[1] for x in params]
            seen = [_unpacked(np.asarray(x)[0], cases, steers) for x in made]
            places.append([_planned(shot) for _, shot in seen])
            lasts.append(seen[0][0].valid)
        now, _ = program(params[0], cases, manner, limits, now)
    return np.moveaxis(np.array(places), 0, 2), np.stack(lasts, axis=1)


def _planned(shot: Snapshot) -> np.ndarray:
    """Planned stations and offsets [B, 2, T] m, 0 from a path that is given."""
    aside = np.zeros_like(shot.plan_s) if shot.plan_l is None else shot.plan_l
    return np.stack([shot.plan_s, aside], axis=1)


def _snapshot(case: Case, now: World, after: World, plan: Plan) -> Snapshot:
    time = after.step * STEP_S
    _, red = colours(case.lines, time)
    sign = ~after.served & (case.lines.kind == 2)
    return Snapshot(
        agents=after.agents,
        plan_s=now.ego.s + stations_from_now(plan),
        line_red=red | sign,
        plan_l=None if plan.path is None else path_at(plan, jnp.asarray(TIMES_S))[0],
    )


def _packed(logs: tuple[Record, Snapshot]) -> jax.Array:
    """The logs of a step as one array [L]: a loop writes it at once."""
    leaves = [jnp.ravel(x).astype(jnp.float32) for x in jax.tree.leaves(logs)]
    return jnp.concatenate(leaves)


def _unpacked(
    packed: Any,  # noqa: ANN401
    cases: Case,
    steers: bool,
) -> tuple[Record, Snapshot]:
    """Records and snapshots [...] of packed ones [..., L]; numpy's or JAX's."""
    given, case = jax.tree.flatten(cases)
    kinds = tuple(jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in given)
    leaves, tree = _layout(case, kinds, steers)
    ends = np.cumsum([leaf.size for leaf in leaves])
    parts = [
        packed[..., end - leaf.size : end]
        .reshape(*packed.shape[:-1], *leaf.shape)
        .astype(leaf.dtype)
        for leaf, end in zip(leaves, ends, strict=True)
    ]
    return jax.tree.unflatten(tree, parts)


@functools.lru_cache(maxsize=8)
def _layout(case: Any, kinds: tuple, steers: bool) -> tuple[list, Any]:  # noqa: ANN401
    """Returns what `_packed` packs of a case of such leaves: leaves, their tree."""

    def logged(case: Case) -> tuple[Record, Snapshot]:
        world = start(case)
        after, record = step(case, world, case.ego_v, case.ego_v > 0.0, Vehicle())
        return record, _snapshot(case, world, after, no_plan(steers))

    return jax.tree.flatten(jax.eval_shape(logged, jax.tree.unflatten(case, kinds)))


@functools.lru_cache(maxsize=8)
def _reducer(reduce: Callable[[Record], Logs], steps: int, steers: bool) -> Callable:
    """A program of its own: whoever drove, records are judged by the same."""

    def judge(spans: list[jax.Array], cases: Case) -> Logs:
        record, _ = _unpacked(jnp.concatenate(spans)[:steps], cases, steers)
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
    *,
    keep: bool = False,
) -> Logs:
    """All cases [B]: (records, snapshots, frames), or what `reduce` makes of them.

    On a CPU a batch that is a multiple of `LANES` runs in groups of that many, else
    all cases at once. With `reduce` the records never leave the device.

    Args:
      policy: who drives.
      params: its weights.
      cases: leaves [B, ...].
      config: of the rollouts.
      reduce: record [S] -> what is wanted of it.
      keep: with `reduce` (what it makes, logs) instead.

    Returns:
      Leaves [B, ...] as numpy arrays: records and snapshots [B, S, ...], planning
      frames [B, S / frames_every, ...] or None.
    """
    total = cases.steps.shape[0]
    in_groups = total % LANES == 0 and jax.default_backend() == "cpu"
    steers = _steers(policy)

    def group(first: int) -> Logs:
        lanes = slice(first, first + (LANES if in_groups else total))
        part = jax.tree.map(lambda leaf: leaf[lanes], cases)
        spans, frames = jax.block_until_ready(rollout(policy, params, part, config))
        made = reduce and _reducer(reduce, config.steps, steers)(spans, part)
        if reduce and not keep:
            return jax.block_until_ready(made)
        packed = np.concatenate([np.asarray(x) for x in spans])[: config.steps]
        kept = (
            # time comes first: a view
            *_unpacked(np.swapaxes(packed, 0, 1), part, steers),
            jax.tree.map(lambda *x: np.stack(x, axis=1), *frames) if frames else None,
        )
        return (made, kept) if keep else kept

    if not in_groups:
        return group(0)
    # a group keeps one core busy: its operations are too small to be shared
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        groups = list(pool.map(group, range(0, total, LANES)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *groups)
