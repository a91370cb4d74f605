"""Train a grid of rewards side by side, choose by held-out scenes, export all.

    python -m experiments.sweep --data=DATASET --output=DIR \
        --leaky_rates=0.01,0.05,0.2 --hidden_sizes=15,32,32x16 --seeds=4

Leaky rates, step sizes and seeds of one network shape train in one compiled program;
shapes are spread by --executor. A part of the training scenes (other vehicles) is held
out to choose by; the test split is scored once, for the chosen. Writes sweep.json,
sweep.png, weights/*.msgpack and best.msgpack. Run again, it goes on where it stopped
(exit status 143 after SIGTERM, 130 after SIGINT): finished shapes are kept.
The best was fitted without the validation scenes: train its settings again by
experiments.train to use them all. `--quick`: 128 scenes, 2 epochs, 2 seeds.
"""

from pathlib import Path

from absl import flags

from experiments.common import floats, hidden_sizes, provenance, run
from experiments.executor import executor
from rcirl_jax.evaluation.sweep import CHOICES, SweepConfig
from rcirl_jax.export.sweep import run_sweep, table
from rcirl_jax.report.sweep_picture import sweep_picture
from rcirl_jax.reward import LOSSES, RewardConfig
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.state import OPTIMIZERS, POSITIVES, TrainConfig

_DATA = flags.DEFINE_list("data", None, "datasets of import_logs", required=True)
_OUTPUT = flags.DEFINE_string("output", None, "folder to write", required=True)
_LEAKY = flags.DEFINE_list("leaky_rates", ["0.01", "0.05", "0.2"], "values of a")
_RATES = flags.DEFINE_list("learning_rates", ["0.003"], "step sizes")
_HIDDEN = flags.DEFINE_list("hidden_sizes", ["15"], "networks: 15, 32x16; 0 is linear")
_SEEDS = flags.DEFINE_integer("seeds", 4, "initial weights tried of each configuration")
_LOSS = flags.DEFINE_enum("loss", "rank", sorted(LOSSES), "loss on value differences")
_FEATURES = flags.DEFINE_string("features", "paper21", "preset in data_specs/features")
_MODE = flags.DEFINE_enum(
    "mode", "speed", ["speed", "path_speed"], "what the sampler varies"
)
_POSITIVE = flags.DEFINE_enum("positive", "nearest", POSITIVES, "what is ranked first")
_OPTIMIZER = flags.DEFINE_enum("optimizer", "adam", sorted(OPTIMIZERS), "gradients")
_PIN = flags.DEFINE_enum("pin", "unit", ["unit", "none"], "scale pinning")
_DECAY = flags.DEFINE_float("weight_decay", 0.0, "L2 pull on the weights")
_BATCH = flags.DEFINE_integer("batch_size", 64, "scenes per step")
_EPOCHS = flags.DEFINE_integer("epochs", 10, "passes over the training scenes")
_HORIZON = flags.DEFINE_float("horizon", 5.0, "s that are compared and ranked")
_SEED = flags.DEFINE_integer("seed", 0, "of splits, candidates and batches")
_SHARE = flags.DEFINE_float("validation", 0.2, "share of training scenes to choose by")
_SCENES = flags.DEFINE_integer("scenes", 0, "training scenes at most; 0: all")
_CHOOSE = flags.DEFINE_enum("choose_by", "top1_fde", CHOICES, "validation metric")
_QUICK = flags.DEFINE_bool("quick", False, "a minute; its numbers mean nothing")


def main() -> None:
    """Flags -> one sweep."""
    base = TrainConfig(
        features=_FEATURES.value,
        loss=_LOSS.value,
        optimizer=_OPTIMIZER.value,
        weight_decay=_DECAY.value,
        batch_size=_BATCH.value,
        epochs=2 if _QUICK.value else _EPOCHS.value,
        positive=_POSITIVE.value,
        train_horizon=_HORIZON.value,
        seed=_SEED.value,
        reward=RewardConfig(pin=_PIN.value),
        sampler=SamplerConfig(mode=_MODE.value),
    )
    config = SweepConfig(
        data=tuple(_DATA.value),
        base=base,
        hidden_sizes=tuple(
            hidden_sizes(s.split("x"), "hidden_sizes") for s in _HIDDEN.value
        ),
        leaky_rates=floats(_LEAKY.value, "leaky_rates"),
        learning_rates=floats(_RATES.value, "learning_rates"),
        seeds=2 if _QUICK.value else _SEEDS.value,
        validation=_SHARE.value,
        scenes=128 if _QUICK.value else _SCENES.value,
        choose_by=_CHOOSE.value,
    )
    folder = Path(_OUTPUT.value)
    report = run_sweep(config, folder, executor(), provenance())
    picture = sweep_picture(folder / "sweep.png", report)
    print(table(report))
    best = f"best.msgpack ({report['chosen']['member']})"
    print(f"written: {folder}/sweep.json, {picture.name}, weights/, {best}")


if __name__ == "__main__":
    run(main)
