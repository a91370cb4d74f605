"""A learned score on top of the planner's own cost."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate.types import AT_HIGHEST
from rcirl_jax.evaluation.ranking.score import PriorCostScorer
from rcirl_jax.export.closed_loop import SuiteJob, score_of, table_rows
from rcirl_jax.export.loading import open_reward, reward_params, scorer_of
from rcirl_jax.export.reader import PriorCost
from rcirl_jax.features import feature_map
from rcirl_jax.planner.rank import ONLINE, hand_score, learned_score
from rcirl_jax.reward.familiarity import Familiarity, familiarity
from tests.helpers.scenes import random_scene, sampled
from tests.helpers.weights_files import random_weights

FEATURES = feature_map("paper21")


def with_prior_cost(reward, offset, low=0.3, high=2.0):
    """A reward whose familiarity is sigmoid(offset) in every scene."""
    size = FEATURES.num_features
    return dataclasses.replace(
        reward,
        prior_cost=PriorCost(
            incumbent="hand-set", low=low, high=high, location=np.zeros(size),
            scale=np.ones(size), kernel=np.zeros((size, 2)), bias=np.zeros(2),
            out=np.zeros(2), offset=np.array([offset]),
        ),
    )  # fmt: skip


@pytest.mark.parametrize(("offset", "gain"), [(-30.0, 0.3), (30.0, 2.0), (0.0, 1.15)])
def test_the_gain_goes_from_low_to_high_with_the_familiarity(tmp_path, offset, gain):
    reward = with_prior_cost(
        open_reward(str(random_weights(tmp_path / "w.msgpack"))), offset
    )
    scene = random_scene(3)
    candidates = sampled(jax.random.key(0), scene, ONLINE)
    score, params = score_of(reward)
    ours = learned_score(FEATURES, reward.activation)(
        reward_params(reward), scene, candidates
    )
    theirs = hand_score(None, scene, candidates)
    found = jax.jit(score)(params, scene, candidates)
    np.testing.assert_allclose(found, theirs + gain * ours, rtol=1e-4, atol=1e-4)
    # the planner's side computes the same from features and its own cost
    features = np.asarray(FEATURES.of_candidates(scene, candidates))
    valid = np.broadcast_to(np.asarray(scene.time_valid), features.shape[:2])
    total = reward.total(features, np.asarray(theirs), valid)
    np.testing.assert_allclose(total, found, rtol=1e-4, atol=1e-3)
    scorer = scorer_of(reward)
    assert isinstance(scorer, PriorCostScorer)
    assert scorer.incumbent == "hand-set"
    ranked = scorer.total(features, np.asarray(theirs), valid)
    np.testing.assert_array_equal(ranked, total)


def test_the_familiarity_is_the_equation():
    rng = np.random.default_rng(0)
    size, units = 3, 4
    params = Familiarity(
        location=jnp.asarray(rng.normal(size=size), jnp.float32),
        scale=jnp.asarray(rng.uniform(0.5, 2.0, size), jnp.float32),
        kernel=jnp.asarray(rng.normal(size=(size, units)), jnp.float32),
        bias=jnp.asarray(rng.normal(size=units), jnp.float32),
        out=jnp.asarray(rng.normal(size=units), jnp.float32),
        offset=jnp.asarray(0.2),
    )
    x = rng.normal(size=(5, size)) * 20.0
    z = np.clip((x - params.location) / params.scale, -5.0, 5.0)
    logit = np.tanh(z @ params.kernel + params.bias) @ params.out + 0.2
    wanted = 1.0 / (1.0 + np.exp(-logit))
    np.testing.assert_allclose(familiarity(params, jnp.asarray(x)), wanted, rtol=1e-4)


def test_a_file_with_a_prior_cost_drives_on_top_of_it(tmp_path, monkeypatch):
    path = str(random_weights(tmp_path / "w.msgpack"))
    reward = with_prior_cost(open_reward(path), 0.0)
    monkeypatch.setattr("rcirl_jax.export.closed_loop.open_reward", lambda _: reward)
    rows = table_rows([path], ["IDM"])
    assert rows[0].name.endswith("on hand-set")
    assert float(rows[0].params.high) == 2.0
    job = SuiteJob(
        weights=(path,), names=("candidate",), baselines=("hand-set",), refs=(),
        duration_s=1.0, highest=True,
    )  # fmt: skip
    shipped, everywhere, _ = job.rows()
    assert (shipped.name, everywhere.name) == ("candidate", AT_HIGHEST)
    assert everywhere.policy is shipped.policy
    gains = [float(x) for x in (everywhere.params.low, everywhere.params.high)]
    assert gains == [2.0, 2.0]
    searched = [row.name for row in table_rows([path], [], dp=True)]
    assert searched == [rows[0].name, f"{rows[0].name} search", f"{rows[0].name} DP"]
    assert reward.prior_cost is not None
    other = dataclasses.replace(reward.prior_cost, incumbent="mine")
    with pytest.raises(InputError, match=r"prior_cost\.incumbent: mine"):
        score_of(dataclasses.replace(reward, prior_cost=other))
