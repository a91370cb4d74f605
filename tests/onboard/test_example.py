"""The worked example of docs/own_planner.md: a stranger's folder, and its C++ twin."""

import inspect
import os
import shutil
import subprocess
import sys
from pathlib import Path

import msgpack
import numpy as np
import pytest

from rcirl_jax import Body, Car, CentreLine, load_weights, scene_from, units
from rcirl_jax.export import reader
from rcirl_jax.export.own_planner import choose, features
from rcirl_jax.export.own_planner.builder import plain_scene
from rcirl_jax.features import columns
from rcirl_jax.planner import safety
from tests.export.test_weights import golden
from tests.helpers.own_planner import TOLERANCE, error, numpy_answers
from tests.onboard.programs import ONBOARD, built, run

WEIGHTS = sorted((ONBOARD / "conformance").glob("*.msgpack"))


@pytest.fixture(scope="module")
def stranger(tmp_path_factory):
    """A folder with the files and the program, and where only two packages are."""
    folder, packages = (tmp_path_factory.mktemp(name) for name in ("own", "packages"))
    program = ONBOARD / "example" / "own_planner.py"
    for module in (features, choose, columns, safety, units, reader):
        shutil.copy(inspect.getfile(module), folder)
    shutil.copy(program, folder)
    for package in (np, msgpack):
        place = Path(package.__file__).parent
        for item in place.parent.glob(f"{place.name}*"):  # its shared libraries too
            (packages / item.name).symlink_to(item)
    return folder, {**os.environ, "PYTHONPATH": str(packages)}


@pytest.fixture(scope="module")
def twin():
    return built("own_planner") / "own_planner"


def in_python(stranger, *arguments):
    folder, environment = stranger
    command = (sys.executable, "-S", *arguments)
    return run(*command, cwd=folder, env=environment).decode()


def answer(said, weights):
    """The ten values of what a program prints, and why each is not admissible."""
    *told, best = said.splitlines()
    about, lines = told[:-10], [line.split(" ", 3) for line in told[-10:]]
    assert about == load_weights(weights).describe().splitlines()
    assert [name for _, name, *_ in lines] == [f"{k}:" for k in range(10)]
    found = np.array([float(value) for *_, value, _ in lines])
    why = [text for *_, text in lines]
    admissible = np.array([text == "is admissible" for text in why])
    chosen = np.argmax(np.where(admissible, found, -np.inf))
    assert best == f"best: candidate {chosen}"
    return found, why


@pytest.mark.parametrize("weights", WEIGHTS, ids=lambda path: path.stem)
def test_both_programs_print_what_the_package_says(stranger, twin, weights):
    shutil.copy(weights, stranger[0] / "weights.msgpack")
    said = in_python(stranger, "own_planner.py", "weights.msgpack")
    found, why = answer(said, weights)
    assert np.ptp(found) > 0.1
    in_cpp, why_in_cpp = answer(run(twin, weights).decode(), weights)
    assert error(in_cpp, found) <= TOLERANCE
    assert why_in_cpp == why
    # who does not brake hits the car ahead, which the value alone does not say
    hits = [text.startswith("hits obstacles[0] after ") for text in why]
    assert hits == [k >= 6 for k in range(10)]
    best = int(np.argmax(found))
    assert hits[best] == (weights.stem == "apollo21")

    a = -3.0 + 0.5 * np.arange(10)[:, None]
    t = np.minimum(8.0 * np.arange(18) / 17.0, 12.0 / np.maximum(-a, 1e-9))
    size = {"length": 4.5, "width": 1.8, "heading": 0.0}
    scene = scene_from(
        ego=Car(x=0.0, y=0.0, heading=0.0, speed=12.0, length=4.9, width=2.1),
        centre_line=CentreLine(points=[[-50, 0], [300, 0]], speed_limit=13.9),
        obstacles=[
            Body(x=30.0, y=0.0, speed=8.0, **size),
            Body(x=-15.0, y=3.6, speed=14.0, **size),
        ],
        predictions=[
            [(0.0, 30.0, 0.0, 0.0), (8.0, 94.0, 0.0, 0.0)],
            [(0.0, -15.0, 3.6, 0.0), (8.0, 97.0, 3.6, 0.0)],
        ],
    )
    s = 12.0 * t + 0.5 * a * t * t
    _, wanted = numpy_answers(load_weights(weights), plain_scene(scene), s)
    assert error(found, wanted) <= TOLERANCE


def test_the_stranger_has_numpy_and_msgpack_only(stranger):
    for name in ("jax", "scipy", "rcirl_jax"):
        with pytest.raises(AssertionError, match=f"No module named '{name}'"):
            in_python(stranger, "-c", f"import {name}")


def test_choose_adds_a_reward_with_a_prior_cost_to_the_costs(tmp_path):
    choose = built("choose") / "choose"
    weights, features, *_ = golden()
    features = features.astype("<f4")
    costs = np.linspace(2.0, -3.0, len(features), dtype="<f4")
    total = load_weights(weights).total(features, -costs)
    best = int(np.argmax(total))
    may = np.arange(len(features)) != best
    second = int(np.argmax(np.where(may, total, -np.inf)))
    (tmp_path / "costs.f32").write_bytes(costs.tobytes())
    (tmp_path / "few.f32").write_bytes(costs[1:].tobytes())
    (tmp_path / "all").write_bytes(b"\1" * len(features))
    (tmp_path / "others").write_bytes(may.tobytes())

    def said(file, *names):
        words = [choose, file, *(tmp_path / name for name in names)]
        return subprocess.run(words, input=features.tobytes(), capture_output=True)

    done = said(weights, "others", "costs.f32")
    assert done.stdout.decode().startswith(f"candidate {second} of "), done.stderr
    done = said(weights, "all", "costs.f32")
    start = f"candidate {best} of {len(total)}, value "
    assert done.stdout.decode().startswith(start), done.stderr
    value = float(done.stdout.decode().removeprefix(start).split(",")[0])
    assert value == pytest.approx(total.max(), rel=1e-5)
    for file, names, wanted in (
        (weights, (), "expected WEIGHTS ADMISSIBLE [COSTS]"),
        (weights, ("all",), "COSTS as a third argument"),
        (weights, ("none", "costs.f32"), "admissible: 0 bytes"),
        (weights, ("all", "few.f32"), f"expected {len(costs)}"),
        (WEIGHTS[0], ("all", "costs.f32"), "expected no COSTS"),
    ):
        done = said(file, *names)
        assert done.returncode == 2
        assert wanted in done.stderr.decode()
