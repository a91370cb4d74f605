"""A linen module of somebody else's as R_theta: trained, exported, driven."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.features import feature_map
from rcirl_jax.planner.rank import RankConfig, module_score, rank_policy
from rcirl_jax.reward import RewardConfig, RewardModel, value
from rcirl_jax.train.step import init_state, make_train_step
from tests.helpers.scenes import random_scene, sampled
from tests.train.test_step import CONFIG, human_is_better, normaliser

FEATURES = feature_map("paper21")
OTHER = RewardConfig(module="tests.reward.others:Residual")


@pytest.mark.parametrize(("loss", "context"), [("rank", ()), ("gan", FEATURES.context)])
def test_learns_a_direction(loss, context):
    reward = dataclasses.replace(OTHER, scene_gating=context)
    config = dataclasses.replace(
        CONFIG, reward=reward, loss=loss, learning_rate=0.03, weight_decay=1e-3
    )
    state, step = init_state(config, normaliser()), jax.jit(make_train_step(config))
    before, made = state, human_is_better()
    for _ in range(30):
        state, metrics = step(state, made)
    assert float(metrics.wins / metrics.pairs) > 0.95
    assert bool(metrics.finite)
    assert ("offset" in state.params) == (loss == "gan")
    assert ("scene_gating" in state.params) == bool(context)
    moved = jax.tree.map(
        lambda a, b: float(jnp.abs(a - b).max()), before.params, state.params
    )
    del moved["point"]["out"]["bias"]  # it cancels within a scene
    assert min(jax.tree.leaves(moved)) > 0.0


def test_it_drives_by_the_value_that_is_trained():
    model, state = (
        RewardModel(OTHER),
        init_state(dataclasses.replace(CONFIG, reward=OTHER), normaliser()),
    )
    scene, key = jax.tree.map(jnp.asarray, random_scene(2)), jax.random.key(2)
    score = module_score(FEATURES, model)
    assert score is module_score(FEATURES, model)  # or a rollout compiles again
    weights, planner = (state.params, state.normaliser), RankConfig()
    candidates = sampled(key, scene, planner.sampler)
    scores = jax.jit(score)(weights, scene, candidates)
    x = jax.jit(FEATURES.of_candidates)(scene, candidates)
    valid = jnp.broadcast_to(scene.time_valid, x.shape[:2])
    want = value(model, state.params, state.normaliser, x, valid)
    np.testing.assert_allclose(scores, want, rtol=1e-5, atol=1e-5)
    assert np.ptp(np.asarray(scores)) > 1e-3
    plan = jax.jit(rank_policy(score, planner))(weights, scene, key, None)
    assert np.isfinite(np.asarray(plan.s)).all()
