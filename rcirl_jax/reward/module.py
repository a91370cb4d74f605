"""The definition of the value: V(xi) = sum_t gamma_t R_theta(g * f_t), in Flax.

R_theta maps one point's F normalised features to a reward and is shared by all
times; gamma is a free learnable vector, not an exponential (the paper, section
IV-A). Human and candidate go through the same parameters (Siamese). The package's
own R_theta is `PointReward`; any linen module [..., F] -> [...] can take its place.
`fast` computes the same for the package's own, in a layout that suits CPUs.
"""

import functools
import importlib
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rcirl_jax.errors import InputError
from rcirl_jax.reward.normaliser import normalise
from rcirl_jax.types import Normaliser, RewardParams
from rcirl_jax.units import NUM_TIMES

# products in float32 on accelerators too (not TF32), as the onboard reader makes them
EXACT = jax.lax.Precision.HIGHEST

LEAKY_SLOPE = 0.01  # negative slope of the leaky-ReLU hidden activation

ACTIVATIONS = {
    "tanh": jnp.tanh,
    "relu": jax.nn.relu,
    "leaky_relu": lambda x: jax.nn.leaky_relu(x, LEAKY_SLOPE),
    "identity": lambda x: x,
}

GLOROT = jax.nn.initializers.glorot_uniform()


class PointReward(nn.Module):
    """R_theta, an MLP: r = W_out h_n,  h_i = act(W_i h_(i-1) + b_i),  h_0 = x.

    `hidden = ()` is the linear reward, `(15,)` the paper's 21-15-1 network. There is
    no output bias: it cancels between trajectories.
    """

    hidden: tuple[int, ...] = (15,)  # units of each hidden layer
    activation: str = "tanh"  # key of ACTIVATIONS

    @nn.compact
    def __call__(self, x: Float[Array, "*batch f"]) -> Float[Array, "*batch"]:
        """Reward of each point of normalised features."""
        for i, units in enumerate(self.hidden):
            dense = nn.Dense(
                units, precision=EXACT, kernel_init=GLOROT, name=f"hidden_{i}"
            )
            x = ACTIVATIONS[self.activation](dense(x))
        out = nn.Dense(
            1, use_bias=False, precision=EXACT, kernel_init=GLOROT, name="out"
        )
        return out(x)[..., 0]


class ValueNetwork(nn.Module):
    """V = sum over valid t of gamma_t R_theta(g * x_t); higher is better.

    Its parameters: gamma [T], `point` those of R_theta, and by context C [F, F].
    """

    point: nn.Module  # R_theta: [..., F] -> [...]
    by_context: bool = False  # g = `gains` of the features at t = 0; else g = 1
    times: int = NUM_TIMES  # T

    @nn.compact
    def __call__(
        self, x: Float[Array, "*batch t f"], time_valid: Bool[Array, "*batch t"]
    ) -> Float[Array, "*batch"]:
        """Value of trajectories.

        Args:
          x: normalised features at the first t of the T times.
          time_valid: shared by the trajectories that are compared.

        Returns:
          Value [...], no unit.
        """
        equal = jax.nn.initializers.constant(self.times**-0.5)
        gamma = self.param("gamma", equal, (self.times,))[: x.shape[-2]]
        if self.by_context:
            zeros, shape = jax.nn.initializers.zeros, (x.shape[-1],) * 2
            x = conditioned(self.param("context", zeros, shape), x)
        return jnp.sum(jnp.where(time_valid, gamma * self.point(x), 0.0), axis=-1)


def module_value(
    network: ValueNetwork,
    variables: dict[str, Any],
    normaliser: Normaliser,
    features: Float[Array, "*batch t f"],
    time_valid: Bool[Array, "*batch t"],
) -> Float[Array, "*batch"]:
    """V [...] of features in declared units; `variables` as Flax has them."""
    x = normalise(normaliser, features)
    return jnp.asarray(network.apply(variables, x, time_valid))


def product(a: jax.Array, b: jax.Array) -> jax.Array:
    """The matrix product a b in float32 everywhere (see `EXACT`)."""
    return jnp.matmul(a, b, precision=EXACT)


def gains(
    context: Float[Array, "f f"], x0: Float[Array, "*batch f"]
) -> Float[Array, "*batch f"]:
    """G = 2 sigmoid(x_0 C) in (0, 2), from normalised features at t = 0.

    A gain never turns a feature's sign, so constraints on signs hold in every
    scene; C = 0 is the unconditioned reward. C's rows of features that the
    candidates of a scene do not share at t = 0 (jerk) are 0, so candidates are
    compared under one gain. Idea: situation-dependent weights (Rosbach et al.,
    arXiv 1912.03509).
    """
    return 2.0 * jax.nn.sigmoid(product(x0, context))


def conditioned(
    context: Float[Array, "f f"] | None, x: Float[Array, "*batch t f"]
) -> Float[Array, "*batch t f"]:
    """x_t <- g * x_t with the gains of the scene; without a context x itself."""
    return x if context is None else x * gains(context, x[..., :1, :])


@functools.lru_cache(maxsize=16)
def point_module(name: str) -> nn.Module:
    """R_theta by its "package.module:Class", with the class's own default fields.

    Importing a module runs its code: as safe as the file that names it.

    Raises:
      InputError: no such class, none of Flax's modules, or fields without default.
    """
    where, _, kind = name.partition(":")
    try:
        found = getattr(importlib.import_module(where), kind)
        if issubclass(found, nn.Module):
            return found()
        reason = "no flax.linen.Module"
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        reason = str(error)
    raise InputError(
        f"module: {name}: {reason}: expected package.module:Class of a linen module "
        "whose fields have defaults"
    )


def network_of(effective: RewardParams, activation: str) -> ValueNetwork:
    """The module that effective parameters (`pinned`) of that activation belong to."""
    hidden = tuple(kernel.shape[1] for kernel in effective.kernels[:-1])
    return ValueNetwork(
        point=PointReward(hidden=hidden, activation=activation),
        by_context=effective.context is not None,
        times=effective.gamma.shape[0],
    )


def variables_of(params: RewardParams) -> dict[str, Any]:
    """The package's parameters as Flax's tree: {"params": {"gamma", "point", ...}}."""
    layers = zip(params.kernels[:-1], params.biases, strict=True)
    point: dict[str, Any] = {
        f"hidden_{i}": {"kernel": kernel, "bias": bias}
        for i, (kernel, bias) in enumerate(layers)
    }
    point["out"] = {"kernel": params.kernels[-1]}
    more = {} if params.context is None else {"context": params.context}
    return {"params": {"gamma": params.gamma, "point": point, **more}}
