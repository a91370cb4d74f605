"""From positions to a Trajectory: the one operator for human and candidate.

A learner that could tell the human by how its derivatives were made would
learn that, and nothing about driving. So nobody's analytic derivatives are
used: every trajectory enters as stations and lateral offsets on the time axis
and leaves with derivatives made here.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rcirl_jax.features.columns import (
    FIRST,
    differentiate,
    lateral_derivatives,
    path_view,
)
from rcirl_jax.types import Scene, Trajectory


def trajectory_from_positions(
    scene: Scene, s: Float[Array, " t"], l: Float[Array, " t"]
) -> Trajectory:
    """The Trajectory through stations `s` [T] m and lateral offsets `l` [T] m."""
    v, a, j = differentiate(s, scene.ego.v, scene.ego.a, scene.time_valid)
    dl, ddl = lateral_derivatives(s, l, scene.ego.dl, scene.ego.ddl)
    return Trajectory(s=s, v=v, a=a, j=j, l=l, dl=dl, ddl=ddl)


def trajectory_on_path(scene: Scene, s: Float[Array, " t"]) -> Trajectory:
    """The Trajectory with stations `s` [T] m on the scene's given path.

    l, dl and ddl are the path's own at the station (the ego's at t = 0), so
    each depends on the station alone: what Bellman's principle needs.
    """
    v, a, j = differentiate(s, scene.ego.v, scene.ego.a, scene.time_valid)
    view = path_view(scene, s)
    return Trajectory(
        s=s,
        v=v,
        a=a,
        j=j,
        l=view.l,
        dl=jnp.where(FIRST, scene.ego.dl, view.dl),
        ddl=jnp.where(FIRST, scene.ego.ddl, view.ddl),
    )


def running_max(x: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """Max over j <= i of x_j, along the last axis, reaching twice as far each time.

    A loop of its own for each doubling: fused, every one would make those before it
    again. On short axes that takes a fifth of the time of `lax.cummax`.
    """
    reach = 1
    while reach < x.shape[-1]:
        aside = [(0, 0)] * (x.ndim - 1) + [(reach, 0)]
        behind = jnp.pad(x[..., :-reach], aside, constant_values=-jnp.inf)
        x = jax.lax.optimization_barrier(jnp.maximum(x, behind))
        reach *= 2
    return x


def remaining_min(x: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """Min over j >= i of x_j, along the last axis."""
    return -running_max(-x[..., ::-1])[..., ::-1]
