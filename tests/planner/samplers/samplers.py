"""Candidates as a user gives them, good and bad."""

import jax.numpy as jnp
import numpy as np

from rcirl_jax.units import TIMES_S


def steady(scene, key, count=9):
    """Constant accelerations until standing, as many metres aside as times go by."""
    del key
    a = jnp.linspace(-2.0, 1.5, count)[:, None]
    until = jnp.where(a < 0.0, jnp.minimum(TIMES_S, scene.ego.v / -a), TIMES_S)
    return scene.ego.s + scene.ego.v * until + 0.5 * a * until**2


def aside(scene, key):
    s = steady(scene, key)
    return s, scene.ego.l + 0.1 * TIMES_S + jnp.zeros_like(s)


def numpy_one(scene, key):
    return np.asarray(steady(scene, key))


def short(scene, key):
    return steady(scene, key)[:, :-1]


def not_finite(scene, key):
    return steady(scene, key).at[2, 5].set(jnp.nan)


def alike(scene, key):
    return steady(scene, key)[:2] * 0.0 + steady(scene, key)[5]


def always_fast(scene, key):
    return steady(scene, key) + 30.0 * TIMES_S
