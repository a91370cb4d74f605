"""The whole tuning loop by one command, from logs to a verdict and its report.

    python -m experiments.autotune --data=DATASET --workdir=RUN [--incumbent=FILE]
    python -m experiments.autotune --format=ngsim --input=LOGS --workdir=RUN

import (if there is no --data; synthetic traffic if there is no --format) -> train ->
export -> rank -> simulate -> gate -> report. Every stage is kept until what it is
made from changes; a killed run goes on where it was, also one ended by SIGTERM (exit
status 143) or SIGINT (130), which save the training's step. The candidate is in
RUN/weights.msgpack; open RUN/report.html. The full suite takes half an hour on two
cores; `--cases=3 --duration=30` is a look that can prove little. `experiments.gate`
gives the verdict as its exit status.
"""

from pathlib import Path

from absl import flags

from experiments import margins, training
from experiments.common import provenance, run
from experiments.executor import executor
from experiments.signals import checked_signals, signals_asked
from rcirl_jax.autotune import STAGES, Loop, TuneConfig
from rcirl_jax.data.config import CollectConfig
from rcirl_jax.data.importers import IMPORTERS
from rcirl_jax.data.importing import ImportConfig
from rcirl_jax.data.logs import Logs
from rcirl_jax.errors import InputError
from rcirl_jax.stages import file_sha256, only_one
from rcirl_jax.train.running import Running

flags.set_default(training.POSITIVE, "nearest")  # what a planner can choose
_WORKDIR = flags.DEFINE_string("workdir", None, "folder of the run", required=True)
_DATA = flags.DEFINE_string("data", None, "dataset, instead of an import")
_FORMAT = flags.DEFINE_enum("format", "synthetic", sorted(IMPORTERS), "of --input")
_INPUT = flags.DEFINE_string("input", None, "recordings to import")
_SOURCE = flags.DEFINE_string("source", None, "TOML of columns and units of --input")
_STRIDE = flags.DEFINE_float("stride", 0.5, "s between planning frames of a driver")
_INCUMBENT = flags.DEFINE_string(
    "incumbent", "hand-set", "weights file that drives today, or a baseline"
)
_SEEDS = flags.DEFINE_integer("seeds", 1, "training runs; the median one drives")
_PARALLEL = flags.DEFINE_string("parallel", "jit", "how the devices share a batch")
_HORIZON = flags.DEFINE_float("horizon", 5.0, "s at which distances are taken")
_SUITE = flags.DEFINE_string("suite", "full", "full, smoke, or families with commas")
_CASES = flags.DEFINE_integer("cases", None, "cases per family")
_DURATION = flags.DEFINE_float("duration", None, "s per case at most")
_SEED = flags.DEFINE_integer("catalogue_seed", 0, "seed of the cases")
_EVERY = flags.DEFINE_integer("plan_every", 1, "steps of 0.1 s between two plans")
_SWEEP = flags.DEFINE_string(
    "sweep", None, "folder of experiments.sweep, to be shown in the report"
)
_UNTIL = flags.DEFINE_enum("until", "report", STAGES, "last stage")


def main() -> None:
    """Flags -> one run of the loop."""
    if _DATA.value and signals_asked():
        raise InputError("--signals: expected with --input, whose lights they are")
    judged = training.PREFERENCES.value
    path = Path(judged) if judged else None
    config = TuneConfig(
        train=training.training_config(preferences=file_sha256(path) if path else ""),
        preferences=path,
        gate=margins.gate_config(),
        incumbent=_INCUMBENT.value,
        seeds=_SEEDS.value,
        horizon_s=_HORIZON.value,
        suite=_SUITE.value,
        cases=_CASES.value,
        duration_s=_DURATION.value,
        catalogue_seed=_SEED.value,
        plan_every=_EVERY.value,
        sweep=Path(_SWEEP.value) if _SWEEP.value else None,
    )
    loop = Loop(
        folder=Path(_WORKDIR.value),
        config=config,
        executor=executor(),
        running=Running(parallel=_PARALLEL.value),
        facts=provenance(),
    )
    with only_one(loop.folder):
        loop.until(_UNTIL.value, _DATA.value or _logs())


def _logs() -> Logs:
    """The recordings to import."""
    collect = CollectConfig(stride_s=_STRIDE.value)
    return Logs(
        format=_FORMAT.value,
        input=Path(_INPUT.value) if _INPUT.value else None,
        source=Path(_SOURCE.value) if _SOURCE.value else None,
        config=ImportConfig(format=_FORMAT.value, collect=collect),
        signals=signals_asked(),
        checked=checked_signals,
    )


if __name__ == "__main__":
    run(main)
