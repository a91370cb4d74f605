"""The network of a configuration: its first parameters, and its value.

The package's own parameters are `RewardParams`, which weights files hold and `fast`
reads; those around a module of `RewardConfig.module` are Flax's own tree.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rcirl_jax.errors import InputError
from rcirl_jax.reward.config import RewardConfig
from rcirl_jax.reward.constraints import pinned, pinned_tree
from rcirl_jax.reward.module import (
    GLOROT,
    ValueNetwork,
    module_value,
    network_of,
    point_module,
    variables_of,
)
from rcirl_jax.types import Normaliser, Parameters, RewardParams
from rcirl_jax.units import NUM_TIMES


def init_reward(
    key: jax.Array, num_features: int, config: RewardConfig
) -> RewardParams:
    """Random kernels (Glorot uniform), zero biases, equal gamma. Key consumed.

    As `ValueNetwork.init`, but layer i draws from the i-th split of the key: seeds
    give the weights that they gave before there was a module.
    """
    _check_context(num_features, config)
    first = 2 * num_features if config.constraint == "nonnegative" else num_features
    sizes = (first, *config.hidden, 1)
    keys = jax.random.split(key, len(sizes) - 1)
    kernels = [
        GLOROT(k, (fan_in, fan_out), jnp.float32)
        for k, fan_in, fan_out in zip(keys, sizes[:-1], sizes[1:], strict=True)
    ]
    return RewardParams(
        gamma=jnp.full((NUM_TIMES,), NUM_TIMES**-0.5, jnp.float32),
        kernels=tuple(kernels),
        biases=tuple(jnp.zeros((h,), jnp.float32) for h in config.hidden),
        context=jnp.zeros((num_features,) * 2) if config.context else None,
    )


def init_tree(
    key: jax.Array, num_features: int, config: RewardConfig
) -> dict[str, Any]:
    """First parameters around `config.module`, as Flax draws them. Key consumed.

    Raises:
      InputError: no such module; it is not a pure function [..., F] -> [...] of
        parameters alone; or it cannot be pinned.
    """
    _check_context(num_features, config)
    network, x = _around(config), jnp.zeros((2, NUM_TIMES, num_features))
    try:
        rewards, made = jax.eval_shape(network.point.init_with_output, key, x)
    except (TypeError, ValueError) as error:
        raise InputError(f"module: {config.module}: {error}") from error
    if set(made) != {"params"} or rewards.shape != x.shape[:-1]:
        raise InputError(
            f"module: {config.module}: {sorted(made)}, {rewards.shape} of {x.shape}: "
            "expected parameters only, and a reward for each point"
        )
    tree = dict(network.init(key, x, jnp.ones(x.shape[:-1], bool))["params"])
    pinned_tree(tree, config)
    return tree


def effective_network(
    params: Parameters, config: RewardConfig
) -> tuple[ValueNetwork, dict[str, Any]]:
    """(module, variables) of raw parameters: constrained and pinned."""
    if isinstance(params, RewardParams):
        effective = pinned(params, config)
        network = network_of(effective, config.hidden_activation)
        return network, variables_of(effective)
    return _around(config), {"params": pinned_tree(params, config)}


def value(
    params: Parameters,
    normaliser: Normaliser,
    features: Float[Array, "*batch t f"],
    time_valid: Bool[Array, "*batch t"],
    config: RewardConfig,
) -> Float[Array, "*batch"]:
    """V(xi) = sum over valid t of gamma_t R(g * f_t) of `ValueNetwork`.

    Args:
      params: raw parameters; the pin is applied here.
      normaliser: frozen, fitted on the training split.
      features: [..., T, F] in declared units; the first T times of gamma.
      time_valid: [..., T], shared by the trajectories that are compared.
      config: static.

    Returns:
      Value [...], no unit; higher is better.
    """
    network, variables = effective_network(params, config)
    return module_value(network, variables, normaliser, features, time_valid)


def _around(config: RewardConfig) -> ValueNetwork:
    return ValueNetwork(
        point=point_module(config.module), by_context=bool(config.context)
    )


def _check_context(num_features: int, config: RewardConfig) -> None:
    if config.context and len(config.context) != num_features:
        raise InputError(
            f"context: {len(config.context)} columns: expected {num_features}"
        )
