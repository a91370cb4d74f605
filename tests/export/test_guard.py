"""The guard: what is flagged, and what drives instead."""

import dataclasses

import numpy as np
import pytest

from rcirl_jax.export import Guard, Limits, decode_weights, pack
from rcirl_jax.features import feature_map
from rcirl_jax.reward import seen_range
from tests.helpers.weights_files import example_samples, example_weights

F, T, K = 3, 4, 10


def made(limit=2.0, scale=0.4, seen=((-1.0,) * F, (1.0,) * F)):
    """A reward clipped to +-limit whose features lay in the range seen."""
    weights = dataclasses.replace(
        example_weights(),
        lower=np.full(F, -limit),
        upper=np.full(F, limit),
        location=np.zeros(F),
        scale=np.full(F, scale),
        training_range=np.array(seen),
    )
    return decode_weights(pack(weights, *example_samples(weights)))


def reaching(low, high):
    """A reward clipped to [-1, 1] whose training got to [low, high]."""
    return made(limit=1.0, scale=1.0, seen=(low, high))


def plan(seed=0, spread=1.0):
    drawn = np.random.default_rng(seed).uniform(-spread, spread, (K, T, F))
    return drawn.astype(np.float32)


def test_a_feature_far_out_is_named_and_the_incumbent_drives():
    reward, features = made(), plan()
    features[..., 1] += 3.0
    incumbent = np.arange(K, dtype=np.float64)
    incumbent[-1] = np.nan  # has no value, so never drives
    index, verdict = Guard(reward).choose(features, incumbent)
    assert (verdict.in_distribution, verdict.feature) == (False, "feature1")
    assert verdict.share > 0.9
    assert index == K - 2


def test_the_limits_are_limits():
    reward, features = made(), np.zeros((K, T, F), np.float32)
    features.reshape(-1, F)[:10, 2] = 1.2  # a quarter of 40 entries
    assert Guard(reward).check(features).in_distribution
    assert Guard(reward, Limits(margin=0.51)).check(features).share == 0.0
    features.reshape(-1, F)[10, 2] = 1.2
    verdict = Guard(reward).check(features)
    assert (verdict.in_distribution, verdict.share) == (False, 11 / 40)
    assert Guard(reward, Limits(share=0.3)).check(features).in_distribution


@pytest.mark.parametrize("value", [-1e9, 1.3])
def test_beyond_a_range_that_training_did_not_fill_is_outside(value):
    """Though range and margin together cover all that the network is given."""
    features = plan(spread=0.9)
    features[..., 1] = value
    verdict = Guard(reaching([-0.9] * F, [0.9] * F)).check(features)
    assert (verdict.in_distribution, verdict.feature) == (False, "feature1")
    assert verdict.share == 1.0


def test_a_side_is_open_where_training_reached_the_limit():
    judge = Guard(reaching([-1.0, -0.5, -1.5], [0.5, 1.0, 1.5]))
    np.testing.assert_array_equal(np.isneginf(judge.low), [True, False, True])
    np.testing.assert_array_equal(np.isposinf(judge.high), [False, True, True])
    assert judge.blind == ("feature2",)
    assert (judge.low.dtype, judge.high.dtype) == (np.float32, np.float32)
    for feature, value, fine in (
        (0, -1e9, True), (0, 1e9, False), (1, -1e9, False), (1, 1e9, True),
        (2, -1e9, True), (2, 1e9, True),
    ):  # fmt: skip
        features = np.zeros((K, T, F), np.float32)
        features[..., feature] = value
        assert judge.check(features).in_distribution == fine


@pytest.mark.parametrize(("value", "filled"), [(np.nan, True), (np.inf, False)])
def test_not_finite_is_unknown_unless_its_time_does_not_count(value, filled):
    reward = reaching([-1.0] * F, [1.0] * F) if filled else made()
    features = plan()
    features[4, 2, 1] = value
    index, verdict = Guard(reward).choose(features, -np.arange(K))
    assert (index, verdict.in_distribution, verdict.feature) == (0, False, "feature1")
    assert verdict.share == 1 / (K * T)
    valid = np.array([1, 1, 0, 1])
    index, verdict = Guard(reward).choose(features, -np.arange(K), valid)
    assert verdict.in_distribution
    assert index == np.argmax(reward.value(features, valid))
    # without a valid time nothing is known
    assert not Guard(reward).check(plan(), np.zeros(T)).in_distribution


def test_the_range_seen_is_of_quantiles_of_clipped_rows():
    features = feature_map("paper21")
    drawn = np.random.default_rng(0).normal(size=(10_000, 21))
    drawn[0] = 1e9
    low, high = seen_range(drawn, features)
    column = features.names.index("velocity")
    exact = np.clip(drawn[:, column], 0.0, features.specs[column].upper)
    assert low[column] == np.float32(np.quantile(exact, 0.001))
    assert high[column] == pytest.approx(np.quantile(exact, 0.999))
    assert high[column] < 5.0


@pytest.mark.parametrize(
    ("features", "incumbent", "says"),
    [
        (plan() + 9.0, np.full(K, np.nan), "incumbent: all NaN"),
        (plan(), np.zeros(3), "incumbent: shape"),
        (plan()[:0], np.zeros(0), "of 0 candidates, at least 1"),
        (plan()[..., :1], np.zeros(K), "features: shape"),
    ],
)
def test_what_is_no_choice_is_refused(features, incumbent, says):
    with pytest.raises(ValueError, match=says):
        Guard(made()).choose(features, incumbent)
