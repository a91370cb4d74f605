"""Pin and constraints: functions from raw parameters to those that are used."""

from typing import Any

import jax
import jax.numpy as jnp

from rcirl_jax.errors import InputError
from rcirl_jax.reward.config import RewardConfig
from rcirl_jax.types import RewardParams


def pinned(params: RewardParams, config: RewardConfig) -> RewardParams:
    """The effective parameters: signs constrained, then the scale pinned.

        gamma <- gamma / |gamma|_2
        W_out <- W_out / |W_out|_2
        for homogeneous activations also each hidden unit's [W; b] to unit norm

    The rank loss is positively homogeneous in the output layer (and through
    ReLUs in every layer): once the mean margin has the right sign it falls
    without bound by growing the weights. With the scale pinned, and with tanh
    units bounded by themselves, V is bounded and the loss measures ranking
    only. Every pin divides by a positive number, so it never changes an order.
    """
    params = _constrained(params, config)
    if config.context and params.context is not None:
        params = params.replace(context=_shared(params.context, config))
    if config.pin == "none" or config.constraint == "nonnegative":
        return params
    kernels, biases = list(params.kernels), list(params.biases)
    if config.activation != "tanh":
        for layer, bias in enumerate(biases):
            norm = jnp.sqrt(jnp.sum(kernels[layer] ** 2, axis=0) + bias**2 + 1e-12)
            kernels[layer], biases[layer] = kernels[layer] / norm, bias / norm
    kernels[-1] = _unit(kernels[-1])
    return params.replace(
        gamma=_unit(params.gamma), kernels=tuple(kernels), biases=tuple(biases)
    )


def pinned_tree(tree: dict[str, Any], config: RewardConfig) -> dict[str, Any]:
    """`pinned` for the parameters of a `ValueNetwork` around another R_theta.

    Its last layer has to be called `out`, for that is the kernel that is pinned. V is
    bounded if what that layer reads is (tanh units, say).

    Raises:
      InputError: a pin, and no layer `out` with a kernel.
    """
    if config.context:
        tree = {**tree, "context": _shared(tree["context"], config)}
    if config.pin == "none":
        return tree
    point = tree.get("point", {})
    if "kernel" not in point.get("out", {}):
        raise InputError(
            f"pin: {config.pin}: expected none with module={config.module}, which "
            "has no last layer `out`"
        )
    out = {**point["out"], "kernel": _unit(point["out"]["kernel"])}
    return {**tree, "gamma": _unit(tree["gamma"]), "point": {**point, "out": out}}


def _shared(context: jax.Array, config: RewardConfig) -> jax.Array:
    """C without its rows of features that candidates do not share at t = 0."""
    return jnp.asarray(config.context, jnp.float32)[:, None] * context


def _constrained(params: RewardParams, config: RewardConfig) -> RewardParams:
    """Parameters whose signs are those of the constraint.

    nonnegative  R = -sum_i u_i max(x_i, 0) + w_i max(-x_i, 0),  u, w >= 0: what
                 departs from the training median costs, each side at its own
                 weight; the form of Apollo's tuned cost before RC-IRL. Written
                 as a network with fixed first layer [I, -I] and ReLUs.
    monotone     first-layer rows of a signed feature have its sign, all later
                 kernels and gamma are non-negative. With tanh, an odd function,
                 non-negative output weights leave one hidden layer as free as
                 before in the unsigned features.
    """
    if config.constraint == "none":
        return params
    gamma = jnp.abs(params.gamma)
    if config.constraint == "nonnegative":
        costs = jnp.abs(params.kernels[0])
        if config.pin == "unit":
            gamma, costs = _unit(gamma), _unit(costs)
        eye = jnp.eye(costs.shape[0] // 2)
        return params.replace(
            gamma=gamma,
            kernels=(jnp.concatenate([eye, -eye], axis=1), -costs),
            biases=(jnp.zeros(costs.shape[0]),),
        )
    first, signs = params.kernels[0], jnp.asarray(config.signs)[:, None]
    first = jnp.where(signs == 0, first, signs * jnp.abs(first))
    later = tuple(jnp.abs(kernel) for kernel in params.kernels[1:])
    return params.replace(gamma=gamma, kernels=(first, *later))


def _unit(x: jax.Array) -> jax.Array:
    return x / jnp.sqrt(jnp.sum(x**2) + 1e-12)
