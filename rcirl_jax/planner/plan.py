"""The plan that answers a scene, and how it is followed until the next one.

A plan is s(t), v(t), a(t) on the time axis, along the given path or with one of its own
(`path_at`). Until the next planning step the ego follows it (`command`), and that step
has the rest of it among its candidates (`stations_from_now`), so that the trajectory
that was valued is the one that is driven.

Keep a plan for a while, and plan again only when that is necessary.

    kept while   admissible now,  chosen less than `commitment` ago

Otherwise the best of all candidates is chosen, the rest of the plan among them. Keeping
a plan costs the check of one trajectory, choosing one the values of 65. `only_where`
skips that work for the cases of a batch that keep their plan, which makes a closed loop
several times faster.
"""

import math
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.typing import ArrayLike

from rcirl_jax.geometry.frenet import lookup
from rcirl_jax.geometry.polynomial import hermite
from rcirl_jax.planner.safety import SafetyConfig, check
from rcirl_jax.sampling import SamplerConfig, trajectory_on_path
from rcirl_jax.sampling.kinematics import running_max, trajectory_from_positions
from rcirl_jax.sampling.sampler import family_index, within_limits
from rcirl_jax.types import Candidates, Scene, Trajectory
from rcirl_jax.units import DT_S, NUM_TIMES, TIMES_S

COMMAND_STEP_S = 0.1  # s that one command stays in force
ACTUATOR_LAG_S = 0.2  # s, of the drive train; the command leads the plan by it
EASED_MPS2 = 0.3  # m/s^2, braking left at standstill in an ordinary stop
EASING_S = 0.5  # s, time constant of the last part of an ordinary stop
MIN_WAY_M = 0.01  # m, keeps v^2 / 2s finite at rest
# A command held for h moves the acceleration by 1 - exp(-h / lag) of the way, so a
# plan with jerk j is met after h when the command leads by j h / (1 - exp(-h / lag)).
LEAD_S = COMMAND_STEP_S / (1.0 - math.exp(-COMMAND_STEP_S / ACTUATOR_LAG_S))


class Plan(flax.struct.PyTreeNode, kw_only=True):
    """One plan in the frame of the scene that it was made for, and its evidence."""

    s: jax.Array  # [T] m, planned stations
    v: jax.Array  # [T] m/s
    a: jax.Array  # [T] m/s^2
    # [3, T] offsets m and their derivatives dl 1 and ddl 1/m by station; None: the path
    # is given
    path: jax.Array | None
    since: jax.Array  # [] s since it was made
    since_choice: jax.Array  # [] s since it was last chosen, made or confirmed
    lasts: jax.Array  # [] bool: may be gone on with at the next planning step
    urgent: jax.Array  # [] bool: brakes at once, without leading up to it
    fallback: jax.Array  # [] bool: no candidate was admissible
    admissible: jax.Array  # [] int32, candidates that passed the safety filter


def plan_of(
    chosen: Trajectory,
    *,
    lasts: jax.Array | bool = False,
    urgent: jax.Array | bool = False,
    fallback: jax.Array | bool = False,
    admissible: jax.Array | int = 0,
    steers: bool = False,
) -> Plan:
    """A fresh plan along a trajectory [T], of its path too if it `steers`."""
    return Plan(
        s=chosen.s,
        v=chosen.v,
        a=chosen.a,
        path=jnp.stack([chosen.l, chosen.dl, chosen.ddl]) if steers else None,
        since=jnp.zeros(()),
        since_choice=jnp.zeros(()),
        lasts=jnp.asarray(lasts),
        urgent=jnp.asarray(urgent),
        fallback=jnp.asarray(fallback),
        admissible=jnp.asarray(admissible, jnp.int32),
    )


def no_plan(steers: bool = False) -> Plan:
    """The empty plan that is in force before the first one."""
    zero = jnp.zeros((NUM_TIMES,))
    nothing = Trajectory(**dict.fromkeys(Trajectory.__dataclass_fields__, zero))
    return plan_of(nothing, steers=steers)


def held(v: jax.Array, a: jax.Array) -> Plan:
    """A plan that holds an acceleration [] m/s^2 from a speed [] m/s until standing."""
    times = jnp.asarray(TIMES_S)
    until = jnp.where(a < 0.0, jnp.minimum(times, v / -jnp.minimum(a, -1e-6)), times)
    s = v * until + 0.5 * a * until**2
    return no_plan().replace(s=s, v=v + a * until, a=jnp.full_like(times, a))


def command(plan: Plan, v: jax.Array) -> jax.Array:
    """Acceleration command [] m/s^2 that follows a plan now, `plan.since` on.

    The planned acceleration, linear between the times, led by the actuator's lag; an
    urgent plan asks for its braking at once. A plan that comes to rest within an
    interval shows only a part of its braking in second differences: there the braking
    is the one that stops within the planned distance, v^2 / 2s, eased off towards
    standstill unless it is urgent.

    Args:
      plan: the plan in force.
      v: [] m/s, the ego's speed now.
    """
    at = jnp.clip(plan.since / DT_S, 0.0, NUM_TIMES - 2.0)
    here = at.astype(jnp.int32)
    led = jnp.clip((plan.since + LEAD_S) / DT_S, 0.0, NUM_TIMES - 1.0)
    wanted = lookup(plan.a, led, 1.0)
    planned = jnp.stack([plan.s, plan.v, plan.a])
    (s, begin, _), (s_next, _, a_next) = jnp.moveaxis(
        planned[:, here + np.arange(2)], 1, 0
    )
    wanted = jnp.where(plan.urgent, a_next, wanted)
    way = s_next - s
    rests = way < 0.5 * begin * DT_S
    stopping = -(begin**2) / (2.0 * jnp.maximum(way, MIN_WAY_M))
    eased = jnp.maximum(stopping, -(EASED_MPS2 + v / EASING_S))
    stopping = jnp.where(plan.urgent, stopping, eased)
    return jnp.where(rests, jnp.minimum(wanted, stopping), wanted)


def later(plan: Plan, seconds: float) -> Plan:
    """The same plan after some time has passed."""
    return plan.replace(
        since=plan.since + seconds, since_choice=plan.since_choice + seconds
    )


def stations_from_now(plan: Plan) -> jax.Array:
    """Stations [T] m of the rest of a plan, from 0 now, on the time axis.

    Cubic Hermite interpolation between the planned times; after the plan's end its
    last speed is kept.
    """
    t = plan.since + jnp.append(jnp.asarray(TIMES_S), 0.0)
    inside = _between(plan.s, plan.v, t)
    stations = inside + jnp.maximum(t - TIMES_S[-1], 0.0) * plan.v[-1]
    return stations[:-1] - stations[-1]


def path_at(plan: Plan, after: ArrayLike) -> jax.Array:
    """Offset m, dl and ddl 1/m [3, ...] of a plan's path some seconds [...] from now.

    Offsets by cubic Hermite interpolation between the planned times, the rest linearly;
    after the plan's end its last offset is kept.
    """
    assert plan.path is not None
    t = jnp.clip(plan.since + after, 0.0, TIMES_S[-1])
    low = jnp.minimum((t / DT_S).astype(jnp.int32), NUM_TIMES - 2)
    start, end = jnp.moveaxis(plan.path[:, low[..., None] + np.arange(2)], -1, 0)
    linear = start + (t / DT_S - low) * (end - start)
    l, dl, _ = plan.path
    return linear.at[0].set(_between(l, dl * plan.v, t))


def beside(plan: Plan, aside: jax.Array) -> Plan:
    """The same plan in a frame whose reference line lies `aside` [] m to the left."""
    if plan.path is None:
        return plan
    return plan.replace(path=plan.path.at[0].add(-aside))


def _between(x: jax.Array, rate: jax.Array, t: jax.Array) -> jax.Array:
    """Values [...] at times t [...] s of x [T] with its rate [T] per s."""
    place = jnp.clip(t / DT_S, 0.0, NUM_TIMES - 1.0)
    low = jnp.minimum(place.astype(jnp.int32), NUM_TIMES - 2)
    (start, end), rates = jnp.moveaxis(
        jnp.stack([x, rate])[:, low[..., None] + np.arange(2)], -1, 1
    )
    return hermite(place - low, start, end, tuple(rates), DT_S)


Tree = Any
PreviousPlan = tuple[
    Plan, Candidates
]  # the plan in force and its rest, a candidate [1]


def only_where(
    needed: jax.Array, make: Callable[..., Tree], otherwise: Tree, *args: Tree
) -> Tree:
    """`make(*args)` where `needed` [], else `otherwise`, like `lax.cond`.

    Under `vmap` a `lax.cond` computes both for every lane. Here a CPU makes the lanes
    that need it one by one; other devices make all of them at once.

    Args:
      needed: [] bool.
      make: pure; closes over no traced value.
      otherwise: a tree like that of `make`.
      *args: of `make`.
    """

    @custom_vmap
    def chosen(needed: jax.Array, otherwise: Tree, args: tuple) -> Tree:
        args = jax.tree.map(jnp.asarray, args)  # constants come as numpy's
        return jax.lax.cond(needed, lambda: make(*args), lambda: otherwise)

    @chosen.def_vmap
    def lanes(
        size: int, batched: Tree, needed: jax.Array, otherwise: Tree, args: tuple
    ) -> tuple[Tree, Tree]:
        spread = lambda x, is_batched: (  # noqa: E731
            x if is_batched else jnp.broadcast_to(x, (size, *jnp.shape(x)))
        )
        needed = spread(needed, batched[0])
        otherwise = jax.tree.map(spread, otherwise, batched[1])
        every = jax.tree.map(lambda _: True, otherwise)
        if jax.default_backend() != "cpu":
            axes = jax.tree.map(lambda x: 0 if x else None, batched[2])
            made = jax.vmap(make, axes, axis_size=size)(*args)
            return jax.vmap(either)(needed, made, otherwise), every

        order = jnp.argsort(~needed)

        def body(n: jax.Array, plans: Tree) -> Tree:
            lane = order[n]
            # constants come as numpy's
            here = lambda x, is_batched: x[lane] if is_batched else jnp.asarray(x)  # noqa: E731
            new = make(*jax.tree.map(here, args, batched[2]))
            return jax.tree.map(lambda old, one: old.at[lane].set(one), plans, new)

        return jax.lax.fori_loop(0, jnp.sum(needed), body, otherwise), every

    return chosen(needed, otherwise, args)


def either(yes: jax.Array | bool, one: Tree, other: Tree) -> Tree:
    """Leaf by leaf `one` where `yes` [], else `other`."""
    return jax.tree.map(lambda a, b: jnp.where(yes, a, b), one, other)


def rest_of(scene: Scene, before: Plan, config: SamplerConfig) -> Candidates:
    """The rest of the plan in force as a candidate [1]; infeasible if there is none."""
    stations = running_max(scene.ego.s + stations_from_now(before))
    if before.path is None:
        rest = trajectory_on_path(scene, stations)
    else:
        offsets = path_at(before, jnp.asarray(TIMES_S))[0].at[0].set(scene.ego.l)
        rest = trajectory_from_positions(scene, stations, offsets)
    return Candidates(
        trajectory=jax.tree.map(lambda x: x[None], rest),
        feasible=(before.lasts & within_limits(scene, rest, config))[None],
        family=jnp.asarray(family_index("in_force"))[None],
    )


def committed(
    replan: Callable[..., Plan],
    sampler: SamplerConfig,
    safety: SafetyConfig,
    commitment: float,
) -> Callable[..., Plan]:
    """A policy that keeps the plan in force while it may, and else plans by `replan`.

    It `steers` if its sampler varies paths: its plans then have one.

    Args:
      replan: `(params, scene, key, in_force) -> Plan`; `in_force` None at first.
      sampler: limits that the plan in force has to meet.
      safety: the filter that it has to pass.
      commitment: s for which a plan is kept.
    """
    replan = jax.jit(replan)  # traced once for one lane and for a batch

    def policy(
        params: Tree, scene: Scene, key: jax.Array, before: Plan | None = None
    ) -> Plan:
        if before is None:
            return replan(params, scene, key, None)
        rest = rest_of(scene, before, sampler)
        fine = check(scene, rest, safety).admissible[0]
        due = ~fine | (before.since_choice >= commitment)
        return only_where(due, replan, before, params, scene, key, (before, rest))

    vars(policy)["steers"] = sampler.mode == "path_speed"
    return policy
