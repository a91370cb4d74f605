"""How far the recordings reach, against drives of the catalogue."""

import types

import jax
import numpy as np

from rcirl_jax.features import feature_map
from rcirl_jax.tune.familiarity import scene_features
from rcirl_jax.tune.prior_cost import PriorCostConfig, fitted_prior_cost
from tests.helpers.scenes import scene

FEATURES = feature_map("paper21")


def stored(scenes):
    """A stand-in for a dataset: scenes of its training split."""
    stack = jax.tree.map(lambda *leaves: np.stack(leaves), *scenes)
    return types.SimpleNamespace(load=lambda split: types.SimpleNamespace(scene=stack))


def test_who_is_slow_on_an_empty_road_is_not_taken_for_recorded_traffic():
    """Recorded: 1 to 5 m/s. The catalogue: 12 to 20 m/s, slow once shown slowed."""
    recorded = [stored([scene(v=float(v)) for v in np.linspace(1.0, 5.0, 40)])]
    driven = [stored([scene(v=float(v)) for v in np.linspace(12.0, 20.0, 40)])]
    slow = stored([scene(v=3.0)]).load("train").scene
    x = scene_features(slow, FEATURES)

    def gain(slowed):
        config = PriorCostConfig(low=0.0, high=1.0, slowed=slowed)
        prior_cost = fitted_prior_cost(config, recorded, [1.0], driven, FEATURES)
        return float(prior_cost.gain(x)[0])

    assert gain(()) > 0.8
    assert gain((0.1, 0.2, 0.3)) < 0.4
