"""Wrong flags of every command: one line that names them, before any work."""

import pytest

from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.scenes.config import CollectConfig
from tests.helpers.commands import refused
from tests.helpers.weights_files import random_weights

TRAIN = "train --data={data} --output={out}"
TUNE = "autotune --output={out}"
GATE = "gate --candidate={weights} --output={out}.json --suite=free_cruise"
DRIVE = "simulate --weights={weights} --output={out} --baselines="
ELSEWHERE = "drive_elsewhere --weights={weights} --output={out}"
EXPORT = "export_weights --weights={weights}"
RANK = "human_likeness --data={data} --output={out}"
FOLDS = f"{RANK} --folds=2"
SWEEP = "sweep --data={data} --output={out}"
ONE_FRAME, TABLE2 = ("paper.one_frame --output={out}", "paper.table2 --output={out}")
WRONG = (
    ("import_logs --format=commonroad --input=nowhere --output={out}", "nowhere"),
    ("import_logs --format=synthetic --stride=0 --output={out}", "stride"),
    ("train --data=nowhere --output={out}", "nowhere"),
    ("train --output={out}", "data"),
    (f"{TRAIN} --loss=hope", "loss"),
    (f"{TRAIN} --epoch=3", "epoch"),
    (f"{TRAIN} more", "more"),
    (f"{TRAIN} --num_processes=2", "all three"),
    (f"{TRAIN} --parallel=ring", "parallel"),
    ("evaluate --weights=nowhere --data=nowhere", "nowhere"),
    ("export_weights --run=nowhere", "run.json: missing"),
    ("export_weights --onnx={out}", "--run, --weights: expected one of them"),
    ("export_weights --yaml={out} --run=x", "expected --weights with"),
    (f"{ELSEWHERE} --simulator=sumoo", "did you mean sumo?"),
    (f"{ELSEWHERE} --simulator=sumo --episodes=1", "--episodes: 1: expected at least"),
    (f"{ELSEWHERE} --simulator=sumo --seconds=0", "--seconds: 0: expected 1 to 600 s"),
    (f"{EXPORT} --yaml={{out}}", "expected a linear reward"),
    (EXPORT, "--onnx, --stablehlo"),
    (TUNE, "--data, --input, --synthetic: expected one of them"),
    (f"{TUNE} --synthetic --recipe=tunde", "did you mean tuned?"),
    (f"{TUNE} --input=x --format=ngsmi", "did you mean ngsim?"),
    (f"{TUNE} --synthetic --incumbent=nobody.msgpack", "nobody.msgpack"),
    (f"{TUNE} --synthetic --leave_out=few", "--leave_out: few: expected a count"),
    (f"{TRAIN} --tags=turnig", "--tags: turnig: expected some of"),
    (f"{TUNE} --synthetic --seeds=0", "--seeds: 0: expected at least 1"),
    (f"{TUNE} --synthetic --format=ngsim", "--input: not given"),
    (f"{TUNE} --synthetic --suite=all", "--suite: all: expected full"),
    (f"{TUNE} --synthetic --features=mine", "mine"),
    (f"{TUNE} --synthetic --mode=path_speed", "path_speed: the closed loop plans"),
    (f"{TUNE} --synthetic --sweep=nowhere", "nowhere/sweep.json: No such file"),
    (f"{GATE} --incumbent=nobody", "nobody"),
    (f"{GATE} --progress_margin=-1", "--progress_margin: -1.0: expected within (0"),
    (f"{GATE} --duration=0.1", "--duration: 0.1: expected 1 to 120 s"),
    (f"{GATE} --suite=cut_in,cut_in", "a family twice"),
    (f"{DRIVE} --suite=heldout", "--data: []: expected distinct datasets"),
    (f"{DRIVE} --suite=smoke --data=somewhere", "--data: with --suite=smoke"),
    (f"{DRIVE} --suite=heldout --duration=3", "--duration: of --suite=heldout"),
    (f"{DRIVE} --tuned_idm=none.json", "none.json"),
    (f"{SWEEP} --leaky_rates=0.05,much", "--leaky_rates: ["),
    (f"{SWEEP} --hidden_sizes=15,32xb", "--hidden_sizes: ["),
    (f"{RANK} --learners=", "--learners: none: expected"),
    (f"{RANK} --split_seed=-1", "--split_seed"),
    (f"{RANK} --horizon=9", "--horizon"),
    (f"{RANK} --holdout=recording --recording=99", "--recording: [99]: expected"),
    (f"{RANK} --holdout=recording --recording=a", "--recording: ['a']: inv"),
    (f"{RANK} --recording=1", "['1']: expected with --holdout=recording"),
    (f"{RANK} --recording=1 --holdout=vehicles", "=recording, not vehicles"),
    (f"{RANK} --split_seed=1", "=vehicles or validation, not groups"),
    (f"{RANK} --split_seed=1 --holdout=recording", "not recording"),
    (f"{FOLDS} --holdout=groups", "--holdout: groups: expected none beside"),
    (f"{FOLDS} --recording=1", "--recording: ['1']: expected none beside --folds"),
    (f"{FOLDS} --split_seed=0", "--split_seed: 0: expected none beside --folds"),
    # shared flags that an experiment does not read, or leaves no choice in
    (f"{TABLE2} --cases=3", "Unknown command line flag 'cases'"),
    (f"{TABLE2} --seeds=3", "flag --seeds=3: expected 2 here"),
    (f"{TABLE2} --weights=x --losses=gan", "expected none beside --weights"),
    (f"{TABLE2} --weights=missing", "missing: "),
    (f"{ONE_FRAME} --data={{data}} --row=-5", "--row: -5: expected one of"),
    (f"{ONE_FRAME} --seeds=3", "Unknown command line flag 'seeds'"),
    (f"{ONE_FRAME} --weights=x --epochs=3", "--epochs: 3: expected none beside"),
    ("paper.background_shift --seed=-1 --output={out}", "--seed"),
    ("paper.artefact_audit --positive=human", "Unknown command line flag 'positive'"),
    ("paper.discount_factors --horizon=5", "flag --horizon=5.0: expected 8.0 here"),
    ("paper.discount_factors --data={data} --seeds=1", "--seeds: 1: expected at"),
)


@pytest.fixture(scope="session")
def places(tmp_path_factory):
    """A dataset and a weights file."""
    folder = tmp_path_factory.mktemp("wrong")
    config = ImportConfig(format="synthetic", collect=CollectConfig(stride_s=120.0))
    import_logs(read_recordings("synthetic", None), folder / "data", config)
    weights = random_weights(folder / "w.msgpack")
    return {"data": folder / "data", "weights": weights}


@pytest.mark.multiprocess
@pytest.mark.parametrize(("command", "message"), WRONG)
def test_wrong_flags_are_one_line_before_any_work(command, message, places, tmp_path):
    out = tmp_path / "out"
    module, *flags = (word.format(out=out, **places) for word in command.split())
    assert message in refused(f"experiments.{module}", *flags)
    assert {x.name for x in tmp_path.rglob("*") if x.is_file()} <= {".lock"}


@pytest.mark.multiprocess
def test_a_gate_that_is_refused_leaves_no_verdict_of_another(places, tmp_path):
    (tmp_path / "v.json").write_text("the verdict of another candidate")
    flags = (f"--candidate={places['weights']}", f"--output={tmp_path}/v.json")
    refused("rcirl_jax", "gate", *flags, "--incumbent=nobody")
    assert not (tmp_path / "v.json").exists()
