"""Frenet frame of a reference line: (s, l) <-> (x, y), curvature, lookups.

A point is r(s) + l n(s): r a cubic Hermite curve through the grid points, n
the left normal of the interpolated heading. Both directions use this one map,
so the round trip is exact up to the Newton iteration's end.
"""

import functools

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import make_smoothing_spline
from scipy.spatial import KDTree

NEWTON_STEPS = 6  # iterations after the nearest grid point
CHUNK = 1024  # points per device call of project_points
SMALL_CHUNK = 128  # likewise, where there are no more
SMOOTHING = 30.0  # penalty of the smoothing spline on second derivatives


class ReferenceLine(flax.struct.PyTreeNode, kw_only=True):
    """A line on a uniform arc-length grid, extended straight beyond its end."""

    x: jax.Array  # [M] m
    y: jax.Array  # [M] m
    heading: jax.Array  # [M] rad, unwrapped
    kappa: jax.Array  # [M] 1/m
    step: jax.Array  # [] m between grid points
    num_valid: jax.Array  # [] int32, grid points on the polyline itself


def reference_line_from_polyline(
    points: np.ndarray, *, size: int, step: float
) -> ReferenceLine:
    """Smooth a noisy polyline [m, 2] and resample it every `step` metres.

    A cubic smoothing spline in arc length (Reinsch) on points thinned to one
    metre; heading and curvature come from its derivatives.
    """
    points = np.asarray(points, np.float64)
    keep = np.concatenate([[True], np.hypot(*np.diff(points, axis=0).T) > 1e-3])
    points = points[keep]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    dense = np.linspace(0.0, arc[-1], max(int(arc[-1]) + 1, 5))
    thinned = np.stack([np.interp(dense, arc, points[:, i]) for i in (0, 1)], axis=1)
    curve = make_smoothing_spline(dense, thinned, lam=SMOOTHING)
    fine = np.linspace(0.0, arc[-1], 8 * dense.size)
    steps = np.hypot(*np.diff(curve(fine), axis=0).T)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    grid = np.arange(size) * step
    inside = np.minimum(grid, length[-1])
    u = np.interp(inside, length, fine)
    (x, y), (dx, dy) = curve(u).T, curve.derivative()(u).T
    ddx, ddy = curve.derivative(2)(u).T
    heading = np.unwrap(np.arctan2(dy, dx))
    kappa = (dx * ddy - dy * ddx) / np.maximum(np.hypot(dx, dy), 1e-9) ** 3
    beyond = grid - inside
    kappa = np.where(beyond > 0.0, 0.0, kappa)
    as_array = lambda v: jnp.asarray(np.asarray(v, np.float32))  # noqa: E731
    return ReferenceLine(
        x=as_array(x + beyond * np.cos(heading)),
        y=as_array(y + beyond * np.sin(heading)),
        heading=as_array(heading),
        kappa=as_array(kappa),
        step=as_array(step),
        num_valid=jnp.asarray(int(length[-1] / step) + 1, jnp.int32),
    )


def entry(table: jax.Array, index: jax.Array) -> jax.Array:
    """`table[index]` where every index is known to lie in the table.

    Plain indexing masks what lies outside, which takes as long as the gather.
    """
    return jnp.asarray(table).at[index].get(mode="promise_in_bounds")


def lookup(
    table: Float[Array, " p"],
    s: Float[Array, ""] | float,
    step: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Linear interpolation on a uniform grid from 0; clamped at both ends."""
    position = jnp.clip(s / step, 0.0, table.shape[0] - 1.0)
    low = jnp.minimum(position.astype(jnp.int32), table.shape[0] - 2)
    share = position - low
    start, end = entry(table, low + np.arange(2))
    return start + share * (end - start)


def _curve(line: ReferenceLine, s: jax.Array) -> tuple:
    """r(s) (x, y) and heading, straight beyond both ends."""
    size = line.x.shape[0]
    position = s / line.step
    low = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, size - 2)
    u = jnp.clip(position - low, 0.0, 1.0)
    h00, h10 = (1 + 2 * u) * (1 - u) ** 2, u * (1 - u) ** 2
    h01, h11 = u**2 * (3 - 2 * u), u**2 * (u - 1)
    a, b = entry(line.heading, low), entry(line.heading, low + 1)
    beyond = (position - low - u) * line.step
    heading = a + u * (b - a)
    x = h00 * entry(line.x, low) + h01 * entry(line.x, low + 1)
    y = h00 * entry(line.y, low) + h01 * entry(line.y, low + 1)
    x = x + line.step * (h10 * jnp.cos(a) + h11 * jnp.cos(b))
    y = y + line.step * (h10 * jnp.sin(a) + h11 * jnp.sin(b))
    return x + beyond * jnp.cos(heading), y + beyond * jnp.sin(heading), heading


def _from_nearest(
    line: ReferenceLine, x: jax.Array, y: jax.Array, nearest: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(s, l) m of a point: from the nearest grid point, Newton on t(s).(p - r(s))."""

    def improve(s: jax.Array, _: None) -> tuple[jax.Array, None]:
        rx, ry, heading = _curve(line, s)
        along = (x - rx) * jnp.cos(heading) + (y - ry) * jnp.sin(heading)
        across = (y - ry) * jnp.cos(heading) - (x - rx) * jnp.sin(heading)
        shrink = 1.0 - lookup(line.kappa, s, line.step) * across
        return s + along / jnp.maximum(shrink, 0.2), None

    s, _ = jax.lax.scan(improve, nearest * line.step, None, length=NEWTON_STEPS)
    rx, ry, heading = _curve(line, s)
    return s, (y - ry) * jnp.cos(heading) - (x - rx) * jnp.sin(heading)


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0))
def _project(
    line: ReferenceLine, x: jax.Array, y: jax.Array, near: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(s, l) m where the nearest grid point is `near` or a neighbour of it."""
    some = jnp.clip(near + jnp.arange(-1, 2), 0, line.x.shape[0] - 1)
    distance = (line.x[some] - x) ** 2 + (line.y[some] - y) ** 2
    return _from_nearest(line, x, y, some[jnp.argmin(distance)])


def project_points(
    line: ReferenceLine, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(s, l) m of points [q, 2], numpy; padded so that few sizes compile.

    A tree finds the nearest grid points: trying all takes most of an import's time.
    """
    points = np.asarray(points, np.float32)
    tree = KDTree(np.stack([line.x, line.y], axis=1))
    near = np.asarray(tree.query(points)[1])
    parts = []
    for start in range(0, len(points), CHUNK):
        taken = points[start : start + CHUNK]
        size = SMALL_CHUNK if len(taken) <= SMALL_CHUNK else CHUNK
        block, index = np.zeros((size, 2), np.float32), np.zeros(size, np.int32)
        block[: len(taken)], index[: len(taken)] = taken, near[start : start + CHUNK]
        s, l = _project(line, block[:, 0], block[:, 1], index)
        parts.append(np.stack([s, l])[:, : len(taken)])
    both = np.concatenate(parts, axis=1) if parts else np.zeros((2, 0), np.float32)
    return both[0], both[1]


# as `_project`, for lanes: lines [B, M], x, y and near [B, q]
project_lanes = jax.jit(jax.vmap(_project))
