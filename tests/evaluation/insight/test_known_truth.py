"""A hidden reward is recovered from its choices, the more of them the better."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.evaluation.insight.known_truth import (
    agreement,
    differences,
    experts,
    hidden_reward,
    learns_from_choices,
)
from rcirl_jax.evaluation.ranking.learners import (
    learner_config,
    normaliser_of,
    train_learner,
)
from rcirl_jax.train.state import TrainConfig
from tests.train.test_step import cached

CONFIG = TrainConfig(loss="logistic", batch_size=16, learning_rate=0.01)


def frozen(count, seed=0):
    """Made-up features of many scenes in the shapes of a real frozen set."""
    rng, base = np.random.default_rng(seed), cached()
    k = 12
    shape = (count, k, *base.points.shape[2:])
    per_candidate = rng.normal(size=(count, k, 1, 21))
    x = per_candidate + 0.3 * rng.normal(size=shape)
    wide = lambda leaf: jnp.zeros((count, *leaf.shape[1:]), leaf.dtype)  # noqa: E731
    made = jax.tree.map(wide, base)
    facts = jax.tree.map(
        lambda leaf: leaf[:, :k] if leaf.ndim == 2 else leaf, made.facts
    )
    return made.replace(
        candidates=jnp.asarray(x, jnp.float32).transpose(0, 3, 2, 1),
        human=jnp.asarray(x[:, 0], jnp.float32),
        feasible=jnp.ones((count, k), bool).at[:, 3].set(False),
        time_valid=jnp.ones((count, 18), bool),
        weight=jnp.ones(count),
        facts=facts,
    )


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("RC-IRL rank", True),
        ("MaxEnt", True),
        ("GAN", True),
        ("soft labels", False),
        ("hinge", False),
        ("logistic, hard negatives", False),
    ],
)
def test_learners_of_the_recorded_humans_distances_are_told_apart(name, told):
    assert learns_from_choices(learner_config(name, CONFIG)) == told


def test_experts_choose_the_best_feasible():
    scenes = frozen(20)
    hidden = hidden_reward(0, normaliser_of(scenes, CONFIG))
    shown = experts(scenes, hidden, 0.0, 0)
    best = np.asarray(hidden.values(scenes)).argmax(axis=1)
    assert (best != 3).all()
    np.testing.assert_array_equal(
        shown.human, np.asarray(scenes.points)[np.arange(20), best]
    )
    assert (np.asarray(shown.feasible).sum(axis=1) == 10).all()
    noisy = experts(scenes, hidden, 100.0, 0)
    assert not np.allclose(noisy.human, shown.human)


def test_the_hidden_reward_agrees_with_itself():
    scenes = frozen(20)
    hidden = hidden_reward(0, normaliser_of(scenes, CONFIG))
    (any_one,) = train_learner(scenes, dataclasses.replace(CONFIG, epochs=1), [0])
    own = dataclasses.replace(
        any_one,
        params=hidden.params,
        normaliser=hidden.normaliser,
        config=dataclasses.replace(CONFIG, reward=hidden.config),
    )
    assert agreement(scenes, hidden, own) == (1.0, 0.0)
    # its opposite loses more than the median candidate
    *first, last = hidden.params.kernels
    opposite = hidden.params.replace(kernels=(*first, -last))
    worst = dataclasses.replace(own, params=opposite)
    same, lost = agreement(scenes, hidden, worst)
    assert same < 0.2
    assert lost > 1.0
    # a scene whose candidates are all alike has nothing to lose
    alike = scenes.candidates.at[0].set(scenes.candidates[0, :, :, :1])
    alike = scenes.replace(candidates=alike)
    rest = jax.tree.map(lambda x: x[1:], scenes)
    assert agreement(alike, hidden, worst)[1] == pytest.approx(
        agreement(rest, hidden, worst)[1], rel=1e-5
    )


@pytest.mark.parametrize("loss", ["logistic", "rank"])
def test_agreement_rises_with_data(loss):
    train, test = frozen(400), frozen(200, seed=1)
    hidden = hidden_reward(0, normaliser_of(train, CONFIG), hidden=())
    shown, share = experts(train, hidden, 0.0, 0), []
    for count in (8, 400):
        part = jax.tree.map(lambda x, n=count: x[:n], shown)
        config = dataclasses.replace(CONFIG, loss=loss, epochs=4000 // count)
        (learned,) = train_learner(part, config, [0])
        assert learned.finite
        share.append(agreement(test, hidden, learned)[0])
    assert share[1] > share[0] + 0.15
    assert share[1] > 0.6


def test_differences_are_paired_over_hidden_rewards():
    """Rewards differ by far more than learners do; pairing sees through that."""
    rng = np.random.default_rng(0)
    hidden = rng.uniform(0.1, 0.9, (8, 1))
    noise = lambda: rng.normal(0.0, 0.01, (8, 2))  # noqa: E731
    rises = hidden + np.array([0.0, 0.1]) + noise()
    found = differences({"A": rises, "B": hidden + noise()}, against="B")
    assert set(found) == {
        "A, most scenes minus fewest",
        "B, most scenes minus fewest",
        "A minus B, most scenes",
    }
    d, p = found["A, most scenes minus fewest"]
    assert d.low > 0.0
    assert p < 0.01
    assert found["A minus B, most scenes"][0].mean == pytest.approx(0.1, abs=0.02)
    d, p = found["B, most scenes minus fewest"]
    assert d.low < 0.0 < d.high
    assert p >= d.p
