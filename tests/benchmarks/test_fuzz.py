"""Damaged files for every reader, a few; benchmarks.reliability.fuzz has more."""

import importlib.util
import json
import random

import numpy as np
import pytest

from benchmarks.reliability.fuzz import contract, forms
from benchmarks.reliability.fuzz.readers import READERS
from rcirl_jax.errors import InputError, as_input_error
from rcirl_jax.export.sweep.result import read_sweep
from rcirl_jax.features import mapping
from rcirl_jax.report.ranking.sweep_picture import sweep_picture
from rcirl_jax.runtime import pipeline
from tests.helpers.commands import fresh

FEW = ("apollo", "nuplan", "argoverse2", "l5", "interaction", "ros2")
FEW += ("suite", "scenarios")


@pytest.fixture(autouse=True)
def own_presets(monkeypatch):
    """A target points the reader of presets to its folder: not beyond a test."""
    monkeypatch.setattr(mapping, "spec_root", mapping.spec_root)


def drawn(target, count, seed):
    """Inputs of a target: mutated seeds."""
    rng = random.Random(seed)
    for _ in range(count):
        index = rng.randrange(len(target.seeds))
        content = forms.mutate(target.seeds[index], target.forms[index], rng)
        yield bytes([index]) + content


def breach_of(target, data):
    """What reading one input breaks."""
    target.put(data)
    return contract.verdict(target.read, target.names)[0]


@pytest.mark.parametrize("name", sorted(READERS))
def test_a_reader_returns_or_says_one_line(name, tmp_path):
    """Whole files, and mutated ones."""
    target = READERS[name].make(tmp_path / "made")
    for index, content in enumerate(target.seeds):
        target.put(bytes([index]) + content)
        assert contract.verdict(target.read, target.names) == (None, None), index
    for data in drawn(target, 25 if name in FEW else 90, name):
        assert breach_of(target, data) is None


def test_a_sweep_that_is_read_can_be_drawn(tmp_path):
    target, drawings = READERS["sweeps"].make(tmp_path / "made"), 0
    for data in drawn(target, 1200, 3):
        target.put(data)
        try:
            report = read_sweep(tmp_path / "made")
        except InputError:
            continue
        if target.index(data) == 0 and drawings < 20:
            sweep_picture(tmp_path / "sweep.png", report)
            drawings += 1
    assert drawings == 20


def test_a_planted_defect_refused_memory_and_places_outside_are_seen(
    tmp_path, monkeypatch
):
    """A stage's record is not looked at; half of all memory is asked for."""
    monkeypatch.setattr(pipeline, "checked", lambda body, kind, where: body)
    target = READERS["stages"].make(tmp_path / "made")
    found = [breach_of(target, data) for data in drawn(target, 60, 1)]
    kinds = {breach.kind for breach in found if breach is not None}
    assert any(x.startswith(("AttributeError", "TypeError")) for x in kinds), kinds

    def read():
        with as_input_error("a.csv", "rows"):
            np.empty(2**62, np.uint8)

    assert contract.verdict(read, ["a.csv"])[0].kind.startswith("MemoryError at ")
    watch, secret = contract.Watch(tmp_path / "made"), tmp_path / "secret"
    with watch:
        (tmp_path / "made" / "fine").write_text("x")
    assert watch.seen == []
    with watch:
        secret.write_text("y")
        secret.unlink()
    assert [x.kind for x in watch.seen] == ["written outside", "os.remove"]


@pytest.mark.slow
@pytest.mark.multiprocess
def test_the_command_writes_a_row_per_reader(tmp_path):
    """Guided in an environment with atheris (`make reliability`)."""
    flags = ("--readers=stages,tfrecord", "--inputs=400", f"--output={tmp_path}")
    plain = [] if importlib.util.find_spec("atheris") else ["--unguided"]
    done = fresh("benchmarks.reliability.fuzz", *flags, *plain)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads((tmp_path / "fuzz.json").read_text())["rows"]
    assert [row["reader"] for row in rows] == ["stages", "tfrecord"]
    assert sum(row["inputs"] for row in rows) >= 400
    assert all(row["crashes"] == [] for row in rows)
