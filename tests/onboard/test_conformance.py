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


def test_the_cases_hold_the_scenes_of_the_package(cases):
    assert list(cases) == list(scenes())
    for name, made in scenes().items():
        ways = positions(cases[name])
        text = [make.line(*x) for x in entries(plain_scene(made), *ways)]
        assert cases[name].given.splitlines() == [*text, "end"]


def test_the_answers_are_those_of_the_numpy_file(cases):
    """Which is compared with JAX in test_features.py."""
    for name, made in scenes().items():
        case = cases[name]
        reward = load_weights(ONBOARD / "conformance" / case.weights)
        assert case.columns == list(reward.names)
        found, values = numpy_answers(reward, plain_scene(made), *positions(case))
        wanted = np.array(case.rows).reshape(found.shape)
        valid = case.valid
        assert error(found[:, :valid], wanted[:, :valid]) <= TOLERANCE
        assert error(values, np.array(case.scores)) <= TOLERANCE


def test_the_rulings_are_those_of_the_numpy_file(cases):
    for name, made in scenes().items():
        s, l = positions(cases[name])
        safety = SafetyConfig(entry=l is not None)
        reason, obstacle, time = admit(plain_scene(made), s, l, safety=safety)
        time = np.where(np.isfinite(time), time, -1.0)
        found = np.stack([reason, obstacle, time], axis=1).ravel()
        np.testing.assert_allclose(found, cases[name].rulings, rtol=1e-6, err_msg=name)


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
FAULTS = {
    "none": (features, "", "", ()),
    "sign_of_relative_speed": (
        f,
        "xp.where(unknown, 0.0, speed - v)",
        "xp.where(unknown, 0.0, v - speed)",
        ("follow_speed",),
    ),
}


def numpy_files(module, old, new, folder, monkeypatch):
    """The three files as a planner copies them, with one text of one replaced."""
    for file in (f, features, units):
        text = Path(file.__file__).read_text()
        if file is module and old:
            assert text.count(old) == 1
            text = text.replace(old, new)
        (folder / Path(file.__file__).name).write_text(text)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setitem(sys.modules, "rcirl_jax.features", None)
    for name in ("features", "columns", "units"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module("features")


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_found(cases, tmp_path, monkeypatch, fault):
    *planted, columns = FAULTS[fault]
    given = scenes()
    module = numpy_files(*planted, tmp_path, monkeypatch)

    def of_the_module(name, _):
        reward = load_weights(ONBOARD / "conformance" / cases[name].weights)
        scene, ways = plain_scene(given[name]), positions(cases[name])
        found = module.FeatureMap(reward.names, reward.units)(scene, *ways)
        values = reward.value(found, scene.time_valid)
        return [*found.ravel().tolist(), *values.tolist()]

    status, _, lines = checked(*answers(cases, tmp_path, of_the_module))
    assert status == int(fault != "none")
    named = [line.split(": ") for line in lines if line.startswith("follow: features")]
    assert {place.split(", ")[-1] for _, _, place, *_ in named} == set(columns)


def test_programs_that_fail_are_named():
    status, _, (line,) = checked(sys.executable, "-c", "raise SystemExit(3)")
    assert (status, line) == (2, "free_road: exit status 3: nothing on stderr")
    assert checked("/none/such")[0] == 2
    assert checked()[0] == 2
