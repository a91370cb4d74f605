"""Savitzky-Golay filters as fixed convolutions (Savitzky and Golay 1964).

nuPlan judges comfort through them: accelerations over 8 samples, jerks over
15, order 2. A window of 8 has no middle sample; like scipy 1.11 and later, an
even window is taken as the next odd one, 9.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.simulation.cases import STEP_S

ORDER = 2  # of the polynomials


@functools.cache
def coefficients(window: int, derivative: int) -> tuple[float, ...]:
    """Weights of the least-squares parabola's derivative at the middle.

    Per sample step; the caller divides by STEP_S**derivative.
    """
    half = window // 2
    x = np.arange(-half, half + 1)
    powers = np.vander(x, ORDER + 1, increasing=True)
    rows = np.linalg.pinv(powers)
    return tuple(float(w) for w in rows[derivative] * np.prod(range(1, derivative + 1)))


def savitzky_golay(x: jax.Array, window: int, derivative: int = 0) -> jax.Array:
    """Smoothed x [S], or its derivative by time; ends hold their values.

    Args:
      x: [S], any unit, a sample every `STEP_S`.
      window: samples; an even one is enlarged by one.
      derivative: 0 or 1.
    """
    odd = window | 1
    weights = jnp.asarray(coefficients(odd, derivative), x.dtype)
    padded = jnp.pad(x, odd // 2, mode="edge")
    return jnp.convolve(padded, weights[::-1], mode="valid") / STEP_S**derivative
