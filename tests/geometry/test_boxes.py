"""Oriented boxes against shapely."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.geometry.boxes import Box, corners, frenet_extent, overlaps, separation


def box(values):
    x, y, heading, length, width = (jnp.float32(v) for v in values)
    return Box(x=x, y=y, heading=heading, length=length, width=width)


def polygon(made):
    return shapely.Polygon(np.asarray(corners(made), np.float64))


def pair(seed):
    rng = np.random.default_rng(seed)
    rows = [
        (*rng.uniform(-5, 5, 2), rng.uniform(-4, 4), *rng.uniform(0.5, 6.0, 2))
        for _ in range(2)
    ]
    return box(rows[0]), box(rows[1])


@given(seed=st.integers(0, 100_000))
def test_sign_is_shapelys_and_size_bounds_the_distance(seed):
    first, second = pair(seed)
    gap = float(separation(first, second))
    distance = polygon(first).distance(polygon(second))
    if abs(gap) > 1e-4:
        assert bool(overlaps(first, second)) == polygon(first).intersects(
            polygon(second)
        )
    assert max(gap, 0.0) <= distance + 1e-4
    assert gap == pytest.approx(float(separation(second, first)), abs=1e-5)


def test_penetration_depth_of_aligned_boxes():
    first = box((0.0, 0.0, 0.0, 4.0, 2.0))
    assert float(separation(first, box((3.5, 0.0, 0.0, 4.0, 2.0)))) == -0.5
    assert float(separation(first, box((5.0, 0.0, 0.0, 4.0, 2.0)))) == 1.0


def test_gradient_is_finite_where_boxes_touch_or_coincide():
    first = box((0.0, 0.0, 0.0, 4.0, 2.0))
    for x in (4.0, 0.0):
        second = box((x, 0.0, 0.0, 4.0, 2.0))
        gradient = jax.grad(lambda b: separation(first, b))(second)
        assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(gradient))


@given(tilt=st.floats(-3.2, 3.2))
def test_frenet_extent_is_the_bounding_box(tilt):
    made = np.asarray(corners(box((0.0, 0.0, tilt, 5.0, 2.0))))
    along, across = frenet_extent(jnp.float32(5.0), jnp.float32(2.0), jnp.float32(tilt))
    assert float(along) == pytest.approx(made[:, 0].max(), abs=1e-4)
    assert float(across) == pytest.approx(made[:, 1].max(), abs=1e-4)
