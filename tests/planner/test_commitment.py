"""Planning anew only where it is due: the same plans, lane by lane or all at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.planner.plan import only_where


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_only_lanes_that_need_it_are_made_again(backend, monkeypatch):
    """One by one on a CPU, all at once elsewhere."""
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    needed = jnp.asarray([True, False, True, False, False])
    old = {"a": jnp.arange(5.0), "b": jnp.zeros((5, 2))}
    offset = jnp.asarray(10.0)

    def make(x, shared):
        return {"a": x + shared, "b": jnp.stack([x, shared])}

    def one(need, before, x):
        return only_where(need, make, before, x, offset)

    got = jax.jit(jax.vmap(one))(needed, old, jnp.arange(5.0) * 2)
    np.testing.assert_array_equal(got["a"], [10, 1, 14, 3, 4])
    np.testing.assert_array_equal(got["b"], [[0, 10], [0, 0], [4, 10], [0, 0], [0, 0]])
    alone = one(jnp.asarray(True), jax.tree.map(lambda x: x[2], old), jnp.asarray(4.0))
    assert float(alone["a"]) == 14.0
    same = jax.vmap(one, in_axes=(None, 0, None))(True, old, jnp.asarray(1.0))
    np.testing.assert_array_equal(same["a"], [11] * 5)
