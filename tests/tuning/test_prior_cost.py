"""The gain on top of an own cost."""

import types

import jax
import numpy as np
import pytest

from rcirl_jax.planner.own_cost import own_cost
from rcirl_jax.tuning.prior_cost import prior_cost_of
from tests.helpers.scenes import batch, random_scene


def test_gains_are_in_units_of_the_own_cost():
    """A copy of the hand-set cost has its gain; a cost times 7 has 7 times its own."""
    scenes = batch([random_scene(seed) for seed in range(12)])
    rows = types.SimpleNamespace(scene=jax.tree.map(np.asarray, scenes))
    recorded = types.SimpleNamespace(
        indices=lambda split: np.arange(12),
        read=lambda at: types.SimpleNamespace(
            scene=jax.tree.map(lambda x: x[at], rows.scene)
        ),
    )

    def made(name):
        cost = own_cost(f"tests/planner/costs/costs.py:{name}")
        return prior_cost_of(2.0, [recorded], cost)

    copied, once, seven = map(made, ("copied", "headway_cost", "seven_and_three"))
    assert (copied.incumbent, once.incumbent) == ("copied", "headway_cost")
    assert copied.gain == pytest.approx(2.0, rel=1e-5)
    assert 0.0 < once.gain < 2.0
    assert seven.gain == pytest.approx(7.0 * once.gain, rel=1e-3)
