"""The guard: what is flagged, what drives instead, alone and in the closed loop."""

import ast
import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rcirl_jax.export import Guard, Limits, decode_weights, guard, pack
from rcirl_jax.export.closed_loop import table_rows
from rcirl_jax.export.loading import open_reward, reward_params
from rcirl_jax.features import feature_map
from rcirl_jax.planner.guard import Guarded, guarded_score, in_distribution
from rcirl_jax.planner.rank import hand_score, learned_score
from rcirl_jax.reward import seen_range
from tests.export.test_reader import ALLOWED
from tests.scenes import random_scene, sampled
from tests.train.test_step import CONFIG
from tests.weights_files import example_samples, example_weights, random_weights

F, T, K = 3, 4, 10


def made(seen=True, **changes):
    """A reward whose features lie in [-1, 1] with location 0 and scale 0.4."""
    weights = dataclasses.replace(
        example_weights(),
        lower=np.full(F, -2.0),
        upper=np.full(F, 2.0),
        location=np.zeros(F),
        scale=np.full(F, 0.4),
        seen=np.array([[-1.0] * F, [1.0] * F]) if seen else None,
        **changes,
    )
    return decode_weights(pack(weights, *example_samples(weights)))


def plan(seed=0, spread=1.0):
    drawn = np.random.default_rng(seed).uniform(-spread, spread, (K, T, F))
    return drawn.astype(np.float32)


def test_imports_are_numpy_and_the_standard_library():
    tree = ast.parse(Path(guard.__file__).read_text(encoding="utf-8"))
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            names.add(str(node.module).partition(".")[0])
    assert names - set(sys.stdlib_module_names) <= ALLOWED


def test_a_file_without_ranges_is_of_an_older_version_and_still_loads():
    old, new = made(seen=False), made()
    assert old.seen is None
    np.testing.assert_array_equal(new.seen, [[-1.0] * F, [1.0] * F])
    features = plan()
    np.testing.assert_array_equal(old.value(features), new.value(features))


@pytest.mark.parametrize("seen", [True, False])
def test_a_plan_as_in_training_is_the_rewards(seen):
    reward, features = made(seen), plan()
    index, verdict = Guard(reward).choose(features, -reward.value(features))
    assert verdict.in_distribution
    assert index == np.argmax(reward.value(features))


@pytest.mark.parametrize("seen", [True, False])
def test_a_feature_far_out_is_named_and_the_incumbent_drives(seen):
    reward, features = made(seen), plan()
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
    far = np.full((K, T, F), 1.19, np.float32)
    assert Guard(made(False)).check(far).in_distribution
    assert not Guard(made(False), Limits(reach=2.9)).check(far).in_distribution


def test_what_is_clipped_is_judged_as_the_network_sees_it():
    """Nobody ahead, infinitely far away: the cap, which the training saw."""
    reward = made(seen=True)
    capped = decode_weights(
        pack(w := dataclasses.replace(
            example_weights(), lower=np.full(F, -1.0), upper=np.full(F, 1.0),
            scale=np.ones(F), seen=np.array([[-1.0] * F, [1.0] * F]),
        ), *example_samples(w))
    )  # fmt: skip
    features = plan()
    features[..., 0] = np.inf
    assert Guard(capped).check(features).in_distribution
    assert not Guard(reward).check(features).in_distribution


def test_nan_is_out_of_distribution_unless_its_time_does_not_count():
    reward, features = made(), plan()
    features[4, 2, 1] = np.nan
    index, verdict = Guard(reward).choose(features, -np.arange(K))
    assert (index, verdict.in_distribution, verdict.feature) == (0, False, "feature1")
    assert verdict.share == 1 / (K * T)
    valid = np.array([1, 1, 0, 1])
    index, verdict = Guard(reward).choose(features, -np.arange(K), valid)
    assert verdict.in_distribution
    assert index == np.argmax(reward.value(features, valid))


def test_without_a_valid_time_nothing_is_known():
    verdict = Guard(made()).check(plan(), np.zeros(T))
    assert not verdict.in_distribution


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


# --------------------------------------------------------------- the closed loop


def guarded(reward, limits=None):
    low, high = guard.bounds(reward, limits or Limits())
    effective, normaliser = reward_params(reward)
    return Guarded(
        reward=effective, normaliser=normaliser, low=jnp.asarray(low),
        high=jnp.asarray(high), share=jnp.asarray((limits or Limits()).share),
        incumbent=None,
    )  # fmt: skip


@given(seed=st.integers(0, 10_000), spread=st.sampled_from([0.9, 1.2, 1.6, 3.0]))
def test_the_compiled_rule_is_the_readers(seed, spread):
    rng, reward = np.random.default_rng(seed), made(bool(seed % 2))
    features = plan(seed, spread) * rng.uniform(0.3, 1.0, F).astype(np.float32)
    if seed % 5 == 0:
        features[0, rng.integers(T), 0] = np.nan
    valid = np.arange(T) < rng.integers(0, T + 1)
    counts = np.broadcast_to(valid[:, None], (T, K))
    found = RULE(guarded(reward), features.transpose(2, 1, 0), counts)
    assert bool(found) == Guard(reward).check(features, valid).in_distribution


RULE = jax.jit(in_distribution)


def test_the_guarded_score_is_one_or_the_other(tmp_path):
    reward = open_reward(str(random_weights(tmp_path / "w.msgpack")))
    preset, scene = feature_map("paper21"), random_scene(3)
    candidates = sampled(jax.random.key(0), scene, CONFIG.sampler)
    score = jax.jit(guarded_score(preset, reward.activation, hand_score))
    ours = learned_score(preset, reward.activation)(
        reward_params(reward), scene, candidates
    )
    theirs = hand_score(None, scene, candidates)
    wide, none = Limits(reach=100.0), Limits(reach=0.0, share=0.0)
    found = score(guarded(reward, wide), scene, candidates)
    np.testing.assert_allclose(found, ours, rtol=1e-4, atol=1e-4)
    found = score(guarded(reward, none), scene, candidates)
    np.testing.assert_allclose(found, theirs, rtol=1e-4, atol=1e-3)


def test_a_table_may_have_a_guarded_row(tmp_path):
    path, other = (str(random_weights(tmp_path / f"{i}.msgpack", i)) for i in (1, 2))
    for incumbent, has_weights in (("hand-set", False), (other, True)):
        drivers = table_rows([path], ["IDM"], guard=incumbent)
        assert [row.name for row in drivers][1] == f"{drivers[0].name} guarded"
        assert (drivers[1].params.incumbent is not None) == has_weights


def test_no_value_at_all_is_no_choice():
    far = plan() + 9.0
    with pytest.raises(ValueError, match="incumbent: all NaN"):
        Guard(made()).choose(far, np.full(len(far), np.nan))


@pytest.mark.parametrize("count", [0, 3])
def test_values_of_other_candidates_are_refused(count):
    with pytest.raises(ValueError, match="incumbent: shape"):
        Guard(made()).choose(plan(), np.zeros(count))


def test_without_candidates_there_is_no_choice():
    with pytest.raises(ValueError, match="of 0 candidates, at least 1"):
        Guard(made()).choose(plan()[:0], np.zeros(0))


def test_features_of_another_count_are_refused():
    with pytest.raises(ValueError, match="features: shape"):
        Guard(made()).check(plan()[..., :1])
