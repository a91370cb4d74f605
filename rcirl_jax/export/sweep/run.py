"""A sweep in its folder: trained once, resumed, chosen, written."""

import collections
import dataclasses
import datetime
import functools
import json
import resource
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tqdm

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.evaluation.ranking.evaluate import covered_rows
from rcirl_jax.evaluation.ranking.sweep import (
    Hidden,
    Part,
    Point,
    SweepConfig,
    member_name,
    open_split,
    shape_name,
    train_group,
)
from rcirl_jax.evaluation.statistics import ClusterBootstrap
from rcirl_jax.export.from_run import verification_samples, write_weights
from rcirl_jax.export.sweep.choice import Found, choice, scores_of, validated
from rcirl_jax.export.sweep.folder import (
    SWEEP,
    check_settings,
    grid_of,
    settings_of,
    weights_file,
)
from rcirl_jax.export.sweep.search import searched
from rcirl_jax.runtime.atomic_files import read_json, write_json, write_whole
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.runtime.pipeline import Stages, code_sha256, only_one


def run_sweep(
    config: SweepConfig,
    folder: Path,
    executor: Executor,
    provenance: Mapping[str, object],
) -> dict:
    """Train what is not there yet, choose, score the chosen, write everything.

    Args:
      config: the sweep.
      folder: its folder; a finished group in it is not trained again.
      executor: where groups train and scenes are scored.
      provenance: what makes it; kept in every file.

    Returns:
      The contents of sweep.json.

    Raises:
      InputError: the folder belongs to other settings or data, or is in use; bad
        data; no configuration that trains.
    """
    opened = open_split(config)
    with only_one(folder):
        return _sweep(config, folder, executor, provenance, opened)


def _sweep(
    config: SweepConfig,
    folder: Path,
    executor: Executor,
    provenance: Mapping[str, object],
    opened: tuple[Demonstrations, Demonstrations, str],
) -> dict:
    """`run_sweep` in a folder that is this sweep's alone."""
    dataset, split, by = opened
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    made_by = {**provenance, "dataset_sha256": dataset.hash, "created": now}
    for name in ("validation", "test"):  # what would fail only after the training
        held_out, _ = covered_rows(split, name, config.setup.horizon_s)
        ClusterBootstrap(np.asarray(held_out.vehicle))
    judge = functools.partial(scores_of, config, folder, split, executor)

    def trained(points: tuple[Point, ...] = (), number: int = 0) -> Found:
        part = dataclasses.replace(config, points=points)
        groups = _train(part, folder, split, executor, made_by, number)
        return validated(part, groups, judge)

    found = searched(config, trained) if config.trials else trained()
    body = {
        "settings": settings_of(config),
        "search": "optuna" if config.trials else "grid",
        "validation_by": by,
        "scenes": {n: split.indices(n).size for n in ("train", "validation", "test")},
        **choice(config, found, judge),
        "peak_memory_gib": _peak_memory_gib(),
        "made_by": made_by,
    }
    chosen = folder / "weights" / f"{body['chosen']['member']}.msgpack"
    write_whole(folder / "best.msgpack", chosen.read_bytes())
    write_json(folder / SWEEP, body)
    return body


def _train(
    config: SweepConfig,
    folder: Path,
    split: Demonstrations,
    executor: Executor,
    made_by: Mapping[str, object],
    number: int,
) -> dict[str, dict]:
    """The groups' files by name, after training those that are missing.

    Groups of a search's round bear its number, from 1.
    """
    stages, settings = Stages(folder=folder), settings_of(config)
    settings["dataset_sha256"] = made_by["dataset_sha256"]
    check_settings(stages, settings)
    inputs = {**settings, "points": config.points, "code": code_sha256()}
    names = {
        h: f"{number}_{shape_name(h)}" if number else shape_name(h)
        for h in config.shapes
    }
    files = {h: folder / "groups" / f"{name}.json" for h, name in names.items()}

    def outputs(hidden: Hidden) -> list[Path]:
        members = [weights_file(folder, member) for member in config.group(hidden)]
        return [*members, files[hidden]]

    todo = [h for h in files if not stages.is_done(names[h], inputs, outputs(h))]
    samples = functools.cache(lambda: verification_samples(split, config.base))
    total, missing = (
        sum(len(config.group(hidden)) for hidden in some) for some in (files, todo)
    )
    parts: dict[Hidden, list[Part]] = collections.defaultdict(list)
    members: dict[Hidden, dict[str, dict]] = collections.defaultdict(dict)
    title = f"sweep, round {number}" if number else "sweep"
    with tqdm.tqdm(
        total=total, initial=total - missing, desc=title, unit="member"
    ) as bar:
        piece = functools.partial(train_group, config=config)
        for part in executor.stream(piece, todo):
            hidden, made = part.hidden, members[part.hidden]
            made |= _write_members(folder, part, samples(), config, made_by)
            parts[hidden].append(part)
            bar.update(len(part.members))
            if len(made) == len(config.group(hidden)):
                facts = _facts(parts[hidden])
                write_json(files[hidden], {"facts": facts, "members": made})
                of = (inputs, outputs(hidden), facts["seconds"])
                stages.note(names[hidden], *of)
    return {names[h]: read_json(file, "a group") for h, file in files.items()}


def _facts(parts: Sequence[Part]) -> dict:
    """How a group trained, in numbers."""
    compiled = [seconds for part in parts for seconds in part.compile_s]
    return {
        "members": sum(len(part.members) for part in parts),
        "seconds": round(sum(part.seconds for part in parts), 3),
        "compiles": len(compiled),
        "compile_seconds": round(sum(compiled), 3),
    }


def _write_members(
    folder: Path,
    part: Part,
    samples: tuple[np.ndarray, np.ndarray],
    config: SweepConfig,
    made_by: Mapping[str, object],
) -> dict[str, dict]:
    """Write the weights files of trained members; what is known of each, by name.

    Args:
      folder: of the sweep.
      part: the members.
      samples: of `verification_samples`.
      config: the sweep; a file keeps all of it but where the data lie.
      made_by: provenance, with the hash of the data.
    """
    found = {}
    normaliser = jax.tree.map(jnp.asarray, part.normaliser)
    for number, member in enumerate(part.members):
        loss, won = float(part.loss[number]), float(part.wins[number])
        provenance = {
            "git_commit": None,
            "flags": {},
            "versions": {},
            **made_by,
            "seed": member.seed,
            "metrics": {"loss": loss, "pair_accuracy": won},
            "mode": member.sampler.mode,
            "config": json.loads(json.dumps(dataclasses.asdict(member))),
            "sweep": grid_of(config),
        }
        params = jax.tree.map(lambda x, n=number: jnp.asarray(x[n]), part.params)
        of = (params, normaliser, member, samples, provenance, part.seen)
        reward = write_weights(weights_file(folder, member), *of)
        fine = bool(part.finite[number])
        known = {"sha256": reward.sha256, "loss": loss, "pairs_won": won}
        found[member_name(member)] = {**known, "finite": fine}
    return found


def _peak_memory_gib() -> float:
    """Of this process; that of workers is theirs."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2)
