"""Oriented boxes: corners, signed separation along the separating axes.

Source: separating-axis theorem for convex polygons (Gottschalk et al. 1996);
two rectangles need four axes, the sides' directions of each.
"""

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Box(flax.struct.PyTreeNode, kw_only=True):
    """An oriented rectangle; all scalars."""

    x: jax.Array  # [] m, centre
    y: jax.Array  # [] m, centre
    heading: jax.Array  # [] rad, of the long side
    length: jax.Array  # [] m
    width: jax.Array  # [] m


def corners(box: Box) -> Float[Array, "4 2"]:
    """Corner points [4, 2] m: front left, rear left, rear right, front right."""
    along = jnp.array([0.5, -0.5, -0.5, 0.5]) * box.length
    across = jnp.array([0.5, 0.5, -0.5, -0.5]) * box.width
    cosine, sine = jnp.cos(box.heading), jnp.sin(box.heading)
    x = box.x + along * cosine - across * sine
    y = box.y + along * sine + across * cosine
    return jnp.stack([x, y], axis=1)


def separation(first: Box, second: Box) -> Float[Array, ""]:
    """Largest gap over the four axes, m; negative is the penetration depth.

        gap(n) = |n . (c2 - c1)| - h1(n) - h2(n),
        h(n) = L/2 |n . u| + W/2 |n . w|   (half extent of a box along n)

    For boxes apart it is a lower bound of their distance, exact when they face
    each other; its sign says exactly whether they meet.
    """
    angles = jnp.stack([first.heading, second.heading])
    axes_x = jnp.concatenate([jnp.cos(angles), -jnp.sin(angles)])
    axes_y = jnp.concatenate([jnp.sin(angles), jnp.cos(angles)])
    apart = jnp.abs(axes_x * (second.x - first.x) + axes_y * (second.y - first.y))
    reach = _half_extent(first, axes_x, axes_y) + _half_extent(second, axes_x, axes_y)
    return jnp.max(apart - reach)


def _half_extent(box: Box, axes_x: jax.Array, axes_y: jax.Array) -> jax.Array:
    cosine, sine = jnp.cos(box.heading), jnp.sin(box.heading)
    along = jnp.abs(axes_x * cosine + axes_y * sine)
    across = jnp.abs(axes_y * cosine - axes_x * sine)
    return 0.5 * (box.length * along + box.width * across)


def overlaps(first: Box, second: Box) -> Bool[Array, ""]:
    """True if two boxes share a point (touching counts)."""
    return separation(first, second) <= 0.0


def frenet_extent(
    length: Float[Array, ""], width: Float[Array, ""], tilt: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Half extents (along, across) m of a box tilted by `tilt` rad to the line.

    along = (L |cos| + W |sin|) / 2,  across = (L |sin| + W |cos|) / 2
    """
    cosine, sine = jnp.abs(jnp.cos(tilt)), jnp.abs(jnp.sin(tilt))
    along = 0.5 * (length * cosine + width * sine)
    return along, 0.5 * (length * sine + width * cosine)


def contact_interval(
    first: Box,
    second: Box,
    velocity_x: Float[Array, ""],
    velocity_y: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns when two boxes meet if the second slides past the first without turning.

    On each of the four separating axes n the signed distance of the centres
    is linear in time, so the boxes overlap on n during an interval:

        |n . (d + w t)| <= h1(n) + h2(n),   d = c2 - c1,  w = relative velocity

    They touch exactly while all four intervals hold: the swept test in closed
    form, with no time grid to slip through.

    Args:
      first: the box at rest.
      second: the moving box, at t = 0.
      velocity_x: m/s, velocity of `second` relative to `first`.
      velocity_y: m/s.

    Returns:
      (enter, leave) in s; they touch for enter <= t <= leave, and never if
      enter > leave.
    """
    angles = jnp.stack([first.heading, second.heading])
    axes_x = jnp.concatenate([jnp.cos(angles), -jnp.sin(angles)])
    axes_y = jnp.concatenate([jnp.sin(angles), jnp.cos(angles)])
    apart = axes_x * (second.x - first.x) + axes_y * (second.y - first.y)
    rate = axes_x * velocity_x + axes_y * velocity_y
    reach = _half_extent(first, axes_x, axes_y) + _half_extent(second, axes_x, axes_y)
    enter, leave = overlap_times(apart, rate, reach)
    return jnp.max(enter), jnp.min(leave)


def overlap_times(
    apart: jax.Array, rate: jax.Array, reach: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Interval of t with |apart + rate t| <= reach; any shape, elementwise.

    Where rate is 0 the answer is everywhere (-inf, inf) or nowhere (inf, -inf).
    """
    still = jnp.abs(rate) < 1e-6
    safe = jnp.where(still, 1.0, rate)
    one, two = (-reach - apart) / safe, (reach - apart) / safe
    inside = jnp.abs(apart) <= reach
    enter = jnp.where(
        still, jnp.where(inside, -jnp.inf, jnp.inf), jnp.minimum(one, two)
    )
    leave = jnp.where(
        still, jnp.where(inside, jnp.inf, -jnp.inf), jnp.maximum(one, two)
    )
    return enter, leave
