r"""Trains a grid of reward networks side by side and chooses by held-out scenes.

    python -m experiments.sweep --data=DATASET --workdir=SWEEP \
        --flagfile=experiments/flagfiles/sweep_leaky_hidden.flags

All members of one network shape train in one compiled program. A part of the training
scenes is held out to choose by; the test split is scored once, for the chosen. Run
again, it goes on where it stopped.
"""

from pathlib import Path

from absl import flags

from rcirl_jax.cli.running import provenance, run
from rcirl_jax.export.sweep import CHOICES, SweepConfig, run_sweep, table
from rcirl_jax.reward import LOSSES
from rcirl_jax.runtime.executors import make_executor
from rcirl_jax.train.state import LEARNED_FUTURES, POSITIVES, TrainConfig

_DATA = flags.DEFINE_list("data", None, "datasets, with commas", required=True)
_WORKDIR = flags.DEFINE_string("workdir", None, "folder of the sweep", required=True)
_HIDDEN = flags.DEFINE_list("hidden_sizes", ["15"], "networks: 15,32x16; 0: linear")
_LEAKY = flags.DEFINE_list("leaky_rates", ["0.05"], "of the rank loss")
_RATES = flags.DEFINE_list("learning_rates", ["3e-3"], "step sizes")
_SEEDS = flags.DEFINE_integer("seeds", 4, "trainings of each configuration")
_SEED = flags.DEFINE_integer("seed", 0, "of splits, candidates and batches")
_LOSS = flags.DEFINE_enum("loss", "rank", sorted(LOSSES), "what training minimises")
_POSITIVE = flags.DEFINE_enum("positive", "human", POSITIVES, "what is ranked first")
_FUTURES = flags.DEFINE_enum("futures", "recorded", LEARNED_FUTURES, "of the others")
_BATCH = flags.DEFINE_integer("batch_size", 64, "scenes per step")
_EPOCHS = flags.DEFINE_integer("epochs", 2, "passes over the training scenes")
_SHARE = flags.DEFINE_float("validation", 0.2, "share of training scenes to choose by")
_SCENES = flags.DEFINE_integer("scenes", 0, "training scenes at most; 0: all")
_CHOOSE = flags.DEFINE_enum("choose_by", "top1_fde", CHOICES, "metric of the choice")
_TRIALS = flags.DEFINE_integer("trials", 0, "proposals of Optuna instead of the grid")
_WORKERS = flags.DEFINE_integer("workers", 1, "processes at once")


def main() -> None:
    """Trains, chooses, exports; prints the table."""
    config = SweepConfig(
        data=tuple(_DATA.value),
        base=TrainConfig(
            loss=_LOSS.value,
            positive=_POSITIVE.value,
            futures=_FUTURES.value,
            admissible_in="none",
            batch_size=_BATCH.value,
            epochs=_EPOCHS.value,
            seed=_SEED.value,
        ),
        hidden_sizes=tuple(
            tuple(int(units) for units in sizes.split("x") if units != "0")
            for sizes in _HIDDEN.value
        ),
        leaky_rates=tuple(float(rate) for rate in _LEAKY.value),
        learning_rates=tuple(float(rate) for rate in _RATES.value),
        seeds=_SEEDS.value,
        validation=_SHARE.value,
        scenes=_SCENES.value,
        choose_by=_CHOOSE.value,
        trials=_TRIALS.value,
    )
    executor = make_executor("local", workers=_WORKERS.value)
    report = run_sweep(config, Path(_WORKDIR.value), executor, provenance())
    print(table(report))
    print(f"written: {_WORKDIR.value}/sweep.json, weights/, best.msgpack")


if __name__ == "__main__":
    run(main)
