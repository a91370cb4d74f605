"""The fast layout: V of `module.ValueNetwork` with the points along the long axis.

For the package's own R_theta only. Values and gradients are the module's
(tests/reward/test_module.py).
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rcirl_jax.reward.module import ACTIVATIONS, EXACT, product
from rcirl_jax.types import Normaliser, RewardParams

UNITS = 8  # hidden units are worked off in multiples of so many


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

    The same sum as `ValueNetwork`: the points run along the long axis of every matrix
    product. On a CPU it takes a third of the time; least with one scene
    at a time, whose features stay in the cache. The parts (the candidates and the
    human) of one scene follow one another along that axis: a human between the
    candidates of every time would break each row of the copy. Parts of several
    scenes stand together at every time, so that devices which share the scenes
    keep their own. The gains of a context are those of a scene's first column: all
    columns share them (`module.gains`). Points are normalised in that copy; in the
    first layer's weights instead, a feature that is the same everywhere would get a
    gradient from round-off.

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
    kernels = effective.kernels
    if effective.context is not None:
        # what is alike for all columns of a scene may stand in the weights: the points
        # need no copy of their own, and no gradient
        starts = points.reshape(points.shape[0], scenes, -1)[:, :, 0]
        gain = 2.0 * jax.nn.sigmoid(product(effective.context.T, starts))
        if scenes == 1:
            kernels = (kernels[0] * gain, *kernels[1:])
        else:
            apart = points.reshape(points.shape[0], scenes, -1) * gain[:, :, None]
            points = apart.reshape(points.shape)
    offsets = (*effective.biases, jnp.zeros((1,)))
    rewards = _layers(kernels, offsets, points, activation)[0]
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
