"""Training from a dataset: sequence only, no mathematics.

restore or init -> for each batch: step, guard, log -> checkpoint every epoch, and
when the process is told to end (`interrupts`).
With several processes (`train.processes`) each reads and computes its part of every
batch; process 0 alone writes run.json and metrics.
"""

import contextlib
import dataclasses
import functools
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store.batches import Prefetch, split_batches
from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.data.store.rows import check_finite
from rcirl_jax.errors import InputError
from rcirl_jax.features import FeatureMap, feature_map
from rcirl_jax.reward import Normaliser, fit_normaliser, pinned
from rcirl_jax.runtime.pipeline import only_one
from rcirl_jax.runtime.signals import Interrupted, asked
from rcirl_jax.train.checkpoint import Checkpoints
from rcirl_jax.train.featurise import featurised
from rcirl_jax.train.finite import check_features, check_step
from rcirl_jax.train.metrics import MetricsWriter, Progress
from rcirl_jax.train.parallel import Parallel, Step, parallelise
from rcirl_jax.train.processes import all_stop_after, is_first, with_the_others
from rcirl_jax.train.running import Running, check_run, describe_run
from rcirl_jax.train.state import Batch, FeatureBatch, TrainConfig, TrainState
from rcirl_jax.train.step import StepMetrics, init_state, make_train_step
from rcirl_jax.train.trackers import settings_of, time_weights, trackers
from rcirl_jax.types import Demonstration, RewardParams

CHUNK = 128  # scenes featurised per call where no batch sets their number
NORMALISER_SCENES = 2048  # training scenes whose features fit the normaliser
NORMALISER_STREAM = 7  # fold_in number of the key that samples for the normaliser


def to_device_batch(
    demonstrations: Demonstration, weight: np.ndarray, index: np.ndarray
) -> Batch:
    """Numpy rows -> a Batch on the default device."""
    return jax.device_put(host_batch(demonstrations, weight, index))


def host_batch(
    demonstrations: Demonstration, weight: np.ndarray, index: np.ndarray
) -> Batch:
    """Numpy rows -> a Batch of numpy arrays of the step's types."""
    weight, index = np.asarray(weight, np.float32), np.asarray(index, np.int32)
    return Batch(
        demonstrations=demonstrations,
        weight=cast(jax.Array, weight),
        index=cast(jax.Array, index),
    )


def fit_normaliser_on(
    dataset: Demonstrations, config: TrainConfig, features: FeatureMap
) -> Normaliser:
    """The frozen normaliser from `normaliser_rows`."""
    return fit_normaliser(normaliser_rows(dataset, config), features)


def normaliser_rows(dataset: Demonstrations, config: TrainConfig) -> np.ndarray:
    """[n, F] features of humans and feasible candidates of some training scenes."""
    index = dataset.indices("train")
    count = index.size
    chosen = np.random.default_rng([config.seed, NORMALISER_STREAM]).permutation(count)
    chosen = np.sort(chosen[:NORMALISER_SCENES])
    rows = dataset.read(index[chosen])
    key = jax.random.fold_in(jax.random.key(config.seed), NORMALISER_STREAM)
    parts = map(rows_that_count, in_chunks(key, rows, chosen, config, index[chosen]))
    return np.concatenate(list(parts))


def in_chunks(
    key: jax.Array,
    rows: Demonstration,
    index: np.ndarray,
    config: TrainConfig,
    stored: np.ndarray | None = None,
) -> Iterator[FeatureBatch]:
    """Features (numpy) of S scenes, CHUNK at a time; each scene once.

    Args:
      key: of the candidates, with the numbers of `index`.
      rows: S demonstrations (numpy).
      index: [S] number of each scene.
      config: sampler, positive, features.
      stored: [S] dataset row of each scene, where that is not `index`.

    Raises:
      InputError: a stored number or a feature is NaN or infinite (names the scene).
    """
    stored = index if stored is None else stored
    check_finite("train", rows, stored)
    for start in range(0, index.size, CHUNK):
        # the last chunk is filled up: one shape to compile
        at = np.minimum(np.arange(start, start + CHUNK), index.size - 1)
        taken = jax.tree.map(lambda x, at=at: x[at], rows)
        made = featurised(
            key, to_device_batch(taken, np.ones(CHUNK), index[at]), config
        )
        keep = min(CHUNK, index.size - start)
        made = jax.tree.map(lambda x, n=keep: np.asarray(x[:n]), made)
        check_features(made, taken, stored[at], config.features)
        yield made


def rows_that_count(batch: FeatureBatch) -> np.ndarray:
    """[n, F] features at valid times of humans and feasible candidates."""
    valid = np.asarray(batch.time_valid)
    human = np.asarray(batch.human)[valid]
    both = np.asarray(batch.feasible)[:, :, None] & valid[:, None, :]
    return np.concatenate([human, np.asarray(batch.points)[both]])


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainResult:
    """What a finished run reports."""

    state: TrainState
    epochs: list[dict]  # one summary per epoch of this process
    queries: float  # pairs compared in this process
    seconds: float  # wall time of the steps in this process
    waited_s: float  # of it, waiting for rows


def train(
    dataset: Demonstrations,
    workdir: Path,
    config: TrainConfig,
    *,
    running: Running | None = None,
    provenance: dict | None = None,
) -> TrainResult:
    """Train on the dataset's training split; resumes from the last checkpoint.

    Args:
      dataset: an open dataset.
      workdir: run folder: run.json, checkpoints/, metrics.jsonl, tensorboard/.
      config: everything that decides the result.
      running: what does not: devices, memory, checkpoints.
      provenance: extra facts for run.json.

    Raises:
      InputError: the workdir belongs to other settings or another dataset, is in
        use, or has no whole checkpoint; a checkpoint cannot be written; or a feature
        turns NaN or infinite (names scene and feature).
      Interrupted: told to end; the last step is saved.
    """
    running = running or Running()
    parallel = step_of(config.for_step, running.parallel)
    check_run(workdir, config, dataset)
    with only_one(workdir) if is_first() else contextlib.nullcontext():
        return _train(dataset, workdir, config, parallel, running, provenance or {})


@functools.lru_cache(maxsize=2)
def step_of(config: TrainConfig, parallel: str) -> Parallel:
    """The step of a configuration on all devices; `train` of another seed reuses it.

    The programs of the last two stay in memory; they hold no data.

    Raises:
      InputError: as `parallelise`.
    """
    return parallelise(make_train_step(config), parallel, config.batch_size)


def _train(
    dataset: Demonstrations,
    workdir: Path,
    config: TrainConfig,
    parallel: Parallel,
    running: Running,
    provenance: dict,
) -> TrainResult:
    """`train` in a folder that is this run's alone."""
    features = feature_map(config.features)
    batches = split_batches(
        dataset,
        "train",
        in_memory_mb=running.in_memory_mb,
        batch_size=config.batch_size,
        seed=config.seed,
        shard_index=jax.process_index(),
        num_shards=jax.process_count(),
    )
    checkpoints = Checkpoints(workdir / "checkpoints")
    for line in checkpoints.passed_over if is_first() else ():
        print(line, file=sys.stderr)
    if checkpoints.latest_step() is None:
        made = init_state(config, fit_normaliser_on(dataset, config, features))
        state = parallel.replicate(made)
    else:
        like = parallel.replicate(_like(config, features))
        state, position = checkpoints.restore(like)
        batches.restore(position)
    describe_run(workdir, config, dataset, provenance)
    per_epoch = batches.batches_per_epoch
    run = _Run(config, running, features, per_epoch, workdir, state, dataset)

    def produce() -> tuple:
        """The next batch, on its devices before its step, and where it stands."""
        if batches.state()["epoch"] >= config.epochs:
            raise StopIteration
        rows, weight, index = next(batches)
        weight = weight * dataset.weights(index)
        return parallel.place(host_batch(rows, weight, index)), batches.state()

    # a signal waits for the end of the step, and for what is being saved
    with (
        asked() as run.told,
        contextlib.closing(run),
        contextlib.closing(checkpoints),
        Prefetch(produce, running.prefetch) as ahead,
    ):
        state = run.epochs_from(state, ahead, parallel.step, checkpoints)
    return TrainResult(
        state=state,
        epochs=run.summaries,
        queries=run.progress.queries,
        seconds=run.progress.seconds,
        waited_s=ahead.waited_s,
    )


def restore_run(workdir: Path, config: TrainConfig) -> TrainState:
    """The newest checkpoint of a run.

    Raises:
      InputError: there is none, it is damaged, or of another structure.
    """
    checkpoints = Checkpoints(workdir / "checkpoints", read_only=True)
    try:
        for line in checkpoints.passed_over:
            raise InputError(f"{line}: expected whole; run the training again")
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
    """The loop's bookkeeping: metrics, progress, guard, when to save."""

    def __init__(
        self,
        config: TrainConfig,
        running: Running,
        features: FeatureMap,
        per_epoch: int,
        workdir: Path,
        state: TrainState,
        dataset: Demonstrations,
    ) -> None:
        self.config, self.running, self.features = config, running, features
        self.dataset = dataset
        self.per_epoch, first_step = per_epoch, int(state.step)
        total = self.per_epoch * config.epochs
        self.trackers = (
            trackers(running.trackers, workdir, first_step) if is_first() else []
        )
        for tracker in self.trackers:
            tracker.settings(settings_of(config))
        self.writer = (
            MetricsWriter(workdir, first_step, self.trackers) if is_first() else None
        )
        self.progress = Progress(total, first_step, "train", shown=is_first())
        self.summaries: list[dict] = []
        self.told: Callable[[], int | None] = lambda: None  # signal to end at

    def close(self) -> None:
        if self.writer is not None:
            self.writer.close()
        self.progress.close()

    def epochs_from(
        self,
        state: TrainState,
        batches: Iterator[tuple],
        take_step: Step,
        checkpoints: Checkpoints,
    ) -> TrainState:
        step = int(state.step)
        for epoch in range(step // self.per_epoch, self.config.epochs):
            sums = np.zeros(4)
            for _ in range(self.per_epoch - step % self.per_epoch):
                batch, position = next(batches)
                step += 1
                with with_the_others(step):
                    state, metrics = take_step(state, batch)
                    metrics = jax.device_get(metrics)
                sums += self._after_step(step, metrics)
                stop = self._told_to_stop(step)
                if stop or self._is_due(step):
                    checkpoints.save(state, position)
                self.running.on_step(step)
                if stop:
                    raise Interrupted(stop)
            self.summaries.append(_summary(epoch, sums))
        self._draw_time_weights(step, state)
        return state

    def _draw_time_weights(self, step: int, state: TrainState) -> None:
        """Gamma over time, for the trackers."""
        if self.trackers and isinstance(state.params, RewardParams):
            gamma = np.asarray(pinned(state.params, self.config.reward).gamma)
            if (figure := time_weights(gamma)) is not None:
                for tracker in self.trackers:
                    tracker.figure(step, "time weights", figure)

    def _told_to_stop(self, step: int) -> int | None:
        """Number of a signal to end after this step, the same in all processes."""
        if jax.process_count() > 1:
            return signal.SIGTERM if all_stop_after(step) else None
        return self.told()

    def _is_due(self, step: int) -> bool:
        every = self.running.checkpoint_every
        return step % self.per_epoch == 0 or (every > 0 and step % every == 0)

    def _after_step(self, step: int, metrics: StepMetrics) -> np.ndarray:
        check_step(metrics, self.features, step, self.dataset)
        pairs = max(float(metrics.pairs), 1.0)
        shown = {
            "loss": float(metrics.loss_sum) / max(float(metrics.terms), 1.0),
            "pair_accuracy": float(metrics.wins) / pairs,
        }
        self.progress.advance(pairs, **shown)
        if self.writer is not None:
            rate = self.progress.queries / self.progress.seconds
            norm = float(metrics.grad_norm)
            more = {"grad_norm": norm, "pairs": pairs, "queries_per_s": rate}
            self.writer.write(step, {**shown, **more})
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
