"""Familiarity of a scene with the recordings: a number in (0, 1).

    familiarity = sigmoid(out . tanh(z W + b) + c)
    z = clip((f_0 - location) / scale, -5, 5)

f_0 are the raw features at t = 0, which all candidates of a scene share. Fitted to tell
recorded scenes from those of a catalogue (`tune.familiarity`), it is near 1 in traffic
as people were recorded in it and near 0 elsewhere.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rcirl_jax.features import FeatureMap
from rcirl_jax.types import Familiarity

UNITS = 16  # H of the familiarity that is fitted here
REACH = 5.0  # 1, |z| beyond which a feature counts as that far
# functions of the trajectory's own time, equal in all scenes at t = 0
OF_THE_TRAJECTORY = ("station", "time")


def familiar_nowhere(size: int) -> Familiarity:
    """Returns the familiarity of `size` features that says 0.5 of every scene."""
    zeros = jnp.zeros
    return Familiarity(
        location=zeros(size),
        scale=jnp.ones(size),
        kernel=zeros((size, UNITS)),
        bias=zeros(UNITS),
        out=zeros(UNITS),
        offset=zeros(()),
    )


def familiarity_logit(
    params: Familiarity, x0: Float[Array, "*n f"]
) -> Float[Array, "*n"]:
    """The familiarity before its sigmoid.

    Args:
      params: of `tune.familiarity.fit_familiarity`.
      x0: [..., F] raw features at t = 0.
    """
    z = jnp.clip((x0 - params.location) / params.scale, -REACH, REACH)
    hidden = jnp.tanh(z @ params.kernel + params.bias)
    return hidden @ params.out + params.offset


def familiarity(params: Familiarity, x0: Float[Array, "*n f"]) -> Float[Array, "*n"]:
    """The equation above, [...] in (0, 1)."""
    return jax.nn.sigmoid(familiarity_logit(params, x0))


def of_the_scene(features: FeatureMap) -> tuple[bool, ...]:
    """[F] which features say at t = 0 what a scene is like."""
    pairs = zip(features.names, features.context, strict=True)
    return tuple(bool(c) and name not in OF_THE_TRAJECTORY for name, c in pairs)
