"""A batch in pieces whose gradient sums add up, one after the other.

On a CPU a piece of the network's work is one scene: its features (0.2 MB for 122
candidates) and hidden units stay in a core's cache from the forward to the backward
pass; several scenes at once take longer. Candidates and features are made for a block
of scenes before that.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from rcirl_jax.train.state import Batch, FeatureBatch

Scenes = TypeVar("Scenes", Batch, FeatureBatch)
TRAJECTORIES = 1 << 11  # made together on a CPU


def piece_size(size: int, most: int) -> int:
    """Scenes of a batch that are worked off together.

    Args:
      size: scenes in the batch; what is returned divides it.
      most: bound on an accelerator; a CPU takes one scene.
    """
    return 1 if jax.default_backend() == "cpu" else _divisor(size, most)


def _divisor(size: int, most: int) -> int:
    """The largest divisor of `size` that is not above `most`, at least 1."""
    return next((n for n in range(min(size, most), 1, -1) if size % n == 0), 1)


def block_size(scenes: int, candidates: int) -> int:
    """Scenes whose candidates and features are made together; divides `scenes`.

    On a CPU the features of a block (3 MB) stay in its caches until the network reads
    them, and a trajectory of a batch of 1,024 scenes, or of 64 with 1,024 candidates,
    costs no more than one of 64 with 122; half of what it costs when all are made at
    once, as elsewhere.
    """
    most = TRAJECTORIES // candidates if jax.default_backend() == "cpu" else scenes
    return _divisor(scenes, most)


def in_pieces(
    batch: Scenes, size: int | None = None
) -> tuple[jax.Array, Callable[[jax.Array], Scenes]]:
    """Numbers of a batch's pieces of `size` scenes, and how to take one of them.

    By default scene by scene on a CPU, all at once elsewhere. A piece is cut out where
    it is used: leaves reshaped to [n, B / n, ...] would be copied whole before a loop.
    """
    scenes = batch.weight.shape[0]
    each = piece_size(scenes, scenes) if size is None else size

    def piece(number: jax.Array) -> Scenes:
        if each == scenes:
            return batch
        cut = lambda x: jax.lax.dynamic_slice_in_dim(x, number * each, each)  # noqa: E731
        return jax.tree.map(cut, batch)

    return jnp.arange(scenes // each), piece


def added(sums_of: Callable[[Any], Any], parts: Any) -> Any:  # noqa: ANN401
    """Sum of `sums_of(part)` over parts, leaves [n, ...], one after the other."""
    return added_and_kept(lambda part: (sums_of(part), None), parts)[0]


def added_and_kept(work: Callable[[Any], tuple[Any, Any]], parts: Any) -> tuple:  # noqa: ANN401
    """Of `work(part)`: the first summed over parts, the second kept for each."""
    if jax.tree.leaves(parts)[0].shape[0] == 1:  # no loop
        total, kept = work(jax.tree.map(lambda x: x[0], parts))
        return total, jax.tree.map(lambda x: x[None], kept)
    like, _ = jax.eval_shape(work, jax.tree.map(lambda x: x[0], parts))
    zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)

    def one(total: Any, part: Any) -> tuple:  # noqa: ANN401
        more, kept = work(part)
        return jax.tree.map(jnp.add, total, more), kept

    return jax.lax.scan(one, zero, parts)
