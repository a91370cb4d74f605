"""The public API: its names, and the examples of their docstrings."""

import doctest
import inspect

import numpy as np
import pytest

import rcirl_jax
from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.errors import InputError
from tests.helpers.commands import python

MOST = 25  # names that a newcomer has to look through
SLOW = {"tune"}  # its stages are those of `rcirl autotune`, which has its tests
TYPES = {"Body", "Car", "CentreLine", "Signal", "InputError", "Reward", "WeightsError"}


def test_every_name_is_loaded_documented_and_typed():
    assert len(rcirl_jax.__all__) <= MOST
    assert set(rcirl_jax.__all__) == set(rcirl_jax._PLACES)
    assert set(rcirl_jax.__all__) <= set(dir(rcirl_jax))
    for name in rcirl_jax.__all__:
        found = getattr(rcirl_jax, name)
        assert found.__name__ == name
        assert inspect.getdoc(found)
        if inspect.isfunction(found):
            arguments = inspect.signature(found).parameters.values()
            annotated = [x.annotation is not x.empty for x in arguments]
            assert all(annotated), name
            assert "return" in found.__annotations__, name


def test_a_name_that_is_none_of_it():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        rcirl_jax.nothing  # noqa: B018


@pytest.mark.parametrize(
    ("names", "absent"),
    [
        (["load_weights", "Reward", "InputError"], "jax"),
        # only a report draws: nobody else needs its extra, or loses a backend to it
        (rcirl_jax.__all__, "matplotlib"),
    ],
    ids=["weights", "all"],
)
def test_what_a_name_does_not_load(names, absent):
    done = python(
        "import sys, rcirl_jax\n"
        f"[getattr(rcirl_jax, name) for name in {names}]\n"
        f"print({absent!r} in sys.modules)"
    )
    assert done.stdout.strip() == "False", done.stderr


SHOWN = {name: getattr(rcirl_jax, name) for name in rcirl_jax.__all__}
SHOWN |= {"Dataset": Dataset}


@pytest.mark.parametrize("name", sorted(set(SHOWN) - SLOW - TYPES))
def test_the_example_runs(name, examples, monkeypatch):
    """Each in the folder that docs/api.md describes."""
    monkeypatch.chdir(examples)
    known = {"rcirl_jax": rcirl_jax, "np": np}
    finder = doctest.DocTestFinder(recurse=False)
    (found,) = finder.find(SHOWN[name], name, globs=known)
    assert found.examples, f"{name}: no example"
    said = []
    doctest.DocTestRunner().run(found, out=said.append)
    assert not said, "".join(said)


@pytest.fixture(scope="module")
def scene(examples):
    return rcirl_jax.open_dataset(examples / "data")[0].scene


def test_own_candidates_are_those_of_the_sampler_at_the_same_positions(scene):
    """Derivatives and limits are made alike; l is left to the path, or given."""
    sampled = rcirl_jax.sample_candidates(scene)
    given = rcirl_jax.candidates_from(scene, sampled.trajectory.s)
    for name, mine in vars(given.trajectory).items():
        theirs = getattr(sampled.trajectory, name)
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-3, err_msg=name)
    aside = rcirl_jax.candidates_from(
        scene, sampled.trajectory.s, sampled.trajectory.l + 0.5
    )
    np.testing.assert_allclose(aside.trajectory.l, sampled.trajectory.l + 0.5)


def test_values_are_those_of_the_reader(scene, examples):
    reward = rcirl_jax.load_weights(examples / "weights.msgpack")
    candidates = rcirl_jax.sample_candidates(scene)
    features = rcirl_jax.compute_features(scene, candidates)
    expected = reward.value(features, scene.time_valid)
    found = rcirl_jax.score_candidates(reward, scene, candidates)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda scene: rcirl_jax.candidates_from(scene, [[1.0]]),
         r"candidates_from: s: shape \(1, 1\): expected finite numbers \[K, 18\]"),
        (lambda scene: rcirl_jax.candidates_from(scene, [[np.inf] * 18]),
         "candidates_from: s: not finite"),
        (lambda scene: rcirl_jax.candidates_from(scene, [[1.0] * 18], [[1.0]]),
         r"candidates_from: l: shape \(1, 1\): expected \(1, 18\) as s"),
        (lambda scene: rcirl_jax.sample_candidates(scene, mode="fly"),
         "mode: fly: expected one of speed, path_speed"),
        (lambda scene: rcirl_jax.import_logs("a.csv", "d", strides=1.0),
         "import_logs: strides: unknown.*did you mean stride_s"),
        (lambda scene: rcirl_jax.train_reward("d", "r", epoch=3),
         "settings: epoch: unknown.*did you mean epochs"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line(scene, call, line):
    with pytest.raises(InputError, match=line):
        call(scene)
