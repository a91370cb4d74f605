"""Queries per second of a training step, ours beside PyTorch's.

    python -m benchmarks.training [--data=DATASET]

From cached features: `make_train_step` with its defaults (21-15-1, rank loss, pin,
Adam) and the same step in PyTorch, eager and compiled, in two forms each (see
`benchmarks.torch_step`); it must first agree with ours within 1e-4. Then ours end to
end, where candidates and features are made in the step, and candidates with features
alone, and the step of the recipe `tuned` in both forms. Ways take turns in rounds. All
of it on one core, then on all, each in a process of its own; all cores can be compared
on a quiet machine only. Goals: 5 times eager, 2.5 times compiled; on two cores 500,000
queries/s end to end (400,000 for the recipe), 1,000,000 candidates/s.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from benchmarks import roofline
from benchmarks.common import dataset_or_synthetic, write
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.evaluation.ranking.learners import normaliser_of
from rcirl_jax.features import feature_map
from rcirl_jax.runtime.compiling import wide_vectors
from rcirl_jax.train.featurise import candidates_of, host_batch
from rcirl_jax.train.parallel import parallelise
from rcirl_jax.train.state import Batch, FeatureBatch, TrainConfig, TrainState
from rcirl_jax.train.step import gradient_sums, init_state, make_train_step
from rcirl_jax.train.sweep import freeze
from rcirl_jax.tuning.recipes import load_recipe
from rcirl_jax.types import Demonstration

try:  # the baseline's extra; without it, one line from `main`
    import torch

    from benchmarks import torch_step
except ModuleNotFoundError:
    torch = None

QUIET = 1.0  # load average up to which rows on all cores can be compared
AGREE = 1e-4  # most that a step of theirs may differ from ours
CONFIG = TrainConfig()
RECIPE = load_recipe("tuned").train  # what drives; its rows begin with "recipe_"

_DATA = flags.DEFINE_string("data", None, "dataset (default: synthetic traffic)")
_SCENES = flags.DEFINE_integer("scenes", 512, "scenes, a multiple of 64; few repeat")
_ROUNDS = flags.DEFINE_integer("rounds", 11, "rounds")
_CORES = flags.DEFINE_integer("cores", None, "only on so many cores")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")


class Way(NamedTuple):
    """One way of working off batches."""

    step: Callable[[], object]  # one batch, the next at every call
    units: float  # queries or candidates of a batch, on average


class Data(NamedTuple):
    """The scenes in batches, as demonstrations and with features made (numpy)."""

    raw: list[Batch]
    cached: list[FeatureBatch]
    state: TrainState
    pairs: float  # feasible pairs (queries) of a batch, on average


def _scenes(path: str) -> tuple[Demonstration, np.ndarray]:
    dataset = open_dataset(path)
    index = np.resize(dataset.indices("train"), _SCENES.value)
    return dataset.read(index), index


def _data(rows: Demonstration, index: np.ndarray, config: TrainConfig) -> Data:
    size = config.batch_size
    frozen = freeze(rows, index, config)
    state = init_state(config, normaliser_of(frozen, config))

    def cut(tree: object) -> list:
        starts = range(0, index.size, size)
        part = lambda at: jax.tree.map(lambda x: np.asarray(x[at : at + size]), tree)  # noqa: E731
        return [part(at) for at in starts]

    raw = cut(host_batch(rows, np.ones(index.size), index))
    pairs = float(jnp.sum(frozen.feasible)) / len(raw)
    return Data(raw, cut(frozen), state, pairs)


def _ours(
    batches: list,
    state: TrainState,
    how: str,
    units: float,
    config: TrainConfig = CONFIG,
) -> Way:
    parallel = parallelise(make_train_step(config), how, config.batch_size)
    turn = cycle([parallel.place(batch) for batch in batches])
    held = [parallel.replicate(state)]

    def step() -> object:
        held[0], metrics = parallel.step(held[0], next(turn))
        return metrics.loss_sum

    return Way(step, units)


def _features(key: jax.Array, batch: Batch) -> tuple[jax.Array, jax.Array]:
    """Candidates and F of a batch, without the human: [B, F, T, K], feasible [B, K]."""
    rows = feature_map(CONFIG.features).rows

    def one(index: jax.Array, demonstration: Demonstration) -> tuple:
        made = candidates_of(jax.random.fold_in(key, index), demonstration, CONFIG)
        return jnp.stack(rows(demonstration.scene, made)), made.feasible

    return jax.vmap(one)(batch.index, batch.demonstrations)


def _candidates(batches: list[Batch], how: str, units: float) -> Way:
    place = parallelise(_features, how, CONFIG.batch_size).place
    turn = cycle([place(batch) for batch in batches])
    keys = cycle(jax.random.split(jax.random.key(1), 64))
    make = jax.jit(_features, compiler_options=wide_vectors())
    return Way(lambda: make(next(keys), next(turn)), units)


def _theirs(data: Data, form: str, compiled: bool, config: TrainConfig) -> Way:
    """PyTorch's step, after its first one has been compared with ours."""
    inputs = [torch_step.inputs_of(batch, form) for batch in data.cached]
    weights = torch_step.parameters_of(data.state.params)
    loss = torch_step.loss_of(form, data.state.normaliser, config)
    loss = torch_step.compiled(loss) if compiled else loss
    step = torch_step.make_step(loss, weights, config.learning_rate)
    step(inputs[0])
    apart = _apart(data, weights, config)
    print(f"torch, {config.loss}, {form}, compiled {compiled}: differs by {apart:.1e}")
    if not apart <= AGREE:
        raise SystemExit(f"error: torch {form}: {apart:.1e}: expected <= {AGREE}")
    turn = cycle(inputs)
    return Way(lambda: step(next(turn)), data.pairs)


def _apart(data: Data, weights: "torch_step.Weights", config: TrainConfig) -> float:
    """Largest difference of the first step: of the gradient, and of parameters.

    The gradient's is relative to its largest entry; Adam's first step alone shows
    signs. Where an entry is within round-off of 0 the sign is that of round-off, so
    parameters are compared elsewhere.
    """
    state, batch = data.state, jax.device_put(data.cached[0])
    sums_of = jax.jit(
        lambda s, b: gradient_sums(s.apply_fn, s.params, s.normaliser, b, config)
    )
    grads, sums = sums_of(state, batch)
    after = jax.jit(make_train_step(config))(state, batch)[0].params
    flat = lambda leaves: np.concatenate([np.ravel(x) for x in leaves])  # noqa: E731
    grad = flat(torch_step.leaves_of(grads)) / float(sums.terms)
    ours = flat(torch_step.leaves_of(after))
    made = [leaf.grad for leaf in weights.leaves if leaf.grad is not None]
    their_grad = flat([g.numpy() for g in made])
    theirs = flat([leaf.detach().numpy() for leaf in weights.leaves])
    largest = np.max(np.abs(grad))
    clear = np.abs(grad) > AGREE * largest
    relative = np.max(np.abs(their_grad - grad)) / largest
    return float(max(relative, np.max(np.abs(theirs - ours)[clear])))


def _ways(data: Data, recipe: Data, cores: int) -> dict[str, Way]:
    made = CONFIG.batch_size * data.cached[0].feasible.shape[1]
    ways = {
        f"{ours}torch_{name}/{form}": _theirs(scenes, form, name == "compile", config)
        for ours, scenes, config in (("", data, CONFIG), ("recipe_", recipe, RECIPE))
        for name in ("eager", "compile")
        for form in torch_step.FORMS
    }
    for how in ("jit", "shard_map")[: min(cores, 2)]:
        ways[f"ours/{how}"] = _ours(data.cached, data.state, how, data.pairs)
        ways[f"end_to_end/{how}"] = _ours(data.raw, data.state, how, data.pairs)
        ways[f"candidates/{how}"] = _candidates(data.raw, how, made)
        for form, batches in (("cached", recipe.cached), ("end_to_end", recipe.raw)):
            ways[f"recipe_{form}/{how}"] = _ours(
                batches, recipe.state, how, recipe.pairs, RECIPE
            )
    return ways


def _timed(ways: dict[str, Way], steps: int) -> dict[str, dict]:
    """Medians over rounds in turn: wall and CPU milliseconds of a step."""
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    for number in range(_ROUNDS.value + 1):
        for name, way in ways.items():
            jax.block_until_ready(way.step())
            wall, cpu = time.perf_counter(), time.process_time()
            for _ in range(steps):  # one at a time, as in the training loop
                jax.block_until_ready(way.step())
            used = (time.perf_counter() - wall, time.process_time() - cpu)
            if number > 0:
                taken[name].append((1e3 * used[0] / steps, 1e3 * used[1] / steps))
    return {name: _row(np.array(taken[name]), way.units) for name, way in ways.items()}


def _row(taken: np.ndarray, units: float) -> dict[str, float]:
    """Of [rounds, (wall, cpu)] ms."""
    (wall, cpu), least = np.median(taken, axis=0), np.min(taken, axis=0)
    return {
        "per_s": round(1e3 * units / wall),
        "per_s_best": round(1e3 * units / least[0]),
        "wall_ms": round(float(wall), 3),
        "wall_ms_best": round(float(least[0]), 3),
        "cpu_ms": round(float(cpu), 3),
        "cpu_ms_best": round(float(least[1]), 3),
    }


def _ratios(rows: dict[str, dict]) -> dict[str, dict]:
    """Time of each PyTorch row over that of our faster one of the same network."""
    measures = [name for name in next(iter(rows.values())) if "_ms" in name]
    ratios = {}
    for baseline, own in (("torch", "ours"), ("recipe_torch", "recipe_cached")):
        ours = [row for name, row in rows.items() if name.startswith(own)]
        best = min(ours, key=lambda row: row["wall_ms"])
        for name, row in rows.items():
            if name.startswith(baseline):
                ratios[name] = {m: round(row[m] / best[m], 2) for m in measures}
    return ratios


def _here(path: str, cores: int) -> dict:
    """Everything on so many cores, in this process."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    jax.config.update("jax_num_cpu_devices", cores)  # before the first use of jax
    if (backend := jax.default_backend()) != "cpu":
        raise SystemExit(
            f"error: jax: {backend}: PyTorch's rows run on the CPU: expected "
            "JAX_PLATFORMS=cpu"
        )
    torch.set_num_threads(cores)
    scenes = _scenes(path)
    data, recipe = (_data(*scenes, config) for config in (CONFIG, RECIPE))
    rows = _timed(_ways(data, recipe, cores), len(data.raw))
    ratios = _ratios(rows)
    for name, row in rows.items():
        print(f"{cores} cores: {name}: {row}; to ours: {ratios.get(name, {})}")
    return {
        "cores": cores,
        "pairs_of_a_batch": round(data.pairs, 1),
        "candidates": int(data.cached[0].feasible.shape[1]),
        "rows": rows,
        "ratios": ratios,
        "roofline": _roofline(data, rows),
        "load_average_after": round(os.getloadavg()[0], 2),
    }


def _roofline(data: Data, rows: dict[str, dict]) -> dict:
    """Operations and least bytes of a trajectory, and the share of peaks reached.

    Bytes: features are written once and read once; all else is small.
    """
    peak = roofline.peaks()
    scenes, features, times, count = data.cached[0].candidates.shape
    point = roofline.network_flops(features, CONFIG.reward.hidden[0])
    raw = jax.tree.map(lambda x: x[:1], data.raw[0])
    made = roofline.operations(_features, jax.random.key(0), raw)
    first = jax.tree.map(lambda x: x[0], raw.demonstrations)
    sampled = roofline.operations(
        lambda key, one: candidates_of(key, one, CONFIG), jax.random.key(0), first
    )
    flops = {
        "network": float((point["forward"] + point["backward"]) * times),
        "sampler": sampled["flops"] / count,
        "features": (made["flops"] - sampled["flops"]) / count,
    }
    tanh = {
        "network": float(point["tanh"] * times),
        "sampler": sampled["transcendentals"] / count,
        "features": (made["transcendentals"] - sampled["transcendentals"]) / count,
    }
    one_way = 4.0 * features * times
    parts = {
        "ours": (("network",), one_way),
        "end_to_end": (("network", "sampler", "features"), 2.0 * one_way),
        "candidates": (("sampler", "features"), one_way),
    }
    reached = {}
    for name, row in rows.items():
        if name.startswith("recipe"):  # of another network
            continue
        used, moved = parts.get(name.split("/")[0], parts["ours"])
        per_s = scenes * count / (1e-3 * row["wall_ms_best"])
        gflops = 1e-9 * per_s * sum(flops[part] for part in used)
        reached[name] = {
            "gflop_per_s": round(gflops, 1),
            "of_peak": round(gflops / peak["gflop_per_s"], 3),
            "gb_per_s": round(1e-9 * per_s * moved, 2),
            "of_bandwidth": round(1e-9 * per_s * moved / peak["gb_per_s"], 3),
        }
    return {
        "peaks": peak,
        "flops_of_a_trajectory": {n: round(x) for n, x in flops.items()},
        "transcendentals_of_a_trajectory": {n: round(x, 1) for n, x in tanh.items()},
        "network_flops_of_a_point": point,
        "feature_bytes_of_a_trajectory": one_way,
        "reached": reached,
    }


def _child(path: str, cores: int) -> dict:
    """Everything on so many cores, in a process that has no more."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "benchmarks.training", f"--data={path}"]
        given = {"cores": cores, "scenes": _SCENES.value, "rounds": _ROUNDS.value}
        command += [f"--{name}={value}" for name, value in given.items()]
        if subprocess.run([*command, f"--output={folder}"]).returncode:
            raise SystemExit(f"error: --cores={cores}: the benchmark failed")
        found = json.loads((Path(folder) / "training.json").read_text())
    return found[f"cores_{cores}"]


def _both(path: str) -> dict:
    """On one core and on all; no comparison on all cores of a busy machine.

    PyTorch's threads wait for each other several times in a step. Where one of them
    loses its core to another program, a step takes ten times as long.
    """
    every, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    found = {f"cores_{n}": _child(path, n) for n in sorted({1, every})}
    if load > QUIET and every > 1:
        found[f"cores_{every}"]["ratios"] = {}
        print(
            f"warning: load average before {load:.1f}: expected <= {QUIET}: "
            f"ratios on {every} cores are left out",
            file=sys.stderr,
        )
    return {"load_average_before": round(load, 2), **found}


def main(_: list[str]) -> None:
    """One core and all of them, or what --cores says."""
    if torch is None:
        raise SystemExit("error: torch: not installed: expected the extra [bench]")
    size = CONFIG.batch_size
    if _SCENES.value < size or _SCENES.value % size:
        raise SystemExit(
            f"error: --scenes: {_SCENES.value}: expected a multiple of {size}"
        )
    with dataset_or_synthetic(_DATA.value) as path:
        number = _CORES.value
        result = {f"cores_{number}": _here(path, number)} if number else _both(path)
    result = {**result, "torch": torch.__version__, "scenes": _SCENES.value}
    write("training", result, _OUTPUT.value, data=_DATA.value)


if __name__ == "__main__":
    app.run(main)
