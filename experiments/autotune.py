"""The whole tuning loop by one command, from logs to a verdict and its report.

    python -m experiments.autotune --data=DATASET --workdir=RUN [--incumbent=FILE]
    python -m experiments.autotune --format=ngsim --input=LOGS --workdir=RUN

import (if there is no --data; synthetic traffic if there is no --format) -> train ->
export -> rank -> simulate -> gate -> report. Every stage is kept until what it is
made from changes; a killed run goes on where it was. The candidate is in
RUN/weights.msgpack; open RUN/report.html. The full suite takes half an hour on two
cores; `--cases=3 --duration=30` is a look that can prove little. `experiments.gate`
gives the verdict as its exit status.
"""

from pathlib import Path

from absl import flags

from experiments.common import hidden_sizes, provenance, run
from experiments.executor import executor
from rcirl_jax.autotune import STAGES, Logs, Loop, TuneConfig
from rcirl_jax.data.config import CollectConfig
from rcirl_jax.data.importers import IMPORTERS
from rcirl_jax.data.importing import ImportConfig
from rcirl_jax.evaluation.gate_types import GateConfig
from rcirl_jax.reward import LOSSES, RewardConfig
from rcirl_jax.stages import only_one
from rcirl_jax.train.running import Running
from rcirl_jax.train.state import POSITIVES, TrainConfig

_WORKDIR = flags.DEFINE_string("workdir", None, "folder of the run", required=True)
_DATA = flags.DEFINE_string("data", None, "dataset, instead of an import")
_FORMAT = flags.DEFINE_enum("format", "synthetic", sorted(IMPORTERS), "of --input")
_INPUT = flags.DEFINE_string("input", None, "recordings to import")
_SOURCE = flags.DEFINE_string("source", None, "TOML of columns and units of --input")
_STRIDE = flags.DEFINE_float("stride", 0.5, "s between planning frames of a driver")
_INCUMBENT = flags.DEFINE_string(
    "incumbent", "hand-set", "weights file that drives today, or a baseline"
)
_LOSS = flags.DEFINE_enum("loss", "rank", sorted(LOSSES), "loss on value differences")
_HIDDEN = flags.DEFINE_list("hidden_size", ["15"], "units per layer; 0 is linear")
_POSITIVE = flags.DEFINE_enum(
    "positive", "nearest", POSITIVES, "ranked first: the human or its nearest candidate"
)
_RATE = flags.DEFINE_float("learning_rate", 3e-3, "step size")
_EPOCHS = flags.DEFINE_integer("epochs", 20, "passes over the training scenes")
_SEEDS = flags.DEFINE_integer("seeds", 1, "training runs; the median one drives")
_PARALLEL = flags.DEFINE_string("parallel", "jit", "how the devices share a batch")
_HORIZON = flags.DEFINE_float("horizon", 5.0, "s at which distances are taken")
_SUITE = flags.DEFINE_string("suite", "full", "full, smoke, or families with commas")
_CASES = flags.DEFINE_integer("cases", None, "cases per family")
_DURATION = flags.DEFINE_float("duration", None, "s per case at most")
_SEED = flags.DEFINE_integer("catalogue_seed", 0, "seed of the cases")
_EVERY = flags.DEFINE_integer("plan_every", 1, "steps of 0.1 s between two plans")
_UNTIL = flags.DEFINE_enum("until", "report", STAGES, "last stage")


def main() -> None:
    """Flags -> one run of the loop."""
    config = TuneConfig(
        train=TrainConfig(
            loss=_LOSS.value,
            positive=_POSITIVE.value,
            learning_rate=_RATE.value,
            epochs=_EPOCHS.value,
            reward=RewardConfig(hidden=hidden_sizes(_HIDDEN.value)),
        ),
        gate=GateConfig(),
        incumbent=_INCUMBENT.value,
        seeds=_SEEDS.value,
        horizon_s=_HORIZON.value,
        suite=_SUITE.value,
        cases=_CASES.value,
        duration_s=_DURATION.value,
        catalogue_seed=_SEED.value,
        plan_every=_EVERY.value,
    )
    logs = Logs(
        format=_FORMAT.value,
        input=Path(_INPUT.value) if _INPUT.value else None,
        source=Path(_SOURCE.value) if _SOURCE.value else None,
        config=ImportConfig(
            format=_FORMAT.value, collect=CollectConfig(stride_s=_STRIDE.value)
        ),
    )
    loop = Loop(
        folder=Path(_WORKDIR.value),
        config=config,
        executor=executor(),
        running=Running(parallel=_PARALLEL.value),
        facts=provenance(),
    )
    with only_one(loop.folder):
        loop.until(_UNTIL.value, _DATA.value or logs)


if __name__ == "__main__":
    run(main)
