"""Latency of the C++ scorer: 512 candidates of 18 x 21 on one core.

    taskset -c 0 python -m benchmarks.onboard

Builds `onboard/` twice, for any processor of this kind (-O3) and for this very one
(-march=native), and times single calls 2 ms apart, as a planner makes them: wall time,
and processor time, which other programs on the core do not stretch. Goal: p99 below
1 ms for 15 tanh units.
"""

import dataclasses
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from absl import app, flags

from benchmarks.common import percentiles, write
from rcirl_jax.export import RewardWeights, save
from tests.export.test_weights import example_samples, example_weights

_CALLS = flags.DEFINE_integer("calls", 2000, "calls that are timed")
_BUILD = flags.DEFINE_string("build", "build", "folder of the two builds")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

PAUSE_US = 2000  # between calls
NETWORKS = {  # hidden units, by context
    "linear": ((), False),
    "15": ((15,), False),
    "15_by_context": ((15,), True),
    "64": ((64,), False),
    "32x16": ((32, 16), False),
}


def built(name: str, native: str) -> Path:
    """The benchmark program of one build."""
    folder = Path(_BUILD.value) / name
    configure = ["cmake", "-S", "onboard", "-B", folder, f"-DRCIRL_NATIVE={native}"]
    compiled = ["cmake", "--build", folder, "--target", "bench"]
    for command in (configure, compiled):
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder / "bench"


def network(hidden: tuple[int, ...], by_context: bool) -> RewardWeights:
    """A random reward of the size of trained ones: 21 features, 18 times."""
    drawn = example_weights(0, 21, 18, hidden, "tanh", by_context)
    return dataclasses.replace(
        drawn,
        kernels=tuple(kernel / np.sqrt(len(kernel)) for kernel in drawn.kernels),
        gamma=drawn.gamma / np.sqrt(18.0),
        context=None if drawn.context is None else drawn.context / 21.0,
    )


def main(_: list[str]) -> None:
    """Time every network in both builds."""
    result: dict = {"calls": _CALLS.value, "pause_us": PAUSE_US}
    builds = {
        "portable": built("onboard", "OFF"),
        "native": built("onboard_native", "ON"),
    }
    with tempfile.TemporaryDirectory() as folder:
        for name, shape in NETWORKS.items():
            path, weights = Path(folder) / name, network(*shape)
            save(path, weights, *example_samples(weights))
            for build, program in builds.items():
                command = [program, path, "512", str(_CALLS.value), str(PAUSE_US)]
                lines = subprocess.run(command, check=True, capture_output=True).stdout
                wall, used = 1e-9 * np.array(lines.split(), float).reshape(-1, 2).T
                row = {"wall": percentiles(wall), "processor": percentiles(used)}
                result[f"{build}_{name}"] = row
                print(f"{build}, {name}: {row}")
    write("onboard", result, _OUTPUT.value)


if __name__ == "__main__":
    app.run(main)
