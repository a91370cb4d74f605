"""A sweep in its folder: trained once, resumed, chosen, written.

DIR/settings.json         what the folder belongs to
DIR/weights/NAME.msgpack  every member
DIR/groups/SHAPE.json     the group is finished; written after its members
DIR/sweep.json            all members with their metrics, and the choice
DIR/best.msgpack          the chosen member, a copy of its file
"""

import collections
import dataclasses
import datetime
import functools
import json
import math
import resource
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tqdm

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.errors import UNFORESEEN, InputError
from rcirl_jax.evaluation.ranking.evaluate import covered_rows
from rcirl_jax.evaluation.ranking.metrics import METRICS
from rcirl_jax.evaluation.ranking.sweep import (
    Hidden,
    Part,
    Scores,
    SweepConfig,
    best,
    estimates,
    held_out_scores,
    member_name,
    open_split,
    row_name,
    seed_means,
    shape_name,
    train_group,
)
from rcirl_jax.evaluation.statistics import ClusterBootstrap
from rcirl_jax.export.from_run import verification_samples, write_weights
from rcirl_jax.export.loading import compiled_scorer, open_reward
from rcirl_jax.export.reader import Reward
from rcirl_jax.runtime.atomic_files import read_json, write_json, write_whole
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.runtime.pipeline import only_one
from rcirl_jax.train.state import TrainConfig

SWEEP = "sweep.json"  # in the sweep's folder
FACTS = ("members", "seconds", "compiles", "compile_seconds")  # of a group, numbers

Rows = Mapping[str, Sequence[TrainConfig]]  # configuration -> its members


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
      provenance: of `experiments.common`; kept in every file.

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
    created = _claim(config, folder, dataset.hash)
    made_by = {**provenance, "dataset_sha256": dataset.hash, "created": created}
    for name in ("validation", "test"):  # what would fail only after the training
        held_out, _ = covered_rows(split, name, config.setup.horizon_s)
        ClusterBootstrap(np.asarray(held_out.vehicle))
    groups = _train(config, folder, split, executor, made_by)
    rows: dict[str, list[TrainConfig]] = collections.defaultdict(list)
    for one in config.members():
        rows[row_name(one)].append(one)
    body = {
        "settings": _settings(config),
        "validation_by": by,
        "scenes": {n: split.indices(n).size for n in ("train", "validation", "test")},
        "groups": {name: group["facts"] for name, group in groups.items()},
        **_judged(config, folder, split, rows, groups, executor),
        "peak_memory_gib": _peak_memory_gib(),
        "made_by": made_by,
    }
    chosen = folder / "weights" / f"{body['chosen']['member']}.msgpack"
    write_whole(folder / "best.msgpack", chosen.read_bytes())
    write_json(folder / SWEEP, body)
    return body


def grid_of(config: SweepConfig) -> dict:
    """What decides the result, as JSON; where the data lie does not."""
    made = json.loads(json.dumps(dataclasses.asdict(config)))
    return {name: value for name, value in made.items() if name != "data"}


def _settings(config: SweepConfig) -> dict:
    """The same in one level, as the folder's files name it."""
    made = grid_of(config)
    return {n: v for n, v in made.items() if n != "base"} | made["base"]


def _claim(config: SweepConfig, folder: Path, dataset_hash: str) -> str:
    """Write settings.json, or check the one that is there; when it was written.

    Raises:
      InputError: the folder is of a sweep with other settings (names the first).
    """
    path = folder / "settings.json"
    own = {**_settings(config), "dataset_sha256": dataset_hash}
    if path.exists():
        found = read_json(path, "the file of a sweep")
        try:
            created = str(found["created"])
        except (KeyError, TypeError) as error:
            raise InputError(
                f"{path}: {type(error).__name__}: {error}: expected the file of a sweep"
            ) from error
        for name, setting in own.items():
            if found.get(name) != setting:
                raise InputError(
                    f"{path}: {name}: {found.get(name)}: expected {setting} to "
                    "resume; use another --output for other settings"
                )
        return created
    created = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    write_json(path, {**own, "created": created})
    return created


def _train(
    config: SweepConfig,
    folder: Path,
    split: Demonstrations,
    executor: Executor,
    made_by: Mapping[str, object],
) -> dict[str, dict]:
    """The groups' files by shape, after training those that are missing."""
    groups = {h: _finished(config, folder, h, made_by) for h in config.hidden_sizes}
    todo = [hidden for hidden, group in groups.items() if group is None]
    samples = functools.cache(lambda: verification_samples(split, config.base))
    total = len(config.members())
    done = total - sum(len(config.group(hidden)) for hidden in todo)
    parts: dict[Hidden, list[Part]] = collections.defaultdict(list)
    with tqdm.tqdm(total=total, initial=done, desc="sweep", unit="member") as bar:
        piece = functools.partial(train_group, config=config)
        for part in executor.stream(piece, todo):
            for number, member in enumerate(part.members):
                output = _weights(folder, member)
                write_member(output, part, number, samples(), config, made_by)
            parts[part.hidden].append(part)
            bar.update(len(part.members))
            if sum(len(p.members) for p in parts[part.hidden]) == len(
                config.group(part.hidden)
            ):
                settings = {**_settings(config), **_data(made_by)}
                groups[part.hidden] = _finish(folder, parts[part.hidden], settings)
    return {shape_name(hidden): group or {} for hidden, group in groups.items()}


def _weights(folder: Path, member: TrainConfig) -> Path:
    return folder / "weights" / f"{member_name(member)}.msgpack"


def write_member(
    output: Path,
    part: Part,
    number: int,
    samples: tuple[np.ndarray, np.ndarray],
    config: SweepConfig,
    made_by: Mapping[str, object],
) -> Reward:
    """Write the weights file of one trained member.

    Args:
      output: the file.
      part: that it was trained in.
      number: its place there.
      samples: of `verification_samples`.
      config: the sweep; the file keeps all of it but where the data lie.
      made_by: provenance, with the hash of the data.
    """
    member = part.members[number]
    metrics = {"loss": part.loss[number], "pair_accuracy": part.wins[number]}
    provenance = {
        "git_commit": None,
        "flags": {},
        "versions": {},
        **made_by,
        "seed": member.seed,
        "metrics": {name: float(x) for name, x in metrics.items()},
        "mode": member.sampler.mode,
        "config": json.loads(json.dumps(dataclasses.asdict(member))),
        "sweep": grid_of(config),
    }
    params = jax.tree.map(lambda x: jnp.asarray(x[number]), part.params)
    normaliser = jax.tree.map(jnp.asarray, part.normaliser)
    return write_weights(
        output, params, normaliser, member, samples, provenance, part.seen
    )


def _finish(folder: Path, parts: Sequence[Part], settings: dict) -> dict:
    """Write and return the file of a finished group."""
    members = {
        member_name(member): {
            "sha256": open_reward(str(_weights(folder, member))).sha256,
            "loss": float(part.loss[number]),
            "pairs_won": float(part.wins[number]),
            "finite": bool(part.finite[number]),
        }
        for part in parts
        for number, member in enumerate(part.members)
    }
    compiled = [seconds for part in parts for seconds in part.compile_s]
    facts = {
        "members": len(members),
        "seconds": round(sum(part.seconds for part in parts), 3),
        "compiles": len(compiled),
        "compile_seconds": round(sum(compiled), 3),
    }
    group = {"facts": facts, "members": members, "settings": settings}
    write_json(folder / "groups" / f"{shape_name(parts[0].hidden)}.json", group)
    return group


def _finished(
    config: SweepConfig, folder: Path, hidden: Hidden, made_by: Mapping[str, object]
) -> dict | None:
    """A group's file, if it and all its members' files are whole."""
    path = folder / "groups" / f"{shape_name(hidden)}.json"
    try:
        group = read_json(path, "the group of a sweep")
        facts, kept = group["facts"], group["members"]
        numbers = all(type(facts[name]) in {int, float} for name in FACTS)
        if not numbers or any(type(one["finite"]) is not bool for one in kept.values()):
            return None
        if group["settings"] != {**_settings(config), **_data(made_by)}:
            return None
        for member in config.group(hidden):
            reward = open_reward(str(_weights(folder, member)))
            if reward.sha256 != group["members"][member_name(member)]["sha256"]:
                return None
    except (OSError, *UNFORESEEN, InputError):
        return None
    return group


def _data(made_by: Mapping[str, object]) -> dict:
    """The data and the code a group was made from."""
    return {name: made_by.get(name) for name in ("dataset_sha256", "git_commit")}


def _judged(
    config: SweepConfig,
    folder: Path,
    split: Demonstrations,
    rows: Rows,
    groups: Mapping[str, dict],
    executor: Executor,
) -> dict:
    """Members and configurations on the validation split; the chosen on the test."""

    def scores(name: str, rows: Rows) -> tuple[Scores, ClusterBootstrap]:
        runs = {
            row: [compiled_scorer(open_reward(str(_weights(folder, m)))) for m in of]
            for row, of in rows.items()
        }
        return held_out_scores(split, name, runs, config.setup, executor)

    members = {n: m for group in groups.values() for n, m in group["members"].items()}
    found, vehicles = scores("validation", rows)
    configurations = {}
    for row, of in rows.items():
        names = [member_name(one) for one in of]
        values = estimates(found[row], vehicles)
        configurations[row] = {
            **_values_of(of[0]),
            "members": names,
            "finite": all(members[name]["finite"] for name in names),
            "validation": {n: dataclasses.asdict(e) for n, e in values.items()},
        }
        for name, one, means in zip(
            names, of, seed_means(found[row], vehicles), strict=True
        ):
            members[name] |= {**_values_of(one), "seed": one.seed, "validation": means}
    metric = config.choose_by
    fine = {row: c for row, c in configurations.items() if c["finite"]}
    row = best({r: c["validation"][metric]["value"] for r, c in fine.items()}, metric)
    names = configurations[row]["members"]
    member = best({n: members[n]["validation"][metric] for n in names}, metric)
    tested, vehicles = scores("test", {row: rows[row]})
    return {
        "choose_by": {"metric": metric, **dataclasses.asdict(METRICS[metric])},
        "members": members,
        "configurations": configurations,
        "chosen": {
            "configuration": row,
            "member": member,
            "validation": configurations[row]["validation"],
            "test": {
                name: dataclasses.asdict(estimate)
                for name, estimate in estimates(tested[row], vehicles).items()
            },
            "member_test": seed_means(tested[row], vehicles)[names.index(member)],
        },
    }


def _values_of(config: TrainConfig) -> dict:
    return {
        "hidden": shape_name(config.reward.hidden),
        "leaky_rate": config.leaky_rate,
        "learning_rate": config.learning_rate,
    }


def _peak_memory_gib() -> float:
    """Of this process; that of workers is theirs."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2)


def read_sweep(folder: Path) -> dict:
    """The contents of a sweep's sweep.json.

    Raises:
      InputError: missing, or not of a finished sweep.
    """
    path = folder / SWEEP
    report = read_json(path, "the result of experiments.sweep")
    try:
        table(report)
        _check_grid(report)
    except UNFORESEEN as error:
        raise InputError(
            f"{path}: {type(error).__name__}: expected the result of experiments.sweep"
        ) from error
    return report


def _check_grid(report: Mapping) -> None:
    """Check what the picture takes for granted: a full grid, as many seeds in each.

    Raises:
      One of `UNFORESEEN`.
    """
    metric, members = report["choose_by"]["metric"], report["members"]
    report["configurations"][report["chosen"]["configuration"]]
    seen, seeds = set(), set()
    for row in report["configurations"].values():
        values = [members[name]["validation"][metric] for name in row["members"]]
        rates = row["leaky_rate"], row["learning_rate"]
        if not all(0.0 < x < 1.0 for x in rates) or not max(map(abs, values)) < 1e9:
            raise ValueError("expected finite numbers, rates between 0 and 1")
        seen.add((row["hidden"], row["leaky_rate"], row["learning_rate"]))
        seeds.add(len(values))
    axes = [len(set(axis)) for axis in zip(*seen, strict=True)]
    if not seen or len(seen) != math.prod(axes) or len(seeds) != 1 or 0 in seeds:
        raise ValueError("expected every configuration with the same seeds")


def table(report: Mapping) -> str:
    """The configurations as text, best first, then the choice with its test score.

    Args:
      report: of `run_sweep`.
    """
    how, chosen = report["choose_by"], report["chosen"]
    metric = how["metric"]
    sign = -1.0 if how["higher_is_better"] else 1.0
    unit = "" if how["unit"] == "1" else f" {how['unit']}"
    scale = 100.0 if how["unit"] == "%" else 1.0

    def text(estimate: Mapping) -> str:
        value, low, high = (scale * estimate[k] for k in ("value", "low", "high"))
        apart = estimate["seed_sd"]
        seeds = "" if apart is None else f"  seeds ±{scale * apart:.3f}"
        return f"{value:8.3f}{unit}  [{low:.3f}, {high:.3f}]{seeds}"

    rows = sorted(
        report["configurations"].items(),
        key=lambda item: sign * item[1]["validation"][metric]["value"],
    )
    lines = [
        f"{how['title']} on {report['scenes']['validation']} validation scenes, held "
        f"out by {report['validation_by']}; 95 % interval, spread of seeds",
        f"{'hidden':>10s} {'leaky rate':>10s} {'step size':>10s}",
    ]
    for name, row in rows:
        mark = "  <- chosen" if name == chosen["configuration"] else ""
        failed = "" if row["finite"] else "  NaN or infinity"
        values = f"{row['hidden']:>10s} {row['leaky_rate']:>10g} "
        values += f"{row['learning_rate']:>10g} "
        lines.append(values + text(row["validation"][metric]) + failed + mark)
    lines.append(
        f"chosen: {chosen['configuration']}, its test score "
        f"({report['scenes']['test']} scenes, not chosen by): "
        f"{text(chosen['test'][metric]).strip()}"
    )
    for name, facts in report["groups"].items():
        lines.append(
            f"group {name}: {facts['members']} members in {facts['seconds']:.1f} s, "
            f"{facts['compiles']} compile of {facts['compile_seconds']:.1f} s"
        )
    return "\n".join(lines)
