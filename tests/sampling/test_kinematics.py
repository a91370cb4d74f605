"""The one operator from positions to derivatives, against float64 numpy."""

import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.features.columns import differentiate
from rcirl_jax.sampling import trajectory_from_positions
from rcirl_jax.units import DT_S, TIMES_S
from tests.helpers.scenes import random_positions, random_scene, scene

T = TIMES_S.size


@given(seed=st.integers(0, 10_000), num_valid=st.integers(4, T))
def test_differences_by_loop(seed, num_valid):
    rng = np.random.default_rng(seed)
    s = np.cumsum(rng.uniform(0.0, 10.0, T))
    valid = np.arange(T) < num_valid
    v, a, j = differentiate(
        jnp.asarray(s, jnp.float32),
        jnp.float32(7.0),
        jnp.float32(0.5),
        jnp.asarray(valid),
    )
    expected_a = [0.5]
    expected_v = [7.0]
    for i in range(1, num_valid):
        if i + 1 < num_valid:
            expected_a.append((s[i + 1] - 2 * s[i] + s[i - 1]) / DT_S**2)
            expected_v.append((s[i + 1] - s[i - 1]) / (2 * DT_S))
        else:
            expected_a.append(expected_a[-1])
            expected_v.append((s[i] - s[i - 1]) / DT_S + 0.5 * expected_a[-1] * DT_S)
    expected_j = np.diff(expected_a) / DT_S
    np.testing.assert_allclose(a[:num_valid], expected_a, atol=2e-2)
    np.testing.assert_allclose(v[:num_valid], expected_v, atol=1e-2)
    np.testing.assert_allclose(j[1:num_valid], expected_j, atol=1e-1)
    assert float(j[0]) == float(j[1])
    assert np.isfinite(np.asarray([v, a, j])).all()


def test_what_lies_beyond_the_mask_changes_nothing_inside():
    made = random_scene(5).replace(time_valid=jnp.arange(T) < 11)
    s, l = random_positions(5, made)
    one = trajectory_from_positions(made, s, l)
    other = trajectory_from_positions(made, s.at[11:].add(50.0), l)
    for name in ("v", "a", "j"):
        np.testing.assert_array_equal(
            getattr(one, name)[:11], getattr(other, name)[:11]
        )


def test_standing_still_has_zero_lateral_derivatives():
    made = scene(v=0.0)
    still = trajectory_from_positions(made, jnp.zeros(T), jnp.linspace(0.0, 1.0, T))
    assert not np.asarray(still.dl).any()
    assert not np.asarray(still.ddl).any()


def test_lateral_derivatives_of_a_sine():
    made = scene(v=12.0)
    s = 12.0 * jnp.asarray(TIMES_S)
    drive = trajectory_from_positions(made, s, jnp.sin(s / 25.0))
    inner = slice(2, -2)
    np.testing.assert_allclose(
        drive.dl[inner], np.cos(np.asarray(s) / 25.0)[inner] / 25.0, atol=2e-3
    )
    np.testing.assert_allclose(
        drive.ddl[inner], -np.sin(np.asarray(s) / 25.0)[inner] / 625.0, atol=2e-4
    )
