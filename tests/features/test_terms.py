"""Own terms: columns, weights learned from today's on, files in the user's names."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.baselines import (
    of_own_terms,
)
from rcirl_jax.export.closed_loop import write_own_terms
from rcirl_jax.export.forms import own_weights, terms_yaml, with_weights
from rcirl_jax.export.loading import features_of, open_reward
from rcirl_jax.features import feature_map
from rcirl_jax.reward import RewardConfig, effective_params, fit_normaliser
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.tuning.recipes import load_recipe, override
from rcirl_jax.units import NUM_TIMES
from tests.helpers.scenes import random_scene, sampled

TRACED = """
import jax.numpy as jnp

def slow(scene, x):
    return jnp.abs(scene.path.speed_limit[0] - x.v)

def jerk(scene, x):
    return x.j ** 2

def at_the_end(scene, x):
    return x.s[-1]

TERMS = {"slow": (slow, 2.0), "jerk": (jerk, 0.5), "at_the_end": (at_the_end, 1e-3)}
"""
CALLED = TRACED.replace("x.j ** 2", "[float(j) ** 2 for j in x.j]")


def terms_file(folder: Path, text: str = TRACED) -> str:
    """Writes own terms; returns their place."""
    path = folder / "terms.py"
    path.write_text(text)
    return f"{path}:TERMS"


@pytest.mark.parametrize("text", [TRACED, CALLED])
def test_columns_are_the_terms(tmp_path, text):
    features = feature_map(terms_file(tmp_path, text))
    scene = random_scene(0)
    scene = scene.replace(time_valid=jnp.arange(NUM_TIMES) < 12)
    candidates = sampled(jax.random.key(0), scene, SamplerConfig())
    found = np.asarray(jax.jit(features.of_candidates)(scene, candidates))
    x = jax.tree.map(np.asarray, candidates.trajectory)
    limit = float(scene.path.speed_limit[0])
    assert features.names == ("slow", "jerk", "at_the_end")
    slow, jerk, end = np.moveaxis(found, -1, 0)
    np.testing.assert_allclose(slow[:, :12], np.abs(limit - x.v)[:, :12], rtol=1e-6)
    np.testing.assert_allclose(jerk[:, :12], x.j[:, :12] ** 2, rtol=1e-5, atol=1e-6)
    # beyond the last valid time it stands still, so the end is that of the record
    assert (jerk[:, 12:] == jerk[:, 11:12]).all()
    np.testing.assert_allclose(end, np.repeat(x.s[:, 11:12], NUM_TIMES, 1), rtol=1e-6)
    assert features.own.is_called_back == (text == CALLED)


def test_weights_begin_as_today_and_stay_positive():
    shape = RewardConfig(
        hidden=(), constraint="terms", scale_constraint="none", today=(2.0, 0.5)
    )
    raw = {
        "gamma": jnp.zeros(NUM_TIMES),
        "point": {"out": {"kernel": jnp.zeros((2, 1))}},
        "log_scale": jnp.zeros(()),
    }
    made = effective_params(raw, shape)
    np.testing.assert_allclose(made["point"]["out"]["kernel"][:, 0], [-2.0, -0.5])
    np.testing.assert_allclose(made["gamma"], 1.0 / NUM_TIMES, rtol=1e-6)
    raw["point"] = {"out": {"kernel": jnp.log(jnp.asarray([[3.0], [0.2]]))}}
    raw["log_scale"] = jnp.log(10.0)
    free = effective_params(raw, shape)["point"]["out"]["kernel"][:, 0]
    np.testing.assert_allclose(free, [-60.0, -1.0], rtol=1e-5)
    fixed = dataclasses.replace(shape, scale_constraint="unit")
    held = effective_params(raw, fixed)["point"]["out"]["kernel"][:, 0]
    np.testing.assert_allclose(held, [-2.0 * 3.0 / 1.6, -0.5 * 0.2 / 1.6], rtol=1e-5)


def test_todays_cost_sets_the_one_scale(tmp_path):
    features = feature_map(terms_file(tmp_path))
    rows = np.random.default_rng(0).uniform(0.0, 1.0, (100_000, 3))
    rows[:, 1:] = 0.0
    made = fit_normaliser(rows, features, (4.0, 1.0, 1.0))
    np.testing.assert_allclose(made.scale, 0.5 * 4.0 * 0.9, rtol=0.01)
    assert not np.any(made.location)
    with pytest.raises(InputError, match="today's cost is 0 nearly everywhere"):
        fit_normaliser(0.0 * rows, features, (4.0, 1.0, 1.0))


def driving_today(folder: Path, text: str = TRACED):
    """A weights file of own terms as they drive today."""
    train = override(load_recipe("terms").train, {"features": terms_file(folder, text)})
    return write_own_terms(folder / "today.msgpack", train)


@pytest.fixture(scope="module")
def today(tmp_path_factory):
    return driving_today(tmp_path_factory.mktemp("terms"))


def test_todays_file_says_todays_weights(today):
    found = own_weights(open_reward(today.file))
    for name, weight in {"slow": 2.0, "jerk": 0.5, "at_the_end": 1e-3}.items():
        assert found[name] == (weight, pytest.approx(weight, rel=1e-5))
    # its value is minus the mean of today's cost, in units of its spread
    x = np.random.default_rng(1).uniform(0.0, 9.0, (5, NUM_TIMES, 3)).astype(np.float32)
    cost = (x @ np.asarray([2.0, 0.5, 1e-3])).mean(axis=1)
    np.testing.assert_allclose(today.value(x), -cost / today.scale[0], rtol=1e-4)


def tuned(today):
    """The same with weights times 4, 1 and 1 / 4."""
    kernel = today.kernels[0] * np.asarray([[4.0], [1.0], [0.25]], np.float32)
    return dataclasses.replace(today, kernels=(kernel,))


def test_files_in_the_planners_own_words(today):
    assert "slow: 8\n" in terms_yaml(tuned(today))
    theirs = "planner:\n  weights: # by hand\n    slow: 2.0  # s\n    jerk: .5\n"
    theirs += "  at_the_end: 1e-3\n  other: 7\n"
    made = with_weights(theirs, tuned(today), "theirs")
    assert made == (
        "planner:\n  weights: # by hand\n    slow: 8.0  # s\n    jerk: 0.5\n"
        "  at_the_end: 0.00025\n  other: 7\n"
    )
    ranker = (
        "metrics:\n  name: [other, jerk, slow, at_the_end]\nscore_weight: "
        "[1.0, 1.0, 1.0, 1.0]\n"
    )
    made = with_weights(ranker, tuned(today), "ranker")
    assert "score_weight: [1.0, 0.5, 8.0, 0.00025]" in made
    with pytest.raises(InputError, match=r"theirs: jerk: found 0 times: expected one"):
        with_weights("slow: 1\n", tuned(today), "theirs")
    with pytest.raises(InputError, match="score_weight: 1 numbers: expected 4"):
        with_weights(ranker.replace(", 1.0, 1.0, 1.0", ""), today, "ranker")


def test_the_search_values_as_the_weights_file(today):
    features, scene = feature_map(today.preset), random_scene(0)
    kind = of_own_terms(features.own)
    candidates = sampled(jax.random.key(0), scene, SamplerConfig())
    mask = jnp.arange(NUM_TIMES) < 11
    known = kind.known(scene, candidates.trajectory, mask)
    made = kind.values(known, kind.baseline(jnp.zeros(3)), True)
    counts = np.broadcast_to(mask, (len(made), NUM_TIMES))
    rows = np.asarray(features.of_candidates(scene, candidates))
    scale = NUM_TIMES * today.scale[0]
    np.testing.assert_allclose(made, today.value(rows, counts) * scale, rtol=1e-4)


def test_terms_that_have_changed_are_refused(today):
    again = dataclasses.replace(today, provenance={**today.provenance, "own_terms": {}})
    with pytest.raises(InputError, match="no longer those that the weights"):
        features_of(again)


def with_slow(term):
    return TRACED.replace("jnp.abs(scene.path.speed_limit[0] - x.v)", term)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("TERMS = {'a': (len, 0.0)}", "a: weight 0.0: expected a number above 0"),
        ("TERMS = [1]", "list: expected {name: [(]term, weight"),
        ("TERMS = {'a': len}", "a: <built-in"),
        ("TERM = {}", "expected a name of that file: TERM; did you mean TERM"),
        (with_slow("x.v[:3]"), r"slow: shape \(3,\): expected a number or an array"),
        (with_slow("x.v / 0.0"), "slow: scene 0, candidate"),
    ],
)
def test_what_are_no_terms_is_one_line(tmp_path, text, line):
    with pytest.raises(InputError, match=line):
        driving_today(tmp_path, text)


def test_terms_that_change_are_another_training(tmp_path):
    place = terms_file(tmp_path)
    before = override(load_recipe("terms").train, {"features": place})
    key = before.for_features
    terms_file(tmp_path, TRACED.replace("x.j ** 2", "x.a ** 2"))
    after = override(load_recipe("terms").train, {"features": place})
    assert before.terms_sha256 != after.terms_sha256
    assert key != after.for_features
    with pytest.raises(InputError, match="have changed since the training"):
        dataclasses.replace(before, epochs=1)
