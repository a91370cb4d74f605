"""Keep a plan for a while, and plan again only when that is necessary.

    kept while   admissible now,  chosen less than `commitment` ago

Otherwise the best of all candidates is chosen, the rest of the plan among them. Keeping
a plan costs the check of one trajectory, choosing one the values of 65. `only_where`
skips that work for the cases of a batch that keep their plan, which makes a closed loop
several times faster.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from rcirl_jax.planner.plan import Plan, stations_from_now
from rcirl_jax.planner.safety import SafetyConfig, check
from rcirl_jax.sampling import SamplerConfig, trajectory_on_path
from rcirl_jax.sampling.kinematics import running_max
from rcirl_jax.sampling.sampler import family_index, within_limits
from rcirl_jax.types import Candidates, Scene

Tree = Any
InForce = tuple[Plan, Candidates]  # the plan in force and its rest, a candidate [1]


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
            return jax.vmap(_either)(needed, made, otherwise), every

        order = jnp.argsort(~needed)

        def body(n: jax.Array, plans: Tree) -> Tree:
            lane = order[n]
            # constants come as numpy's
            here = lambda x, is_batched: x[lane] if is_batched else jnp.asarray(x)  # noqa: E731
            new = make(*jax.tree.map(here, args, batched[2]))
            return jax.tree.map(lambda old, one: old.at[lane].set(one), plans, new)

        return jax.lax.fori_loop(0, jnp.sum(needed), body, otherwise), every

    return chosen(needed, otherwise, args)


def _either(yes: jax.Array, one: Tree, other: Tree) -> Tree:
    return jax.tree.map(lambda a, b: jnp.where(yes, a, b), one, other)


def rest_of(scene: Scene, before: Plan, config: SamplerConfig) -> Candidates:
    """The rest of the plan in force as a candidate [1]; infeasible if there is none."""
    stations = running_max(scene.ego.s + stations_from_now(before))
    rest = trajectory_on_path(scene, stations)
    return Candidates(
        trajectory=jax.tree.map(lambda x: x[None], rest),
        feasible=(before.lasts & within_limits(scene, rest, config))[None],
        family=jnp.asarray(family_index("in_force"))[None],
    )


def committed(
    anew: Callable[..., Plan],
    sampler: SamplerConfig,
    safety: SafetyConfig,
    commitment: float,
) -> Callable[..., Plan]:
    """A policy that keeps the plan in force while it may, and else plans by `anew`.

    Args:
      anew: `(params, scene, key, in_force) -> Plan`, `in_force` None before the first.
      sampler: limits that the plan in force has to meet.
      safety: the filter that it has to pass.
      commitment: s for which a plan is kept.
    """
    anew = jax.jit(anew)  # traced once for one lane and for a batch

    def policy(
        params: Tree, scene: Scene, key: jax.Array, before: Plan | None = None
    ) -> Plan:
        if before is None:
            return anew(params, scene, key, None)
        rest = rest_of(scene, before, sampler)
        fine = check(scene, rest, safety).admissible[0]
        due = ~fine | (before.since_choice >= commitment)
        return only_where(due, anew, before, params, scene, key, (before, rest))

    return policy
