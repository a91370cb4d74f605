"""The rewards of a run: anchors, the learners of rounds, all seeds, the candidate."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.export.from_run import export_run
from rcirl_jax.export.reader import Anchor
from rcirl_jax.features import feature_map
from rcirl_jax.runtime.atomic_files import write_whole
from rcirl_jax.runtime.pipeline import digest, file_sha256
from rcirl_jax.train.loop import train
from rcirl_jax.train.metrics import pairs_won
from rcirl_jax.tune.anchoring import fitted_anchor, read_anchor, write_anchor
from rcirl_jax.tune.run import Run


def fit_anchor(
    run: Run,
    sources: Sequence[Dataset],
    shares: Sequence[float],
    drives: Sequence[Dataset],
) -> Path | None:
    """The anchor, fitted on recordings against rehearsed drives; None: no anchor."""
    config, path = run.config, _anchor_file(run, len(drives))
    if path is None:
        return None
    inputs = {
        "anchor": dataclasses.asdict(config.anchor),
        "recorded": [one.hash for one in sources],
        "shares": list(shares),
        "drives": [one.hash for one in drives],
        "features": config.train.features,
    }

    def work() -> None:
        features = feature_map(config.train.features)
        made = fitted_anchor(config.anchor, sources, shares, drives, features)
        write_anchor(path, made)

    run.stage(f"anchor {len(drives)}", inputs, [path], work)
    return path


def train_round(
    run: Run, dataset: Demonstrations, number: int, file: Path, path: Path | None
) -> None:
    """The learner of a round; `path` is of its anchor."""
    inputs = {**_inputs(run, dataset), "seed": 0}
    anchor = None
    if path:
        anchor, inputs = read_anchor(path), {**inputs, "anchor": file_sha256(path)}
    work = functools.partial(_train_one, run, dataset, 0, file, anchor)
    run.stage(f"rehearse learner {number}", inputs, [file], work)


def train_seeds(run: Run, dataset: Demonstrations) -> None:
    """Train every seed, export it, choose the median one."""
    inputs, files = _inputs(run, dataset), run.seed_files
    anchor = None
    if path := _anchor_file(run, run.config.rehearsal.datasets):
        anchor, inputs = read_anchor(path), {**inputs, "anchor": file_sha256(path)}
    for number, file in enumerate(files):
        named = {**inputs, "seed": number}
        work = functools.partial(_train_one, run, dataset, number, file, anchor)
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


def _anchor_file(run: Run, drives: int) -> Path | None:
    """Where the anchor against so many sets of drives lies; None: there is none."""
    wanted = run.config.anchor.wanted
    return run.folder / "anchors" / f"{drives}.json" if wanted else None


def _inputs(run: Run, dataset: Demonstrations) -> dict:
    """What decides a training besides its seed and anchor."""
    settings = dataclasses.asdict(run.config.train)
    return {"config": settings, "dataset": dataset.hash, **run.code(__name__)}


def _train_one(
    run: Run, dataset: Demonstrations, seed: int, file: Path, anchor: Anchor | None
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
    export_run(workdir, dataset, file, anchor=anchor)


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
