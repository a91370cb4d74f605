"""Features that are not finite, found on the device while a step reads them."""

import jax
import jax.numpy as jnp

from rcirl_jax.reward.module import product
from rcirl_jax.train.state import FeatureBatch


def bad_values(batch: FeatureBatch) -> jax.Array:
    """[B, F] bool: scenes that count and hold a NaN or an infinity of a feature."""
    bad = _holds_bad(batch.candidates) | _holds_bad(batch.human.swapaxes(1, 2))
    return bad & (batch.weight > 0.0)[:, None]


def bad_facts(batch: FeatureBatch) -> jax.Array:
    """[B, 1] bool: scenes that count whose facts, which losses read, are not finite.

    Of candidates that count, and of the human.
    """
    facts = batch.facts
    of_each = jnp.isfinite(facts.distance) & jnp.isfinite(facts.breaks_rule)
    of_each &= jnp.isfinite(facts.density)
    of_human = jnp.isfinite(facts.human_distance) & jnp.isfinite(facts.human_density)
    bad = jnp.any(~of_each & batch.feasible, axis=-1) | ~of_human
    return (bad & (batch.weight > 0.0))[:, None]


def count_bad(bad: jax.Array, index: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Scenes with bad values per feature, and the row of one such scene (or -1)."""
    return jnp.sum(bad, axis=0), jnp.max(jnp.where(jnp.any(bad, axis=1), index, -1))


def _holds_bad(features: jax.Array) -> jax.Array:
    """[B, F] bool, of [B, F, ...]: one of the values is a NaN or an infinity.

    Seen in a weighted sum, which a CPU takes at the speed of its memory; the weight
    is so small that finite values do not overflow.
    """
    flat = features.reshape(*features.shape[:2], -1)
    return ~jnp.isfinite(product(flat, jnp.full((flat.shape[2],), 1e-30)))
