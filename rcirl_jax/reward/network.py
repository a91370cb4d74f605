"""The value functional: V(xi) = sum_t gamma_t R_theta(f_t).

R_theta maps one point's F normalised features to a reward and is shared by all
times; gamma is a free learnable vector, not an exponential (the paper, section
IV-A). `hidden = ()` is the linear reward, `(15,)` the paper's 21-15-1 network.
Human and candidate go through the same parameters (Siamese).
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rcirl_jax.errors import InputError
from rcirl_jax.reward.normaliser import normalise
from rcirl_jax.types import Normaliser, RewardParams
from rcirl_jax.units import NUM_TIMES

# products in float32 on accelerators too (not TF32), as the onboard reader makes them
EXACT = jax.lax.Precision.HIGHEST

UNITS = 8  # hidden units are worked off in multiples of so many
LEAKY_SLOPE = 0.01  # negative slope of the leaky-ReLU hidden activation

PINS = ("unit", "none")

CONSTRAINTS = ("none", "nonnegative", "monotone")

ACTIVATIONS = {
    "tanh": jnp.tanh,
    "relu": jax.nn.relu,
    "leaky_relu": lambda x: jax.nn.leaky_relu(x, LEAKY_SLOPE),
    "identity": lambda x: x,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Shape of the value network; hashable."""

    # units of each hidden layer; () is linear
    hidden: tuple[int, ...] = (15,)
    # key of ACTIVATIONS
    activation: str = "tanh"
    # "unit": output kernel and gamma have unit norm (see `pinned`); "none": free
    pin: str = "unit"
    # "nonnegative": weights of costs, `hidden` must be (); "monotone": `signs`
    constraint: str = "none"
    # per feature: 1 the reward may not fall with it, -1 may not rise, 0 free
    signs: tuple[int, ...] = ()
    # per feature: 1 if its value at t = 0 is part of the context that sets the
    # gains of all features (see `conditioned`); () for one reward in all scenes
    context: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Reject unknown names."""
        if self.activation not in ACTIVATIONS:
            raise InputError(
                f"--activation: {self.activation}: expected one of "
                f"{sorted(ACTIVATIONS)}"
            )
        if self.pin not in PINS:
            raise InputError(f"--pin: {self.pin}: expected one of {PINS}")
        if self.constraint not in CONSTRAINTS:
            raise InputError(
                f"--constraint: {self.constraint}: expected one of {CONSTRAINTS}"
            )
        if self.constraint == "nonnegative" and self.hidden:
            raise InputError(
                f"--hidden_size: {self.hidden}: expected 0 under "
                "--constraint=nonnegative, which is linear in its costs"
            )

    @property
    def hidden_activation(self) -> str:
        """Activation of the effective network (see `pinned`)."""
        if self.constraint == "nonnegative":
            return "relu"
        return self.activation if self.hidden else "identity"


def init_reward(
    key: jax.Array, num_features: int, config: RewardConfig
) -> RewardParams:
    """Random kernels (Glorot uniform), zero biases, equal gamma. Key consumed."""
    if config.context and len(config.context) != num_features:
        raise InputError(
            f"context: {len(config.context)} columns: expected {num_features}"
        )
    first = 2 * num_features if config.constraint == "nonnegative" else num_features
    sizes = (first, *config.hidden, 1)
    keys = jax.random.split(key, len(sizes) - 1)
    glorot = jax.nn.initializers.glorot_uniform()
    kernels = [
        glorot(k, (fan_in, fan_out), jnp.float32)
        for k, fan_in, fan_out in zip(keys, sizes[:-1], sizes[1:], strict=True)
    ]
    return RewardParams(
        gamma=jnp.full((NUM_TIMES,), NUM_TIMES**-0.5, jnp.float32),
        kernels=tuple(kernels),
        biases=tuple(jnp.zeros((h,), jnp.float32) for h in config.hidden),
        context=jnp.zeros((num_features,) * 2) if config.context else None,
    )


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
        mask = jnp.asarray(config.context, jnp.float32)[:, None]
        params = params.replace(context=mask * params.context)
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


def product(a: jax.Array, b: jax.Array) -> jax.Array:
    """The matrix product a b in float32 everywhere (see `EXACT`)."""
    return jnp.matmul(a, b, precision=EXACT)


def _unit(x: jax.Array) -> jax.Array:
    return x / jnp.sqrt(jnp.sum(x**2) + 1e-12)


def conditioned(
    params: RewardParams, x: Float[Array, "*batch t f"]
) -> Float[Array, "*batch t f"]:
    """Normalised features scaled by what the scene is like at t = 0.

        x_t <- g * x_t,   g = 2 sigmoid(x_0 C) in (0, 2)

    A gain never turns a feature's sign, so constraints on signs hold in every
    scene; C = 0 is the unconditioned reward. C's rows of features that the
    candidates of a scene do not share at t = 0 (jerk) are 0, so candidates are
    compared under one gain. Idea: situation-dependent weights (Rosbach et al.,
    arXiv 1912.03509).
    """
    if params.context is None:
        return x
    return x * gains(params.context, x[..., :1, :])


def gains(
    context: Float[Array, "f f"], x0: Float[Array, "*batch f"]
) -> Float[Array, "*batch f"]:
    """G = 2 sigmoid(x_0 C) from normalised features at t = 0."""
    return 2.0 * jax.nn.sigmoid(product(x0, context))


def point_rewards(
    params: RewardParams, x: Float[Array, "*batch f"], activation: str
) -> Float[Array, "*batch"]:
    """R_theta of normalised features, any leading axes.

    The points run along the long axis of every product: on a CPU the gradient
    takes two thirds of the time of the other order, and half when many members
    of a sweep look at the same points.
    """
    points = x.reshape(-1, x.shape[-1]).T
    offsets = (*params.biases, jnp.zeros((1,)))
    return _layers(params.kernels, offsets, points, activation).reshape(x.shape[:-1])


def _layers(
    kernels: Sequence[jax.Array],
    offsets: Sequence[jax.Array],
    points: Float[Array, "f n"],
    activation: str,
) -> Float[Array, "1 n"]:
    """The network on points that stand side by side.

    An offset is added as a product with ones, so that its gradient is one too: a
    sum along the points takes a CPU longer. Units of weight 0 fill up its vectors.
    """
    ones, before = jnp.ones((1, points.shape[1]), points.dtype), 0
    for kernel, offset in zip(kernels[:-1], offsets[:-1], strict=True):
        idle = -kernel.shape[1] % UNITS
        kernel = jnp.pad(kernel, ((0, before), (0, idle)))
        offset = jnp.pad(offset, (0, idle))
        moved = product(kernel.T, points) + product(offset[:, None], ones)
        points, before = ACTIVATIONS[activation](moved), idle
    out = jnp.pad(kernels[-1], ((0, before), (0, 0)))
    return product(out.T, points) + offsets[-1][:, None]


def rows_value(
    effective: RewardParams,
    normaliser: Normaliser,
    rows: Sequence[Float[Array, "t k"]],
    time_valid: Bool[Array, " t"],
    activation: str,
) -> Float[Array, " k"]:
    """V of all K candidates of a scene from features laid out row by row.

    Args:
      effective: pinned parameters (`pinned`, or a weights file's).
      normaliser: [F].
      rows: F arrays [T, K] of `FeatureMap.rows`.
      time_valid: [T].
      activation: key of ACTIVATIONS.
    """
    x, valid = jnp.stack(rows)[None], time_valid[None]
    (values,) = scenes_value(effective, normaliser, [x], valid, activation)
    return values[0]


def scenes_value(
    effective: RewardParams,
    normaliser: Normaliser,
    parts: Sequence[Float[Array, "b f t _"]],
    time_valid: Bool[Array, "b t"],
    activation: str,
) -> list[Float[Array, "b _"]]:
    """V of the candidates of B scenes, features before points, in several parts.

    The same sum as `value`: the points run along the long axis of every matrix
    product. On a CPU it takes a third of the time of `value`; least with one scene
    at a time, whose features stay in the cache. The parts (the candidates and the
    human) of one scene follow one another along that axis: a human between the
    candidates of every time would break each row of the copy. Parts of several
    scenes stand together at every time, so that devices which share the scenes
    keep their own. Points are normalised in that copy; in the first layer's weights
    instead, a feature that is the same everywhere would get a gradient from round-off.

    Args:
      effective: pinned parameters (`pinned`, or a weights file's).
      normaliser: [F].
      parts: in declared units; the first T times of gamma.
      time_valid: [B, T].
      activation: key of ACTIVATIONS.

    Returns:
      V of each part.
    """
    scenes, times = time_valid.shape
    counts = [part.shape[3] for part in parts]
    if scenes > 1:
        parts = [jnp.concatenate(parts, axis=3)]
    points = _side_by_side([jnp.moveaxis(part, 1, 0) for part in parts])
    points = jnp.clip(points, normaliser.lower[:, None], normaliser.upper[:, None])
    points = (points - normaliser.location[:, None]) * (1.0 / normaliser.scale)[:, None]
    spans = _spans([scenes * times * part.shape[3] for part in parts])
    if effective.context is not None:
        shapes = [(-1, scenes, times, part.shape[3]) for part in parts]
        apart = [
            points[:, begin:end].reshape(shape)
            for (begin, end), shape in zip(spans, shapes, strict=True)
        ]
        points = _side_by_side([_scaled(effective.context, x) for x in apart])
    offsets = (*effective.biases, jnp.zeros((1,)))
    rewards = _layers(effective.kernels, offsets, points, activation)[0]
    weight = jnp.where(time_valid, effective.gamma[:times], 0.0)
    # slices, not a split: its gradient would be joined anew for every hidden unit
    apart = [rewards[begin:end].reshape(scenes, times, -1) for begin, end in spans]
    values = [jnp.einsum("bt,btk->bk", weight, r, precision=EXACT) for r in apart]
    if scenes > 1:
        return [values[0][:, begin:end] for begin, end in _spans(counts)]
    return values


def _spans(sizes: Sequence[int]) -> list[tuple[int, int]]:
    """Where each of some lengths begins and ends, one after the other."""
    ends = np.cumsum(sizes).tolist()
    return [(end - size, end) for size, end in zip(sizes, ends, strict=True)]


def _side_by_side(parts: Sequence[Float[Array, "f b t _"]]) -> Float[Array, "f n"]:
    return jnp.concatenate([x.reshape(x.shape[0], -1) for x in parts], axis=1)


def _scaled(
    context: Float[Array, "f f"], x: Float[Array, "f b t k"]
) -> Float[Array, "f b t k"]:
    """As `conditioned`, features first."""
    gain = jnp.einsum("fg,fbk->gbk", context, x[:, :, 0], precision=EXACT)
    return x * 2.0 * jax.nn.sigmoid(gain)[:, :, None]


def value(
    params: RewardParams,
    normaliser: Normaliser,
    features: Float[Array, "*batch t f"],
    time_valid: Bool[Array, "*batch t"],
    config: RewardConfig,
) -> Float[Array, "*batch"]:
    """V(xi) = sum over valid t of gamma_t R(g * f_t); higher is better.

    The gains g are 1 unless the reward is conditioned (see `conditioned`).

    Args:
      params: raw parameters; the pin is applied here.
      normaliser: frozen, fitted on the training split.
      features: [..., T, F] in declared units; the first T times of gamma.
      time_valid: [..., T], shared by the trajectories that are compared.
      config: static.

    Returns:
      Value [...], no unit.
    """
    effective = pinned(params, config)
    x = conditioned(effective, normalise(normaliser, features))
    rewards = point_rewards(effective, x, config.hidden_activation)
    gamma = effective.gamma[: x.shape[-2]]
    return jnp.sum(jnp.where(time_valid, gamma * rewards, 0.0), axis=-1)
