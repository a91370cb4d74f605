"""Wrong flags of every command: one line that names them, before any work."""

import pytest

from tests.helpers.commands import refused

TRAIN = "train --data={data} --output={out}"
TUNE = "autotune --output={out}"
GATE = "gate --candidate={weights} --output={out}.json --suite=free_cruise"
DRIVE = "simulate --weights={weights} --output={out} --baselines="
ELSEWHERE = "drive-elsewhere --weights={weights} --output={out}"
EXPORT = "export --weights={weights}"
RANK = "human-likeness --data={data} --output={out}"
SWEEP = "sweep --data={data} --output={out}"
WRONG = (
    ("tune", "tune: unknown: expected one of autotune, "),
    ("import --output={out}", "--input: not given: expected a file or folder"),
    ("import --stride=far", "--stride: far: expected a number"),
    ("sweep --trails=9", "Did you mean: trials"),
    ("rank --flagfile=nix", "error: --flagfile: nix: No such file or directory: "),
    ("import --format=commonroad --input=nowhere --output={out}", "nowhere"),
    ("import --format=synthetic --stride=0 --output={out}", "stride"),
    (f"{TRAIN} more", "more"),
    (f"{TRAIN} --num_processes=2", "all three"),
    (f"{TRAIN} --tags=turnig", "--tags: turnig: expected some of"),
    (f"{TRAIN} --hidden_size=4 --constraint=nonnegative", "--hidden_size: (4,): exp"),
    ("export --run=nowhere", "run.json: missing"),
    ("inspect --data={data} --output={out} --rows=1,two", "expected row numbers"),
    ("compare {data} {data} --output={out}", "data: no verdict in it: expected"),
    ("compare {data} --output={out}", "--runs: 1 given: expected two folders"),
    ("report --run={data}", "gate: missing: expected a run with its verdict"),
    ("export --onnx={out}", "--run, --weights: expected one of them"),
    (f"{EXPORT} --yaml={{out}}", "expected a linear reward"),
    (f"{ELSEWHERE} --simulator=sumoo", "did you mean sumo?"),
    (f"{ELSEWHERE} --simulator=sumo --seconds=0", "--seconds: 0: expected 1 to 600 s"),
    (TUNE, "--data, --input, --synthetic: expected one of them"),
    (f"{TUNE} --input=x --format=ngsmi", "did you mean ngsim?"),
    (f"{TUNE} --synthetic --incumbent=nobody.msgpack", "nobody.msgpack"),
    (f"{TUNE} --synthetic --cases=1", "--cases: 23 in all: the gate expects at least"),
    (f"{TUNE} --synthetic --sweep=nowhere", "nowhere/sweep.json: No such file"),
    (f"{TUNE} --synthetic --duration=-1", "--duration: -1.0: expected 1 to 120 s"),
    (f"{GATE} --progress_margin=-1", "--progress_margin: -1.0: expected within (0"),
    (f"{GATE} --plan_every=0", "--plan_every: 0: expected at least 1"),
    (f"{DRIVE} --suite=heldout", "--data: []: expected distinct datasets"),
    (f"{DRIVE} --suite=smoke --data=somewhere", "--data: with --suite=smoke"),
    (f"{SWEEP} --leaky_rates=0.05,much", "--leaky_rates: ["),
    (f"{RANK} --holdout=recording --recording=99", "--recording: [99]: expected"),
    (f"{RANK} --folds=2 --holdout=groups", "--holdout: groups: expected none beside"),
    # shared flags that an experiment does not read, or leaves no choice in
    ("paper.table2 --output={out} --seeds=3", "flag --seeds=3: expected 2 here"),
    ("paper.one_frame --output={out} --weights=x --epochs=3", "--epochs: 3: expected"),
    ("paper.artefact_audit --positive=human", "Unknown command line flag 'positive'"),
)


@pytest.mark.multiprocess
@pytest.mark.parametrize(("command", "message"), WRONG)
def test_wrong_flags_are_one_line_before_any_work(command, message, root, tmp_path):
    places = {"data": root / "data", "weights": root / "w.msgpack"}
    places["out"] = tmp_path / "out"
    name, *flags = (word.format(**places) for word in command.split())
    paper = name.startswith("paper.")
    module = (f"experiments.{name}",) if paper else ("rcirl_jax", name)
    assert message in refused(*module, *flags)
    assert not [x.name for x in tmp_path.rglob("*") if x.is_file()]


@pytest.mark.multiprocess
def test_a_gate_that_is_refused_leaves_no_verdict_of_another(root, tmp_path):
    (tmp_path / "v.json").write_text("the verdict of another candidate")
    flags = (f"--candidate={root}/w.msgpack", f"--output={tmp_path}/v.json")
    refused("rcirl_jax", "gate", *flags, "--incumbent=nobody")
    assert not (tmp_path / "v.json").exists()
