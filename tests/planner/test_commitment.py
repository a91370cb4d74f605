"""Planning anew only where it is due: the same plans, lane by lane or all at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.planner.plan import later, no_plan, only_where
from rcirl_jax.planner.rank import RankConfig, hand_score, rank_policy
from tests.helpers.scenes import random_scene


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


def test_a_batch_of_lanes_plans_as_each_does_alone():
    scenes = [jax.tree.map(jnp.asarray, random_scene(seed)) for seed in range(6)]
    keys = jax.random.split(jax.random.key(0), 6)
    policy = rank_policy(hand_score, RankConfig())
    alone = jax.jit(policy)
    first = [alone(None, s, k, no_plan()) for s, k in zip(scenes, keys, strict=True)]
    # due, young, due ...: some keep their plan, some do not
    aged = [later(plan, 1.2 if i % 2 else 0.3) for i, plan in enumerate(first)]
    stack = lambda many: jax.tree.map(lambda *x: jnp.stack(x), *many)  # noqa: E731
    together = jax.jit(jax.vmap(policy, in_axes=(None, 0, 0, 0)))(
        None, stack(scenes), keys, stack(aged)
    )
    for i, (scene, key, before) in enumerate(zip(scenes, keys, aged, strict=True)):
        expected = alone(None, scene, key, before)
        got = jax.tree.map(lambda x, i=i: x[i], together)
        np.testing.assert_allclose(got.s, expected.s, atol=1e-2)
        assert float(got.since_choice) == float(expected.since_choice)
    assert float(together.since_choice.min()) == 0.0
    assert float(together.since_choice.max()) > 0.0
