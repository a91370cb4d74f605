"""A planner's own cost: of JAX, numpy and C the same; what is none is one line."""

from pathlib import Path

import jax
import numpy as np
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.export.closed_loop import gate_job
from rcirl_jax.planner import own_cost as module
from rcirl_jax.planner.own_cost import check_own_cost, own_cost
from rcirl_jax.planner.plan import no_plan
from rcirl_jax.planner.rank import ONLINE
from rcirl_jax.sampling import sample
from rcirl_jax.simulation.rollout import first_scenes
from rcirl_jax.simulation.suite import build, suite_refs
from tests.onboard.programs import ONBOARD, compiled

COSTS = Path(__file__).parent / "costs"


def place(name):
    return f"{COSTS / 'costs.py'}:{name}"


@pytest.fixture(scope="module")
def some():
    """Scenes and candidates of 60 cases."""
    scenes = first_scenes(build(suite_refs("full", 3, seed=2)[:60], 1.0))
    keys = jax.random.split(jax.random.key(1), 60)
    draw = jax.jit(jax.vmap(lambda key, scene: sample(key, scene, ONLINE)))
    return scenes, draw(keys, scenes)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    file = tmp_path_factory.mktemp("cost") / "libheadway.so"
    flags = ("-shared", "-fPIC", f"-I{ONBOARD / 'include'}")
    return compiled(COSTS / "cost.cpp", file, *flags)


def costs_of(cost, some):
    return -np.asarray(jax.jit(jax.vmap(lambda *x: cost.score(None, *x)))(*some))


def test_jax_numpy_and_c_say_the_same(some, library):
    by_jax = own_cost(place("headway_cost"))
    expected = costs_of(by_jax, some)
    assert not by_jax.is_called_back
    assert np.ptp(expected, axis=1).min() > 0.01
    for other in (own_cost(place("numpy_cost")), own_cost(library)):
        found = costs_of(other, some)
        np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-4)
        assert other.is_called_back
    assert own_cost(library).name == "headway"


def ends(row, some):
    """Where the plans of the first scenes end, m."""
    scenes = jax.tree.map(lambda x: x[:10], some[0])
    keys = jax.random.split(jax.random.key(2), 10)
    policy = jax.jit(jax.vmap(row.policy, in_axes=(None, 0, 0, None)))
    return np.asarray(policy(row.params, scenes, keys, no_plan()).s[:, -1])


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("constant", r"constant: in 100% of 60 scenes all candidates cost the same"),
        ("nan", r"nan: scene 0, candidate 0: nan: expected a finite cost"),
        ("one_too_few", r"one_too_few: shape \(\d+,\) for \d+ candidates: expected"),
        ("dies", r"dies: its process ended with status 9: expected costs"),
        ("endless", r"endless: no answer in 1 s: expected costs"),
    ],
)
def test_what_is_no_cost_is_one_line(name, line, some, monkeypatch):
    monkeypatch.setattr(module, "CALL_S", 1.0)
    with pytest.raises(InputError, match=line):
        check_own_cost(own_cost(place(name)), *some)


def version(folder, sign):
    """The place of a cost in three files; fast drives are best for a sign of -1."""
    (folder / "parts").mkdir(parents=True)
    (folder / "parts" / "weights.py").write_text(f"SPEED = {sign}\n")
    (folder / "terms.py").write_text(
        "from parts import weights\n"
        "def speed(x):\n"
        "    return weights.SPEED * x.v.mean(axis=1)\n"
    )
    (folder / "cost.py").write_text(
        "from __future__ import annotations\n"
        "import dataclasses\n"
        "import terms\n"
        "@dataclasses.dataclass\n"
        "class Mine:\n"
        "    weight: float = 1.0\n"
        "def my_cost(scene, candidates):\n"
        "    return Mine().weight * terms.speed(candidates.trajectory)\n"
    )
    return f"{folder / 'cost.py'}:my_cost"


def test_two_versions_of_an_own_cost_against_each_other(tmp_path, some):
    new, old = version(tmp_path / "new", -1.0), version(tmp_path / "old", 1.0)
    job, incumbent = gate_job(
        new, old, suite="smoke", cases=None, duration_s=4.0, catalogue_seed=0,
        plan_every=1, baselines=["+velocity", "IDM"],
    )  # fmt: skip
    rows = {row.name: row for row in job.rows()}
    assert [*rows] == ["candidate", "my_cost", "+velocity", "IDM"]
    assert incumbent == "my_cost"
    fastest, slowest = (ends(rows[name], some) for name in ("candidate", incumbent))
    assert np.all(slowest <= fastest)
    assert np.mean(slowest < fastest - 1.0) > 0.5
    assert [*job.planner_facts()] == [new, old]


def test_a_change_of_what_a_file_imports_is_a_change_of_the_cost(tmp_path):
    place = version(tmp_path / "new", -1.0)
    hashes = {own_cost.__wrapped__(place).sha256}
    for name in ("unread.py", "terms.py", "parts/weights.py"):
        with (tmp_path / "new" / name).open("a") as file:
            file.write("# changed\n")
        hashes.add(own_cost.__wrapped__(place).sha256)
    assert len(hashes) == 3  # what is not imported does not count


def test_a_library_without_the_functions(tmp_path, some):
    (tmp_path / "none.cpp").write_text("int rcirl_cost_abi() { return 1; }")
    file = compiled(tmp_path / "none.cpp", tmp_path / "libmine.so", "-shared", "-fPIC")
    with pytest.raises(InputError, match=r'rcirl_cost_abi: missing .* extern "C": '):
        check_own_cost(own_cost(str(file)), *some)
    (tmp_path / "libnone.so").write_bytes(b"no library")
    with pytest.raises(InputError, match=r"libnone.so: OSError: .*expected costs"):
        check_own_cost(own_cost(str(tmp_path / "libnone.so")), *some)
