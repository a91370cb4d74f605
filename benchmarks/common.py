"""What the benchmarks share: hardware and versions, percentiles, the JSON."""

import json
import os
import platform
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import jax
import numpy as np


def machine() -> dict:
    """Hardware and versions, for the result file."""
    model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text().splitlines()
        names = [
            line.split(":", 1)[1].strip() for line in lines if "model name" in line
        ]
        model = names[0] if names else model
    return {
        "cpu": model,
        "cores": len(os.sched_getaffinity(0)),
        "device": jax.devices()[0].device_kind,
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


def write(name: str, result: dict, folder: str) -> Path:
    """The result with its machine as JSON under `folder`."""
    path = Path(folder) / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**result, "machine": machine()}, indent=2) + "\n")
    return path
