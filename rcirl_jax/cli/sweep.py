r"""Train many rewards side by side, choose by held-out scenes, export all.

    rcirl sweep --data=DATASET --output=DIR --recipe=paper \
        --leaky_rates=0.01,0.05,0.2 --hidden_sizes=15,32x16 --seeds=4

What the grid leaves open is as the --recipe says; a flag given beside it wins.
--search=optuna --trials=32 tries that many configurations within the grid's bounds
instead, each proposed by what the validation scenes said of those before.
Leaky rates, step sizes and seeds of one network shape train in one compiled program;
shapes are spread by --executor. A part of the training scenes (other vehicles) is held
out to choose by; the test split is scored once, for the chosen. Writes sweep.json,
sweep.png, weights/*.msgpack and best.msgpack. Run again, it goes on where it stopped
(exit status 143 after SIGTERM, 130 after SIGINT): finished shapes are kept.
The best was fitted without the validation scenes: train its settings again by
`rcirl train` to use them all. Needs the extra [report].
"""

import dataclasses
from pathlib import Path

from absl import flags

from rcirl_jax.cli import flags as shared
from rcirl_jax.cli.flags import AS_SAID, floats, hidden_sizes
from rcirl_jax.cli.running import provenance
from rcirl_jax.errors import InputError
from rcirl_jax.export.closed_loop import checked_sampler
from rcirl_jax.export.sweep import CHOICES, SweepConfig, run_sweep, table
from rcirl_jax.train.state import TrainConfig

LEAKY_RATES = (0.01, 0.05, 0.2)
GRID = "grid"
USUAL = (
    *("data", "output", "recipe", "leaky_rates", "learning_rates", "hidden_sizes"),
    *("search", "trials", "seeds", "seed", "validation", "choose_by", "quick"),
    "workers",
)
_DATA = flags.DEFINE_list(
    "data", None, "datasets of `rcirl import`, with commas", required=True
)
_OUTPUT = flags.DEFINE_string(
    "output", None, "folder to write; a sweep in it goes on", required=True
)
_LEAKY = flags.DEFINE_list(
    "leaky_rates",
    None,
    "of the rank loss, between 0 and 1 (default: 0.01,0.05,0.2 with that loss)",
)
_RATES = flags.DEFINE_list(
    "learning_rates", None, "step sizes, between 0 and 1" + AS_SAID
)
_HIDDEN = flags.DEFINE_list(
    "hidden_sizes", ["15"], "networks, units per layer: 15,32x16; 0: linear"
)
_SEEDS = flags.DEFINE_integer(
    "seeds", 4, "trainings of each configuration, 1 or more; more tell luck from merit"
)
_SEED = flags.DEFINE_integer("seed", 0, "of splits, candidates, batches and proposals")
_SHARE = flags.DEFINE_float(
    "validation", 0.2, "share of training scenes to choose by, above 0, at most 0.5"
)
_SCENES = flags.DEFINE_integer("scenes", 0, "training scenes at most; 0: all")
_CHOOSE = flags.DEFINE_enum("choose_by", "top1_fde", CHOICES, "metric of the choice")
_SEARCH = flags.DEFINE_enum(
    "search", GRID, (GRID, "optuna"), "the whole grid, or proposals within its bounds"
)
_TRIALS = flags.DEFINE_integer(
    "trials", 32, "configurations that optuna proposes, 1 or more", 1
)
_QUICK = flags.DEFINE_bool("quick", False, "128 scenes, 2 epochs, 2 seeds: a minute")
_TRAINING = shared.training(
    without=("leaky_rate", "learning_rate", "hidden_size", "data_weights")
)
_HORIZON = shared.horizon()
_EXECUTOR = shared.executor()


def _leaky_rates(base: TrainConfig) -> tuple[float, ...]:
    """--leaky_rates; without it several for the one loss that has such a rate."""
    if _LEAKY.value is None:
        return LEAKY_RATES if base.loss == "rank" else (base.leaky_rate,)
    return floats(_LEAKY.value, "leaky_rates")


def main() -> None:
    """Flags -> one sweep."""
    from rcirl_jax.report.charts import sweep_picture

    if _SEARCH.value == GRID and flags.FLAGS["trials"].present:
        raise InputError(
            f"--trials: {_TRIALS.value}: expected --search=optuna beside it"
        )
    shapes = tuple(hidden_sizes(s.split("x"), "hidden_sizes") for s in _HIDDEN.value)
    base = _TRAINING.config(seed=_SEED.value, hidden=shapes[0] if shapes else None)
    checked_sampler(base.sampler)
    config = SweepConfig(
        data=tuple(_DATA.value),
        base=dataclasses.replace(base, epochs=2) if _QUICK.value else base,
        hidden_sizes=shapes,
        leaky_rates=_leaky_rates(base),
        learning_rates=(
            (base.learning_rate,)
            if _RATES.value is None
            else floats(_RATES.value, "learning_rates")
        ),
        seeds=2 if _QUICK.value else _SEEDS.value,
        validation=_SHARE.value,
        scenes=128 if _QUICK.value else _SCENES.value,
        choose_by=_CHOOSE.value,
        horizon_s=_HORIZON.value,
        trials=0 if _SEARCH.value == GRID else _TRIALS.value,
    )
    folder = Path(_OUTPUT.value)
    report = run_sweep(config, folder, _EXECUTOR(), provenance())
    picture = sweep_picture(folder / "sweep.png", report)
    print(table(report))
    best = f"best.msgpack ({report['chosen']['member']})"
    print(f"written: {folder}/sweep.json, {picture.name}, weights/, {best}")
