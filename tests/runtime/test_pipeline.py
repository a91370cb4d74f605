"""Stages: done once for their inputs, again when inputs or outputs change."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.runtime import pipeline
from rcirl_jax.runtime.pipeline import FILE, LOCK, Stages, only_one


@pytest.fixture
def stages(tmp_path):
    return Stages(folder=tmp_path)


def step(stages, text, inputs, name="one"):
    """One stage that writes a file; whether it ran."""
    path = stages.folder / f"{name}.txt"
    return stages.run(name, inputs, [path], lambda: path.write_text(text))


def test_a_stage_is_done_once_for_its_inputs(stages):
    assert step(stages, "a", {"x": 1})
    assert not step(stages, "b", {"x": 1})
    assert (stages.folder / "one.txt").read_text() == "a"
    assert step(stages, "c", {"x": 2})
    assert (stages.folder / "one.txt").read_text() == "c"


@pytest.mark.parametrize("harm", [Path.unlink, lambda path: path.write_text("other")])
def test_a_harmed_output_is_made_again(stages, harm):
    step(stages, "a", {"x": 1})
    path = stages.folder / "one.txt"
    harm(path)
    assert step(stages, "a", {"x": 1})
    assert path.read_text() == "a"


def test_what_fails_is_not_noted(stages):
    def fail():
        (stages.folder / "one.txt").write_text("half")
        raise InputError("no")

    with pytest.raises(InputError, match="no"):
        stages.run("one", {}, [stages.folder / "one.txt"], fail)
    assert step(stages, "a", {})
    with pytest.raises(InputError, match=r"two\.txt: missing after stage two"):
        stages.run("two", {}, [stages.folder / "two.txt"], lambda: None)


def test_what_would_mislead_goes_before_the_work(stages):
    """New weights beside the verdict on old ones, were the run killed here."""

    def killed():
        assert not (stages.folder / "verdict.txt").exists()
        raise KeyboardInterrupt

    step(stages, "w", {"x": 1}, "weights")
    step(stages, "ship w", {}, "verdict")
    outputs = [stages.folder / "weights.txt"]
    kept = stages.run("weights", {"x": 1}, outputs, killed, stale=["verdict"])
    assert not kept
    assert (stages.folder / "verdict.txt").read_text() == "ship w"
    with pytest.raises(KeyboardInterrupt):
        stages.run("weights", {"x": 2}, outputs, killed, stale=["verdict", "report"])
    assert list(stages.read()) == ["weights"]


@pytest.mark.parametrize("name", ["../outside.txt", "folder"])
def test_outputs_that_no_stage_makes_are_one_line(stages, name):
    """And nothing outside of the folder is removed."""
    outside = stages.folder.parent / "outside.txt"
    outside.write_text("precious")
    step(stages, "a", {}, "one")
    (stages.folder / "folder").mkdir()
    text = (stages.folder / FILE).read_text().replace("one.txt", name)
    (stages.folder / FILE).write_text(text)
    with pytest.raises(InputError, match=rf"{FILE}: one: {name}: .*expected a file of"):
        stages.run("two", {}, [], lambda: None, stale=["one"])
    assert outside.read_text() == "precious"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "expected the stages of a run"),
        ('{"schema_version": 9, "stages": {}}', "9: expected 1"),
        *(
            (json.dumps({"schema_version": 1, "stages": stages}), message)
            for stages, message in (
                ({"a": {"key": "k", "outputs": {"f": 1}}}, "'f': 1}: expected a text"),
                ({"b": {"key": "k", "outputs": {"f\0": "x"}}}, "b: outputs: .*: exp"),
                ({"b": {"outputs": {}}}, "b: key: missing"),
            )
        ),
    ],
)
def test_a_damaged_file_is_one_line(stages, text, message):
    (stages.folder / FILE).write_text(text)
    with pytest.raises(InputError, match=message):
        step(stages, "a", {})


def test_what_made_a_stage_is_noted_and_decides_nothing(stages):
    """Another commit with the same code and inputs keeps what is there."""
    path = stages.folder / "a.txt"

    def made(commit):
        work, facts = lambda: path.write_text("x"), {"git_commit": commit}
        return stages.run("a", {"x": 1}, [path], work, made_by=facts)

    assert made("abc")
    record = stages.read()["a"]
    assert record["made_by"] == {"git_commit": "abc"}
    assert not made("def")
    assert stages.read()["a"] == record  # of the commit that did the work


HOLDING = """
import sys, time
from pathlib import Path
from rcirl_jax.runtime.pipeline import only_one
with only_one(Path(sys.argv[1])):
    print('held', flush=True)
    time.sleep(float(sys.argv[2]))
"""


def holding(folder, seconds):
    """A process that holds the folder for so long, if nobody else does."""
    return subprocess.Popen(
        [sys.executable, "-c", HOLDING, str(folder), str(seconds)], text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


@pytest.mark.multiprocess
def test_a_second_process_is_refused_and_a_killed_one_holds_nothing(tmp_path):
    with only_one(tmp_path):
        out, err = holding(tmp_path, 0).communicate()
        assert out == ""
        assert "in use by another process" in err
    first = holding(tmp_path, 60)
    assert first.stdout.readline() == "held\n"
    with pytest.raises(InputError, match=f"{tmp_path}: in use"), only_one(tmp_path):
        pass
    first.kill()
    first.communicate()
    with only_one(tmp_path):
        assert (tmp_path / LOCK).exists()


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("pack/report/templates/page.html", True),
        ("specs/sources/csv.toml", True),
        ("specs/recipes/own.toml", False),  # settings of a run
    ],
)
def test_any_change_of_what_decides_results_is_other_code(
    tmp_path, monkeypatch, name, counts
):
    monkeypatch.setattr(pipeline, "PACKAGE", tmp_path / "pack")
    monkeypatch.setattr(pipeline, "spec_root", lambda: tmp_path / "specs")
    file, found = tmp_path / name, []
    file.parent.mkdir(parents=True)
    for text in ("a = 1", "a = 2"):
        file.write_text(text)
        found.append(pipeline.code_sha256.__wrapped__())
    assert (found[0] != found[1]) == counts
