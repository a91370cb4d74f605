"""Shares of features and times in one trajectory being valued above another.

The difference V(a) - V(b) is split over features and times by integrated
gradients. The shares add up to the difference, a feature that is the same in
both gets none, and for the linear reward they are the terms of the sum itself.
Features are compared where the network sees them, clipped and normalised: a
feature that is beyond its range in both trajectories explains nothing.

Source: Sundararajan, Taly and Yan, Axiomatic Attribution for Deep Networks
(ICML 2017).
"""

import jax
import jax.numpy as jnp

from rcirl_jax.reward import (
    Normaliser,
    RewardParams,
    effective_model,
    identity_normaliser,
    normalise,
)
from rcirl_jax.reward.network import scene_values

STEPS = 64  # points on the line from b to a


def attribute(
    params: RewardParams,
    normaliser: Normaliser,
    features_a: jax.Array,
    features_b: jax.Array,
    time_valid: jax.Array,
    activation: str,
    steps: int = STEPS,
) -> jax.Array:
    """Returns the contribution of each feature at each time to V(a) - V(b).

        C_ti = gamma_t (x^a_ti - x^b_ti)
               * integral over u in [0, 1] of dR/dx_i (x^b_t + u (x^a_t - x^b_t))

    with x the clipped and normalised features. The integral is a midpoint sum;
    its error falls like 1 / steps^2 for tanh and like 1 / steps for ReLUs, whose
    slope jumps. The sum of C over t and i is V(a) - V(b) up to that error. Pure:
    it may be traced and mapped; `activation` and `steps` are static. Needs the
    space of `steps` copies of [T, F].

    Args:
      params: effective ones (`reward.effective_params`, or a weights file's).
      normaliser: [F].
      features_a: [T, F] in declared units, of the trajectory to be explained.
      features_b: [T, F] in declared units, of the one it is compared with.
      time_valid: [T] bool, shared by both.
      activation: key of ACTIVATIONS.
      steps: points of the midpoint rule, at least 1.

    Returns:
      [T, F], no unit; 0 at times that are not valid, whatever the features.
    """
    start = normalise(normaliser, features_b)
    clipped_a, clipped_b = (
        jnp.clip(features, normaliser.lower, normaliser.upper)
        for features in (features_a, features_b)
    )
    # exactly 0 where the network sees no difference
    change = (clipped_a - clipped_b) / normaliser.scale
    model = effective_model(params, activation)
    as_is = identity_normaliser(start.shape[1])  # x is normalised already

    def total(x: jax.Array) -> jax.Array:
        rows = x.T[:, :, None]
        return scene_values(model, params, as_is, time_valid, rows)[0][0]

    shares = (jnp.arange(steps) + 0.5) / steps
    slopes = jax.vmap(lambda share: jax.grad(total)(start + share * change))(shares)
    contribution = change * jnp.mean(slopes, axis=0)
    return jnp.where(time_valid[:, None], contribution, 0.0)
