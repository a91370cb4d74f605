"""What losses know of a candidate: rules broken, distances."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.train.facts import OVER_LIMIT_MPS, facts_of

T, LIMIT = 18, 10.0


def of(speeds, overrun, valid=None):
    """Facts of candidates [K] that drive at `speeds` [T, K] past a line."""
    shape = speeds.shape
    still = SimpleNamespace(s=jnp.zeros(shape[::-1]), l=jnp.zeros(shape[::-1]))
    frames = SimpleNamespace(
        point=SimpleNamespace(v=jnp.asarray(speeds)),
        path=SimpleNamespace(speed_limit=jnp.full(shape, LIMIT)),
        relations=SimpleNamespace(
            line_overrun=jnp.asarray(overrun), body=jnp.ones(shape)
        ),
    )
    human = SimpleNamespace(s=jnp.zeros(T), l=jnp.zeros(T))
    seen = jnp.ones(T, bool) if valid is None else jnp.asarray(valid)
    return facts_of(human, SimpleNamespace(trajectory=still), frames, seen)


def test_a_line_is_run_at_one_time_and_counts_in_full():
    speeds, overrun = np.full((T, 3), LIMIT), np.zeros((T, 3))
    speeds[:6, 1] += 2.0 * OVER_LIMIT_MPS
    overrun[11, 2] = 0.4
    broken = of(speeds, overrun).breaks_rule
    np.testing.assert_allclose(broken, [0.0, 6 / T, 1.0], rtol=1e-6)


@pytest.mark.parametrize("times", [6, 11])
def test_what_nobody_recorded_breaks_no_rule(times):
    speeds, overrun = np.full((T, 2), LIMIT), np.zeros((T, 2))
    speeds[times - 3 :, 0] += 2.0 * OVER_LIMIT_MPS
    overrun[times, 1] = 0.4
    broken = of(speeds, overrun, np.arange(T) < times).breaks_rule
    np.testing.assert_allclose(broken, [3 / times, 0.0], rtol=1e-6)
