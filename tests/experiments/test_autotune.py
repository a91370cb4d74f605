"""The loop by its command: once, again; `slow`: changed, damaged."""

import json

import pytest

from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.runtime.pipeline import only_one
from tests.helpers.commands import command, fresh

SMALL = (
    "--synthetic", "--recipe=quick", "--stride=60", "--epochs=1", "--drives=6",
    "--suite=free_cruise,stopped_lead", "--cases=15", "--duration=2",
)  # fmt: skip
REHEARSED = """
[train]
epochs = 1
loss = "listwise"
positive = "nearest"
[rehearsal]
teacher = "hand-set"
cases = 1
takeover_cases = 1
rounds = 1
duration_s = 45.0
stride_s = 8.0
takeover_stride_s = 4.0
"""


def kept(done):
    """Stage -> whether it was kept."""
    lines = [x for x in done.stdout.splitlines() if x.startswith("[")]
    return {x[1 : x.index("]")]: x.endswith("kept") for x in lines}


@pytest.mark.multiprocess
def test_a_small_loop(tmp_path):
    run, own = tmp_path / "run", tmp_path / "own.toml"
    own.write_text(REHEARSED)
    flags = (f"--workdir={run}", *SMALL, f"--recipe={own}")
    done = command("experiments.autotune", *flags)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.rstrip().endswith(f"report to open: {run}/report.html")
    assert "verdict: " in done.stdout
    stages = [
        "import 0", "rehearse 0", "rehearse learner 1", "rehearse 1", "train 0",
        "export", "tune", "rank predicted", "rank recorded", "simulate", "likeness",
        "gate", "report",
    ]  # fmt: skip
    assert kept(done) == dict.fromkeys(stages, False)
    verdict = json.loads((run / "verdict.json").read_text())
    assert verdict["cases"] == 30
    assert verdict["files"]["incumbent"] == "hand-set"
    page = (run / "report.html").read_text()
    assert verdict["decision"] in page
    assert f"&quot;recipe&quot;: &quot;{own}&quot;" in page
    assert verdict["training_runs"] == 1
    left_out = "30 cases, 4,110 of the full suite's left out; cases of 2 s instead of"
    assert verdict["part"].startswith(left_out)
    assert "recorded human" in page  # drives beside the others
    assert "features without effect" in done.stdout
    likeness = json.loads((run / "likeness.json").read_text())
    rows = {"candidate", "hand-set", "IDM", "IDM, tuned", "constant V", "+velocity"}
    assert rows | {"random weights", "recorded human"} == set(likeness["rows"])
    table = (run / "suite" / "table.txt").read_text()
    assert all(name in table for name in rows)
    kinds = {check["kind"] for check in verdict["checks"]}
    assert {"safety", "nulls", "likeness", "gain"} <= kinds
    noted = json.loads((run / "stages.json").read_text())["stages"]
    assert list(noted) == stages
    for record in noted.values():
        assert set(record["made_by"]) == {
            "git_commit", "code_sha256", "versions", "flags",
        }  # fmt: skip

    again = fresh("experiments.autotune", *flags)
    assert all(kept(again).values()), again.stdout
    (run / "report.html").unlink()
    copy = tmp_path / "copy.html"
    drawn = command("experiments.report", f"--workdir={run}", f"--output={copy}")
    assert kept(drawn) == {"report": False}, drawn.stderr[-2000:]
    assert verdict["decision"] in (run / "report.html").read_text()
    assert copy.read_bytes() == (run / "report.html").read_bytes()
    assert 'id="training-heading"' in page
    assert all(kept(fresh("experiments.autotune", *flags)).values())
    dataset = open_dataset(*run.glob("dataset-*"))
    assert dataset.facts()["data_hash"] == dataset.hash
    assert "flags" in dataset.facts()["made_by"]


@pytest.mark.slow
@pytest.mark.multiprocess
def test_a_damaged_report_is_drawn_again_to_the_byte(tmp_path):
    flags = (f"--workdir={tmp_path}", *SMALL)
    assert command("experiments.autotune", *flags).returncode == 0
    page = (tmp_path / "report.html").read_bytes()
    (tmp_path / "report.html").write_text("damaged")
    mended = fresh("experiments.autotune", *flags)
    assert [name for name, was in kept(mended).items() if not was] == ["report"]
    assert (tmp_path / "report.html").read_bytes() == page


@pytest.mark.slow
@pytest.mark.multiprocess
def test_other_weights_leave_no_old_verdict(tmp_path):
    run = tmp_path / "run"
    flags = (f"--workdir={run}", *SMALL)
    assert command("experiments.autotune", *flags).returncode == 0
    assert (run / "verdict.json").exists()
    other = command(
        "experiments.autotune", *flags, "--learning_rate=2e-3", "--until=train"
    )
    told = {name: was for name, was in kept(other).items() if name[:8] != "rehearse"}
    assert told == {"import 0": True, "train 0": False, "export": False}
    assert not (run / "verdict.json").exists()
    assert not (run / "report.html").exists()


@pytest.mark.multiprocess
@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--incumbent=nobody.msgpack",), "nobody.msgpack"),
        (("--seeds=0",), "--seeds: 0: expected at least 1"),
        (("--format=ngsim",), "--input: not given"),
        (("--suite=everything",), "--suite: everything: expected full"),
        (("--features=mine",), "mine"),
        (("--mode=path_speed",), "--mode: path_speed: the closed loop plans speed"),
        (
            ("--sweep=nowhere",),
            "nowhere/sweep.json: No such file or directory: expected the result of",
        ),
    ],
)
def test_what_cannot_be_is_one_line_before_any_work(flags, message, tmp_path):
    done = command("experiments.autotune", f"--workdir={tmp_path}/run", *SMALL, *flags)
    assert done.returncode == 2, done.stdout
    (line,) = done.stderr.strip().splitlines()
    assert message in line
    assert not (tmp_path / "run" / "stages.json").exists()


@pytest.mark.multiprocess
def test_a_page_of_no_run_is_one_line(tmp_path):
    done = command("experiments.report", f"--workdir={tmp_path}")
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert line.endswith("stages.json: gate: missing: expected a run with its verdict")
    gate = {
        "key": "k",
        "inputs": {},
        "outputs": {},
        "made_by": {"flags": {"seeds": []}},
    }
    stages = {"schema_version": 1, "stages": {"gate": gate}}
    (tmp_path / "stages.json").write_text(json.dumps(stages))
    for flag, message in (("--seeds=2", "--seeds: expected none"), ("", "--seeds: ")):
        done = command("experiments.report", f"--workdir={tmp_path}", *flag.split())
        assert done.returncode == 2
        (line,) = done.stderr.strip().splitlines()
        assert message in line


@pytest.mark.multiprocess
def test_a_run_in_use_is_one_line(tmp_path):
    run = tmp_path / "run"
    with only_one(run):
        done = command("experiments.autotune", f"--workdir={run}", *SMALL)
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(f"error: {run}: in use by another process: ")
    assert [x.name for x in run.iterdir()] == [".lock"]
