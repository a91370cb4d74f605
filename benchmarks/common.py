"""Shared parts of the benchmarks: hardware, percentiles, made datasets, the JSON."""

import contextlib
import datetime
import os
import platform
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import psutil

from rcirl_jax.cli.running import provenance
from rcirl_jax.data.formats import read_recordings
from rcirl_jax.data.importing import ImportConfig, import_logs
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.features import feature_map
from rcirl_jax.reward import RewardConfig, effective_params, init_params
from rcirl_jax.runtime.atomic_files import write_json
from rcirl_jax.runtime.provenance import processor
from rcirl_jax.types import Normaliser, RewardParams

STRIDE_S = 60.0  # s between planning frames of the synthetic dataset


def machine() -> dict:
    """Hardware and versions, for the result file."""
    return {
        **processor(),
        "load": round(os.getloadavg()[0], 2),
        "device": jax.devices()[0].device_kind,
        "devices": jax.device_count(),
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in ("jax", "jaxlib", "numpy")},
    }


def percentiles(seconds: list[float]) -> dict[str, float]:
    """Median, 99th percentile and the worst, in milliseconds."""
    times = 1e3 * np.asarray(seconds)
    return {
        "p50_ms": round(float(np.percentile(times, 50)), 4),
        "p99_ms": round(float(np.percentile(times, 99)), 4),
        "max_ms": round(float(times.max()), 4),
    }


def timed(call: Callable[[], object], count: int, warm_up: int = 20) -> list[float]:
    """Seconds of each of `count` calls after a warm-up; results are waited for."""
    for _ in range(warm_up):
        jax.block_until_ready(call())
    seconds = []
    for _ in range(count):
        begin = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - begin)
    return seconds


def in_turn(
    ways: Mapping[str, Callable[[], object]], rounds: int
) -> dict[str, list[float]]:
    """Seconds of every way in each round, one way after the other."""
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, way in ways.items():
            begin = time.perf_counter()
            jax.block_until_ready(way())
            taken[name].append(time.perf_counter() - begin)
    return taken


def write(
    name: str,
    result: dict,
    folder: str,
    *,
    weights: Sequence[str] = (),
    data: str | None = None,
) -> Path:
    """The result with its machine and provenance as JSON under `folder`.

    Args:
      name: of the benchmark.
      result: its numbers.
      folder: where the file is written.
      weights: weights files that were read.
      data: dataset that was read.

    Raises:
      InputError: a weights file or the dataset is missing or damaged.
    """
    path = Path(folder) / f"{name}.json"
    made = {**provenance(weights), "date": datetime.date.today().isoformat()}
    made["flags"] = {flag: _public(value) for flag, value in made["flags"].items()}
    if data:
        made["data_hash"] = open_dataset(data, verify=False).hash
    write_json(path, {**result, "made_by": made, "machine": machine()})
    print(f"written: {path}")
    return path


def _public(value: object) -> object:
    """A flag's value for others to read: of a path of this machine its name."""
    here = isinstance(value, str) and Path(value).is_absolute()
    return Path(value).name if here else value


def resident_mb() -> float:
    """Memory of this process now, MiB."""
    return psutil.Process().memory_info().rss / 2**20


@contextlib.contextmanager
def dataset_or_synthetic(path: str | None) -> Iterator[str]:
    """The path of a dataset: the given one, or synthetic traffic while this lasts."""
    if path:
        yield path
        return
    collect = CollectConfig(stride_s=STRIDE_S)
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "synthetic"
        config = ImportConfig(format="synthetic", collect=collect)
        import_logs(read_recordings("synthetic", None), made, config)
        yield str(made)


def untrained(preset: str = "paper21") -> tuple[RewardParams, Normaliser]:
    """A reward of the paper's shape with drawn weights; what it costs is as learned."""
    shape, specs = RewardConfig(), feature_map(preset).specs
    params = effective_params(init_params(jax.random.key(0), len(specs), shape), shape)
    lower = jnp.asarray([spec.lower for spec in specs])
    upper = jnp.asarray([spec.upper for spec in specs])
    location = jnp.zeros(len(specs))
    return params, Normaliser(
        lower=lower, upper=upper, location=location, scale=upper - lower
    )


# source TOML of generated CSV logs: one straight lane
LANE_TOML = """
source = "generated"
licence = "none needed"
[columns]
t = "t"
id = "id"
x = "x"
y = "y"
[[lanes]]
id = "a"
points = [[-50.0, 0.0], [6000.0, 0.0]]
width = 4.0
"""
