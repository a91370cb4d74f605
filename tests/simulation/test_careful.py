"""Careful drivers: their formulas, and the verdict per case."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.planner.baselines import B_MAX, B_MIN, cc_braking, fsm_braking
from rcirl_jax.simulation.rows import judges, preventable, trivial
from rcirl_jax.types import Kind
from tests.simulation.drives import drive
from tests.simulation.worlds import make_case


def test_cc_brakes_at_two_seconds():
    v, lead = jnp.float32(20.0), jnp.float32(10.0)
    assert cc_braking(jnp.float32(20.1), v, 0.0, lead) == 0.0
    assert cc_braking(jnp.float32(19.9), v, 0.0, lead) == pytest.approx(7.59)
    assert cc_braking(jnp.float32(5.0), v, 0.0, jnp.float32(21.0)) == 0.0


def test_fsm_grows_as_the_gap_shrinks():
    gaps = jnp.linspace(120.0, 1.0, 60)
    v, lead, a = jnp.float32(20.0), jnp.float32(0.0), jnp.float32(5.0)
    brakes = np.array([fsm_braking(g, v, lead, a) for g in gaps])
    assert brakes[0] == 0.0
    assert (np.diff(brakes) >= -1e-5).all()
    assert brakes[-1] == pytest.approx(B_MAX)
    proactive = brakes[(brakes > 0.0) & (brakes <= B_MIN)]
    assert proactive.size > 0  # it brakes before the conflict is critical


def test_what_can_be_seen_is_avoided_by_both_and_a_sudden_wall_by_neither():
    walls = {"s": 120.0}, {"s": 60.0, "appear_s": 50.0}
    still = {"v": 0.0, "kind": Kind.STATIC}
    cases = [make_case([{**still, **wall}], speed=15.0) for wall in walls]
    for row in judges()[:2]:
        how = {"command_delay": row.command_delay, "braking_jerk": row.braking_jerk}
        record, _ = drive(cases, policy=row.policy, params=row.params, **how)
        assert (record.collision.sum(axis=1) > 0).tolist() == [False, True]
        assert record.v[0, -1] < 0.1


def metrics(**values):
    return types.SimpleNamespace(**{k: np.array(v) for k, v in values.items()})


def test_preventable_unless_both_crash():
    one, other = metrics(at_fault=[0, 1, 0, 1]), metrics(at_fault=[0, 0, 1, 1])
    np.testing.assert_array_equal(preventable([one, other]), [True, True, True, False])


def test_trivial_only_where_nobody_comes_near():
    one = metrics(collisions=[0, 0, 1], min_ttc=[9.0, 1.0, 9.0])
    other = metrics(collisions=[0, 0, 0], min_ttc=[np.inf, 9.0, 9.0])
    np.testing.assert_array_equal(trivial([one, other]), [True, False, False])
