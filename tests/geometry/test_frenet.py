"""Frenet frames: round trips, shapely as an oracle, closed-form curvature."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from rcirl_jax.features.columns import path_curvature
from rcirl_jax.geometry.frenet import (
    _curve,
    _from_nearest,
    project_points,
    reference_line_from_polyline,
)


def curve(kind, noise=0.0, seed=0):
    """A polyline of about 200 m with points every 2 m."""
    s = np.arange(0.0, 200.0, 2.0)
    kappa = {
        "straight": 0.0 * s,
        "circle": np.full(s.shape, 1 / 60.0),
        "clothoid": s / 200.0 / 40.0,
        "s_curve": np.sin(s / 30.0) / 50.0,
    }[kind]
    heading = np.cumsum(kappa) * 2.0
    points = np.stack([np.cumsum(np.cos(heading)), np.cumsum(np.sin(heading))], 1) * 2.0
    return points + np.random.default_rng(seed).normal(0.0, noise, points.shape)


def line_of(points, size=256):
    return reference_line_from_polyline(points, size=size, step=1.0)


@jax.jit
def placed(line, s, l):
    """[n, 2] m, of stations and offsets [n]."""
    x, y, heading = jax.vmap(_curve, in_axes=(None, 0))(line, s)
    return jnp.stack([x - l * jnp.sin(heading), y + l * jnp.cos(heading)], axis=1)


@jax.jit
def alone(line, points):
    """(s, l) m of points [n, 2], each from the nearest of all grid points."""
    x, y = points.T
    apart = (line.x[:, None] - x) ** 2 + (line.y[:, None] - y) ** 2
    near = jnp.argmin(apart, axis=0)
    return jax.vmap(_from_nearest, in_axes=(None, 0, 0, 0))(line, x, y, near)


@pytest.mark.parametrize("kind", ["clothoid", "s_curve"])
def test_round_trip_within_a_centimetre(kind):
    line = line_of(curve(kind, 0.03))
    rng = np.random.default_rng(1)
    s = jnp.asarray(rng.uniform(2.0, 190.0, 300), jnp.float32)
    l = jnp.asarray(rng.uniform(-8.0, 8.0, 300), jnp.float32)
    s_back, l_back = project_points(line, np.asarray(placed(line, s, l)))
    np.testing.assert_allclose(s_back, s, atol=0.01)
    np.testing.assert_allclose(l_back, l, atol=0.01)


@pytest.mark.parametrize("legs_apart", [8.0, 30.0])
def test_many_points_are_projected_as_one_by_one_also_between_legs(legs_apart):
    """A hairpin: the nearest grid point may be on either leg."""
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 40)[1:-1]
    out = np.arange(0.0, 100.0, 2.0)
    bend = 100.0 + 0.5 * legs_apart * np.cos(turn)
    x = np.concatenate([out, bend, out[::-1]])
    sides = (np.full(out.shape, -1.0), np.sin(turn), np.ones(out.shape))
    y = 0.5 * legs_apart * np.concatenate(sides)
    line = line_of(np.stack([x, y], axis=1), size=512)
    rng = np.random.default_rng(0)
    points = rng.uniform((-20.0, -40.0), (130.0, 40.0), (3000, 2)).astype(np.float32)
    points = np.concatenate([points, np.stack([line.x, line.y], axis=1)])
    found = zip(project_points(line, points), alone(line, points), strict=True)
    for one, other in found:
        np.testing.assert_array_equal(one, other)


def test_shapely_projects_to_the_same_station():
    points = curve("s_curve")
    line = line_of(points)
    dense = shapely.LineString(
        np.stack([np.asarray(line.x), np.asarray(line.y)], 1)[: int(line.num_valid)]
    )
    rng = np.random.default_rng(2)
    queries = points[rng.integers(5, 90, 100)] + rng.uniform(-4.0, 4.0, (100, 2))
    s, l = project_points(line, queries)
    for query, station, offset in zip(queries, s, l, strict=True):
        point = shapely.Point(query)
        # the oracle walks straight chords: up to 1 % of a metre per metre short
        assert station == pytest.approx(dense.project(point), abs=0.15)
        assert abs(offset) == pytest.approx(dense.distance(point), abs=0.02)


def test_curvature_of_a_circle_and_of_noise_on_a_straight():
    inside = slice(15, 180)
    kappa = np.asarray(line_of(curve("circle")).kappa)[inside]
    np.testing.assert_allclose(kappa, 1 / 60.0, rtol=0.03)
    noisy = np.asarray(line_of(curve("straight", 0.03)).kappa)[inside]
    assert np.abs(noisy).max() < 0.01


def test_duplicate_points_and_short_lines():
    points = np.array([[0.0, 0.0], [0.0, 0.0], [3.0, 0.0], [3.0, 0.0], [9.0, 0.0]])
    s, l = project_points(line_of(points), np.array([[4.0, 1.0]]))
    assert s[0] == pytest.approx(4.0, abs=1e-2)
    assert l[0] == pytest.approx(1.0, abs=1e-2)
    assert project_points(line_of(points), np.zeros((0, 2)))[0].shape == (0,)


def test_curvature_of_a_path_against_finite_differences():
    """l(s) = 2 sin(s / 30) along a circle, differentiated in x and y."""
    s = np.linspace(60.0, 120.0, 4001)
    offset = 2.0 * np.sin(s / 30.0)
    radius = 60.0
    angle = s / radius
    x = (radius - offset) * np.sin(angle)
    y = radius - (radius - offset) * np.cos(angle)
    dx, dy = np.gradient(x, s), np.gradient(y, s)
    ddx, ddy = np.gradient(dx, s), np.gradient(dy, s)
    expected = (dx * ddy - dy * ddx) / np.hypot(dx, dy) ** 3
    for i in (500, 2000, 3500):
        slope = 2.0 / 30.0 * np.cos(s[i] / 30.0), -2.0 / 900.0 * np.sin(s[i] / 30.0)
        found = path_curvature(*map(jnp.float32, (1 / radius, 0.0, offset[i], *slope)))
        assert float(found) == pytest.approx(expected[i], abs=2e-5)
