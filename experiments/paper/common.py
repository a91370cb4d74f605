"""The common part of the paper's experiments: flags, data, training, files."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from absl import flags

from rcirl_jax.cli import flags as shared
from rcirl_jax.cli.flags import AS_SAID, mutually_exclusive, undefine_flags
from rcirl_jax.cli.running import made_by_file, provenance
from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.store.dataset import Dataset, Demonstrations, open_dataset
from rcirl_jax.data.store.splits import Resplit
from rcirl_jax.errors import InputError
from rcirl_jax.reward import RewardConfig
from rcirl_jax.runtime.atomic_files import write_json
from rcirl_jax.train.state import POSITIVES, TrainConfig

DATA = flags.DEFINE_string("data", None, "dataset (default: synthetic traffic)")
OUTPUT = flags.DEFINE_string("output", "out/paper", "folder to write")
SEEDS = flags.DEFINE_integer("seeds", 10, "training runs of each row", lower_bound=1)
EPOCHS = flags.DEFINE_integer(
    "epochs", None, "passes over the training scenes" + AS_SAID, lower_bound=1
)
HORIZON = flags.DEFINE_float(
    "horizon", 5.0, "s compared and ranked", lower_bound=0.4, upper_bound=8.0
)
POSITIVE = flags.DEFINE_enum("positive", None, POSITIVES, "trained on" + AS_SAID)
QUICK = flags.DEFINE_bool("quick", False, "few scenes, two seeds, two epochs")

recipe = shared.recipe()

QUICK_S = 2.0  # s of a case of `--quick`: with one length a program serves all tables
QUICK_STRIDE_S = 60.0  # s between planning frames of the small synthetic dataset
QUICK_SCENES = 128  # of each split
QUICK_COUNTS = {"seeds": 2, "epochs": 2}  # whatever the flags say


def instead(flag: str, *names: str) -> None:
    """As `undefine_flags`, by an experiment that was given --flag."""
    mutually_exclusive(flag, *names)
    undefine_flags(*names)


def fixed(**values: object) -> None:
    """Shared flags with one value in an experiment: recorded, any other refused."""
    for name, value in values.items():
        flags.FLAGS.set_default(name, value)
        flags.register_validator(
            name, lambda given, value=value: given == value, f"expected {value} here"
        )


def dataset() -> Demonstrations:
    """--data, or synthetic traffic, made once beside the output; few under --quick."""
    return few(open_dataset(DATA.value) if DATA.value else _synthetic())


def few(found: Demonstrations) -> Demonstrations:
    """The dataset; under --quick at most `QUICK_SCENES` of each split."""
    if not QUICK.value:
        return found
    return Resplit(
        found,
        {name: _spread(found.indices(name)) for name in ("train", "test")},
    )


def _spread(rows: np.ndarray) -> np.ndarray:
    """At most QUICK_SCENES rows, evenly spread."""
    count = min(rows.size, QUICK_SCENES)
    return rows[np.linspace(0, rows.size - 1, count).astype(int)]


def _synthetic() -> Dataset:
    stride = QUICK_STRIDE_S if QUICK.value else 2.0
    folder = Path(OUTPUT.value) / f"synthetic_{stride:g}s"
    if not (folder / "manifest.json").exists():
        config = ImportConfig(
            format="synthetic", collect=CollectConfig(stride_s=stride)
        )
        recordings = read_recordings("synthetic", None)
        import_logs(recordings, folder, config, before_commit=made_by_file())
    return open_dataset(folder)


def seeds(least: int = 1) -> range:
    """Seeds of the training runs; a spread between them needs at least two."""
    if SEEDS.value < least:
        raise InputError(f"--seeds: {SEEDS.value}: expected at least {least}")
    return range(QUICK_COUNTS["seeds"] if QUICK.value else SEEDS.value)


def epochs() -> int:
    """Passes over the training scenes."""
    if QUICK.value:
        return QUICK_COUNTS["epochs"]
    return EPOCHS.value or recipe().train.epochs


def positive() -> str:
    """Returns the kind of positive."""
    return POSITIVE.value or recipe().train.positive


def base(**changes: object) -> TrainConfig:
    """The recipe's training of the paper's network on pairs, with some changes."""
    shared: dict = {
        "loss": "logistic",
        "epochs": epochs(),
        "train_horizon": HORIZON.value,
        "reward": RewardConfig(),
    }
    if "positive" not in changes:
        shared["positive"] = positive()
    return dataclasses.replace(recipe().train, **{**shared, **changes})


def as_used(weights: Sequence[str] = (), **used: object) -> dict:
    """Provenance with the flags as they were used, whatever --quick and recipe say."""
    found = provenance(weights)
    given = found["flags"]
    own = {"seeds": len(seeds())} if "seeds" in given else {}
    own |= {"epochs": epochs()} if "epochs" in given else {}
    own |= {"positive": positive()} if "positive" in given else {}
    return {**found, "flags": {**given, **own, **used}}


def write(
    name: str,
    body: Mapping[str, object],
    data: Demonstrations | None = None,
    weights: Sequence[str] = (),
    **used: object,
) -> None:
    """OUTPUT/name.json with provenance, also of scenes and weights; says where.

    Args:
      name: of the experiment.
      body: its numbers.
      data: its scenes, if they are of one dataset.
      weights: files whose rewards it is about.
      used: flags of its own that --quick changes, as used.
    """
    folder = Path(OUTPUT.value)
    made_by = as_used(weights, **used)
    if data is not None:
        made_by["data_hash"] = data.hash
    if "recipe" in made_by["flags"]:
        made_by["recipe"] = dataclasses.asdict(recipe().train)
    made = {**body, "quick": QUICK.value, "made_by": made_by}
    write_json(folder / f"{name}.json", made)
    print(f"written: {folder}/{name}.json, {name}.png")


def picture(name: str) -> Path:
    """OUTPUT/name.png."""
    return Path(OUTPUT.value) / f"{name}.png"
