"""Training on a little of every shipped folder of recordings stays finite."""

import shutil

import numpy as np
import pytest

from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.evaluation.ranking.learners import (
    FrozenSets,
    learner_configs,
    train_learner,
)
from rcirl_jax.train.state import PAPER_OPTIMIZERS, TrainConfig

# folder, format, files to take (all that can be told apart by name), stride s
FOLDERS = {
    "us101": ("ngsim_us101_commonroad/xml", "commonroad", 12, 1.0),
    "urban": ("ngsim_urban_commonroad/xml", "commonroad", 12, 1.0),
    "i80": ("ngsim_i80_native", "ngsim", None, 20.0),
    "pairs": ("ngsim_i80_pairs", "ngsim_pairs", 60, 1.0),
}
DEFAULT = (TrainConfig().optimizer,)
# in `make test-slow`, with the recordings
LONG = tuple((name, tuple(sorted(PAPER_OPTIMIZERS))) for name in FOLDERS)
LEARNERS = ("RC-IRL rank", "logistic free", "MaxEnt free")


@pytest.mark.dataset
@pytest.mark.parametrize(
    ("name", "optimisers"),
    [("us101", DEFAULT), *(pytest.param(*x, marks=pytest.mark.slow) for x in LONG)],
)
def test_no_learner_ends_in_nan(name, optimisers, data_dir, tmp_path):
    """Default flags but for the epochs."""
    folder, kind, some, stride = FOLDERS[name]
    (tmp_path / "logs").mkdir()
    files = sorted(x for x in (data_dir / folder).iterdir() if x.is_file())
    every = max(1, len(files) // some) if some else 1
    for file in files[::every]:
        shutil.copy(file, tmp_path / "logs" / file.name)
    config = ImportConfig(format=kind, collect=CollectConfig(stride_s=stride))
    import_logs(read_recordings(kind, tmp_path / "logs"), tmp_path / "data", config)
    sets = FrozenSets(open_dataset(tmp_path / "data"))
    for how in optimisers:
        base = TrainConfig(optimizer=how, epochs=2)
        for row, own in learner_configs(LEARNERS, base).items():
            frozen = sets.of(own)
            assert frozen.weight.size >= 20  # else the test shows nothing
            (run,) = train_learner(frozen, own, [0])
            assert run.finite, f"{row}, {how}"
            assert np.isfinite(run.loss).all(), f"{row}, {how}"
            values = run.scorer(np.asarray(frozen.human), np.asarray(frozen.time_valid))
            assert np.isfinite(values).all(), f"{row}, {how}"
