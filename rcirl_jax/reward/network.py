"""The learned reward: one Flax module for training, planner, evaluation and export.

    V(xi) = sum over valid t of gamma_t R_theta(g * x_t),   x = normalised features

R_theta maps one point's F normalised features to a reward and is shared by all times;
gamma is a free learnable vector, not an exponential (the paper, section IV-A). Human
and candidate go through the same parameters (Siamese).

A scene's features are [F, T, K]: points run along the long axes of every matrix
product, which takes a CPU a third of the time of [K, T, F]. The parameters are

    gamma         [T]
    point         of R_theta: {hidden_0: {kernel [F, H], bias [H]}, ..., out: {kernel}}
    scene_gating  [F, F] C, if the scene sets the gates g
    offset        [] the discriminator's threshold, of the GAN loss only; ranks nothing
    log_beta      [] of V_total = beta own + V, where V is a residual on an own cost
    log_scale     [] of weights of own terms, whose kernel is a logarithm too

There is no output bias: it cancels between trajectories. Training changes raw
parameters; `effective_params` are what V is made of, and what weights files hold.
"""

import dataclasses
import functools
import importlib
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rcirl_jax.errors import InputError
from rcirl_jax.reward.normaliser import identity_normaliser
from rcirl_jax.types import Normaliser, RewardParams
from rcirl_jax.units import NUM_TIMES

# products in float32 on accelerators too (not TF32), as the onboard reader makes them
EXACT = jax.lax.Precision.HIGHEST
UNITS = 8  # hidden units are worked off in multiples of so many
LEAKY_SLOPE = 0.01  # negative slope of the leaky-ReLU hidden activation

ACTIVATIONS = {
    "tanh": jnp.tanh,
    "relu": jax.nn.relu,
    "leaky_relu": lambda x: jax.nn.leaky_relu(x, LEAKY_SLOPE),
    "identity": lambda x: x,
}
SCALE_CONSTRAINTS = ("unit", "none")
CONSTRAINTS = ("none", "nonnegative", "monotone", "terms")
GLOROT = jax.nn.initializers.glorot_uniform()


@dataclasses.dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Shape of the reward; hashable."""

    # units of each hidden layer; () is linear
    hidden: tuple[int, ...] = (15,)
    # key of ACTIVATIONS
    activation: str = "tanh"
    # "unit": output kernel and gamma have unit norm (see `effective_params`); "none"
    scale_constraint: str = "unit"
    # "nonnegative": weights of costs, `hidden` must be (); "monotone": `signs`;
    # "terms": weights of own terms, from `today` on, `hidden` must be ()
    constraint: str = "none"
    # per feature: weight > 0 with which an own term drives today
    today: tuple[float, ...] = ()
    # per feature: 1 the reward may not fall with it, -1 may not rise, 0 free
    signs: tuple[int, ...] = ()
    # per feature: 1 if its value at t = 0 is part of the scene that sets the gates of
    # all features (see `feature_gates`); () for one reward in all scenes
    scene_gating: tuple[int, ...] = ()
    # "package.module:Class", a linen module [..., F] -> [...] that is R_theta in the
    # place of `hidden` and `activation` (see `user_module`); "": the package's own
    module: str = ""

    def __post_init__(self) -> None:
        """Reject unknown names."""
        if self.activation not in ACTIVATIONS:
            raise InputError(
                f"activation: {self.activation}: expected one of {sorted(ACTIVATIONS)}"
            )
        if self.scale_constraint not in SCALE_CONSTRAINTS:
            raise InputError(
                f"scale_constraint: {self.scale_constraint}: expected one of "
                f"{SCALE_CONSTRAINTS}"
            )
        if self.constraint not in CONSTRAINTS:
            raise InputError(
                f"constraint: {self.constraint}: expected one of {CONSTRAINTS}"
            )
        if self.constraint in ("nonnegative", "terms") and self.hidden:
            raise InputError(
                f"hidden: {self.hidden}: expected 0 under "
                f"constraint={self.constraint}, which is linear in its costs"
            )
        if self.constraint == "terms" and not self.today:
            raise InputError(
                "constraint: terms: expected own terms as features, FILE.py:NAME"
            )
        if self.constraint != "none" and self.module:
            raise InputError(
                f"constraint: {self.constraint}: expected none with module, of "
                "whose weights nothing is known"
            )

    def check_own(self) -> None:
        """Check that R_theta is the package's own.

        Raises:
          InputError: it is another module, which weights.msgpack cannot hold.
        """
        if self.module:
            raise InputError(
                f"module: {self.module}: expected none: weights.msgpack, and all "
                "that reads it, holds the package's own network; for others there are "
                "`rcirl train` and `rcirl export --stablehlo`"
            )

    @property
    def hidden_activation(self) -> str:
        """Activation of the effective network."""
        if self.constraint == "nonnegative":
            return "relu"
        return self.activation if self.hidden else "identity"


class RewardModel(nn.Module):
    """V of the trajectories of one scene; `jax.vmap` takes several scenes."""

    config: RewardConfig = RewardConfig()
    times: int = NUM_TIMES  # T

    @nn.compact
    def __call__(
        self,
        normaliser: Normaliser,
        time_valid: Bool[Array, " t"],
        *sets: Float[Array, "f t _"],
    ) -> tuple[Float[Array, " _"], ...]:
        """Values the trajectories of a scene, in one pass through the same weights.

        Args:
          normaliser: [F], frozen, fitted on the training split.
          time_valid: [T], shared by the trajectories that are compared.
          *sets: [F, T, K] each, features of K trajectories in declared units, at the
            first T of `times`; e.g. of the human (K = 1) and of the candidates.

        Returns:
          V [K] of each set, no unit; higher is better.
        """
        config, (count, times, _) = self.config, sets[0].shape
        equal, zeros = nn.initializers.constant(self.times**-0.5), nn.initializers.zeros
        raw = {
            "gamma": self.param("gamma", equal, (self.times,)),
            "point": self.param("point", functools.partial(_first, config), count),
        }
        if config.scene_gating:
            raw["scene_gating"] = self.param("scene_gating", zeros, (count, count))
        if config.constraint == "terms":
            raw["log_scale"] = self.param("log_scale", zeros, ())
        params = effective_params(raw, config)
        # Sets follow one another along the points: a human between the candidates of
        # every time would break each row of the copy.
        x = jnp.concatenate([one.reshape(count, -1) for one in sets], axis=1)
        x = normalise_rows(normaliser, x)
        # all trajectories of a scene share what its gates read at t = 0
        gates = (
            feature_gates(params["scene_gating"], x[:, 0])
            if config.scene_gating
            else None
        )
        if config.module:
            x = x if gates is None else x * gates[:, None]
            variables = {"params": params["point"]}
            rewards = cast(jax.Array, user_module(config.module).apply(variables, x.T))
        else:
            rewards = point_reward(params["point"], gates, x, config.hidden_activation)
        weight = jnp.where(time_valid, params["gamma"][:times], 0.0)
        ends = np.cumsum([one[0].size for one in sets]).tolist()
        # slices, not a split: its gradient would be joined anew for every hidden unit
        parts = (
            rewards[end - one[0].size : end]
            for one, end in zip(sets, ends, strict=True)
        )
        return tuple(
            jnp.einsum("t,tk->k", weight, part.reshape(times, -1), precision=EXACT)
            for part in parts
        )


def normalise_rows(
    normaliser: Normaliser, features: Float[Array, "f n"]
) -> Float[Array, "f n"]:
    """Clips and scales features that stand row by row; see `normaliser.normalise`."""
    columns = jax.tree.map(lambda x: x[:, None], normaliser)
    clipped = jnp.clip(features, columns.lower, columns.upper)
    return (clipped - columns.location) * (1.0 / columns.scale)


def feature_gates(
    scene_gating: Float[Array, "f f"], x0: Float[Array, " f"]
) -> Float[Array, " f"]:
    """Returns g = 2 sigmoid(C^T x_0) in (0, 2), from normalised features at t = 0.

    A gate never turns a feature's sign, so constraints on signs hold in every scene;
    C = 0 is the ungated reward. C's rows of features that the candidates of a scene do
    not share at t = 0 (jerk) are 0 in `effective_params`, so candidates are compared
    under one gate. Idea: situation-dependent weights (Rosbach et al., arXiv
    1912.03509).
    """
    return 2.0 * jax.nn.sigmoid(matmul_f32(scene_gating.T, x0))


def point_reward(
    point: RewardParams,
    gates: Float[Array, " f"] | None,
    x: Float[Array, "f n"],
    activation: str,
) -> Float[Array, " n"]:
    """R_theta of n points: r = W_out h_n,  h_i = act(W_i h_(i-1) + b_i),  h_0 = g * x.

    `hidden = ()` is the linear reward, `(15,)` the paper's 21-15-1 network. Gates stand
    in the first kernel, so that the points need no copy of their own.
    """
    kernels, biases = layers_of(point)
    if gates is not None:
        kernels = [kernels[0] * gates[:, None], *kernels[1:]]
    # On a CPU a bias as a product with ones has a matrix product as its gradient too,
    # where a sum along the points takes longer. Idle units fill up the vectors.
    ones, before = jnp.ones((1, x.shape[1]), x.dtype), 0
    for kernel, bias in zip(kernels[:-1], biases, strict=True):
        idle = -kernel.shape[1] % UNITS
        kernel = jnp.pad(kernel, ((0, before), (0, idle)))
        bias = jnp.pad(bias, (0, idle))[:, None]
        moved = matmul_f32(kernel.T, x) + matmul_f32(bias, ones)
        x, before = ACTIVATIONS[activation](moved), idle
    return matmul_f32(jnp.pad(kernels[-1], ((0, before), (0, 0))).T, x)[0]


def layers_of(point: RewardParams) -> tuple[list[Any], list[Any]]:
    """Returns (kernels [F, H1], ..., [H, 1]; biases [H1], ...) of `params["point"]`."""
    hidden = [point[f"hidden_{i}"] for i in range(len(point) - 1)]
    kernels = [*(layer["kernel"] for layer in hidden), point["out"]["kernel"]]
    return kernels, [layer["bias"] for layer in hidden]


def point_of(kernels: list[Any], biases: list[Any]) -> RewardParams:
    """Returns `params["point"]` of kernels and biases; the inverse of `layers_of`."""
    pairs = zip(kernels[:-1], biases, strict=True)
    hidden = {
        f"hidden_{i}": {"kernel": kernel, "bias": bias}
        for i, (kernel, bias) in enumerate(pairs)
    }
    return {**hidden, "out": {"kernel": kernels[-1]}}


def effective_params(raw: RewardParams, config: RewardConfig) -> dict[str, Any]:
    """Returns the parameters that V is made of: signs constrained, then scale fixed.

        gamma <- gamma / |gamma|_2
        W_out <- W_out / |W_out|_2
        for homogeneous activations also each hidden unit's [W; b] to unit norm

    The rank loss is positively homogeneous in the output layer (and through ReLUs in
    every layer): once the mean margin has the right sign it falls without bound by
    growing the weights. With the scale fixed, and with tanh units bounded by
    themselves, V is bounded and the loss measures ranking only. Every norm is a
    positive number, so it never changes an order. Of a module of `--module` the last
    layer has to be called `out`.

    Raises:
      InputError: a fixed scale, and a module without a layer `out`.
    """
    params = _constrained(dict(raw), config)
    if config.scene_gating:
        # C without its rows of features that candidates do not share at t = 0
        shared = jnp.asarray(config.scene_gating, jnp.float32)[:, None]
        params["scene_gating"] = shared * params["scene_gating"]
    if config.scale_constraint == "none" or config.constraint in (
        "nonnegative",
        "terms",
    ):
        return params
    point = dict(params["point"])
    if config.module and "kernel" not in point.get("out", {}):
        raise InputError(
            f"scale_constraint: {config.scale_constraint}: expected none with "
            f"module={config.module}, which has no last layer `out`"
        )
    if not config.module and config.activation != "tanh":
        for name in point.keys() - {"out"}:
            layer = point[name]
            norm = jnp.sum(layer["kernel"] ** 2, axis=0) + layer["bias"] ** 2
            norm = jnp.sqrt(norm + 1e-12)
            point[name] = jax.tree.map(lambda x, norm=norm: x / norm, layer)
    point["out"] = {**point["out"], "kernel": _unit(point["out"]["kernel"])}
    return {**params, "gamma": _unit(params["gamma"]), "point": point}


def _constrained(params: dict[str, Any], config: RewardConfig) -> dict[str, Any]:
    """Returns parameters whose signs are those of the constraint.

    nonnegative  R = -sum_i u_i max(x_i, 0) + w_i max(-x_i, 0),  u, w >= 0: what
                 departs from the training median costs, each side at its own
                 weight; the form of Apollo's tuned cost before RC-IRL. Written
                 as a network with fixed first layer [I, -I] and ReLUs.
    monotone     first-layer rows of a signed feature have its sign, all later
                 kernels and gamma are non-negative. With tanh, an odd function,
                 non-negative output weights leave one hidden layer as free as
                 before in the unsigned features.
    terms        R = -sum_i w_i f_i,  w_i = scale today_i exp(theta_i): costs with the
                 weights of today where theta = 0, to which weight decay pulls them;
                 never negative. All times count alike, as in the planner. The scale
                 is learned, or such that the mean of exp(theta) is 1.
    """
    if config.constraint == "none":
        return params
    if config.constraint == "terms":
        ratio = jnp.exp(params["point"]["out"]["kernel"][:, 0])
        scale = jnp.exp(params.pop("log_scale"))
        if config.scale_constraint == "unit":
            scale = 1.0 / jnp.mean(ratio)
        weights = scale * jnp.asarray(config.today, jnp.float32) * ratio
        gamma = jnp.full_like(params["gamma"], 1.0 / params["gamma"].shape[0])
        return {**params, "gamma": gamma, "point": point_of([-weights[:, None]], [])}
    gamma = jnp.abs(params["gamma"])
    kernels, biases = layers_of(params["point"])
    if config.constraint == "nonnegative":
        costs = jnp.abs(kernels[0])
        if config.scale_constraint == "unit":
            gamma, costs = _unit(gamma), _unit(costs)
        eye = jnp.eye(costs.shape[0] // 2)
        kernels = [jnp.concatenate([eye, -eye], axis=1), -costs]
        biases = [jnp.zeros(costs.shape[0])]
    else:
        signs = jnp.asarray(config.signs)[:, None]
        first = jnp.where(signs == 0, kernels[0], signs * jnp.abs(kernels[0]))
        kernels = [first, *(jnp.abs(kernel) for kernel in kernels[1:])]
    return {**params, "gamma": gamma, "point": point_of(kernels, biases)}


def _unit(x: jax.Array) -> jax.Array:
    return x / jnp.sqrt(jnp.sum(x**2) + 1e-12)


def _first(config: RewardConfig, key: jax.Array, count: int) -> RewardParams:
    """First parameters of R_theta: Glorot uniform kernels, zero biases.

    Own terms begin with the weights of today.
    """
    if config.constraint == "terms":
        return point_of([jnp.zeros((count, 1))], [])
    if config.module:
        x = jnp.zeros((2, NUM_TIMES, count))
        return dict(user_module(config.module).init(key, x)["params"])
    sides = 2 if config.constraint == "nonnegative" else 1
    sizes = (sides * count, *config.hidden, 1)
    keys = jax.random.split(key, len(sizes) - 1)
    pairs = zip(keys, sizes[:-1], sizes[1:], strict=True)
    kernels = [GLOROT(key, (fan_in, out), jnp.float32) for key, fan_in, out in pairs]
    return point_of(kernels, [jnp.zeros((units,)) for units in config.hidden])


def init_params(
    key: jax.Array, num_features: int, config: RewardConfig
) -> dict[str, Any]:
    """Draws first parameters by the module's own `init`. Key consumed.

    Raises:
      InputError: gating columns of another number of features, or a `module` that is
        none, is not a pure function [..., F] -> [...] of parameters alone, or whose
        scale cannot be fixed.
    """
    if config.scene_gating and len(config.scene_gating) != num_features:
        raise InputError(
            f"scene_gating: {len(config.scene_gating)} columns: expected {num_features}"
        )
    if config.module:
        _check_module(config.module, num_features)
    normaliser = identity_normaliser(num_features)
    x, valid = jnp.zeros((num_features, NUM_TIMES, 1)), jnp.ones((NUM_TIMES,), bool)
    return dict(RewardModel(config).init(key, normaliser, valid, x)["params"])


def effective_model(params: RewardParams, activation: str) -> RewardModel:
    """Returns the module whose parameters are effective ones, as weights files hold."""
    kernels, _ = layers_of(params["point"])
    config = RewardConfig(
        hidden=tuple(kernel.shape[1] for kernel in kernels[:-1]),
        activation=activation,
        scale_constraint="none",
        scene_gating=(1,) * kernels[0].shape[0] if "scene_gating" in params else (),
    )
    return RewardModel(config, times=params["gamma"].shape[0])


def scene_values(
    model: RewardModel,
    params: RewardParams,
    normaliser: Normaliser,
    time_valid: Bool[Array, " t"],
    *sets: Float[Array, "f t _"],
) -> tuple[jax.Array, ...]:
    """V [K] of each set of a scene's trajectories, as `RewardModel` takes them."""
    found = model.apply({"params": params}, normaliser, time_valid, *sets)
    return cast("tuple[jax.Array, ...]", found)


def value(
    model: RewardModel,
    params: RewardParams,
    normaliser: Normaliser,
    features: Float[Array, "*n t f"],
    time_valid: Bool[Array, "*n t"],
) -> Float[Array, "*n"]:
    """V of trajectories each with a mask of its own, features last.

    Args:
      model: the reward's module.
      params: its parameters.
      normaliser: [F].
      features: [..., T, F] in declared units; the first T times of gamma.
      time_valid: [..., T].

    Returns:
      V [...], no unit; higher is better.
    """

    def one(x: jax.Array, valid: jax.Array) -> jax.Array:
        # whatever stands at times that do not count; gates read the first
        kept = valid.at[0].set(True) if model.config.scene_gating else valid
        rows = jnp.where(kept, x.T, 0.0)[:, :, None]
        return scene_values(model, params, normaliser, valid, rows)[0][0]

    for _ in range(features.ndim - 2):
        one = jax.vmap(one)
    return one(features, time_valid)


def matmul_f32(a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns the matrix product a b in float32 everywhere (see `EXACT`)."""
    return jnp.matmul(a, b, precision=EXACT)


@functools.lru_cache(maxsize=16)
def user_module(name: str) -> nn.Module:
    """Returns R_theta by its "package.module:Class", with the class's default fields.

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


def _check_module(name: str, num_features: int) -> None:
    x = jnp.zeros((2, NUM_TIMES, num_features))
    try:
        rewards, made = jax.eval_shape(
            user_module(name).init_with_output, jax.random.key(0), x
        )
    except (TypeError, ValueError) as error:
        raise InputError(f"module: {name}: {error}") from error
    if set(made) != {"params"} or rewards.shape != x.shape[:-1]:
        raise InputError(
            f"module: {name}: {sorted(made)}, {rewards.shape} of {x.shape}: "
            "expected parameters only, and a reward for each point"
        )
