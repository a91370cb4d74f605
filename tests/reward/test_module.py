"""The Flax module is the definition; parameters and the fast layout are its own."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.reward import (
    RewardConfig,
    effective_network,
    init_reward,
    init_tree,
    pinned,
    scenes_value,
    value,
)
from rcirl_jax.reward.module import point_module
from rcirl_jax.units import TIMES_S
from tests.reward.test_context import normaliser

FEATURES = feature_map("paper21")
F, T, B, K = 21, TIMES_S.size, 3, 5
CONFIGS = {
    "linear": {"hidden": ()},
    "paper": {},
    "deep, leaky": {"hidden": (8, 4), "activation": "leaky_relu"},
    "relu, free": {"activation": "relu", "pin": "none"},
    "nonnegative": {"hidden": (), "constraint": "nonnegative"},
    "monotone": {"constraint": "monotone", "signs": FEATURES.signs},
}


def config(name, by_context):
    context = FEATURES.context if by_context else ()
    return RewardConfig(**CONFIGS[name], context=context)


def drawn(config):
    params, rng = init_reward(jax.random.key(1), F, config), np.random.default_rng(1)
    add = lambda x: x + jnp.asarray(rng.normal(0.0, 0.3, x.shape), jnp.float32)  # noqa: E731
    return jax.tree.map(add, params)


def batch():
    rng = np.random.default_rng(2)
    x = jnp.asarray(rng.normal(0.0, 2.0, (B, K, T, F)), jnp.float32)
    # what the gains of a scene are made of is alike for all of its trajectories
    shared = jnp.where(jnp.asarray(FEATURES.context) > 0, x[:, :1, 0], x[:, :, 0])
    return x.at[:, :, 0].set(shared), jnp.arange(T) < jnp.array([[T], [11], [7]])


@pytest.mark.parametrize("by_context", [False, True])
@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("scenes", [1, B])
def test_the_fast_layout_is_the_module(name, by_context, scenes):
    """Values and gradients, of one scene at a time and of several."""
    made, (x, valid) = config(name, by_context), batch()
    x, valid = x[:scenes], valid[:scenes]

    def by_module(params):
        every = jnp.broadcast_to(valid[:, None], x.shape[:-1])
        return value(params, normaliser(), x, every, made)

    def fast(params):
        rows = jnp.moveaxis(x, 3, 1).swapaxes(2, 3)  # [B, F, T, K]
        parts, how = [rows[..., :1], rows[..., 1:]], made.hidden_activation
        found = scenes_value(pinned(params, made), normaliser(), parts, valid, how)
        return jnp.concatenate(found, axis=1)

    def both(form):
        def total(params):
            values = form(params)
            return jnp.sum(jnp.sin(values)), values

        return jax.jit(jax.grad(total, has_aux=True))(drawn(made))

    near = lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-5)  # noqa: E731
    jax.tree.map(near, both(fast), both(by_module))


@pytest.mark.parametrize("by_context", [False, True])
@pytest.mark.parametrize("name", CONFIGS)
def test_first_parameters_are_those_of_flax_but_for_the_draw(name, by_context):
    made = config(name, by_context)
    params = init_reward(jax.random.key(0), F, made)
    network, variables = effective_network(params, made)
    x = jnp.zeros((T, F))
    own = network.init(jax.random.key(0), x, jnp.ones(T, bool))
    shapes = lambda tree: jax.tree.map(jnp.shape, tree)  # noqa: E731
    assert shapes(own) == shapes(variables)
    if made.pin == "unit":
        return
    np.testing.assert_array_equal(own["params"]["gamma"], variables["params"]["gamma"])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("no_such_room:Reward", "No module named"),
        ("json:Reward", "no attribute"),
        ("json:JSONDecoder", "no flax.linen.Module"),
        ("tests.reward.others:Needy", "missing 1 required"),
        ("Reward", "expected package.module:Class"),
    ],
)
def test_a_module_that_is_none_is_one_line(name, words):
    with pytest.raises(InputError, match=rf"module: {name}.*{words}"):
        point_module(name)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Wide", r"\(2, 18, 3\) of \(2, 18, 21\): expected parameters only"),
        ("Stateful", r"\['batch_stats', 'params'\]"),
        ("Nameless", "pin: unit: expected none .* no last layer `out`"),
    ],
)
def test_a_module_of_another_signature_is_one_line(name, words):
    made = RewardConfig(module=f"tests.reward.others:{name}")
    with pytest.raises(InputError, match=words):
        init_tree(jax.random.key(0), F, made)
    if name == "Nameless":
        free = dataclasses.replace(made, pin="none")
        assert set(init_tree(jax.random.key(0), F, free)) == {"gamma", "point"}
    with pytest.raises(InputError, match="constraint: monotone: expected none"):
        dataclasses.replace(made, constraint="monotone")
