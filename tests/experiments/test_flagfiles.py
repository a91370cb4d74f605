"""The experiments by their flag files, on little data; each is a complete program."""

import json

import pytest

from rcirl_jax.export.reader import load_weights
from tests.conftest import REPO
from tests.helpers.commands import command, refused

FOLDER = REPO / "experiments" / "flagfiles"
SHORT = "--suite=free_cruise,stopped_lead --cases=15 --duration=2 --drives=4"
LEARN = "--data={root}/data --workdir={out} --epochs=1"
# flag file: experiment, what makes it small, the file that it writes below OUT
RUNS = {
    "paper_import": (
        "import_logs",
        "--input={root}/logs --output={out}/data --stride=2 --norequire_speed_change",
        "data/manifest.json",
    ),
    "listwise_train": ("train", f"{LEARN} --batch_size=8", "weights.msgpack"),
    "sweep_leaky_hidden": (
        "sweep",
        f"{LEARN} --batch_size=8 --leaky_rates=0.05 --hidden_sizes=0 --seeds=1",
        "best.msgpack",
    ),
    "paper_evaluate": (
        "evaluate",
        "--weights={root}/w.msgpack --data={root}/data --output={out}/r.json",
        "r.json",
    ),
    "gate_full": (
        "gate",
        "--candidate={root}/w.msgpack --incumbent={root}/w.msgpack "
        f"--data={{root}}/data --output={{out}}/v.json {SHORT}",
        "v.json",
    ),
    "quick_demo": ("autotune", f"{LEARN} {SHORT}", "report.html"),
    "tuned_three_sites": (
        "autotune",
        f"{LEARN} --recipe=quick {SHORT}",
        "verdict.json",
    ),
    "learners": (
        "human_likeness",
        "--data={root}/data --output={out} --learners=GAN --seeds=1 --epochs=1",
        "ranking.json",
    ),
}
# as long as the gate's own tests: not in each run of the tests
LONG = ("quick_demo", "tuned_three_sites")


# their experiments run by other flag files, or by their commands in other tests
READ = {
    "paper_train": ("train", "--data=nowhere", "--workdir={out}"),
    "full_suite": ("simulate", "--weights=nowhere", "--output={out}"),
}


def test_every_flag_file_has_its_run():
    assert {file.stem for file in FOLDER.iterdir()} == {*RUNS, *READ}


@pytest.mark.multiprocess
@pytest.mark.parametrize("name", READ)
def test_a_flag_file_is_taken(name, tmp_path):
    module, *given = READ[name]
    given = [f"--flagfile={FOLDER / name}.flags", *given]
    line = refused(f"experiments.{module}", *(x.format(out=tmp_path) for x in given))
    assert "nowhere" in line  # which is asked for after the flags


@pytest.mark.multiprocess
@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=pytest.mark.slow if x in LONG else ()) for x in RUNS],
)
def test_a_flag_file_runs(name, root, tmp_path):
    module, small, written = RUNS[name]
    given = small.format(root=root, out=tmp_path).split()
    file = FOLDER / f"{name}.flags"
    done = command(f"experiments.{module}", f"--flagfile={file}", *given)
    judged = module in ("gate", "autotune")  # the status is the verdict's
    assert done.returncode in ((0, 2, 3) if judged else (0,)), done.stderr[-2000:]
    made = tmp_path / written
    assert made.is_file(), done.stderr[-2000:]
    if made.suffix == ".msgpack":
        assert load_weights(made).names
    if name == "gate_full":  # a reward against itself
        body = json.loads(made.read_text())
        assert (body["decision"], body["cases"]) == ("could not judge", 30)
        hashes = body["result_sha256"]
        assert hashes["candidate"] == hashes["incumbent"] != hashes["IDM"]
