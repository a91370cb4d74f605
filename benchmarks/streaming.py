"""Scenes per second from disk, memory meanwhile, and how long the step waits.

    python -m benchmarks.streaming [--data=DATASET] [--scenes=10000000]

Writes a dataset that repeats stored scenes, streams one epoch of it, then trains on
it for some steps; its rival holds its rows in memory. Pages of a small dataset stay
in the system's cache: only one larger than the machine's memory is read from disk.
"""

import shutil
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from absl import app, flags

from benchmarks.common import resident_mb, stored_scenes, write
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.data.store.order import ROW_BYTES, BatchIterator, split_batches
from rcirl_jax.data.store.rows import checked_leaves
from rcirl_jax.data.store.shards import encode
from rcirl_jax.data.store.stream import Prefetch
from rcirl_jax.features import feature_map
from rcirl_jax.train.loop import fit_normaliser_on, host_batch
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.train.step import init_state, make_train_step
from rcirl_jax.types import Demonstration
from tests.helpers.scenes import demonstration

_DATA = flags.DEFINE_string("data", None, "dataset to repeat (default: random scenes)")
_SCENES = flags.DEFINE_integer("scenes", 100_000, "scenes to write and stream")
_STEPS = flags.DEFINE_integer("steps", 200, "training steps in which waiting is timed")
_BATCH = flags.DEFINE_integer("batch_size", 64, "scenes of a batch")
_PREFETCH = flags.DEFINE_integer("prefetch", 4, "batches read ahead")
_RIVAL = flags.DEFINE_integer("rival_scenes", 100_000, "most scenes held in memory")
_FOLDER = flags.DEFINE_string("folder", None, "where to write (default: temporary)")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")


def _rows() -> Demonstration:
    """The scenes to repeat: the first 4096 of --data, or 256 random ones."""
    if _DATA.value:
        dataset = open_dataset(_DATA.value)
        return dataset.read(np.arange(min(dataset.count, 4096)))
    made = [demonstration(seed) for seed in range(256)]
    return jax.tree.map(lambda *x: np.stack(x), *made)


def _fitting(rows: Demonstration, folder: Path) -> tuple[int, dict]:
    """How many scenes to write, after saying what they need."""
    values = encode(checked_leaves(rows))
    each = sum(len(value) for value in values.values()) / rows.vehicle.shape[0]
    free = shutil.disk_usage(folder).free
    count = min(_SCENES.value, int(0.9 * free / each))
    print(
        f"a scene takes {each:,.0f} bytes on disk ({ROW_BYTES:,} unpacked): "
        f"{_SCENES.value:,} scenes {_SCENES.value * each / 1e9:,.1f} GB, 10 million "
        f"{1e7 * each / 1e9:,.1f} GB; {free / 1e9:,.1f} GB are free: writing {count:,}"
    )
    return count, {"bytes_per_scene": round(each), "free_gb": round(free / 1e9, 1)}


def _epoch(batches: BatchIterator) -> dict:
    """Speed of one epoch without a step, and memory after a tenth and at its end."""
    total, frames, watched = batches.batches_per_epoch, 0, []
    begin = time.perf_counter()
    with Prefetch(lambda: next(batches), _PREFETCH.value) as ahead:
        for _ in range(total):
            rows, weight, number = next(ahead)
            frames += int(np.sum(rows.frame[weight > 0], dtype=np.int64))
            if not np.array_equal(rows.frame, number):
                raise ValueError("a row is not the one that was asked for")
            watched.append(resident_mb())
    seconds = time.perf_counter() - begin
    return {
        "frame_sum": frames,
        "seconds": round(seconds, 2),
        "rss_mb_after_a_tenth": round(watched[total // 10], 1),
        "rss_mb_at_the_end": round(watched[-1], 1),
        "rss_mb_max": round(max(watched), 1),
    }


def _training(batches: BatchIterator, config: TrainConfig, state: object) -> dict:
    """Share of the time that the step waits for rows."""
    step = jax.jit(make_train_step(config))
    with Prefetch(lambda: next(batches), _PREFETCH.value) as ahead:
        for turn in range(_STEPS.value + 20):
            if turn == 20:
                begin, before = time.perf_counter(), ahead.waited_s
            state, metrics = step(state, jax.device_put(host_batch(*next(ahead))))
            jax.block_until_ready(metrics)
        seconds, waited = time.perf_counter() - begin, ahead.waited_s - before
    return {
        "scenes_per_s": round(_STEPS.value * _BATCH.value / seconds),
        "share_waiting": round(waited / seconds, 5),
    }


def main(_: list[str]) -> None:
    """Write, stream, train, compare."""
    with tempfile.TemporaryDirectory(dir=_FOLDER.value) as folder:
        rows = _rows()
        count, result = _fitting(rows, Path(folder))
        begin = time.perf_counter()
        dataset = stored_scenes(Path(folder) / "d", rows, count)
        result |= {"scenes": count, "written_s": round(time.perf_counter() - begin, 1)}
        settings: dict = {"batch_size": _BATCH.value, "seed": 0}
        streamed = lambda: split_batches(  # noqa: E731
            dataset, "train", in_memory_mb=0.0, **settings
        )
        result["streamed"] = _epoch(streamed())
        if result["streamed"].pop("frame_sum") != count * (count - 1) // 2:
            raise ValueError("an epoch did not visit every scene once")
        config = TrainConfig(batch_size=_BATCH.value)
        features = feature_map(config.features)
        state = init_state(config, fit_normaliser_on(dataset, config, features))
        result["streamed"] |= _training(streamed(), config, state)
        held = np.arange(min(count, _RIVAL.value))
        memory = lambda: BatchIterator(  # noqa: E731
            loaded, blocks=dataset.blocks(held), **settings
        )
        loaded = dataset.read(held)
        result["in_memory"] = {"scenes": held.size, **_epoch(memory())}
        del result["in_memory"]["frame_sum"]
        result["in_memory"] |= _training(memory(), config, state)
    for name in ("streamed", "in_memory"):
        part = result[name]
        part["scenes_per_s_without_step"] = round(
            part.get("scenes", count) / part["seconds"]
        )
        print(f"{name}: {part}")
    print("written:", write("streaming", result, _OUTPUT.value, data=_DATA.value))


if __name__ == "__main__":
    app.run(main)
