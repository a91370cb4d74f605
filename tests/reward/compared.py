"""Made-up comparisons for the loss tests."""

import jax.numpy as jnp

from rcirl_jax.reward import Compared


def compared(human, candidates, counts=None, weight=None, **facts):
    """Values [B], [B, K] with plain facts unless given."""
    human, candidates = jnp.asarray(human), jnp.asarray(candidates)
    shape = candidates.shape
    plain = {
        "counts": jnp.ones(shape, bool) if counts is None else jnp.asarray(counts),
        "weight": jnp.ones(shape[0]) if weight is None else jnp.asarray(weight),
        "human_distance": jnp.zeros(shape[0]),
        "human_collides": jnp.zeros(shape[0], bool),
        "distance": jnp.zeros(shape),
        "collides": jnp.zeros(shape, bool),
        "breaks_rule": jnp.zeros(shape),
        "human_density": jnp.zeros(shape[0]),
        "density": jnp.zeros(shape),
        "offset": jnp.zeros(()),
    }
    return Compared(human=human, candidates=candidates, **{**plain, **facts})
