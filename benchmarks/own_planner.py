"""F outside of this package against F in JAX, on random and on imported scenes.

    python -m benchmarks.own_planner --data=out/us101,out/urban,out/i80

Of every scene four ways, of an imported one the driver's own among them, along the
given path and with offsets of their own: the largest difference of every column and of
the score, as a share of max(1, |x|), for the numpy file and the C++ headers. Goal:
1e-5. Without --data random scenes alone.
"""

import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from absl import app, flags

from benchmarks.common import write
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.export import Reward
from rcirl_jax.export.own_planner.builder import plain_scene
from rcirl_jax.features import FeatureMap
from rcirl_jax.types import Demonstration, Scene
from tests.helpers import drawn_scenes, own_planner

_DATA = flags.DEFINE_list("data", [], "datasets, separated by commas")
_RANDOM = flags.DEFINE_integer("random", 10_000, "random scenes")
_BUILD = flags.DEFINE_string("build", "build/onboard", "folder of the C++ programs")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")

BATCH = 250  # scenes at once
WAYS = 4  # of a scene


def reader() -> Path:
    """The C++ program that computes F."""
    folder = Path(_BUILD.value)
    configure = ["cmake", "-S", "onboard", "-B", folder]
    for command in (configure, ["cmake", "--build", folder, "--target", "reader"]):
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder / "reader"


def in_cpp(program: Path, reward: Reward, cases: list, folder: Path) -> list:
    """Features and values of each case (scene, s, l) by the C++ headers."""
    file = folder / "cases"
    np.concatenate([own_planner.as_numbers(*case) for case in cases]).tofile(file)
    words = [program, "features", reward.file, file]
    done = subprocess.run(words, check=True, capture_output=True)
    each = np.frombuffer(done.stdout, np.float32).reshape(len(cases), -1)
    shape = (*cases[0][1].shape, len(reward.names))
    count = len(cases[0][1])
    return [(row[:-count].reshape(shape), row[-count:]) for row in each]


def imported(rows: Demonstration, seed: int) -> tuple[Scene, np.ndarray, np.ndarray]:
    """Scenes [n] with stations and offsets [n, K, T]: the driver's and drawn ones."""
    rng = np.random.default_rng(seed)
    drawn = drawn_scenes.candidates(rng, rows.scene, WAYS - 1)
    human = (rows.human.s, rows.human.l)
    s, l = (
        np.concatenate([np.asarray(one)[:, None], more], axis=1)
        for one, more in zip(human, drawn, strict=True)
    )
    return rows.scene, s, l


def random(count: int, seed: int) -> tuple[Scene, np.ndarray, np.ndarray]:
    """Random scenes with drawn stations and offsets."""
    rng = np.random.default_rng(seed)
    scenes = drawn_scenes.scenes(rng, count)
    return scenes, *drawn_scenes.candidates(rng, scenes, WAYS)


def batches(path: str | None) -> Iterator[tuple[Scene, np.ndarray, np.ndarray]]:
    """The scenes of a dataset, or random ones, up to `BATCH` at once."""
    if path is None:
        for first in range(0, _RANDOM.value, BATCH):
            yield random(min(BATCH, _RANDOM.value - first), first)
        return
    dataset = open_dataset(path, verify=False)
    for first in range(0, dataset.count, BATCH):
        part = np.arange(first, min(first + BATCH, dataset.count))
        yield imported(dataset.read(part), first)


def differences(
    scenes: Scene,
    s: np.ndarray,
    l: np.ndarray,
    columns: FeatureMap,
    reward: Reward,
    program: Path,
) -> dict[str, dict[str, float]]:
    """Largest differences of a batch, by implementation and column."""
    ones = [jax.tree.map(lambda x, i=i: x[i], scenes) for i in range(len(s))]
    found: dict[str, dict[str, float]] = {"numpy": {}, "cpp": {}}
    for offsets in (None, l):
        wanted, values = own_planner.jax_answers(columns, reward, scenes, s, offsets)
        each = [None] * len(s) if offsets is None else offsets
        cases = [(plain_scene(x), *at) for x, *at in zip(ones, s, each, strict=True)]
        with tempfile.TemporaryDirectory() as folder:
            answers = {
                "cpp": in_cpp(program, reward, cases, Path(folder)),
                "numpy": [own_planner.numpy_answers(reward, *case) for case in cases],
            }
        clean = own_planner.in_valid_times
        for name, answer in answers.items():
            features = clean(scenes, np.stack([x for x, _ in answer]))
            apart = {
                column: own_planner.error(
                    features[..., f], clean(scenes, wanted)[..., f]
                )
                for f, column in enumerate(columns.names)
            }
            apart["score"] = own_planner.error(np.stack([v for _, v in answer]), values)
            larger(found[name], apart)
    return found


def larger(found: dict[str, float], more: dict[str, float]) -> None:
    """Keep the larger of both numbers of every name."""
    for name, value in more.items():
        found[name] = max(found.get(name, 0.0), value)


def main(_: list[str]) -> None:
    """Compare random scenes and all scenes of all datasets."""
    columns, program, result = own_planner.every_column(), reader(), {}
    with tempfile.TemporaryDirectory() as folder:
        reward = own_planner.drawn_reward(Path(folder) / "reward", columns)
        for path in [None, *_DATA.value]:
            worst: dict[str, dict[str, float]] = {"numpy": {}, "cpp": {}}
            count = 0
            for scenes, s, l in batches(path):
                found = differences(scenes, s, l, columns, reward, program)
                count += len(s)
                for name, apart in found.items():
                    larger(worst[name], apart)
            name = "random" if path is None else Path(path).name
            result[name] = {
                "scenes": count,
                "candidates_of_a_scene": 2 * WAYS,
                **(
                    {"data_hash": open_dataset(path, verify=False).hash} if path else {}
                ),
                **worst,
            }
            most = {name: max(apart.values()) for name, apart in worst.items()}
            print(f"{name}: {count} scenes, largest difference {most}")
    write("own_planner", result, _OUTPUT.value)


if __name__ == "__main__":
    app.run(main)
