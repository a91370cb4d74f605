"""How the end-to-end step scales: candidates, obstacles, scenes, devices.

    python -m benchmarks.scaling

One training step from scenes to new parameters (sampling, features, values, loss,
gradient, Adam). One thing changes at a time, from 64 scenes of 122 candidates with
all obstacle slots. Points take turns in rounds; medians. Devices are worked by
shard_map; on a CPU a device is a core, in a process bound to so many. Expected: time
in proportion to scenes, candidates and slots, so that what is done per second stays.
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from benchmarks.common import write
from rcirl_jax.evaluation.ranking.learners import normaliser_of
from rcirl_jax.sampling import SamplerConfig, num_candidates
from rcirl_jax.train.frozen import freeze
from rcirl_jax.train.loop import host_batch
from rcirl_jax.train.parallel import parallelise
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.train.step import init_state, make_train_step
from rcirl_jax.types import Demonstration
from rcirl_jax.units import NUM_OBSTACLES
from tests.helpers.scenes import demonstration

CANDIDATES = (80, 122, 256, 512, 1024)
OBSTACLES = (2, 4, 8, NUM_OBSTACLES, 2 * NUM_OBSTACLES)
SCENES = (8, 16, 64, 256, 1024)
DISTINCT = 64  # scenes that are made; larger batches repeat them

_ROUNDS = flags.DEFINE_integer("rounds", 5, "rounds")
_SECONDS = flags.DEFINE_float("seconds", 0.5, "least time of a point in a round")
_CORES = flags.DEFINE_integer("cores", None, "the point of so many cores alone")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """One size of everything."""

    scenes: int = TrainConfig().batch_size
    candidates: int = num_candidates(SamplerConfig())
    obstacles: int = NUM_OBSTACLES
    how: str = "jit"


def _config(point: Point) -> TrainConfig:
    default = SamplerConfig()
    more = default.num_random + point.candidates - num_candidates(default)
    sampler = dataclasses.replace(default, num_random=more)
    return TrainConfig(batch_size=point.scenes, sampler=sampler)


def _rows(point: Point) -> Demonstration:
    """Scenes (numpy) whose obstacles are cut, or met twice, to fill the slots."""
    made = [demonstration(seed) for seed in range(DISTINCT)]
    rows = jax.tree.map(lambda *x: np.stack(x), *made)
    take = np.arange(point.scenes) % DISTINCT
    slots = np.arange(point.obstacles) % NUM_OBSTACLES
    rows = jax.tree.map(lambda x: x[take], rows)
    cut = lambda x: x[:, slots]  # noqa: E731
    obstacles = jax.tree.map(cut, rows.scene.obstacles)
    scene = rows.scene.replace(obstacles=obstacles)
    return rows.replace(scene=scene, decisions=cut(rows.decisions))


def _way(point: Point) -> tuple[Callable[[], object], float]:
    """(one step, its queries)."""
    config, rows, index = _config(point), _rows(point), np.arange(point.scenes)
    some = jax.tree.map(lambda x: x[:DISTINCT], rows)
    frozen = freeze(some, index[:DISTINCT], config)
    queries = float(jnp.mean(jnp.sum(frozen.feasible, axis=1))) * point.scenes
    parallel = parallelise(make_train_step(config), point.how, point.scenes)
    batch = parallel.place(host_batch(rows, np.ones(point.scenes), index))
    start = init_state(config, normaliser_of(frozen, config))
    held = [parallel.replicate(start)]

    def step() -> object:
        held[0], metrics = parallel.step(held[0], batch)
        return metrics.loss_sum

    return step, queries


def _measured(points: list[Point]) -> list[dict]:
    """Medians over rounds in turn."""
    ways = [_way(point) for point in points]
    counts, taken = [], [[] for _ in points]
    for step, _ in ways:
        jax.block_until_ready(step())
        begin = time.perf_counter()
        jax.block_until_ready(step())
        counts.append(max(1, round(_SECONDS.value / (time.perf_counter() - begin))))
    for _ in range(_ROUNDS.value):
        for (step, _), count, seconds in zip(ways, counts, taken, strict=True):
            begin = time.perf_counter()
            for _ in range(count):  # one at a time, as in the training loop
                jax.block_until_ready(step())
            seconds.append((time.perf_counter() - begin) / count)
    found = []
    for point, (_, queries), seconds in zip(points, ways, taken, strict=True):
        median = float(np.median(seconds))
        found.append(
            {
                **dataclasses.asdict(point),
                "step_ms": round(1e3 * median, 3),
                "queries_per_s": round(queries / median),
                "scenes_per_s": round(point.scenes / median),
                "candidates_per_s": round(point.scenes * point.candidates / median),
            }
        )
        print(found[-1], flush=True)
    return found


def _devices() -> list[dict]:
    """1, 2, 4, ... devices; cores of a CPU in a process each."""
    on_cpu = jax.default_backend() == "cpu"
    most = len(os.sched_getaffinity(0)) if on_cpu else jax.device_count()
    if not on_cpu:
        return [{**_measured([Point(how="shard_map")])[0], "devices": most}]
    counts = [2**n for n in range(most.bit_length()) if 2**n <= most]
    found = []
    for count in counts:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "benchmarks.scaling", f"--cores={count}"]
            given = {"rounds": _ROUNDS.value, "seconds": _SECONDS.value}
            command += [f"--{name}={value}" for name, value in given.items()]
            if subprocess.run([*command, f"--output={folder}"]).returncode:
                raise SystemExit(f"error: --cores={count}: the benchmark failed")
            one = json.loads((Path(folder) / "scaling.json").read_text())
        found.append({**one["devices"][0], "devices": count})
    return found


def main(_: list[str]) -> None:
    """All curves, or one point on so many cores."""
    if count := _CORES.value:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])
        jax.config.update("jax_num_cpu_devices", count)
        result = {"devices": _measured([Point(how="shard_map")])}
    else:
        result = {
            "candidates": _measured([Point(candidates=k) for k in CANDIDATES]),
            "obstacles": _measured([Point(obstacles=n) for n in OBSTACLES]),
            "scenes": _measured([Point(scenes=b) for b in SCENES]),
            "devices": _devices(),
        }
    print(f"written: {write('scaling', result, _OUTPUT.value)}")


if __name__ == "__main__":
    app.run(main)
