"""Where people were recorded, learned by contrast with drives of the catalogue."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.features import feature_map
from rcirl_jax.planner.own_cost import own_cost
from rcirl_jax.reward.familiarity import familiarity, of_the_scene
from rcirl_jax.tuning.prior_cost import (
    fit_familiarity,
    fitted_prior_cost,
    scene_features,
)
from rcirl_jax.tuning.recipes import PriorCostConfig
from tests.helpers.scenes import batch, random_scene, scene

COUNTS = np.array([True, True, False, True])


def clouds(seed=0, count=400):
    rng = np.random.default_rng(seed)
    recorded = rng.normal(0.0, 1.0, (count, 4))
    elsewhere = rng.normal([3.0, -2.0, 0.0, 0.0], 1.0, (count, 4))
    recorded[:, 3] = elsewhere[:, 3] = 7.0  # never varies
    return recorded, elsewhere


def test_the_familiarity_tells_the_two_apart_and_doubt_is_elsewhere():
    recorded, elsewhere = clouds()
    made = fit_familiarity(recorded, np.ones(len(recorded)), elsewhere, COUNTS)
    here, there = (np.asarray(familiarity(made, jnp.asarray(x))) for x in clouds(1))
    assert np.median(here) > 0.9
    assert np.median(there) < 0.05
    between = familiarity(made, jnp.array([[1.5, -1.0, 0.0, 7.0]]))
    assert float(between[0]) < 0.4


def test_what_never_varies_or_does_not_count_has_no_weight():
    recorded, elsewhere = clouds()
    made = fit_familiarity(recorded, np.ones(len(recorded)), elsewhere, COUNTS)
    assert np.all(np.asarray(made.kernel)[2:] == 0.0)
    moved = recorded.copy()
    moved[:, 2:] += 100.0
    np.testing.assert_array_equal(
        familiarity(made, jnp.asarray(recorded)), familiarity(made, jnp.asarray(moved))
    )


def test_a_source_counts_by_its_weight_not_its_size():
    recorded, elsewhere = clouds()
    rare = np.random.default_rng(2).normal([0.0, 8.0, 0.0, 0.0], 0.5, (8, 4))
    rare[:, 3] = 7.0
    both = np.concatenate([recorded, rare])
    weights = np.concatenate([np.full(400, 0.5 / 400), np.full(8, 0.5 / 8)])
    made = fit_familiarity(both, weights, elsewhere, COUNTS)
    assert np.min(np.asarray(familiarity(made, jnp.asarray(rare)))) > 0.8


def test_a_scene_is_told_by_what_its_candidates_share():
    features = feature_map("paper21")
    counts = dict(zip(features.names, of_the_scene(features), strict=True))
    assert counts["velocity"]
    assert counts["follow_distance"]
    for name in ("jerk", "acceleration", "station", "time"):
        assert not counts[name]
    scenes = batch([random_scene(seed) for seed in range(4)])
    found = scene_features(scenes, features)
    assert found.shape == (4, features.num_features)
    speed = found[:, features.names.index("velocity")]
    np.testing.assert_allclose(speed, np.asarray(scenes.ego.v), atol=1e-4)


def stored(scenes):
    """A stand-in for a dataset: scenes of its training split."""
    stack = jax.tree.map(lambda *leaves: np.stack(leaves), *scenes)
    return types.SimpleNamespace(load=lambda split: types.SimpleNamespace(scene=stack))


def test_who_is_slow_on_an_empty_road_is_not_taken_for_recorded_traffic():
    """Recorded: 1 to 5 m/s. The catalogue: 12 to 20 m/s, slow once shown slowed."""
    features = feature_map("paper21")
    recorded = [stored([scene(v=float(v)) for v in np.linspace(1.0, 5.0, 40)])]
    driven = [stored([scene(v=float(v)) for v in np.linspace(12.0, 20.0, 40)])]
    slow = stored([scene(v=3.0)]).load("train").scene
    x = scene_features(slow, features)

    def gain(slowed):
        config = PriorCostConfig(low=0.0, high=1.0, slowed=slowed)
        prior_cost = fitted_prior_cost(config, recorded, [1.0], driven, features)
        return float(prior_cost.gain(x)[0])

    assert gain(()) > 0.8
    assert gain((0.1, 0.2, 0.3)) < 0.4


def test_gains_are_in_units_of_the_own_cost():
    """A copy of the hand-set cost has its gains; a cost times 7 has 7 times those."""
    config = PriorCostConfig(low=0.5, high=2.0)
    scenes = batch([random_scene(seed) for seed in range(12)])
    rows = types.SimpleNamespace(scene=jax.tree.map(np.asarray, scenes))
    recorded = types.SimpleNamespace(
        load=lambda split: rows,
        indices=lambda split: np.arange(12),
        read=lambda at: types.SimpleNamespace(
            scene=jax.tree.map(lambda x: x[at], rows.scene)
        ),
    )
    features = feature_map("paper21")

    def made(name):
        cost = own_cost(f"tests/planner/costs/costs.py:{name}")
        return fitted_prior_cost(config, [recorded], [1.0], [recorded], features, cost)

    copied, once, seven = map(made, ("copied", "headway_cost", "seven_and_three"))
    assert (copied.incumbent, once.incumbent) == ("copied", "headway_cost")
    assert (copied.low, copied.high) == pytest.approx((0.5, 2.0), rel=1e-5)
    assert once.high == pytest.approx(4.0 * once.low)
    assert 0.0 < once.high < 2.0
    assert seven.high == pytest.approx(7.0 * once.high, rel=1e-3)
