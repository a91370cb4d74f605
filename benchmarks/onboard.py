"""Latency of the C++ headers: 512 candidates of 18 x 21 on one core.

    taskset -c 0 python -m benchmarks.onboard

Builds `onboard/` twice, for any processor of this kind (-O3) and for this very one
(-march=native), and times single calls 2 ms apart, as a planner makes them: wall time,
and processor time, which other programs on the core do not stretch. Goals: scores
alone have a p99 below 1 ms for 15 tanh units, features and scores together one below
2 ms, and so with the safety filter and the choice (`choose`). Beside the latter two,
in the same run: the compiled JAX functions, and the numpy files for planners.
"""

import dataclasses
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np
from absl import app, flags

from benchmarks.common import percentiles, write
from rcirl_jax.export import Reward, save
from rcirl_jax.export.own_planner.builder import plain_scene
from rcirl_jax.export.own_planner.choose import choose
from rcirl_jax.features import feature_map
from rcirl_jax.types import Scene
from tests.helpers import drawn_scenes, own_planner
from tests.helpers.scenes import random_scene
from tests.helpers.weights_files import example_samples, example_weights

_CALLS = flags.DEFINE_integer("calls", 2000, "calls that are timed")
_PARTS = flags.DEFINE_list(
    "parts", "scores,features,choose", "what is timed, each a file"
)
_BUILD = flags.DEFINE_string("build", "build", "folder of the two builds")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

PAUSE_US = 2000  # between calls
CANDIDATES = 512
SCENES = 8  # which calls take in turn, all slots taken
NUMPY_CALLS = 50
NETWORKS = {  # hidden units, by context
    "linear": ((), False),
    "15": ((15,), False),
    "15_scene_gating": ((15,), True),
    "64": ((64,), False),
    "32x16": ((32, 16), False),
}


def built(name: str, native: str) -> Path:
    """The folder of one build's benchmark programs."""
    folder = Path(_BUILD.value) / name
    configure = ["cmake", "-S", "onboard", "-B", folder, f"-DRCIRL_NATIVE={native}"]
    targets = ("bench", "bench_features")
    compiled = ["cmake", "--build", folder, "--target", *targets]
    for command in (configure, compiled):
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder


def network(hidden: tuple[int, ...], scene_gating: bool) -> Reward:
    """A random reward of the size of trained ones: 21 features, 18 times."""
    drawn = example_weights(0, 21, 18, hidden, "tanh", scene_gating)
    return dataclasses.replace(
        drawn,
        kernels=tuple(kernel / np.sqrt(len(kernel)) for kernel in drawn.kernels),
        gamma=drawn.gamma / np.sqrt(18.0),
        scene_gating=None if drawn.scene_gating is None else drawn.scene_gating / 21.0,
    )


def measured(*command: object) -> dict:
    """Times of the calls of a program that prints them."""
    words = [str(word) for word in (*command, _CALLS.value, PAUSE_US)]
    lines = subprocess.run(words, check=True, capture_output=True).stdout
    wall, used = 1e-9 * np.array(lines.split(), float).reshape(-1, 2).T
    return {"wall": percentiles(wall), "processor": percentiles(used)}


def here(call: Callable[[int], object], count: int) -> dict:
    """Times of a call in this process, apart as a planner's cycles are."""
    for number in range(SCENES):
        call(number)
    wall, used = [], []
    for number in range(count):
        time.sleep(1e-6 * PAUSE_US)
        begin, begin_used = time.perf_counter(), time.process_time()
        call(number)
        used.append(time.process_time() - begin_used)
        wall.append(time.perf_counter() - begin)
    return {"wall": percentiles(wall), "processor": percentiles(used)}


def planning_frames() -> Iterator[tuple[Scene, np.ndarray, np.ndarray]]:
    """Crowded scenes with their candidates [K, T]."""
    seed, found = 0, 0
    while found < SCENES:
        made = jax.tree.map(np.asarray, random_scene(seed))
        seed += 1
        if np.sum(made.obstacles.kind != 0) < 14:
            continue
        found += 1
        one = jax.tree.map(lambda x: x[None], made)
        draw = np.random.default_rng(seed)
        s, l = drawn_scenes.candidates(draw, one, CANDIDATES)
        yield made, s[0], l[0]


def features(programs: dict[str, Path], folder: Path) -> dict:
    """Features and scores together, on crowded scenes."""
    return on_frames("features", programs, folder)


def choice(programs: dict[str, Path], folder: Path) -> dict:
    """The safety filter, features, scores and the choice, on the same scenes."""
    return on_frames("choose", programs, folder)


def on_frames(what: str, programs: dict[str, Path], folder: Path) -> dict:
    """Times of what is done with each planning frame, by every form of it."""
    columns = feature_map("paper21")
    reward = own_planner.drawn_reward(folder / "reward", columns, mode="path_speed")
    frames, file = list(planning_frames()), folder / "cases"
    plain = [(plain_scene(scene), *ways) for scene, *ways in frames]
    np.concatenate([own_planner.as_numbers(*case) for case in plain]).tofile(file)
    rows = {
        build: measured(path / "bench_features", what, reward.file, file)
        for build, path in programs.items()
    }
    rows["jax"] = here(jax_call(what, reward, frames), _CALLS.value)
    in_numpy = choose if what == "choose" else own_planner.numpy_answers
    rows["numpy"] = here(lambda i: in_numpy(reward, *plain[i % SCENES]), NUMPY_CALLS)
    return rows


def jax_call(what: str, reward: Reward, frames: list) -> Callable[[int], object]:
    """The same by compiled JAX, of scenes that lie on the device."""
    compiled = {
        "features": own_planner.compiled_score,
        "choose": own_planner.compiled_choice,
    }
    score = compiled[what](feature_map("paper21"), reward)
    given = [jax.tree.map(jax.numpy.asarray, frame) for frame in frames]
    return lambda i: jax.block_until_ready(score(*given[i % SCENES]))


def scores(programs: dict[str, Path], folder: Path) -> dict:
    """Scores alone, of every network."""
    rows = {}
    for name, shape in NETWORKS.items():
        path, weights = folder / name, network(*shape)
        save(path, weights, *example_samples(weights))
        for build, program in programs.items():
            rows[f"{build}_{name}"] = measured(program / "bench", path, CANDIDATES)
    return rows


def main(_: list[str]) -> None:
    """Time the parts that are asked for, in both builds."""
    programs = {
        "portable": built("onboard", "OFF"),
        "native": built("onboard_native", "ON"),
    }
    parts = {
        "scores": ("onboard", scores),
        "features": ("onboard_features", features),
        "choose": ("onboard_choose", choice),
    }
    for part in _PARTS.value:
        name, timed_part = parts[part]
        with tempfile.TemporaryDirectory() as folder:
            rows = timed_part(programs, Path(folder))
        for row, times in rows.items():
            print(f"{row}: {times}")
        result = {"calls": _CALLS.value, "pause_us": PAUSE_US, **rows}
        write(name, result, _OUTPUT.value)


if __name__ == "__main__":
    app.run(main)
