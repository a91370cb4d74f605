"""Weights files that the closed-loop experiments train from drives."""

from collections.abc import Callable
from pathlib import Path

from experiments.common import provenance
from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.export.from_run import export_run
from rcirl_jax.train.loop import train
from rcirl_jax.train.state import TrainConfig

QUICK_S = 2.0  # s of a case of `--quick`: with one length a program serves all tables


def drives_config(*, quick: bool, **changes: object) -> TrainConfig:
    """How rewards are learned from a driver model's drives, with some changes."""
    shared: dict = {
        "positive": "nearest",
        "learning_rate": 4e-3,
        "halve_every": 900,
        "epochs": 1 if quick else 4,
    }
    return TrainConfig(**{**shared, **changes})


def trained_weights(
    folder: Path, name: str, data: Callable[[], Demonstrations], config: TrainConfig
) -> Path:
    """FOLDER/NAME.msgpack, trained on what `data` opens and exported; made once.

    What a name stands for, its data and configuration, is the caller's to keep.
    """
    file = folder / f"{name}.msgpack"
    if not file.exists():
        dataset = data()
        train(dataset, folder / name, config, provenance=provenance())
        export_run(folder / name, dataset, file)
    return file
