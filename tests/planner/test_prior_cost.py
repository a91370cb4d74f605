"""A learned score on top of the planner's own cost."""

import dataclasses

import jax
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.score import PriorCostScorer
from rcirl_jax.export.closed_loop import score_of, table_rows
from rcirl_jax.export.loading import open_reward, scorer_of
from rcirl_jax.export.reader import PriorCost
from rcirl_jax.features import feature_map
from rcirl_jax.planner.rank import ONLINE, hand_score
from tests.helpers.scenes import random_scene, sampled
from tests.helpers.weights_files import LOWER, UPPER, random_weights

FEATURES = feature_map("paper21")


def with_prior_cost(reward, gain=2.0):
    prior_cost = PriorCost(incumbent="hand-set", gain=gain)
    return dataclasses.replace(reward, prior_cost=prior_cost)


@pytest.mark.parametrize(("off", "knows"), [(0.9, True), (1.1, False)])
def test_v_counts_as_the_gain_says_where_no_feature_is_new(tmp_path, off, knows):
    """A speed limit that never varied in training is now `off` scales away."""
    drawn = open_reward(str(random_weights(tmp_path / "w.msgpack")))
    scene, at = random_scene(3), FEATURES.names.index("speed_limit")
    candidates = sampled(jax.random.key(0), scene, ONLINE)
    features = np.asarray(jax.jit(FEATURES.of_candidates)(scene, candidates))
    valid = np.broadcast_to(np.asarray(scene.time_valid), features.shape[:2])
    location = drawn.location.copy()
    location[at] = features[0, 0, at] + off * drawn.scale[at]
    ends = [np.where(np.arange(21) == at, location, x) for x in (LOWER, UPPER)]
    lower, upper = (x.astype(np.float32) for x in ends)
    made = dataclasses.replace(drawn, lower=lower, upper=upper, location=location)
    reward = with_prior_cost(made, 1.15)
    score, params = score_of(reward)
    found = jax.jit(score)(params, scene, candidates)
    theirs = np.asarray(jax.jit(hand_score)(None, scene, candidates))
    ours = reward.value(features, valid)
    assert np.ptp(ours) > 0.1
    wanted = theirs + 1.15 * knows * ours
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-3)
    # the planner's side and the ranking report compute the same from features
    total = reward.total(features, theirs, valid)
    np.testing.assert_allclose(total, wanted, rtol=1e-5)
    scorer = scorer_of(reward)
    assert isinstance(scorer, PriorCostScorer)
    assert scorer.incumbent == "hand-set"
    np.testing.assert_array_equal(scorer.total(features, theirs, valid), total)
    # alone it has nothing to give way to
    score, params = score_of(made)
    alone = jax.jit(score)(params, scene, candidates)
    np.testing.assert_allclose(alone, ours, rtol=1e-4, atol=1e-3)


def test_a_file_with_a_prior_cost_drives_on_top_of_it(tmp_path, monkeypatch):
    path = str(random_weights(tmp_path / "w.msgpack"))
    reward = with_prior_cost(open_reward(path))
    monkeypatch.setattr("rcirl_jax.export.closed_loop.open_reward", lambda _: reward)
    rows = table_rows([path], ["IDM"])
    assert rows[0].name.endswith("on hand-set")
    assert float(rows[0].params.gain) == 2.0
    searched = [row.name for row in table_rows([path], [], dp=True)]
    assert searched == [rows[0].name, f"{rows[0].name} search", f"{rows[0].name} DP"]
    assert reward.prior_cost is not None
    other = dataclasses.replace(reward.prior_cost, incumbent="mine")
    with pytest.raises(InputError, match=r"prior_cost\.incumbent: mine"):
        score_of(dataclasses.replace(reward, prior_cost=other))
