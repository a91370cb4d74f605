"""A sweep of 64 members against 64 single runs in turn.

    python -m benchmarks.sweep

Members are leaky rates x seeds of the paper's network on the same candidates, made
once. Per round, in turn: all members in the chunks of a sweep; a few single runs by
`fit` with one member, already compiled; and a few steps as `rcirl train` takes
them, which make candidates and features anew in every step. Single runs are scaled
to 64; compiling is reported apart. Medians over the rounds.

Then as commands, as a user has them: `rcirl sweep`, which also chooses by
held-out scenes and exports every member, and a few runs of `rcirl train`, each of
which starts, compiles and trains. Run in turn, scaled to 64.
"""

import dataclasses
import itertools
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from absl import app, flags

from benchmarks.common import dataset_or_synthetic, in_turn, write
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.evaluation.ranking.learners import normaliser_of
from rcirl_jax.export.sweep import MEMBERS_AT_ONCE
from rcirl_jax.reward import RewardConfig
from rcirl_jax.runtime.compiling import compiles
from rcirl_jax.train.featurise import host_batch
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.train.step import init_state, make_train_step
from rcirl_jax.train.sweep import Members, fit, freeze, members_of
from tests.helpers.scenes import demonstration

LEAKY_RATES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)

_MEMBERS = flags.DEFINE_integer("members", 64, "members, a multiple of 8")
_SCENES = flags.DEFINE_integer("scenes", 256, "training scenes")
_EPOCHS = flags.DEFINE_integer("epochs", 1, "passes over them")
_HIDDEN = flags.DEFINE_list("hidden_size", ["15"], "units per layer")
_SINGLE = flags.DEFINE_integer("single", 4, "single runs per round")
_STEPS = flags.DEFINE_integer("steps", 2, "training steps per round")
_ROUNDS = flags.DEFINE_integer("rounds", 5, "rounds")
_COMMANDS = flags.DEFINE_integer("commands", 2, "rounds of the commands; 0: none")
_DATA = flags.DEFINE_string("data", None, "dataset of the commands (default: made)")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")


def _grid(config: TrainConfig) -> list[Members]:
    """The members in chunks as a sweep trains them."""
    seeds = range(_MEMBERS.value // len(LEAKY_RATES))
    grid = itertools.product(LEAKY_RATES, seeds)
    every = members_of(
        [dataclasses.replace(config, leaky_rate=rate, seed=seed) for rate, seed in grid]
    )
    starts = range(0, _MEMBERS.value, MEMBERS_AT_ONCE)
    size = MEMBERS_AT_ONCE
    return [jax.tree.map(lambda x, at=at: x[at : at + size], every) for at in starts]


def _command(name: str, data: str, folder: Path, *flags_: str) -> float:
    """Seconds of one command."""
    words = [sys.executable, "-m", "rcirl_jax", name, f"--data={data}", *flags_]
    words += ["--recipe=paper", "--positive=nearest", "--train_horizon=5"]
    words += ["--futures=predicted", f"--epochs={_EPOCHS.value}"]
    begin = time.perf_counter()
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"error: {name}: {done.stderr[-300:]}")
    shutil.rmtree(folder)
    return time.perf_counter() - begin


def _commands() -> dict:
    """One command for all members, and one for each, in turn."""
    taken: dict[str, list[float]] = {"sweep": [], "train": []}
    rates = ",".join(map(str, LEAKY_RATES))
    seeds = _MEMBERS.value // len(LEAKY_RATES)
    with (
        dataset_or_synthetic(_DATA.value) as data,
        tempfile.TemporaryDirectory() as name,
    ):
        for number in range(_COMMANDS.value):
            folder = Path(name) / "sweep"
            grid = (f"--leaky_rates={rates}", f"--seeds={seeds}", f"--output={folder}")
            taken["sweep"].append(_command("sweep", data, folder, *grid))
            folder = Path(name) / "train"
            one = (f"--seed={number}", f"--output={folder}")
            taken["train"].append(_command("train", data, folder, *one))
        scenes = int(open_dataset(data).indices("train").size)
    sweep, alone = (float(np.median(taken[name])) for name in ("sweep", "train"))
    return {
        "scenes": scenes,
        "seconds": {n: [round(x, 2) for x in found] for n, found in taken.items()},
        "seconds_of_all_members": {
            "sweep": round(sweep, 2),
            "train": round(alone * _MEMBERS.value, 2),
        },
        "ratio": round(alone * _MEMBERS.value / sweep, 1),
    }


def main(_: list[str]) -> None:
    """Alternate the three ways."""
    hidden = tuple(int(units) for units in _HIDDEN.value)
    config = TrainConfig(
        positive="nearest",
        train_horizon=5.0,
        epochs=_EPOCHS.value,
        reward=RewardConfig(hidden=hidden),
    )
    made = [demonstration(seed % 64) for seed in range(_SCENES.value)]
    rows = jax.tree.map(lambda *x: np.stack(x), *made)
    index = np.arange(_SCENES.value)
    frozen = freeze(rows, index, config)
    normaliser, chunks = normaliser_of(frozen, config), _grid(config)
    single = dataclasses.replace(config, seed=0)
    state, step = init_state(config, normaliser), jax.jit(make_train_step(config))
    batch = host_batch(
        jax.tree.map(lambda x: x[: config.batch_size], rows),
        np.ones(config.batch_size),
        index[: config.batch_size],
    )

    def sweep() -> list:
        return [fit(frozen, normaliser, config, members) for members in chunks]

    def alone() -> list:
        seeds = range(_SINGLE.value)
        runs = [members_of([dataclasses.replace(single, seed=seed)]) for seed in seeds]
        return [fit(frozen, normaliser, single, run) for run in runs]

    def steps() -> list:
        return [step(state, batch)[1] for _ in range(_STEPS.value)]

    ways, compiled = {"sweep": sweep, "single": alone, "train": steps}, {}
    for name, way in ways.items():
        with compiles() as found:
            jax.block_until_ready(way())
        compiled[name] = found
    taken = in_turn(ways, _ROUNDS.value)
    each_run = -(-_SCENES.value // config.batch_size) * _EPOCHS.value
    times = {
        "sweep": 1.0,
        "single": _MEMBERS.value / _SINGLE.value,
        "train": _MEMBERS.value * each_run / _STEPS.value,
    }
    median = {name: float(np.median(x)) * times[name] for name, x in taken.items()}
    result = {
        "members": _MEMBERS.value,
        "hidden": hidden,
        "scenes": _SCENES.value,
        "candidates": int(frozen.feasible.shape[1]),
        "epochs": _EPOCHS.value,
        "members_at_once": MEMBERS_AT_ONCE,
        "seconds_of_all_members": {n: round(x, 4) for n, x in median.items()},
        "rounds": {n: [round(x, 4) for x in found] for n, found in taken.items()},
        "compiles": {name: len(found) for name, found in compiled.items()},
        "compile_seconds": {n: round(sum(found), 3) for n, found in compiled.items()},
        "single_to_sweep": round(median["single"] / median["sweep"], 2),
        "train_to_sweep": round(median["train"] / median["sweep"], 2),
    }
    if _COMMANDS.value:
        result["commands"] = _commands()
    for name, found in result.items():
        print(f"{name}: {found}")
    write("sweep", result, _OUTPUT.value, data=_DATA.value)


if __name__ == "__main__":
    app.run(main)
