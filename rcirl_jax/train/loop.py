"""Training from a dataset: sequence only, no mathematics.

restore or init -> for each batch: step, guard, log -> checkpoint every epoch, and
when the process is told to end (`interrupts`).
With several processes (`train.parallel`) each reads and computes its part of every
batch; process 0 alone writes run.json and metrics.
"""

import contextlib
import dataclasses
import functools
import json
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from jax.experimental import multihost_utils

from rcirl_jax.data.store.batches import Prefetch, split_batches
from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.data.store.rows import scene_name, unusable_leaves
from rcirl_jax.errors import InputError
from rcirl_jax.features import feature_map
from rcirl_jax.reward import effective_params, fit_normaliser, identity_normaliser
from rcirl_jax.runtime.atomic_files import read_json, write_whole
from rcirl_jax.runtime.pipeline import only_one
from rcirl_jax.runtime.signals import Interrupted, asked
from rcirl_jax.train.checkpoint import Checkpoints
from rcirl_jax.train.featurise import (
    featurised,
    host_batch,
    normaliser_rows,
    not_finite,
)
from rcirl_jax.train.metrics import RunLog, plateau_warning, read_metrics
from rcirl_jax.train.parallel import (
    Parallel,
    all_stop_after,
    exit_if_peer_lost,
    is_first,
    parallelise,
)
from rcirl_jax.train.state import TrainConfig, TrainState
from rcirl_jax.train.step import init_state, make_train_step

AHEAD = 4  # batches read ahead of the step


@dataclasses.dataclass(frozen=True, kw_only=True)
class Running:
    """The means of a run; nothing here changes its result."""

    # "jit", or over the devices of all processes "pmap" or "shard_map"
    parallel: str = "jit"
    # MiB of scenes up to which the training split is loaded whole
    in_memory_mb: float = 1024.0
    # steps between checkpoints, besides those at the end of each epoch (0: none)
    checkpoint_every: int = 0
    # of `rcirl_jax.train.trackers`; None: TensorBoard if it is installed
    trackers: tuple[str, ...] | None = None
    # called with the number of each finished step
    on_step: Callable[[int], None] = lambda step: None

    def __post_init__(self) -> None:
        """Reject values out of range with the flag's name."""
        for name in ("in_memory_mb", "checkpoint_every"):
            if not (value := getattr(self, name)) >= 0:
                raise InputError(f"{name}: {value}: expected >= 0")


def check_run(workdir: Path, config: TrainConfig, dataset: Demonstrations) -> None:
    """Check that an existing run.json says the same.

    Raises:
      InputError: the folder holds a run with other settings (names the first).
    """
    path = workdir / "run.json"
    if not path.exists():
        return
    found = read_json(path, "the file of a training run")
    try:
        made = dict(found["config"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: {type(error).__name__}: {error}: expected the file of a training "
            "run"
        ) from error
    described = _described(config, dataset)
    if found.get("dataset_hash") != described["dataset_hash"]:
        raise InputError(f"{path}: dataset_hash: made from another dataset")
    for name in made.keys() - described["config"].keys():
        raise InputError(f"{path}: {name}: unknown: expected a run of this version")
    for name, setting in described["config"].items():
        if made.get(name) != setting and name != "epochs":
            raise InputError(
                f"{path}: {name}: {made.get(name)}: expected {setting} to resume; "
                "use another folder for other settings"
            )


def describe_run(
    workdir: Path, config: TrainConfig, dataset: Demonstrations, provenance: dict
) -> None:
    """Write run.json (process 0)."""
    if is_first():
        text = json.dumps({**_described(config, dataset), **provenance}, indent=2)
        write_whole(workdir / "run.json", text + "\n")


def _described(config: TrainConfig, dataset: Demonstrations) -> dict:
    return {
        "config": json.loads(json.dumps(dataclasses.asdict(config))),
        "dataset_hash": dataset.hash,
    }


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainResult:
    """The report of a finished run."""

    state: TrainState
    epochs: list[dict]  # one summary per epoch of this process
    queries: float  # pairs compared in this process
    seconds: float  # wall time of the steps in this process
    waited_s: float  # of it, waiting for rows
    warnings: tuple[str, ...] = ()  # why its result may be worth nothing


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
    if checkpoints.latest_step is None:
        rows = normaliser_rows(dataset, config)
        features, today = feature_map(config.features), config.reward.today
        normaliser = fit_normaliser(rows, features, today)
        state = parallel.replicate(init_state(config, normaliser))
    else:
        like = parallel.replicate(blank_state(config))
        state, position = checkpoints.restore(like)
        batches.restore(position)
    describe_run(workdir, config, dataset, provenance)

    def produce() -> tuple:
        """The next batch, on its devices before its step, and where it stands."""
        if batches.state()["epoch"] >= config.epochs:
            raise StopIteration
        rows, weight, index = next(batches)
        weight = weight * dataset.weights(index)
        placed = parallel.place(host_batch(rows, weight, index))
        return placed, index[weight > 0.0], batches.state()

    def is_due(step: int) -> bool:
        every = running.checkpoint_every
        return step % per_epoch == 0 or (every > 0 and step % every == 0)

    step, per_epoch = int(state.step), batches.batches_per_epoch
    total, summaries = per_epoch * config.epochs, []
    # a signal waits for the end of the step, and for what is being saved
    with (
        asked() as told,
        contextlib.closing(
            RunLog(workdir, config, step, total, running.trackers, shown=is_first())
        ) as log,
        contextlib.closing(checkpoints),
        Prefetch(produce, AHEAD) as ahead,
    ):
        for epoch in range(step // per_epoch, config.epochs):
            sums = np.zeros(4)
            for _ in range(per_epoch - step % per_epoch):
                batch, index, position = next(ahead)
                step += 1
                with exit_if_peer_lost(step):
                    state, metrics = parallel.step(state, batch)
                    metrics = jax.device_get(metrics)
                if not metrics.finite:
                    refuse_step(state, step, index, dataset, config)
                sums += log.step(step, metrics)
                # the same in all processes
                many = jax.process_count() > 1
                stop = all_stop_after(step) and signal.SIGTERM if many else told()
                if stop or is_due(step):
                    checkpoints.save(state, position)
                running.on_step(step)
                if stop:
                    raise Interrupted(stop)
            loss, terms, wins, pairs = sums
            summaries.append(
                {
                    "epoch": epoch + 1,
                    "loss": loss / max(terms, 1.0),
                    "pair_accuracy": wins / max(pairs, 1.0),
                    "pairs": int(pairs),
                }
            )
        log.draw_time_weights(
            step, effective_params(state.params, config.reward)["gamma"]
        )
    warnings: tuple[str, ...] = ()
    if is_first():
        found = [row.get("loss") for row in read_metrics(workdir / "metrics.jsonl")]
        said = plateau_warning(np.array(found, float))  # None becomes NaN
        warnings = (said,) if said else ()
        describe_run(workdir, config, dataset, {**provenance, "warnings": warnings})
    return TrainResult(
        state=state,
        epochs=summaries,
        queries=log.queries,
        seconds=log.seconds,
        waited_s=ahead.waited_s,
        warnings=warnings,
    )


def restore_run(workdir: Path, config: TrainConfig) -> TrainState:
    """The newest checkpoint of a run.

    Raises:
      InputError: there is none, it is damaged, or of another structure.
    """
    checkpoints = Checkpoints(workdir / "checkpoints", read_only=True)
    with contextlib.closing(checkpoints):
        for line in checkpoints.passed_over:
            raise InputError(f"{line}: expected whole; run the training again")
        if checkpoints.latest_step is None:
            raise InputError(f"{workdir}: checkpoints: none: expected a trained run")
        return checkpoints.restore(blank_state(config))[0]


def blank_state(config: TrainConfig) -> TrainState:
    """Returns a state of a run's structure, to restore a checkpoint into."""
    size = feature_map(config.features).num_features
    return init_state(config, identity_normaliser(size))


def refuse_step(
    state: TrainState,
    step: int,
    index: np.ndarray,
    dataset: Demonstrations,
    config: TrainConfig,
) -> None:
    """Names what made a step not finite: makes its features again and looks at them.

    Args:
      state: before or after the step.
      step: its number, from 1.
      index: dataset rows of its scenes, in this process.
      dataset: where they lie.
      config: of the training.

    Raises:
      InputError: always.
    """
    if jax.process_count() > 1:
        index = np.ravel(multihost_utils.process_allgather(index))
    rows, key = dataset.read(index), jax.random.fold_in(state.key, step - 1)
    batch = jax.device_put(host_batch(rows, np.ones(index.size), index))
    found = not_finite(featurised(key, batch, config), config.features)
    bad = np.array(list(found.values()))
    if not bad.any():
        raise InputError(
            f"train: step {step}: loss or gradient: not finite: features are finite; "
            "lower learning_rate; the state before is kept"
        )
    at = int(np.argmax(bad.any(axis=0)))
    names = ", ".join(name for name, of in found.items() if of[at])
    leaves = unusable_leaves(rows, at)
    cause = f" (as is the stored {', '.join(leaves)})" if leaves else ""
    raise InputError(
        f"train: step {step}: {scene_name(rows, at, int(index[at]))}: {names}: not "
        f"finite{cause}: expected finite numbers; the state before is kept"
    )
