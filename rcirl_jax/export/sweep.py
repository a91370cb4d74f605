"""A sweep in its folder: trained, resumed, searched, chosen, written, read again.

DIR/stages.json           the groups that are finished, and what they were made from
DIR/weights/NAME.msgpack  every member
DIR/groups/SHAPE.json     how the members of a group trained (a search: of a round)
DIR/sweep.json            all members with their metrics, and the choice
DIR/best.msgpack          the chosen member, a copy of its file

A search tries configurations that Optuna proposes within the bounds of the grid's axes:
it proposes a round of them, they train side by side as a grid's do, and it learns their
values on the validation scenes before it proposes the next round.
"""

import collections
import dataclasses
import datetime
import functools
import json
import math
import resource
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tqdm

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.errors import MALFORMED, InputError, extra_module
from rcirl_jax.evaluation.baselines import new_study
from rcirl_jax.evaluation.ranking.evaluate import covered_rows
from rcirl_jax.evaluation.ranking.metrics import METRICS
from rcirl_jax.evaluation.ranking.sweep import (
    Hidden,
    Part,
    Point,
    Scores,
    SweepConfig,
    best,
    estimates,
    held_out_scores,
    member_name,
    open_split,
    point_name,
    row_name,
    seed_means,
    shape_name,
    train_group,
)
from rcirl_jax.evaluation.statistics import ClusterBootstrap
from rcirl_jax.export.from_run import verification_samples, write_weights
from rcirl_jax.export.loading import compiled_scorer, open_reward
from rcirl_jax.runtime.atomic_files import read_json, write_json, write_whole
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.runtime.pipeline import FILE, Stages, code_sha256, only_one
from rcirl_jax.train.state import TrainConfig

SWEEP = "sweep.json"  # in the sweep's folder
ELSEWHERE = ("data", "trials", "points")  # fields that are no settings of a folder
ROUND = 8  # configurations of a round
DIGITS = 3  # of a proposed rate: more would tell nothing, and lengthen names
Rows = Mapping[str, Sequence[TrainConfig]]  # configuration -> its members
# (name of a split, rows) -> their metrics, and the vehicles of the scenes
Judge = Callable[[str, Rows], tuple[Scores, ClusterBootstrap]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Found:
    """Trained members, with their values on the validation split; all by name."""

    rows: Rows
    groups: Mapping[str, dict]  # how each trained, in numbers
    members: Mapping[str, dict]
    configurations: Mapping[str, dict]

    def value(self, row: str, metric: str) -> float:
        """Of a configuration, the mean of its seeds; NaN where one did not train."""
        known = self.configurations[row]
        return known["validation"][metric]["value"] if known["finite"] else math.nan

    def beside(self, other: "Found") -> "Found":
        """These and those of another."""
        return Found(
            rows={**self.rows, **other.rows},
            groups={**self.groups, **other.groups},
            members={**self.members, **other.members},
            configurations={**self.configurations, **other.configurations},
        )


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


def scores_of(
    config: SweepConfig,
    folder: Path,
    split: Demonstrations,
    executor: Executor,
    name: str,
    rows: Rows,
) -> tuple[Scores, ClusterBootstrap]:
    """Metrics of the members in a sweep's folder on the scenes of a split."""
    runs = {
        row: [compiled_scorer(open_reward(str(weights_file(folder, m)))) for m in of]
        for row, of in rows.items()
    }
    return held_out_scores(split, name, runs, config.setup, executor)


def validated(config: SweepConfig, groups: Mapping[str, dict], judge: Judge) -> Found:
    """Members and configurations on the validation split.

    Args:
      config: whose members they are.
      groups: what is known of each group's training, by its name.
      judge: scores them.
    """
    members = {n: m for group in groups.values() for n, m in group["members"].items()}
    rows: dict[str, list[TrainConfig]] = collections.defaultdict(list)
    for one in config.members():
        rows[row_name(one)].append(one)
    found, vehicles = judge("validation", rows)
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
    return Found(
        rows=rows,
        groups={name: group["facts"] for name, group in groups.items()},
        members=members,
        configurations=configurations,
    )


def chosen(config: SweepConfig, found: Found, judge: Judge) -> dict:
    """The best on the validation split, and its scores on the test split."""
    metric, members = config.choose_by, found.members
    row = best({row: found.value(row, metric) for row in found.rows}, metric)
    names = found.configurations[row]["members"]
    member = best({n: members[n]["validation"][metric] for n in names}, metric)
    tested, vehicles = judge("test", {row: found.rows[row]})
    test = estimates(tested[row], vehicles)
    return {
        "configuration": row,
        "member": member,
        "validation": found.configurations[row]["validation"],
        "test": {name: dataclasses.asdict(one) for name, one in test.items()},
        "member_test": seed_means(tested[row], vehicles)[names.index(member)],
    }


def choice(config: SweepConfig, found: Found, judge: Judge) -> dict:
    """The part of sweep.json on the members and on the one that is chosen."""
    metric = config.choose_by
    return {
        "groups": found.groups,
        "choose_by": {"metric": metric, **dataclasses.asdict(METRICS[metric])},
        "members": found.members,
        "configurations": found.configurations,
        "chosen": chosen(config, found, judge),
    }


def _values_of(config: TrainConfig) -> dict:
    return {
        "hidden": shape_name(config.reward.hidden),
        "leaky_rate": config.leaky_rate,
        "learning_rate": config.learning_rate,
    }


class Search:
    """A study that is asked for configurations and told their values.

    It has no file of its own: what it proposes follows from the seed and the values,
    so a search that goes on asks again and finds the rounds that are finished.
    """

    def __init__(self, config: SweepConfig) -> None:
        """Rates between the least and the largest of the grid's, on a log scale."""
        optuna = extra_module("optuna", "optuna")
        how = METRICS[config.choose_by]
        direction = "maximize" if how.higher_is_better else "minimize"
        self._study = new_study(config.base.seed, direction)
        self._failed = optuna.trial.TrialState.FAIL
        self._shapes = {shape_name(hidden): hidden for hidden in config.hidden_sizes}

        def between(values: Sequence[float]) -> Any:  # noqa: ANN401
            low, high = min(values), max(values)
            return optuna.distributions.FloatDistribution(low, high, log=True)

        self._space: dict[str, Any] = {
            "hidden": optuna.distributions.CategoricalDistribution([*self._shapes]),
            "leaky_rate": between(config.leaky_rates),
            "learning_rate": between(config.learning_rates),
        }
        self._asked: list = []

    def ask(self, count: int) -> list[Point]:
        """Configurations to try next, the same one perhaps twice."""
        self._asked = [self._study.ask(self._space) for _ in range(count)]
        return [self._point(trial.params) for trial in self._asked]

    def _point(self, params: dict) -> Point:
        def short(name: str) -> float:
            space, value = self._space[name], float(f"{params[name]:.{DIGITS}g}")
            return min(max(value, space.low), space.high)

        hidden = self._shapes[params["hidden"]]
        return hidden, short("leaky_rate"), short("learning_rate")

    def tell(self, values: Sequence[float]) -> None:
        """The values of those that were asked for; NaN where one did not train."""
        for trial, value in zip(self._asked, values, strict=True):
            if np.isfinite(value):
                self._study.tell(trial, value)
            else:
                self._study.tell(trial, state=self._failed)


def searched(
    config: SweepConfig, trained: Callable[[tuple[Point, ...], int], Found]
) -> Found:
    """All rounds of a search.

    Args:
      config: of the sweep.
      trained: trains configurations that are new, and scores them on the validation
        scenes; takes the number of the round.
    """
    search = Search(config)
    found = Found(rows={}, groups={}, members={}, configurations={})
    for start in range(0, config.trials, ROUND):
        points = search.ask(min(ROUND, config.trials - start))
        rows = {point_name(point): point for point in points}
        if new := tuple(at for row, at in rows.items() if row not in found.rows):
            found = found.beside(trained(new, start // ROUND + 1))
        names = map(point_name, points)
        search.tell([found.value(name, config.choose_by) for name in names])
    return found


def grid_of(config: SweepConfig) -> dict:
    """What decides the result, as JSON; where the data lie and how many trials do not.

    More trials go on where fewer ended.
    """
    made = json.loads(json.dumps(dataclasses.asdict(config)))
    kept = {n: value for n, value in made.items() if n not in ELSEWHERE}
    return {**kept, "search": "optuna" if config.trials else "grid"}


def settings_of(config: SweepConfig) -> dict:
    """The same in one level, as the folder's files name it."""
    made = grid_of(config)
    return {n: v for n, v in made.items() if n != "base"} | made["base"]


def check_settings(stages: Stages, settings: Mapping[str, object]) -> None:
    """Check that the groups of a folder are of these settings.

    Raises:
      InputError: one is of others (names the first).
    """
    for record in stages.read().values():
        for name, setting in settings.items():
            if (found := record.get("inputs", {}).get(name)) != setting:
                raise InputError(
                    f"{stages.folder / FILE}: {name}: {found}: expected {setting} to "
                    "resume; use another output folder for other settings"
                )


def weights_file(folder: Path, member: TrainConfig) -> Path:
    """A member's weights."""
    return folder / "weights" / f"{member_name(member)}.msgpack"


def read_sweep(folder: Path) -> dict:
    """The contents of a sweep's sweep.json.

    Raises:
      InputError: missing, or not of a finished sweep.
    """
    path = folder / SWEEP
    report = read_json(path, "the result of `rcirl sweep`")
    try:
        table(report)
        _check_grid(report)
    except MALFORMED as error:
        raise InputError(
            f"{path}: {type(error).__name__}: expected the result of `rcirl sweep`"
        ) from error
    return report


def _check_grid(report: Mapping) -> None:
    """Check what the picture takes for granted: as many seeds in each, a full grid.

    Only a search's configurations are no grid.

    Raises:
      One of `MALFORMED`.
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
    whole = len(seen) == math.prod(axes) or report.get("search") == "optuna"
    if not seen or not whole or len(seeds) != 1 or 0 in seeds:
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
