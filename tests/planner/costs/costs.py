"""Own costs as users write them: of JAX, of numpy, and what is none."""

import jax.numpy as jnp
import numpy as np

from rcirl_jax.reward import lattice_costs

WEIGHTS = {"headway": 4.0, "offset": 0.5, "jerk": 0.02, "speed": 0.3}


def of(xp, scene, candidates):
    """Headway below 2 s, distance to the path, jerk, speed below the limit."""
    x, others = candidates.trajectory, scene.obstacles
    station = (x.s / 2.0).astype("int32").clip(0, scene.path.l.shape[0] - 1)
    own, limit = scene.path.l[station], scene.path.speed_limit[station]
    ahead = others.s_lower[None] - x.s[:, None] - 0.5 * scene.ego.length
    in_way = (others.l_lower[None] < x.l[:, None] + 1.0) & others.valid[None]
    in_way = in_way & (others.l_upper[None] > x.l[:, None] - 1.0) & (ahead > 0.0)
    gap = xp.where(in_way, ahead, 1e3).min(axis=1)
    headway = gap / xp.maximum(x.v, 1.0)
    terms = {
        "headway": xp.maximum(2.0 - headway, 0.0) ** 2,
        "offset": (x.l - own) ** 2,
        "jerk": x.j**2,
        "speed": xp.abs(limit - x.v),
    }
    return sum(WEIGHTS[name] * term.mean(axis=1) for name, term in terms.items())


def headway_cost(scene, candidates):
    return of(jnp, scene, candidates)


def seven_and_three(scene, candidates):
    return 7.0 * headway_cost(scene, candidates) + 3.0


def numpy_cost(scene, candidates):
    assert isinstance(np.asarray(scene.ego.v), np.ndarray)
    float(scene.ego.v)  # what JAX cannot trace
    return of(np, scene, candidates)


def copied(scene, candidates):
    """The embedded hand-set cost."""
    return lattice_costs(scene, candidates.trajectory)


def constant(scene, candidates):
    return 1.0 + 0.0 * candidates.trajectory.s[:, 0]


def nan(scene, candidates):
    return jnp.sqrt(-1.0 - candidates.trajectory.s[:, -1])


def one_too_few(scene, candidates):
    return headway_cost(scene, candidates)[:-1]


def endless(scene, candidates):
    while float(scene.ego.v) < 1e9:
        pass


def dies(scene, candidates):
    float(scene.ego.v)
    import os

    os._exit(9)
