"""Weights files that the closed-loop experiments train from drives."""

from collections.abc import Sequence
from pathlib import Path

from experiments.common import provenance
from rcirl_jax.data.joined import open_datasets
from rcirl_jax.export.from_run import export_run
from rcirl_jax.train.loop import train
from rcirl_jax.train.state import TrainConfig


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
    folder: Path, name: str, data: Sequence[str | Path], config: TrainConfig
) -> Path:
    """FOLDER/NAME.msgpack, trained on the datasets and exported; made once."""
    file = folder / f"{name}.msgpack"
    if not file.exists():
        dataset = open_datasets([str(path) for path in data])
        train(dataset, folder / name, config, provenance=provenance())
        export_run(folder / name, dataset, file)
    return file
