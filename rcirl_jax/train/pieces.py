"""A batch in pieces whose sums add up: what fits a cache is worked off at once."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rcirl_jax.train.state import FeatureBatch

PIECE_VALUES = 1 << 16  # feature values worked off together on a CPU


def divisor_at_most(size: int, most: int) -> int:
    """The largest divisor of `size` that is at most `most`, or 1."""
    return next((n for n in range(most, 1, -1) if size % n == 0), 1)


def in_pieces(batch: FeatureBatch) -> FeatureBatch:
    """Leaves [n, B / n, ...]: few scenes at a time on a CPU, all at once elsewhere.

    The features (0.2 MB for 122 candidates) and hidden units of one scene stay in
    a core's cache from the forward to the backward pass; those of a batch do not.
    """
    scenes, values = batch.weight.shape[0], batch.candidates[0].size
    most = scenes
    if jax.default_backend() == "cpu":
        most = min(scenes, max(1, PIECE_VALUES // values))
    size = divisor_at_most(scenes, most)
    return jax.tree.map(lambda x: x.reshape(-1, size, *x.shape[1:]), batch)


def added(sums_of: Callable[[Any], Any], parts: Any) -> Any:  # noqa: ANN401
    """Sum of `sums_of(part)` over parts, leaves [n, ...], one after the other."""
    like = jax.eval_shape(sums_of, jax.tree.map(lambda x: x[0], parts))
    zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    add = lambda total, part: (  # noqa: E731
        jax.tree.map(jnp.add, total, sums_of(part)),
        None,
    )
    return jax.lax.scan(add, zero, parts)[0]
