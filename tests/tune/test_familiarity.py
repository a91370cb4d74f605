"""Where people were recorded, learned by contrast."""

import jax.numpy as jnp
import numpy as np

from rcirl_jax.features import feature_map
from rcirl_jax.reward.familiarity import familiarity, of_the_scene
from rcirl_jax.tune.familiarity import fit_familiarity, scene_features
from tests.helpers.scenes import batch, random_scene

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
