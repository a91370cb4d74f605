"""The conformance cases: they are what JAX says, and the checker finds what differs."""

import hashlib
import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from onboard.conformance import check, make
from rcirl_jax import units
from rcirl_jax.export import load_weights
from rcirl_jax.export.own_planner import features
from rcirl_jax.export.own_planner.builder import plain_scene
from rcirl_jax.export.own_planner.choose import admit
from rcirl_jax.features import columns as f
from rcirl_jax.planner.safety import SafetyConfig
from rcirl_jax.units import NUM_TIMES
from tests.helpers.own_planner import TOLERANCE, entries, error, numpy_answers
from tests.onboard.programs import ONBOARD

# answers from a file of numbers for each case, named by what is on stdin
ANSWERS = """
import hashlib, json, sys
given = hashlib.sha256(sys.stdin.read().encode()).hexdigest()
print(*json.load(open({path!r}))[given])
"""


@pytest.fixture(scope="module")
def cases():
    return {case.name: case for case in check.read_cases(check.CASES)}


@pytest.fixture(scope="module")
def scenes():
    return dict(make.cases())


def positions(case):
    """The stations and, if there are some, the offsets of a case [K, T]."""
    rows = [line.split() for line in case.given.splitlines()]
    found = {"s": [], "l": []}
    for label, *words in rows:
        if label in found and len(words) == NUM_TIMES:
            found[label].append([float(word) for word in words])
    s, l = (np.array(found[name], np.float32) for name in "sl")
    return s, l if len(l) else None


def test_the_cases_are_scenes_answers_and_rulings_of_the_numpy_files(cases, scenes):
    """Which are compared with JAX in test_features.py and test_safety.py."""
    assert list(cases) == list(scenes)
    for name, made in scenes.items():
        case, plain = cases[name], plain_scene(made)
        s, l = positions(case)
        text = [make.line(*x) for x in entries(plain, s, l)]
        assert case.given.splitlines() == [*text, "end"]
        reward = load_weights(ONBOARD / "conformance" / case.weights)
        assert case.columns == list(reward.names)
        found, values = numpy_answers(reward, plain, s, l)
        wanted = np.array(case.rows).reshape(found.shape)
        assert error(found[:, : case.valid], wanted[:, : case.valid]) <= TOLERANCE
        assert error(values, np.array(case.scores)) <= TOLERANCE
        safety = SafetyConfig(entry=l is not None)
        reason, obstacle, time = admit(plain, s, l, safety=safety)
        time = np.where(np.isfinite(time), time, -1.0)
        rulings = np.stack([reason, obstacle, time], axis=1).ravel()
        np.testing.assert_allclose(rulings, case.rulings, rtol=1e-6, err_msg=name)


def test_the_filter_is_compared_if_asked_for(cases, tmp_path):
    said = answers(cases, tmp_path, lambda name, numbers: numbers)
    assert checked(*said)[0] == 0
    assert checked("--filter", *said)[2][0] == "free_road: 1137 numbers: expected 1146"

    def whole(name, numbers):
        rulings = list(cases[name].rulings)
        rulings[0] += name == "follow"
        return [*numbers, *rulings]

    status, _, lines = checked("--filter", *answers(cases, tmp_path, whole))
    assert status == 1
    assert lines == ["follow: rulings: candidate 0, reason: 3: expected 2"]


def answers(cases, folder, change):
    """A program that answers as the file says, but for what `change` does to it."""
    said = {}
    for name, case in cases.items():
        numbers = [value for _, value, _ in case.expected()]
        said[hashlib.sha256(case.given.encode()).hexdigest()] = change(name, numbers)
    path = folder / "answers.json"
    path.write_text(json.dumps(said))
    return [sys.executable, "-c", ANSWERS.format(path=str(path))]


def checked(*command):
    words = [sys.executable, ONBOARD / "conformance" / "check.py", *command]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout.strip(), done.stderr.strip().splitlines()


# a file of F for planners, what stands there, the mistake instead, and the columns of
# the case "follow" that are wrong then
# a text of the columns' file, and the mistake instead
RIGHT = "xp.where(unknown, 0.0, speed - v)"
WRONG = "xp.where(unknown, 0.0, v - speed)"


def numpy_files(folder, monkeypatch):
    """The three files as a planner copies them, with the mistake."""
    for file in (f, features, units):
        text = Path(file.__file__).read_text()
        if file is f:
            assert text.count(RIGHT) == 1
            text = text.replace(RIGHT, WRONG)
        (folder / Path(file.__file__).name).write_text(text)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setitem(sys.modules, "rcirl_jax.features", None)
    for name in ("features", "columns", "units"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module("features")


def test_planted_faults_are_found(cases, scenes, tmp_path, monkeypatch):
    """A wrong sign of the relative speed, and nothing else, is named."""
    module = numpy_files(tmp_path, monkeypatch)

    def of_the_module(name, _):
        reward = load_weights(ONBOARD / "conformance" / cases[name].weights)
        scene, ways = plain_scene(scenes[name]), positions(cases[name])
        found = module.FeatureMap(reward.names, reward.units)(scene, *ways)
        values = reward.value(found, scene.time_valid)
        return [*found.ravel().tolist(), *values.tolist()]

    status, _, lines = checked(*answers(cases, tmp_path, of_the_module))
    assert status == 1
    named = [line.split(": ") for line in lines if line.startswith("follow: features")]
    assert {place.split(", ")[-1] for _, _, place, *_ in named} == {"follow_speed"}


def test_programs_that_fail_are_named():
    status, _, (line,) = checked(sys.executable, "-c", "raise SystemExit(3)")
    assert (status, line) == (2, "free_road: exit status 3: nothing on stderr")
    assert checked("/none/such")[0] == 2
    assert checked()[0] == 2
