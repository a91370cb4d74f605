"""Polynomials against a float64 linear solve, automatic derivatives and scipy."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from rcirl_jax.geometry.polynomial import evaluate, hermite, quartic, quintic

speeds = st.floats(-5, 40, width=32)
accelerations = st.floats(-8, 4, width=32)
durations = st.floats(0.5, 10, width=32)


def powers(t, order, size):
    """Row of the Vandermonde matrix of the order-th derivative."""
    row = np.zeros(size)
    for i in range(order, size):
        factor = np.prod(np.arange(i, i - order, -1)) if order else 1.0
        row[i] = factor * t ** (i - order)
    return row


@given(v0=speeds, a0=accelerations, v1=speeds, d=durations)
def test_quartic_solves_its_conditions(v0, a0, v1, d):
    rows = [powers(0, k, 5) for k in range(3)] + [powers(d, k, 5) for k in (1, 2)]
    expected = np.linalg.solve(np.array(rows), [3.0, v0, a0, v1, 0.5])
    found = np.asarray(quartic(3.0, v0, a0, v1, 0.5, d), np.float64)
    scale = d ** np.arange(5)
    np.testing.assert_allclose(found * scale, expected * scale, rtol=1e-4, atol=1e-2)


@given(v0=speeds, a0=accelerations, s1=st.floats(0, 200, width=32), d=durations)
def test_quintic_meets_both_ends(v0, a0, s1, d):
    curve = quintic(0.0, v0, a0, s1, 4.0, -1.0, d)
    rows = [powers(0, k, 6) for k in range(3)] + [powers(d, k, 6) for k in range(3)]
    expected = np.linalg.solve(np.array(rows), [0.0, v0, a0, s1, 4.0, -1.0])
    scale = d ** np.arange(6)
    np.testing.assert_allclose(
        np.asarray(curve) * scale, expected * scale, rtol=1e-3, atol=0.05
    )
    value, first, second, _ = evaluate(curve, jnp.float32(d))
    assert float(value) == pytest.approx(s1, abs=0.02)
    assert float(first) == pytest.approx(4.0, abs=0.05)
    assert float(second) == pytest.approx(-1.0, abs=0.2)


@pytest.mark.parametrize("duration", [0.0, -1.0])
def test_tiny_durations_stay_finite(duration):
    assert np.isfinite(np.asarray(quartic(0.0, 1.0, 0.0, 2.0, 0.0, duration))).all()
    assert np.isfinite(
        np.asarray(quintic(0.0, 1.0, 0.0, 1.0, 2.0, 0.0, duration))
    ).all()


@given(v0=speeds, v1=speeds, s1=st.floats(0, 200, width=32), d=durations)
def test_hermite_is_that_of_scipy(v0, v1, s1, d):
    x = jnp.linspace(0.0, 1.0, 9)
    ends, slopes = (tuple(map(jnp.float32, x)) for x in ((3.0, s1), (v0, v1)))
    expected = CubicHermiteSpline([0.0, d], [3.0, s1], [v0, v1])(np.linspace(0, d, 9))
    found = hermite(x, *ends, slopes, d)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-3)
    # slopes per whole way, and a share that is no array
    again = hermite(0.25, *ends, (slopes[0] * d, slopes[1] * d))
    assert float(again) == pytest.approx(expected[2], rel=1e-5, abs=1e-3)
    assert (float(found[0]), float(found[-1])) == pytest.approx((3.0, s1))
