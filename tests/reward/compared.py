"""Made-up comparisons for the loss tests."""

import jax.numpy as jnp

from rcirl_jax.reward import CandidateInfo, LossInputs


def compared(human, candidates, feasible=None, weight=None, offset=0.0, **info):
    """Values [B], [B, K] with plain facts unless given."""
    human, candidates = jnp.asarray(human), jnp.asarray(candidates)
    shape = candidates.shape
    plain = {
        "human_distance": jnp.zeros(shape[0]),
        "human_collides": jnp.zeros(shape[0], bool),
        "distance": jnp.zeros(shape),
        "collides": jnp.zeros(shape, bool),
        "breaks_rule": jnp.zeros(shape),
        "human_density": jnp.zeros(shape[0]),
        "density": jnp.zeros(shape),
        "human_own": jnp.zeros(shape[0]),
        "own": jnp.zeros(shape),
    }
    return LossInputs(
        human=human,
        candidates=candidates,
        feasible=jnp.ones(shape, bool) if feasible is None else jnp.asarray(feasible),
        weight=jnp.ones(shape[0]) if weight is None else jnp.asarray(weight),
        info=CandidateInfo(**{**plain, **info}),
        offset=jnp.asarray(offset),
    )
