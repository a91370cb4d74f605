"""The rewards of a run: prior costs, learners of rounds, all seeds, the candidate."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.export.from_run import export_run
from rcirl_jax.export.reader import PriorCost
from rcirl_jax.features import feature_map
from rcirl_jax.runtime.atomic_files import write_whole
from rcirl_jax.runtime.pipeline import digest, file_sha256
from rcirl_jax.train.loop import train
from rcirl_jax.train.metrics import pairs_won
from rcirl_jax.tune.prior_cost import (
    fitted_prior_cost,
    read_prior_cost,
    write_prior_cost,
)
from rcirl_jax.tune.run import Run


def fit_prior_cost(
    run: Run,
    sources: Sequence[Dataset],
    shares: Sequence[float],
    drives: Sequence[Dataset],
) -> Path | None:
    """The prior cost, fitted on recordings against rehearsed drives, if wanted."""
    config, path = run.config, _prior_cost_file(run, len(drives))
    if path is None:
        return None
    inputs = {
        "prior_cost": dataclasses.asdict(config.prior_cost),
        "recorded": [one.hash for one in sources],
        "shares": list(shares),
        "drives": [one.hash for one in drives],
        "features": config.train.features,
    }

    def work() -> None:
        features = feature_map(config.train.features)
        made = fitted_prior_cost(config.prior_cost, sources, shares, drives, features)
        write_prior_cost(path, made)

    run.stage(f"prior cost {len(drives)}", inputs, [path], work)
    return path


def train_round(
    run: Run, dataset: Demonstrations, number: int, file: Path, path: Path | None
) -> None:
    """The learner of a round; `path` is of its prior cost."""
    inputs = {**_inputs(run, dataset), "seed": 0}
    prior_cost = None
    if path:
        prior_cost, inputs = (
            read_prior_cost(path),
            {**inputs, "prior_cost": file_sha256(path)},
        )
    work = functools.partial(_train_one, run, dataset, 0, file, prior_cost)
    run.stage(f"rehearse learner {number}", inputs, [file], work)


def train_seeds(run: Run, dataset: Demonstrations) -> None:
    """Train every seed, export it, choose the median one."""
    inputs, files = _inputs(run, dataset), run.seed_files
    prior_cost = None
    if path := _prior_cost_file(run, run.config.rehearsal.datasets):
        prior_cost, inputs = (
            read_prior_cost(path),
            {**inputs, "prior_cost": file_sha256(path)},
        )
    for number, file in enumerate(files):
        named = {**inputs, "seed": number}
        work = functools.partial(_train_one, run, dataset, number, file, prior_cost)
        run.stage(f"train {number}", named, [file], work)
    hashes = [file_sha256(file) for file in files]
    choose = functools.partial(_choose, run, dataset)
    run.stage("export", {"seeds": hashes}, [run.weights], choose)


def workdir_of(run: Run, dataset: Demonstrations, seed: int) -> Path:
    """The folder of a training run."""
    key = digest(_inputs(run, dataset))[:8]
    return run.folder / f"train-{key}" / f"seed-{seed}"


def kept_workdir(run: Run, seed: int) -> Path:
    """The folder of a finished training run, from the notes of its stage."""
    noted = run.stages.read().get(f"train {seed}", {}).get("inputs", {})
    decided = ("config", "dataset", *run.code(__name__))
    key = digest({name: noted.get(name) for name in decided})[:8]
    return run.folder / f"train-{key}" / f"seed-{seed}"


def _prior_cost_file(run: Run, drives: int) -> Path | None:
    """Where the prior cost against so many sets of drives lies; None: there is none."""
    wanted = run.config.prior_cost.wanted
    return run.folder / "prior_costs" / f"{drives}.json" if wanted else None


def _inputs(run: Run, dataset: Demonstrations) -> dict:
    """What decides a training besides its seed and prior cost."""
    settings = dataclasses.asdict(run.config.train)
    return {"config": settings, "dataset": dataset.hash, **run.code(__name__)}


def _train_one(
    run: Run,
    dataset: Demonstrations,
    seed: int,
    file: Path,
    prior_cost: PriorCost | None,
) -> None:
    """One training run, exported."""
    config = dataclasses.replace(run.config.train, seed=seed)
    workdir = workdir_of(run, dataset, seed)
    train(
        dataset,
        workdir,
        config,
        running=run.running,
        provenance=dict(run.facts),
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    export_run(workdir, dataset, file, prior_cost=prior_cost)


def _choose(run: Run, dataset: Demonstrations) -> None:
    """The seed with the median share of training pairs won becomes candidate."""
    config = run.config.train
    steps = -(-dataset.indices("train").size // config.batch_size)

    def won(number: int) -> float:
        workdir = workdir_of(run, dataset, number)
        return pairs_won(workdir / "metrics.jsonl", steps)

    ranked = sorted(range(run.config.seeds), key=won)
    median = run.seed_files[ranked[(len(ranked) - 1) // 2]]
    write_whole(run.weights, median.read_bytes())
