"""Training from a dataset: sequence only, no mathematics.

restore or init -> for each batch: step, guard, log -> checkpoint every epoch.
"""

import dataclasses
import json
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.joined import Demonstrations
from rcirl_jax.data.pipeline import BatchIterator
from rcirl_jax.errors import InputError
from rcirl_jax.features import FeatureMap, feature_map
from rcirl_jax.reward import Normaliser, fit_normaliser
from rcirl_jax.train.checkpoint import Checkpoints
from rcirl_jax.train.metrics import MetricsWriter, Progress
from rcirl_jax.train.parallel import Step, parallelise
from rcirl_jax.train.state import Batch, FeatureBatch, TrainConfig, TrainState
from rcirl_jax.train.step import StepMetrics, featurise, init_state, make_train_step
from rcirl_jax.types import Demonstration

NORMALISER_SCENES = 512  # training scenes whose features fit the normaliser
NORMALISER_STREAM = 7  # fold_in number of the key that samples for the normaliser


def to_device_batch(
    demonstrations: Demonstration, weight: np.ndarray, index: np.ndarray
) -> Batch:
    """Numpy rows -> a Batch on the default device."""
    return Batch(
        demonstrations=jax.tree.map(jnp.asarray, demonstrations),
        weight=jnp.asarray(weight, jnp.float32),
        index=jnp.asarray(index, jnp.int32),
    )


def fit_normaliser_on(
    rows: Demonstration, config: TrainConfig, features: FeatureMap
) -> Normaliser:
    """The frozen normaliser from humans and feasible candidates of some scenes."""
    count = int(rows.vehicle.shape[0])
    chosen = np.random.default_rng([config.seed, NORMALISER_STREAM]).permutation(count)
    chosen = np.sort(chosen[:NORMALISER_SCENES])
    key = jax.random.fold_in(jax.random.key(config.seed), NORMALISER_STREAM)
    make = jax.jit(lambda batch: featurise(key, batch, config, features))
    parts = []
    for start in range(0, chosen.size, config.batch_size):
        picked = np.resize(chosen[start : start + config.batch_size], config.batch_size)
        taken = jax.tree.map(lambda x, picked=picked: x[picked], rows)
        batch = make(to_device_batch(taken, np.ones(picked.size), picked))
        parts.append(rows_that_count(batch))
    return fit_normaliser(np.concatenate(parts), features)


def rows_that_count(batch: FeatureBatch) -> np.ndarray:
    """[n, F] features at valid times of humans and feasible candidates."""
    valid = np.asarray(batch.time_valid)
    human = np.asarray(batch.human)[valid]
    both = np.asarray(batch.feasible)[:, :, None] & valid[:, None, :]
    return np.concatenate([human, np.asarray(batch.candidates)[both]])


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainResult:
    """What a finished run reports."""

    state: TrainState
    epochs: list[dict]  # one summary per epoch of this process
    queries: float  # pairs compared in this process
    seconds: float  # wall time of the steps in this process


def train(
    dataset: Demonstrations,
    workdir: Path,
    config: TrainConfig,
    *,
    parallel: str = "jit",
    provenance: dict | None = None,
) -> TrainResult:
    """Train on the dataset's training split; resumes from the last checkpoint.

    Args:
      dataset: an open dataset.
      workdir: run folder: run.json, checkpoints/, metrics.jsonl, tensorboard/.
      config: everything that decides the result.
      parallel: "jit", "pmap" or "shard_map" over the local devices.
      provenance: extra facts for run.json.

    Raises:
      InputError: the workdir belongs to other settings or another dataset, or
        a feature turns NaN or infinite (names scene and feature).
    """
    describe_run(workdir, config, dataset, provenance or {})
    features = feature_map(config.features)
    rows = dataset.load("train")
    index = dataset.indices("train")
    checkpoints = Checkpoints(workdir / "checkpoints")
    batches = BatchIterator(rows, batch_size=config.batch_size, seed=config.seed)
    if checkpoints.latest_step() is None:
        state = init_state(config, fit_normaliser_on(rows, config, features))
    else:
        state, position = checkpoints.restore(_like(config, features))
        batches.restore(position)
    run = _Run(config, features, index, workdir, int(state.step))
    step = parallelise(make_train_step(config), parallel, config.batch_size)
    try:
        state = run.epochs_from(state, batches, step, checkpoints)
    finally:
        checkpoints.close()
        run.close()
    return TrainResult(
        state=state,
        epochs=run.summaries,
        queries=run.progress.queries,
        seconds=run.progress.seconds,
    )


def restore_run(workdir: Path, config: TrainConfig) -> TrainState:
    """The newest checkpoint of a run.

    Raises:
      InputError: there is none, or it is of another structure.
    """
    checkpoints = Checkpoints(workdir / "checkpoints")
    try:
        if checkpoints.latest_step() is None:
            raise InputError(f"{workdir}: checkpoints: none: expected a trained run")
        return checkpoints.restore(_like(config, feature_map(config.features)))[0]
    finally:
        checkpoints.close()


def _like(config: TrainConfig, features: FeatureMap) -> TrainState:
    ones = jnp.ones(features.num_features)
    return init_state(
        config, Normaliser(lower=ones, upper=ones, location=ones, scale=ones)
    )


class _Run:
    """The loop's bookkeeping: metrics, progress, guard."""

    def __init__(
        self,
        config: TrainConfig,
        features: FeatureMap,
        index: np.ndarray,
        workdir: Path,
        first_step: int,
    ) -> None:
        self.config, self.features, self.index = config, features, index
        self.per_epoch = -(-index.size // config.batch_size)
        total = self.per_epoch * config.epochs
        self.writer = MetricsWriter(workdir, first_step)
        self.progress = Progress(total, first_step, "train")
        self.summaries: list[dict] = []

    def close(self) -> None:
        self.writer.close()
        self.progress.__exit__(None, None, None)

    def epochs_from(
        self,
        state: TrainState,
        batches: BatchIterator,
        step: Step,
        checkpoints: Checkpoints,
    ) -> TrainState:
        for epoch in range(int(state.step) // self.per_epoch, self.config.epochs):
            sums = np.zeros(4)
            for _ in range(self.per_epoch - int(state.step) % self.per_epoch):
                rows, weight, local = next(batches)
                batch = to_device_batch(rows, weight, self.index[local])
                state, metrics = step(state, batch)
                sums += self._after_step(int(state.step), metrics)
            self.summaries.append(_summary(epoch, sums))
            checkpoints.save(state, batches.state())
        return state

    def _after_step(self, step: int, metrics: StepMetrics) -> np.ndarray:
        guard(metrics, self.features, step)
        pairs = max(float(metrics.pairs), 1.0)
        shown = {
            "loss": float(metrics.loss_sum) / max(float(metrics.terms), 1.0),
            "pair_accuracy": float(metrics.wins) / pairs,
        }
        self.progress.advance(pairs, **shown)
        self.writer.write(
            step,
            {
                **shown,
                "grad_norm": float(metrics.grad_norm),
                "pairs": pairs,
                "queries_per_s": self.progress.queries / self.progress.seconds,
            },
        )
        counted = (metrics.loss_sum, metrics.terms, metrics.wins, metrics.pairs)
        return np.array([float(x) for x in counted])


def _summary(epoch: int, sums: np.ndarray) -> dict:
    loss, terms, wins, pairs = sums
    return {
        "epoch": epoch + 1,
        "loss": loss / max(terms, 1.0),
        "pair_accuracy": wins / max(pairs, 1.0),
        "pairs": int(sums[2]),
    }


def guard(metrics: StepMetrics, features: FeatureMap, step: int) -> None:
    """Stop with the scene and the features named when a number is not finite."""
    if bool(metrics.finite):
        return
    bad = np.flatnonzero(np.asarray(metrics.nonfinite))
    if bad.size:
        names = ", ".join(features.names[i] for i in bad)
        raise InputError(
            f"train: step {step}: scene {int(metrics.first_bad)}: feature {names}: "
            "not finite: expected finite features; the state before is kept"
        )
    raise InputError(
        f"train: step {step}: loss or gradient: not finite: features are finite; "
        "lower --learning_rate; the state before is kept"
    )


def describe_run(
    workdir: Path, config: TrainConfig, dataset: Demonstrations, provenance: dict
) -> None:
    """Write run.json, or check that an existing one says the same.

    Raises:
      InputError: the folder holds a run with other settings (names the first).
    """
    path = workdir / "run.json"
    described = {
        "config": json.loads(json.dumps(dataclasses.asdict(config))),
        "dataset_hash": dataset.hash,
    }
    if path.exists():
        found = json.loads(path.read_text())
        if found.get("dataset_hash") != dataset.hash:
            raise InputError(f"{path}: dataset_hash: made from another dataset")
        for name, setting in described["config"].items():
            before = found["config"].get(name)
            if before != setting and name != "epochs":
                raise InputError(
                    f"{path}: {name}: {before}: expected {setting} to resume; "
                    "use another --workdir for other settings"
                )
    workdir.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps({**described, **provenance}, indent=2) + "\n")
    os.replace(temporary, path)
