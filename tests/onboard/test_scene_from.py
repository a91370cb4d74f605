"""Scenes from Cartesian input: C++ makes those that Python makes."""

import dataclasses
import subprocess

import numpy as np
import pytest

from rcirl_jax.export.own_planner.builder import plain_scene, scene_from
from rcirl_jax.export.own_planner.features import checked
from tests.helpers.own_planner import as_numbers
from tests.helpers.surroundings import as_words, drawn
from tests.onboard.programs import built

NO_CANDIDATES = np.zeros((0, 18))


@pytest.fixture(scope="module")
def program():
    folder = built("build_scene")
    return folder / "build_scene"


def in_cpp(program, given):
    """The scene's numbers, or the line of its refusal."""
    done = subprocess.run(
        [program], input=as_words(given).encode(), capture_output=True, check=False
    )
    if done.returncode == 0:
        return np.frombuffer(done.stdout, np.float32)
    assert done.returncode == 2, done.stderr.decode()[-2000:]
    return done.stderr.decode().rstrip("\n")


@pytest.mark.parametrize("first", [0, 50])
def test_random_surroundings_give_the_scene_of_python(program, first):
    for seed in range(first, first + 50):
        given = drawn(seed)
        found = in_cpp(program, given)
        made = checked(plain_scene(scene_from(**given)))  # 0 where nothing is there
        wanted = as_numbers(made, NO_CANDIDATES)[:-2]
        assert not isinstance(found, str), found
        np.testing.assert_allclose(
            found, wanted, atol=1e-3, rtol=1e-3, err_msg=f"{seed}"
        )


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"x": float("nan")}, "ego.x: nan: expected a finite number up to 1e9"),
        ({"heading": 90.0}, "ego.heading: 90: expected radians, not degrees"),
    ],
)
def test_wrong_input_has_one_line(program, changes, line):
    given = drawn(0)
    given["ego"] = dataclasses.replace(given["ego"], **changes)
    found = in_cpp(program, given)
    assert found == f"scene_from: {line}"
