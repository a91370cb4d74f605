"""Losses on value differences, y = V(candidate) - V(human).

Each is a value of one option: a pure function of one difference. Sums and
counts are carried apart, so that uneven shards add up correctly.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def rank_loss(y: Float[Array, "*n"], leaky_rate: float) -> Float[Array, "*n"]:
    """The paper's leaky-ReLU rank loss: L(y) = y if y >= 0 else a y, a = 0.05.

    A candidate valued above the human costs its lead; one below earns a small
    reward for its distance. Needs a pinned scale (`reward.network.pinned`).
    """
    return jnp.where(y >= 0.0, y, leaky_rate * y)


def logistic_loss(y: Float[Array, "*n"], leaky_rate: float) -> Float[Array, "*n"]:
    """Bradley-Terry: L(y) = log(1 + exp(y)); `leaky_rate` is not used."""
    del leaky_rate
    return jax.nn.softplus(y)


LOSSES: dict[str, Callable[[jax.Array, float], jax.Array]] = {
    "rank": rank_loss,
    "logistic": logistic_loss,
}


def pair_sums(
    name: str,
    human_value: Float[Array, " b"],
    candidate_values: Float[Array, "b k"],
    counts: Bool[Array, "b k"],
    weight: Float[Array, " b"],
    leaky_rate: float,
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Sum of losses, sum of pairs the human wins (ties half), number of pairs.

    Args:
      name: key of `LOSSES`.
      human_value: [B].
      candidate_values: [B, K].
      counts: [B, K] whether a pair counts (feasible candidate).
      weight: [B] 0 for padding rows.
      leaky_rate: a of the rank loss.

    Returns:
      Three scalars; divide only after summing over all shards.
    """
    y = candidate_values - human_value[:, None]
    share = counts * weight[:, None]
    loss = jnp.sum(jnp.where(counts, LOSSES[name](y, leaky_rate), 0.0) * share)
    wins = jnp.sum(share * jnp.where(y < 0.0, 1.0, jnp.where(y == 0.0, 0.5, 0.0)))
    return loss, wins, jnp.sum(share)
