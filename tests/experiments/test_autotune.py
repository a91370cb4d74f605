"""The loop by its command: once, again, changed, damaged."""

import json

import pytest

from tests.commands import command

SMALL = (
    "--stride=60", "--epochs=1", "--suite=free_cruise,stopped_lead", "--cases=15",
    "--duration=2",
)  # fmt: skip


def kept(done):
    """Stage -> whether it was kept."""
    lines = [x for x in done.stdout.splitlines() if x.startswith("[")]
    return {x[1 : x.index("]")]: x.endswith("kept") for x in lines}


@pytest.mark.multiprocess
def test_a_small_loop(tmp_path):
    run = tmp_path / "run"
    flags = (f"--workdir={run}", *SMALL)
    done = command("experiments.autotune", *flags)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.rstrip().endswith(f"report to open: {run}/report.html")
    assert "verdict: " in done.stdout
    stages = ["import", "train 0", "export", "rank", "simulate", "gate", "report"]
    assert kept(done) == dict.fromkeys(stages, False)
    verdict = json.loads((run / "verdict.json").read_text())
    assert verdict["cases"] == 30
    assert verdict["files"]["incumbent"] == "hand-set"
    page = (run / "report.html").read_text()
    assert verdict["decision"] in page
    assert list(json.loads((run / "stages.json").read_text())["stages"]) == stages

    again = command("experiments.autotune", *flags)
    assert all(kept(again).values()), again.stdout

    (run / "report.html").write_text("damaged")
    mended = command("experiments.autotune", *flags)
    assert [name for name, was in kept(mended).items() if not was] == ["report"]
    assert (run / "report.html").read_text() == page


@pytest.mark.multiprocess
@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--incumbent=nobody.msgpack",), "nobody.msgpack"),
        (("--seeds=0",), "--seeds: 0: expected at least 1"),
        (("--format=ngsim",), "--input: not given"),
        (("--suite=everything",), "--suite: everything: expected full"),
    ],
)
def test_what_cannot_be_is_one_line_before_any_work(flags, message, tmp_path):
    done = command("experiments.autotune", f"--workdir={tmp_path}/run", *SMALL, *flags)
    assert done.returncode == 2, done.stdout
    (line,) = done.stderr.strip().splitlines()
    assert message in line
    assert not (tmp_path / "run" / "stages.json").exists()
