"""Sweeps: networks, leaky rates, step sizes and seeds, a grid or proposed by Optuna.

A point is a configuration without its seed, a member one with it. Members with one
network shape train side by side in one compiled program (`train.sweep`); such a group
is the piece of work that goes to an executor, and nothing depends on where it ran.

The training split is cut into scenes to fit and scenes to choose by, by group of
vehicles or by vehicle (`data.store.splits.with_validation`). A point is judged by the
mean of its seeds on the validation scenes. The test split is scored afterwards, for the
chosen point alone, so nothing can be chosen by it.

    DIR/stages.json           the groups that are finished, and what they were made from
    DIR/weights/NAME.msgpack  every member
    DIR/groups/SHAPE.json     how the members of a group trained (a search: of a round)
    DIR/sweep.json            all members with their metrics, and the choice
    DIR/best.msgpack          the chosen member, a copy of its file
"""

import dataclasses
import datetime
import functools
import itertools
import json
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import tqdm

from rcirl_jax.data.store.dataset import Demonstrations, open_datasets
from rcirl_jax.data.store.splits import Resplit, subsample, with_validation
from rcirl_jax.errors import MALFORMED, InputError, extra_module
from rcirl_jax.evaluation.baselines import new_study
from rcirl_jax.evaluation.ranking.evaluate import RANDOM_RUNS, covered_rows
from rcirl_jax.evaluation.ranking.learners import fitting_rows, normaliser_of
from rcirl_jax.evaluation.ranking.metrics import (
    METRICS,
    random_scorer,
    scene_metrics,
)
from rcirl_jax.evaluation.ranking.report import not_ahead
from rcirl_jax.evaluation.ranking.score import RankingSetup, numbered, score_scenes
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    combine_seeds,
    paired_difference,
)
from rcirl_jax.export.from_run import verification_samples, write_weights
from rcirl_jax.export.loading import open_reward
from rcirl_jax.features import feature_map
from rcirl_jax.reward import Normaliser, seen_range
from rcirl_jax.runtime.atomic_files import read_json, write_json, write_whole
from rcirl_jax.runtime.compiling import compiles
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.runtime.pipeline import FILE, Stages, code_sha256, only_one
from rcirl_jax.train.metrics import plateau_warning
from rcirl_jax.train.state import FeatureBatch, TrainConfig
from rcirl_jax.train.sweep import PROGRAM, Fitted, fit, freeze, members_of

SWEEP = "sweep.json"  # in the sweep's folder
NO_SETTINGS = ("data", "trials")  # where data lie, and how far a search has come
MOST_MEMBERS = 100_000  # of a sweep
MEMBERS_AT_ONCE = 16  # per call: enough to share the scenes, few enough to see progress
ROUND = 8  # points of a search that train together
DIGITS = 3  # of a proposed rate: more would tell nothing, and lengthen names
CHOICES = tuple(name for name, how in METRICS.items() if how.compared)
# a likelihood needs a temperature of its own, which no choice here depends on
REPORTED = tuple(name for name in METRICS if name != "nll")

Hidden = tuple[int, ...]  # units of the hidden layers; () is linear
Name = TypeVar("Name")


def shape_name(hidden: Hidden) -> str:
    """Returns a network shape in words: "15", "32x16", "linear"."""
    return "x".join(map(str, hidden)) or "linear"


class Point(NamedTuple):
    """A configuration without its seed."""

    hidden: Hidden
    leaky_rate: float
    learning_rate: float

    @property
    def name(self) -> str:
        """As in file names and tables."""
        rates = f"a{self.leaky_rate:g}_r{self.learning_rate:g}"
        return f"h{shape_name(self.hidden)}_{rates}"

    def as_json(self) -> dict[str, object]:
        """As in sweep.json."""
        return {**self._asdict(), "hidden": shape_name(self.hidden)}


def member_name(member: TrainConfig) -> str:
    """Returns a point's name with the seed."""
    point = Point(member.reward.hidden, member.leaky_rate, member.learning_rate)
    return f"{point.name}_s{member.seed}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepConfig:
    """Everything that decides the result of a sweep; hashable and small."""

    # datasets that every worker can open
    data: tuple[str, ...]
    # what the members share; its seed draws splits, candidates and batches
    base: TrainConfig
    hidden_sizes: tuple[Hidden, ...]
    leaky_rates: tuple[float, ...]
    learning_rates: tuple[float, ...]
    # training runs of each point, with seeds 0, 1, ...
    seeds: int
    # share of the training scenes to choose by
    validation: float = 0.2
    # training scenes used at most, drawn by vehicle (0: all)
    scenes: int = 0
    # metric of the choice
    choose_by: str = "top1_fde"
    # s at which distances are taken
    horizon_s: float = 5.0
    # points that Optuna proposes within the grid's bounds (0: the whole grid)
    trials: int = 0

    def __post_init__(self) -> None:
        """Reject values out of range, and what is no grid of a weights file's."""
        count, axes = math.prod(map(len, self.axes.values())), self.axes.values()
        rules = (
            ("choose_by", self.choose_by in CHOICES, f"one of {CHOICES}"),
            ("validation", 0.0 < self.validation <= 0.5, "0 to 0.5"),
            ("horizon_s", 0.0 < self.horizon_s <= 8.0, "above 0, at most 8 s"),
            ("seeds", self.seeds >= 1, ">= 1"),
            ("scenes", self.scenes >= 0, ">= 0"),
            ("trials", self.trials >= 0, ">= 0"),
            *((n, len(axis) > 0, "one value or more") for n, axis in self.axes.items()),
            (
                "leaky_rates",
                self.base.loss == "rank" or len(self.leaky_rates) == 1,
                "one value: only loss=rank has a leaky rate",
            ),
            (
                "trials",
                not self.trials or any(len(set(axis)) > 1 for axis in axes),
                "two values or more of leaky_rates, learning_rates or hidden_sizes: "
                "bounds to search in",
            ),
            (
                "seeds",
                max(count, self.trials) * self.seeds <= MOST_MEMBERS,
                f"a sweep of at most {MOST_MEMBERS} trainings",
            ),
        )
        for name, holds, expected in rules:
            if not holds:
                raise InputError(f"{name}: {getattr(self, name)}: expected {expected}")
        self.base.reward.check_own()
        names = [member_name(one) for at in self.grid for one in self.members(at)]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"sweep: {twice}: twice: expected distinct values")

    @property
    def axes(self) -> dict[str, tuple]:
        """The grid's axes, in the order of `Point`."""
        names = ("hidden_sizes", "leaky_rates", "learning_rates")
        return {name: getattr(self, name) for name in names}

    @property
    def grid(self) -> list[Point]:
        """All points of the grid, shape by shape."""
        return list(itertools.starmap(Point, itertools.product(*self.axes.values())))

    def shared(self, hidden: Hidden) -> TrainConfig:
        """Returns the settings that all members of a group share."""
        reward = dataclasses.replace(self.base.reward, hidden=hidden)
        return dataclasses.replace(self.base, reward=reward)

    def members(self, point: Point) -> list[TrainConfig]:
        """The members of a point, seed by seed."""
        rates = {"leaky_rate": point.leaky_rate, "learning_rate": point.learning_rate}
        shared = dataclasses.replace(self.shared(point.hidden), **rates)
        return [dataclasses.replace(shared, seed=seed) for seed in range(self.seeds)]

    def as_json(self) -> dict:
        """Returns what decides the result; more trials go on where fewer ended."""
        made = json.loads(json.dumps(dataclasses.asdict(self)))
        kept = {n: value for n, value in made.items() if n not in NO_SETTINGS}
        return {**kept, "search": "optuna" if self.trials else "grid"}


def open_split(
    config: SweepConfig, *, verify: bool = True
) -> tuple[Demonstrations, Resplit, str]:
    """Returns all data, splits train, validation, test, and what the cut goes by."""
    dataset = open_datasets(config.data, verify=verify)
    seed = config.base.seed
    part = subsample(dataset, config.scenes, seed) if config.scenes else dataset
    return dataset, *with_validation(part, config.validation, seed)


# ------------------------------------------------------------------ what to try


def rounds(
    config: SweepConfig, values: Mapping[Point, float]
) -> Iterator[tuple[int, list[Point]]]:
    """Yields what trains together: the whole grid, or what Optuna proposes next.

    A search has no file of its own: its proposals follow from the seed and the values,
    so one that goes on proposes the same points and finds them trained.

    Args:
      config: of the sweep.
      values: of all points yielded before, which the caller fills in between two
        rounds; NaN where one did not train.

    Yields:
      Number of the round (0: the grid), and points that are not tried yet.
    """
    if not config.trials:
        yield 0, config.grid
        return
    optuna = extra_module("optuna", "optuna")
    higher = METRICS[config.choose_by].higher_is_better
    study = new_study(config.base.seed, "maximize" if higher else "minimize")
    shapes = {shape_name(hidden): hidden for hidden in config.hidden_sizes}
    space = {"hidden": optuna.distributions.CategoricalDistribution([*shapes])}
    bounds = {}
    for name in ("leaky_rate", "learning_rate"):
        axis = config.axes[f"{name}s"]
        low, high = bounds[name] = min(axis), max(axis)
        space[name] = optuna.distributions.FloatDistribution(low, high, log=True)

    def point_of(params: Mapping) -> Point:
        """The rates with few digits, within their bounds."""
        rates = {
            name: min(max(float(f"{params[name]:.{DIGITS}g}"), low), high)
            for name, (low, high) in bounds.items()
        }
        return Point(hidden=shapes[params["hidden"]], **rates)

    for start in range(0, config.trials, ROUND):
        count = min(ROUND, config.trials - start)
        trials = [study.ask(space) for _ in range(count)]
        points = [point_of(trial.params) for trial in trials]
        if new := [at for at in dict.fromkeys(points) if at not in values]:
            yield start // ROUND + 1, new
        for trial, point in zip(trials, points, strict=True):
            if math.isfinite(values[point]):
                study.tell(trial, values[point])
            else:
                study.tell(trial, state=optuna.trial.TrialState.FAIL)


# --------------------------------------------------------------------- training


class TrainedMembers(NamedTuple):
    """Some trained members of a group (numpy)."""

    hidden: Hidden
    members: Sequence[TrainConfig]  # [m]
    fitted: Fitted  # leaves [m, ...]
    normaliser: Normaliser
    seen: np.ndarray  # [2, F] of `seen_range`
    seconds: float  # wall time, with compiling
    compile_s: Sequence[float]  # of each compile


@functools.lru_cache(maxsize=1)
def _scenes(config: SweepConfig) -> tuple[FeatureBatch, Normaliser, np.ndarray]:
    """Candidates of the scenes to fit and their ranges, made once per process."""
    split = open_split(config, verify=False)[1]
    frozen = freeze(split.load("train"), split.indices("train"), config.base)
    rows = fitting_rows(frozen, config.base)
    seen = seen_range(rows, feature_map(config.base.features))
    return frozen, normaliser_of(frozen, config.base), seen


def train_group(
    points: Sequence[Point], config: SweepConfig
) -> Iterator[TrainedMembers]:
    """Trains all members of points of one network shape, compiled once.

    Members go in equal chunks of at most MEMBERS_AT_ONCE; the last is filled up
    with repetitions, which are dropped.

    Args:
      points: of one shape.
      config: the sweep.

    Yields:
      One chunk at a time, in the order of the points and their seeds.
    """
    frozen, normaliser, seen = _scenes(config)
    hidden = points[0].hidden
    members = [one for point in points for one in config.members(point)]
    size = -(-len(members) // -(-len(members) // MEMBERS_AT_ONCE))
    for start in range(0, len(members), size):
        taken = members[start : start + size]
        filled = [*taken, *[taken[-1]] * (size - len(taken))]
        begin = time.perf_counter()
        with compiles(PROGRAM) as compiled:
            fitted = fit(frozen, normaliser, config.shared(hidden), members_of(filled))
            count = len(taken)
            fitted = jax.tree.map(lambda x, n=count: np.asarray(x)[:n], fitted)
        yield TrainedMembers(
            hidden=hidden,
            members=taken,
            fitted=fitted,
            normaliser=jax.tree.map(np.asarray, normaliser),
            seen=seen,
            seconds=time.perf_counter() - begin,
            compile_s=[*compiled],
        )


@dataclasses.dataclass(frozen=True)
class _Run:
    """A sweep in its folder, which is held for it alone."""

    config: SweepConfig
    folder: Path
    split: Demonstrations
    executor: Executor
    made_by: Mapping[str, object]  # provenance, with the hash of the data
    settings: Mapping[str, object]

    def weights_file(self, member: TrainConfig) -> Path:
        return self.folder / "weights" / f"{member_name(member)}.msgpack"

    @functools.cached_property
    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        return verification_samples(self.split, self.config.base)

    def train(self, points: Iterable[Point], number: int) -> dict[str, dict]:
        """Trains and writes the groups of a round that are not finished.

        Args:
          points: of the round.
          number: of the round, from 1, which its groups bear; 0: the grid.

        Returns:
          Contents of the groups' files by name: numbers of the training ("facts"), and
          of each member ("members").
        """
        stages = Stages(folder=self.folder)
        settings = {**self.settings, "dataset_sha256": self.made_by["dataset_sha256"]}
        check_settings(stages, settings)
        inputs = {**settings, "points": [*points], "code": code_sha256()}
        groups: dict[Hidden, list[Point]] = {}
        for point in points:
            groups.setdefault(point.hidden, []).append(point)
        prefix = f"{number}_" if number else ""
        names = {hidden: f"{prefix}{shape_name(hidden)}" for hidden in groups}
        files = {h: self.folder / "groups" / f"{names[h]}.json" for h in groups}
        outputs = {
            h: [self.weights_file(m) for at in of for m in self.config.members(at)]
            + [files[h]]
            for h, of in groups.items()
        }
        todo = [h for h in groups if not stages.is_done(names[h], inputs, outputs[h])]
        total, missing = (sum(len(outputs[h]) - 1 for h in of) for of in (groups, todo))
        made: dict[Hidden, dict[str, dict]] = {h: {} for h in todo}
        seconds = dict.fromkeys(todo, 0.0)
        compiled: dict[Hidden, list[float]] = {h: [] for h in todo}
        title = f"sweep, round {number}" if number else "sweep"
        with tqdm.tqdm(
            total=total, initial=total - missing, desc=title, unit="member"
        ) as bar:
            piece = functools.partial(train_group, config=self.config)
            for part in self.executor.stream(piece, [groups[h] for h in todo]):
                h, of = part.hidden, made[part.hidden]
                of |= self._write_weights(part)
                seconds[h] += part.seconds
                compiled[h] += part.compile_s
                bar.update(len(part.members))
                if len(of) == len(outputs[h]) - 1:
                    facts = {
                        "members": len(of),
                        "seconds": round(seconds[h], 3),
                        "compiles": len(compiled[h]),
                        "compile_seconds": round(sum(compiled[h]), 3),
                    }
                    write_json(files[h], {"facts": facts, "members": of})
                    stages.note(names[h], inputs, outputs[h], seconds[h])
        return {names[h]: read_json(file, "a group") for h, file in files.items()}

    def _write_weights(self, part: TrainedMembers) -> dict[str, dict]:
        """Writes members' weights files; returns what is known of each, by name."""
        found = {}
        normaliser = jax.tree.map(jnp.asarray, part.normaliser)
        for number, member in enumerate(part.members):
            one = jax.tree.map(lambda x, n=number: x[n], part.fitted)
            loss, won = float(one.loss[-1]), float(one.wins[-1])
            provenance = {
                "git_commit": None,
                "flags": {},
                "versions": {},
                **self.made_by,
                "seed": member.seed,
                "metrics": {"loss": loss, "pair_accuracy": won},
                "mode": member.sampler.mode,
                "config": json.loads(json.dumps(dataclasses.asdict(member))),
                "sweep": self.config.as_json(),
            }
            params = jax.tree.map(jnp.asarray, one.params)
            of = (params, normaliser, member, self.samples, provenance, part.seen)
            known = {"loss": loss, "pairs_won": won, "finite": bool(one.finite)}
            known["plateau"] = plateau_warning(one.step_loss)
            reward = write_weights(self.weights_file(member), *of)
            found[member_name(member)] = {"sha256": reward.sha256, **known}
        return found

    def score(
        self, name: str, points: Sequence[Point]
    ) -> dict[Point, tuple[dict[str, dict], list[dict[str, float]], str]]:
        """Scores trained points on the scenes of a split.

        Returns:
          For each point the estimate of each metric over seeds and scenes, the means of
          each seed, and `not_ahead` of random order and the hand-set cost.

        Raises:
          InputError: no scene covers the horizon, or all are of one vehicle.
        """
        setup = RankingSetup(
            preset=self.config.base.features,
            sampler=self.config.base.sampler,
            horizon_s=self.config.horizon_s,
        )
        rows, index = covered_rows(self.split, name, setup.horizon_s)
        vehicles = ClusterBootstrap(np.asarray(rows.vehicle))
        rewards = {
            point.name: [
                open_reward(str(self.weights_file(member))).value
                for member in self.config.members(point)
            ]
            for point in points
        }
        scored = score_scenes(rows, index, setup, numbered(rewards), self.executor)
        hand = scored.values["hand-set"], scored.human_values["hand-set"]
        drawn = [random_scorer(run, hand[0].shape) for run in range(RANDOM_RUNS)]
        easy = {
            name: np.stack([scene_metrics(*x, scored.outcomes)["top1_fde"] for x in of])
            for name, of in {"random": drawn, "hand-set": [hand]}.items()
        }
        found = {}
        for point in points:
            keys = [f"{point.name}#{seed}" for seed in range(self.config.seeds)]
            of_seeds = [
                scene_metrics(
                    scored.values[key], scored.human_values[key], scored.outcomes
                )
                for key in keys
            ]
            estimates, means = {}, [{} for _ in keys]
            for metric in REPORTED:
                by = METRICS[metric].weight  # of the scenes
                weight = None if by is None else of_seeds[0][by]
                values = np.stack([one[metric] for one in of_seeds])
                estimate = combine_seeds(values, vehicles, weight=weight)
                estimates[metric] = dataclasses.asdict(estimate)
                for mean, x in zip(means, vehicles.mean(values, weight), strict=True):
                    mean[metric] = float(x)
            chosen = np.stack([one["top1_fde"] for one in of_seeds])
            apart = {n: paired_difference(chosen, x, vehicles) for n, x in easy.items()}
            found[point] = estimates, means, not_ahead(point.name, apart)
        return found


def check_settings(stages: Stages, settings: Mapping[str, object]) -> None:
    """Checks that the groups of a folder are of these settings.

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


# ----------------------------------------------------------------------- choosing


def best(values: Mapping[Name, float], metric: str) -> Name:
    """Returns the one with the best value of a metric; the first of equals.

    Raises:
      InputError: nothing to choose from.
    """
    values = {name: value for name, value in values.items() if np.isfinite(value)}
    if not values:
        raise InputError(
            "sweep: members: NaN or infinity in every configuration: expected one "
            "that trains; lower learning_rates"
        )
    sign = -1.0 if METRICS[metric].higher_is_better else 1.0
    return min(values, key=lambda name: sign * values[name])


def run_sweep(
    config: SweepConfig,
    folder: Path,
    executor: Executor,
    provenance: Mapping[str, object],
) -> dict:
    """Trains what is not there yet, chooses, scores the chosen, writes everything.

    Args:
      config: the sweep.
      folder: its folder; a finished group in it is not trained again.
      executor: where groups train and scenes are scored.
      provenance: what makes it; kept in every file.

    Returns:
      The contents of sweep.json.

    Raises:
      InputError: the folder belongs to other settings or data, or is in use; bad
        data; no point that trains.
    """
    dataset, split, by = open_split(config)
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    made_by = {**provenance, "dataset_sha256": dataset.hash, "created": now}
    settings = config.as_json()
    settings |= settings.pop("base")
    metric = config.choose_by
    with only_one(folder):
        for name in ("validation", "test"):  # what would fail only after the training
            held_out, _ = covered_rows(split, name, config.horizon_s)
            ClusterBootstrap(np.asarray(held_out.vehicle))
        run = _Run(config, folder, split, executor, made_by, settings)
        groups, members, configurations = {}, {}, {}
        values: dict[Point, float] = {}
        for number, points in rounds(config, values):
            for name, group in run.train(points, number).items():
                groups[name] = group["facts"]
                members |= group["members"]
            for point, (estimates, means, _) in run.score("validation", points).items():
                of = point.as_json()
                names = [member_name(one) for one in config.members(point)]
                for seed, (name, found) in enumerate(zip(names, means, strict=True)):
                    members[name] |= {**of, "seed": seed, "validation": found}
                finite = all(members[name]["finite"] for name in names)
                of |= {"members": names, "finite": finite, "validation": estimates}
                configurations[point.name] = of
                values[point] = estimates[metric]["value"] if finite else math.nan
        point = best(values, metric)
        names = configurations[point.name]["members"]
        member = best({n: members[n]["validation"][metric] for n in names}, metric)
        test, means, behind = run.score("test", [point])[point]
        warnings = filter(None, (members[member]["plateau"], behind))
        body = {
            "settings": settings,
            "search": settings["search"],
            "validation_by": by,
            "scenes": {
                name: split.indices(name).size
                for name in ("train", "validation", "test")
            },
            "groups": groups,
            "choose_by": {"metric": metric, **dataclasses.asdict(METRICS[metric])},
            "members": members,
            "configurations": configurations,
            "chosen": {
                "configuration": point.name,
                "member": member,
                "validation": configurations[point.name]["validation"],
                "test": test,
                "member_test": means[names.index(member)],
            },
            "warnings": [f"of the sweep's best: {said}" for said in warnings],
            "made_by": made_by,
        }
        file = folder / "weights" / f"{member}.msgpack"
        write_whole(folder / "best.msgpack", file.read_bytes())
        write_json(folder / SWEEP, body)
    return body


# ------------------------------------------------------------------ reading again


def read_sweep(folder: Path) -> dict:
    """Returns the contents of a sweep's sweep.json.

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
    """Checks what the picture takes for granted: as many seeds in each, a full grid.

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
    """Returns the configurations as text, best first, then the choice's test score.

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
        *(f"warning: {said}" for said in report.get("warnings", ())),
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
