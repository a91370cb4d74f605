"""Everything that an accelerator is asked, by one command that ends in time.

    make accelerator                                        # or, without make:
    python -m benchmarks.accelerator --output=DIR [--seconds=480]
    python -m benchmarks.accelerator --small --output=DIR   # rehearsal, on a CPU too

Parts, in this order; each starts only while there is time left, and the file is
written anew after each, so that what ends early keeps what was found:

    devices     card, driver, memory, versions
    equality    values, gradients, ranks and a smoke suite against this machine's CPU
    training    queries/s end to end and from cached features, by batch and by reward
    roofline    peaks of the card, and the share of them that training reaches
    suite       the closed-loop suite, rows of `benchmarks.suite`
    sweep       64 members side by side
    paper       718 million frames, 2.8 billion queries, 2 epochs: a slice, and all of
                it if it fits into the time left

Nothing is downloaded or built; scenes are synthetic traffic unless there is --data. A
part that fails is noted with its error, and the next begins.
"""

import contextlib
import dataclasses
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from benchmarks import roofline
from benchmarks.common import dataset_or_synthetic, machine, timed, untrained, write
from rcirl_jax.data.store.dataset import Dataset, open_dataset
from rcirl_jax.evaluation.ranking.learners import normaliser_of
from rcirl_jax.planner.rank import RankConfig
from rcirl_jax.reward import RewardModel, value
from rcirl_jax.simulation.metrics import CaseMetrics, MetricsConfig, case_metrics
from rcirl_jax.simulation.rollout import drive_cases
from rcirl_jax.simulation.rows import baseline_row
from rcirl_jax.simulation.suite import build, rollout_config, suite_refs
from rcirl_jax.train.featurise import featurised, host_batch
from rcirl_jax.train.parallel import Parallel, parallelise
from rcirl_jax.train.state import TrainConfig, TrainState
from rcirl_jax.train.step import gradient_sums, init_state, make_train_step
from rcirl_jax.train.sweep import fit, freeze, members_of
from rcirl_jax.tuning.recipes import load_recipe

_DATA = flags.DEFINE_string("data", None, "dataset (default: synthetic traffic)")
_SECONDS = flags.DEFINE_float("seconds", 480.0, "s for everything")
_SMALL = flags.DEFINE_bool("small", False, "a rehearsal: few scenes, batches, cases")
_OUTPUT = flags.DEFINE_string("output", None, "folder of the JSON; default: $OUT")

SMOKE_S = 10.0  # s of a compared drive
METRES = 100.0  # m driven in it, about
AGREE = 2e-4  # most that values and gradients may differ from the CPU's, of their size
SHARE = 0.5  # of the time left that the full run of the paper's amount may take


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of the parts."""

    scenes: int  # compared with the CPU
    drives: int  # likewise
    batches: tuple[int, ...]  # scenes of a training step
    steps: int  # timed of each
    members: int  # of the sweep
    fitted: int  # scenes that the sweep trains on
    slice_s: float  # s of the paper's slice
    suite: tuple[str, ...]  # flags of benchmarks.suite


WHOLE = Sizes(
    1000, 23, (64, 256, 1024, 4096), 20, 64, 2048, 30.0, ("--full", "--rounds=1")
)
SMALL = Sizes(
    *(16, 2, (8,), 2, 4, 32, 1.0),
    ("--duration=1", "--single=1", "--rounds=1"),
)


def card() -> dict:
    """Returns what the driver says of the card; empty without one."""
    fields = "name,driver_version,memory.total,clocks.max.sm,power.limit"
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        command = ["nvidia-smi", f"--query-gpu={fields}", "--format=csv,noheader"]
        said = subprocess.run(command, capture_output=True, text=True, check=True)
        rows = [line.split(", ") for line in said.stdout.splitlines()]
        return {
            "cards": [dict(zip(fields.split(","), row, strict=True)) for row in rows]
        }
    return {}


def devices(_: Dataset, sizes: Sizes) -> dict:
    """Returns the devices that JAX sees."""
    return {
        **machine(),
        **card(),
        "backend": jax.default_backend(),
        "jax_devices": [str(device) for device in jax.devices()],
        "memory": jax.devices()[0].memory_stats() or {},
    }


def _scenes(dataset: Dataset, count: int) -> tuple:
    index = np.resize(dataset.indices("train"), count)
    return dataset.read(index), index


def _on(device: Any, dataset: Dataset, count: int) -> dict[str, np.ndarray]:  # noqa: ANN401
    """Values, gradient and ranks of the recipe's reward, computed on a device."""
    config = load_recipe("tuned").train
    with jax.default_device(device):
        rows, index = _scenes(dataset, count)
        frozen = freeze(rows, index, config)
        state = init_state(config, normaliser_of(frozen, config))
        batch = jax.device_put(frozen, device)
        sums = jax.jit(
            lambda s, b: gradient_sums(s.apply_fn, s.params, s.normaliser, b, config)
        )
        of = (state.params, state.normaliser, batch.points, batch.points_valid)
        values = np.asarray(value(RewardModel(config.reward), *of))
        gradient, _ = sums(state, batch)
        flat = np.concatenate([np.ravel(x) for x in jax.tree.leaves(gradient)])
    kept = np.where(np.asarray(frozen.feasible), values, -np.inf)
    return {"values": values, "gradient": flat, "first": np.argmax(kept, axis=1)}


def _driven(device: Any, cases: int) -> CaseMetrics:  # noqa: ANN401
    """The hand-set cost through one smoke case of each of some families, 10 s each."""
    refs = suite_refs("smoke")
    refs = refs[:: max(1, len(refs) // cases)][:cases]
    with jax.default_device(device):
        row = baseline_row("hand-set", "paper21", untrained(), RankConfig())
        measure = functools.partial(case_metrics, config=MetricsConfig())
        config = rollout_config(row, SMOKE_S, plan_every=1)
        world = build(refs, SMOKE_S)
        return jax.device_get(
            drive_cases(row.policy, row.params, world, config=config, reduce=measure)
        )


def equality(dataset: Dataset, sizes: Sizes) -> dict:
    """The default device against the CPU of the same machine."""
    own, cpu = jax.devices()[0], jax.devices("cpu")[0]
    here, there = (_on(d, dataset, sizes.scenes) for d in (own, cpu))
    found = {}
    for name in ("values", "gradient"):
        apart = np.abs(here[name] - there[name])
        found[name] = float(apart.max() / np.abs(there[name]).max())
    same = float(np.mean(here["first"] == there["first"]))
    drives = [_driven(device, sizes.drives) for device in (own, cpu)]
    progress = [np.asarray(drive.progress) for drive in drives]
    found["progress"] = float(np.abs(progress[0] - progress[1]).max() / METRES)
    return {
        "scenes": sizes.scenes,
        "relative_difference": found,
        "same_first_choice": same,
        "drives": sizes.drives,
        "agrees": max(found.values()) <= AGREE and same >= 0.999,
    }


def _rate(work: Callable[[], object], units: float, steps: int) -> dict:
    """Units per second of calls that are each waited for; medians."""
    median = float(np.median(timed(work, steps, warm_up=1)))
    return {"per_s": round(units / median), "ms": round(1e3 * median, 3)}


def _stepping(
    parallel: Parallel, state: TrainState, batch: object
) -> Callable[[], object]:
    """One training step at every call, always on the same batch."""
    held, placed = [parallel.replicate(state)], parallel.place(batch)

    def step() -> object:
        held[0], metrics = parallel.step(held[0], placed)
        return metrics.loss_sum

    return step


def training(dataset: Dataset, sizes: Sizes) -> dict:
    """Queries/s by reward and batch, end to end and from cached features."""
    rewards = {"21-15-1, rank": TrainConfig(), "tuned": load_recipe("tuned").train}
    found: dict[str, dict] = {name: {} for name in rewards}
    how = "shard_map" if jax.device_count() > 1 else "jit"
    for name, base in rewards.items():
        for size in sizes.batches:
            config = dataclasses.replace(base, batch_size=size)
            rows, index = _scenes(dataset, size)
            raw = host_batch(rows, np.ones(size), index)
            cached = featurised(jax.random.key(0), jax.device_put(raw), config)
            state = init_state(config, normaliser_of(cached, config))
            parallel = parallelise(make_train_step(config), how, size)
            pairs = float(jnp.sum(cached.feasible))
            turn = {}
            for form, batch in (("end_to_end", raw), ("cached", cached)):
                step = _stepping(parallel, state, jax.tree.map(np.asarray, batch))
                turn[form] = _rate(step, pairs, sizes.steps)
            found[name][str(size)] = turn
    return {"how": how, "queries": found}


def peaks(dataset: Dataset, sizes: Sizes) -> dict:
    """Peaks of the device, and the operations of a trajectory of 21-15-1."""
    point = roofline.network_flops(21, 15)
    return {"peaks": roofline.peaks(), "network_flops_of_a_point": point}


def sweep(dataset: Dataset, sizes: Sizes) -> dict:
    """Members of one shape in one program."""
    config = dataclasses.replace(TrainConfig(), epochs=2)
    rows, index = _scenes(dataset, sizes.fitted)
    frozen = freeze(rows, index, config)
    normaliser = normaliser_of(frozen, config)
    members = members_of(
        [dataclasses.replace(config, seed=seed) for seed in range(sizes.members)]
    )
    taken = []
    for _ in range(2):  # the first compiles
        begin = time.perf_counter()
        jax.block_until_ready(fit(frozen, normaliser, config, members))
        taken.append(time.perf_counter() - begin)
    queries = sizes.members * config.epochs * float(jnp.sum(frozen.feasible))
    return {
        "members": sizes.members,
        "scenes": sizes.fitted,
        "seconds": round(taken[1], 3),
        "seconds_with_compiling": round(taken[0], 3),
        "queries_per_s": round(queries / taken[1]),
    }


def _command(module: str, *more: str) -> dict:
    """Another benchmark in a process of its own; its result, read from its file."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", f"benchmarks.{module}", *more]
        subprocess.run([*command, f"--output={folder}"], check=True)
        made = json.loads((Path(folder) / f"{module}.json").read_text())
    return {name: x for name, x in made.items() if name not in {"made_by", "machine"}}


def suite(_: Dataset, sizes: Sizes) -> dict:
    """`benchmarks.suite`; it shares the device with this process."""
    return _command("suite", *sizes.suite)


def paper(_: Dataset, sizes: Sizes, left_s: float = 0.0) -> dict:
    """A slice of the paper's amount of training; all of it where that fits."""
    data = [f"--data={_DATA.value}"] if _DATA.value else []
    found = {"slice": _command("paper_scale", f"--seconds={sizes.slice_s}", *data)}
    whole = found["slice"].get("extrapolated_seconds_of_the_full_run", 0.0)
    if jax.default_backend() != "cpu" and whole < SHARE * left_s:
        found["full"] = _command("paper_scale", "--full", *data)
    return found


PARTS: dict[str, Callable[..., dict]] = {
    "devices": devices,
    "equality": equality,
    "training": training,
    "roofline": peaks,
    "suite": suite,
    "sweep": sweep,
    "paper": paper,
}


def run_parts(
    dataset: Dataset, sizes: Sizes, ends: float
) -> Iterator[tuple[str, dict]]:
    """(name, result) of each part that there was time for, as it is found."""
    for name, part in PARTS.items():
        left = ends - time.monotonic()
        if left <= 0.0:
            yield name, {"left_out": "no time left"}
            continue
        begin = time.monotonic()
        more = {"left_s": left} if part is paper else {}
        try:
            found = part(dataset, sizes, **more)
        except Exception as error:  # the next part may still tell something
            traceback.print_exc()
            found = {"error": f"{type(error).__name__}: {error}"[:500]}
        yield name, {**found, "part_s": round(time.monotonic() - begin, 1)}


def main(_: list[str]) -> None:
    """All parts; status 1 where one failed or the devices disagree."""
    ends = time.monotonic() + _SECONDS.value
    # several processes share the device one after the other
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    output = _OUTPUT.value or os.environ.get("OUT") or "benchmarks/results"
    result: dict = {"small": _SMALL.value}
    with dataset_or_synthetic(_DATA.value) as path:
        sizes = SMALL if _SMALL.value else WHOLE
        for name, found in run_parts(open_dataset(path), sizes, ends):
            result[name] = found
            print(f"{name}: {found}", flush=True)
            write("accelerator", result, output, data=_DATA.value)
    failed = [name for name in PARTS if "error" in result[name]]
    if failed or not result["equality"].get("agrees", True):
        raise SystemExit(f"error: accelerator: {failed or 'devices disagree'}")


if __name__ == "__main__":
    app.run(main)
