"""Cubic, quartic and quintic polynomials between states, in closed form.

Source: Werling et al. 2010, "Optimal trajectory generation for dynamic street
scenarios in a Frenet frame". Time is normalised by the duration inside, so
that float32 keeps its digits for short and for long moves. All functions are
elementwise: an array of end conditions gives an array of curves.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

MIN_DURATION = 1e-3  # s (or m): shorter moves are stretched to this
Scalar = Float[Array, "..."] | float


def quartic(
    s0: Scalar, v0: Scalar, a0: Scalar, v1: Scalar, a1: Scalar, duration: Scalar
) -> Float[Array, "*batch 5"]:
    """Coefficients of the quartic from (s0, v0, a0) to end speed v1 and a1.

        s(t) = c0 + c1 t + c2 t^2 + c3 t^3 + c4 t^4,  s'(d) = v1, s''(d) = a1

    The end position is free. Ascending powers of t; units follow the inputs.
    """
    d = jnp.maximum(jnp.asarray(duration, jnp.float32), MIN_DURATION)
    speed_gap = v1 - v0 - a0 * d
    accel_gap = a1 - a0
    c3 = (3.0 * speed_gap - accel_gap * d) / (3.0 * d**2)
    c4 = (accel_gap * d - 2.0 * speed_gap) / (4.0 * d**3)
    return _stack(s0, v0, 0.5 * jnp.asarray(a0), c3, c4)


def quintic(
    s0: Scalar,
    v0: Scalar,
    a0: Scalar,
    s1: Scalar,
    v1: Scalar,
    a1: Scalar,
    duration: Scalar,
) -> Float[Array, "*batch 6"]:
    """Coefficients of the quintic from (s0, v0, a0) to (s1, v1, a1).

    s(t) = sum_i c_i t^i, i = 0..5, matching value and two derivatives at
    both ends. Ascending powers of t; units follow the inputs.
    """
    d = jnp.maximum(jnp.asarray(duration, jnp.float32), MIN_DURATION)
    p = s1 - s0 - v0 * d - 0.5 * a0 * d**2
    q = (v1 - v0 - a0 * d) * d
    r = (a1 - a0) * d**2
    c3 = (10.0 * p - 4.0 * q + 0.5 * r) / d**3
    c4 = (-15.0 * p + 7.0 * q - r) / d**4
    c5 = (6.0 * p - 3.0 * q + 0.5 * r) / d**5
    return _stack(s0, v0, 0.5 * jnp.asarray(a0), c3, c4, c5)


def _stack(*coefficients: Scalar) -> jax.Array:
    parts = [jnp.asarray(c, jnp.float32) for c in coefficients]
    return jnp.stack(jnp.broadcast_arrays(*parts), axis=-1)


def evaluate(
    coefficients: Float[Array, "*#batch c"], t: Scalar
) -> tuple[
    Float[Array, "*batch"],
    Float[Array, "*batch"],
    Float[Array, "*batch"],
    Float[Array, "*batch"],
]:
    """Value and first three derivatives at t, by Horner's scheme; elementwise."""
    values, row = [], coefficients
    for _ in range(4):
        total = jnp.zeros((), jnp.float32)
        for i in reversed(range(row.shape[-1])):
            total = total * t + row[..., i]
        values.append(total)
        row = row[..., 1:] * jnp.arange(1, row.shape[-1], dtype=jnp.float32)
    return values[0], values[1], values[2], values[3]


def hermite(
    x: Float[Array, "..."] | float,
    begin: Float[Array, "..."],
    end: Float[Array, "..."],
    slopes: tuple[Float[Array, "..."], Float[Array, "..."]],
    duration: float = 1.0,
) -> Float[Array, "..."]:
    """Value of the cubic that has given values and slopes at both ends.

    Args:
      x: share of the way between the ends, 0 to 1.
      begin: value at x = 0; its unit is that of the result.
      end: value at x = 1.
      slopes: at both ends, per unit of time (or of whatever the cubic runs over).
      duration: between the ends, in that unit; 1: the slopes are per whole way.
    """
    return (
        (1.0 + 2.0 * x) * (1.0 - x) ** 2 * begin
        + x * (1.0 - x) ** 2 * duration * slopes[0]
        + x**2 * (3.0 - 2.0 * x) * end
        - x**2 * (1.0 - x) * duration * slopes[1]
    )
