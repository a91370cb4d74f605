"""From positions to a Trajectory: the one operator for human and candidate.

A learner that could tell the human by how its derivatives were made would
learn that, and nothing about driving. So nobody's analytic derivatives are
used: every trajectory enters as stations and lateral offsets on the time axis
and leaves with derivatives made here.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rcirl_jax.features.columns import path_view
from rcirl_jax.types import Scene, Trajectory
from rcirl_jax.units import DT_S, NUM_TIMES

FIRST = np.arange(NUM_TIMES) == 0  # [T]
LONG_AXIS, BLOCK = 32, 8  # points beyond which a running extremum works in blocks
MIN_ADVANCE_M = 1.0  # m between neighbours below which dl/ds is taken as 0


def differentiate(
    s: Float[Array, " t"],
    v0: Float[Array, ""],
    a0: Float[Array, ""],
    time_valid: Bool[Array, " t"],
) -> tuple[Float[Array, " t"], Float[Array, " t"], Float[Array, " t"]]:
    """Speed, acceleration and jerk of stations on the time axis.

        v_i = (s_{i+1} - s_{i-1}) / 2dt        v_0, a_0 given (the ego's state)
        a_i = (s_{i+1} - 2 s_i + s_{i-1}) / dt^2
        j_i = (a_i - a_{i-1}) / dt             j_0 = j_1

    At the last valid time there is no next point: a is carried over and v
    follows from it. Because the mask is shared by all trajectories of a scene,
    the operator is the same for all of them.

    Args:
      s: [T] m.
      v0: m/s at t = 0.
      a0: m/s^2 at t = 0.
      time_valid: [T] bool, a prefix of True with at least 3 entries.

    Returns:
      v [T] m/s, a [T] m/s^2, j [T] m/s^3. Beyond the last valid time they are
      finite and meaningless.
    """
    behind, ahead = _neighbours(s)
    has_next = jnp.concatenate([time_valid[1:], jnp.zeros_like(time_valid[:1])])
    central_a = jnp.where(FIRST, a0, (ahead - 2.0 * s + behind) / DT_S**2)
    carried_a, _ = _neighbours(central_a)
    a = jnp.where(has_next, central_a, carried_a)
    v = jnp.where(
        has_next, (ahead - behind) / (2.0 * DT_S), (s - behind) / DT_S + 0.5 * a * DT_S
    )
    v = jnp.where(FIRST, v0, v)
    step = (a[1:] - a[:-1]) / DT_S
    return v, a, jnp.concatenate([step[:1], step])


def lateral_derivatives(
    s: Float[Array, " t"],
    l: Float[Array, " t"],
    dl0: Float[Array, ""],
    ddl0: Float[Array, ""],
) -> tuple[Float[Array, " t"], Float[Array, " t"]]:
    """dl/ds and d2l/ds2 by divided differences over the neighbouring times.

    Where the car advances less than `MIN_ADVANCE_M` between the neighbours the
    derivative by station is not defined by positions and is set to 0.

    Args:
      s: [T] m.
      l: [T] m.
      dl0: dl/ds at t = 0.
      ddl0: 1/m, at t = 0.

    Returns:
      dl [T] (1) and ddl [T] (1/m).
    """
    advance = _spread(s)
    moves = advance > MIN_ADVANCE_M
    safe = jnp.where(moves, advance, 1.0)
    dl = jnp.where(FIRST, dl0, jnp.where(moves, _spread(l) / safe, 0.0))
    ddl = jnp.where(FIRST, ddl0, jnp.where(moves, _spread(dl) / safe, 0.0))
    return dl, ddl


def _neighbours(x: Float[Array, " t"]) -> tuple[Float[Array, " t"], Float[Array, " t"]]:
    """x_{i-1} and x_{i+1}; at the ends the end itself."""
    padded = jnp.concatenate([x[:1], x, x[-1:]])
    return padded[:-2], padded[2:]


def _spread(x: Float[Array, " t"]) -> Float[Array, " t"]:
    """x_{i+1} - x_{i-1}, one-sided at both ends."""
    behind, ahead = _neighbours(x)
    return ahead - behind


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
    """Max over j <= i of x_j, along the last axis.

    A few loops over all pairs within blocks: they compile to few kernels and are faster
    on short axes than `lax.cummax`, which halves and interleaves its operand.
    """
    size = x.shape[-1]
    if size > LONG_AXIS:
        blocks = -(-size // BLOCK)
        rest = [(0, 0)] * (x.ndim - 1) + [(0, blocks * BLOCK - size)]
        parts = jnp.pad(x, rest, constant_values=-jnp.inf)
        parts = running_max(parts.reshape(*x.shape[:-1], blocks, BLOCK))
        before = jnp.pad(
            running_max(parts[..., -1])[..., :-1],
            [(0, 0)] * (x.ndim - 1) + [(1, 0)],
            constant_values=-jnp.inf,
        )
        return jnp.maximum(parts, before[..., None]).reshape(*x.shape[:-1], -1)[
            ..., :size
        ]
    upto = np.triu(np.ones((size, size), bool))  # [j, i]: j <= i
    return jnp.max(jnp.where(upto, x[..., None], -jnp.inf), axis=-2)


def remaining_min(x: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """Min over j >= i of x_j, along the last axis."""
    return -running_max(-x[..., ::-1])[..., ::-1]
