"""Batch sweeps: networks, leaky rates, step sizes and seeds, a grid or proposed ones.

All members with one network shape are a group. A group trains side by side in one
compiled program (`train.sweep`), `MEMBERS_AT_ONCE` at a time, and is the piece of
work that goes to an executor; what comes out does not depend on the executor.

The training split is cut into scenes to fit and scenes to choose by
(`data.store.resplit.with_validation`): by vehicle-disjoint group, or by vehicle where a
group is too large for that. A configuration is judged by the mean of its seeds on
the validation scenes. The test split is scored afterwards, for the chosen one alone,
so nothing can be chosen by it.
"""

import dataclasses
import functools
import itertools
import math
import time
from collections.abc import Iterator, Mapping, Sequence

import jax
import numpy as np

from rcirl_jax.data.store.joined import Demonstrations, open_datasets
from rcirl_jax.data.store.resplit import Resplit, subsample, with_validation
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.evaluate import (
    RankingSetup,
    covered_rows,
    numbered,
    outcomes_of,
    score_rows,
)
from rcirl_jax.evaluation.ranking.learners import fitting_rows, normaliser_of
from rcirl_jax.evaluation.ranking.metrics import METRICS, scene_metrics
from rcirl_jax.evaluation.ranking.score import Scorer
from rcirl_jax.evaluation.statistics import ClusterBootstrap, Estimate, combine_seeds
from rcirl_jax.features import feature_map
from rcirl_jax.reward import Normaliser, RewardParams, seen_range
from rcirl_jax.runtime.compiling import compiles
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.train.state import FeatureBatch, TrainConfig
from rcirl_jax.train.sweep import PROGRAM, fit, freeze, members_of

MOST_MEMBERS = 100_000  # of a sweep
MEMBERS_AT_ONCE = 16  # per call: enough to share the scenes, few enough to see progress
CHOICES = tuple(name for name, how in METRICS.items() if how.compared)
# a likelihood needs a temperature of its own, which no choice here depends on
REPORTED = tuple(name for name in METRICS if name != "nll")

Hidden = tuple[int, ...]  # units of the hidden layers; () is linear
Point = tuple[Hidden, float, float]  # network, leaky rate, step size


def shape_name(hidden: Hidden) -> str:
    """A network shape in words: "15", "32x16", "linear"."""
    return "x".join(map(str, hidden)) or "linear"


def point_name(point: Point) -> str:
    """A configuration without its seed, as in file names and tables."""
    hidden, leaky_rate, learning_rate = point
    return f"h{shape_name(hidden)}_a{leaky_rate:g}_r{learning_rate:g}"


def row_name(config: TrainConfig) -> str:
    """The same of a member."""
    return point_name((config.reward.hidden, config.leaky_rate, config.learning_rate))


def member_name(config: TrainConfig) -> str:
    """A configuration with its seed."""
    return f"{row_name(config)}_s{config.seed}"


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
    # training runs of each configuration, with seeds 0, 1, ...
    seeds: int
    # share of the training scenes to choose by
    validation: float = 0.2
    # training scenes used at most, drawn by vehicle (0: all)
    scenes: int = 0
    # metric of the choice
    choose_by: str = "top1_fde"
    # s at which distances are taken
    horizon_s: float = 5.0
    # configurations that Optuna proposes within the grid's bounds (0: the whole grid)
    trials: int = 0
    # the configurations to train, instead of the grid
    points: tuple[Point, ...] = ()

    def __post_init__(self) -> None:
        """Reject values out of range and what is no grid."""
        if self.choose_by not in CHOICES:
            raise InputError(f"choose_by: {self.choose_by}: expected one of {CHOICES}")
        if not 0.0 < self.validation <= 0.5:
            raise InputError(f"validation: {self.validation}: expected 0 to 0.5")
        if not 0.0 < self.horizon_s <= 8.0:
            raise InputError(
                f"horizon_s: {self.horizon_s}: expected above 0, at most 8 s"
            )
        for name, low in (("seeds", 1), ("scenes", 0), ("trials", 0)):
            if getattr(self, name) < low:
                raise InputError(f"{name}: {getattr(self, name)}: expected >= {low}")
        self._check_grid()

    def _check_grid(self) -> None:
        """Reject empty lists, equal members, too many, and no weights file's."""
        self.base.reward.check_own()
        if self.base.loss != "rank" and len(self.leaky_rates) > 1:
            raise InputError(
                f"leaky_rates: {list(self.leaky_rates)}: expected one value: only "
                "loss=rank has a leaky rate"
            )
        for name in ("hidden_sizes", "leaky_rates", "learning_rates"):
            found = getattr(self, name)
            if not found:
                raise InputError(f"{name}: none: expected at least one value")
        grid = (self.hidden_sizes, self.leaky_rates, self.learning_rates)
        if self.trials and all(len(set(axis)) == 1 for axis in grid):
            raise InputError(
                f"trials: {self.trials}: expected two values or more of leaky_rates, "
                "learning_rates or hidden_sizes: bounds to search in"
            )
        if max(math.prod(map(len, grid)), self.trials) * self.seeds > MOST_MEMBERS:
            raise InputError(
                f"seeds: {self.seeds}: expected a sweep of at most {MOST_MEMBERS} "
                "trainings"
            )
        names = [member_name(one) for one in self.members()]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"sweep: {twice}: twice: expected distinct values")

    def shared(self, hidden: Hidden) -> TrainConfig:
        """What all members of a group share."""
        reward = dataclasses.replace(self.base.reward, hidden=hidden)
        return dataclasses.replace(self.base, reward=reward)

    def group(self, hidden: Hidden) -> list[TrainConfig]:
        """The members of one network shape."""
        grid = itertools.product((hidden,), self.leaky_rates, self.learning_rates)
        return [
            dataclasses.replace(
                self.shared(hidden), leaky_rate=a, learning_rate=rate, seed=seed
            )
            for shape, a, rate in self.points or grid
            for seed in range(self.seeds)
            if shape == hidden
        ]

    def members(self) -> list[TrainConfig]:
        """All members, group by group."""
        return [one for hidden in self.shapes for one in self.group(hidden)]

    @property
    def shapes(self) -> tuple[Hidden, ...]:
        """The network shapes that are trained."""
        proposed = tuple(dict.fromkeys(shape for shape, _, _ in self.points))
        return proposed or self.hidden_sizes

    @property
    def setup(self) -> RankingSetup:
        """How held-out scenes are ranked."""
        return RankingSetup(
            preset=self.base.features,
            sampler=self.base.sampler,
            horizon_s=self.horizon_s,
        )


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Some trained members of a group (numpy)."""

    hidden: Hidden
    members: tuple[TrainConfig, ...]  # [m]
    params: RewardParams  # leaves [m, ...]
    normaliser: Normaliser
    seen: np.ndarray  # [2, F] of `seen_range`
    loss: np.ndarray  # [m] mean of the last epoch
    wins: np.ndarray  # [m] share of pairs the positive wins, last epoch
    finite: np.ndarray  # [m] no step was refused for a NaN or infinity
    seconds: float  # wall time, with compiling
    compile_s: tuple[float, ...]  # of each compile


def open_split(
    config: SweepConfig, *, verify: bool = True
) -> tuple[Demonstrations, Resplit, str]:
    """(all data; splits "train", "validation", "test"; what the cut goes by)."""
    dataset = open_datasets(config.data, verify=verify)
    seed = config.base.seed
    part = subsample(dataset, config.scenes, seed) if config.scenes else dataset
    return dataset, *with_validation(part, config.validation, seed)


@functools.lru_cache(maxsize=1)
def _scenes(config: SweepConfig) -> tuple[FeatureBatch, Normaliser, np.ndarray]:
    """Candidates of the scenes to fit and their ranges, made once per process."""
    split = open_split(config, verify=False)[1]
    frozen = freeze(split.load("train"), split.indices("train"), config.base)
    rows = fitting_rows(frozen, config.base)
    seen = seen_range(rows, feature_map(config.base.features))
    return frozen, normaliser_of(frozen, config.base), seen


def train_group(hidden: Hidden, config: SweepConfig) -> Iterator[Part]:
    """Train all members of one network shape, compiled once.

    Members go in equal chunks of at most MEMBERS_AT_ONCE; the last is filled up
    with repetitions, which are dropped.

    Args:
      hidden: the shape.
      config: the sweep.

    Yields:
      One part per chunk, in the order of `config.group(hidden)`.
    """
    frozen, normaliser, seen = _scenes(dataclasses.replace(config, points=()))
    members = config.group(hidden)
    size = -(-len(members) // -(-len(members) // MEMBERS_AT_ONCE))
    for start in range(0, len(members), size):
        taken = members[start : start + size]
        filled = [*taken, *[taken[-1]] * (size - len(taken))]
        begin = time.perf_counter()
        with compiles(PROGRAM) as compiled:
            fitted = fit(frozen, normaliser, config.shared(hidden), members_of(filled))
            count = len(taken)
            fitted = jax.tree.map(lambda x, n=count: np.asarray(x)[:n], fitted)
        yield Part(
            hidden=hidden,
            members=tuple(taken),
            params=fitted.params,
            normaliser=jax.tree.map(np.asarray, normaliser),
            seen=seen,
            loss=np.asarray(fitted.loss[:, -1]),
            wins=np.asarray(fitted.wins[:, -1]),
            finite=np.asarray(fitted.finite),
            seconds=time.perf_counter() - begin,
            compile_s=tuple(compiled),
        )


# row -> metric -> [R, S], runs are the seeds
Scores = Mapping[str, Mapping[str, np.ndarray]]


def held_out_scores(
    split: Demonstrations,
    name: str,
    runs: Mapping[str, Sequence[Scorer]],
    setup: RankingSetup,
    executor: Executor | None = None,
) -> tuple[Scores, ClusterBootstrap]:
    """Metrics of every row's runs on the scenes of a split, and their vehicles.

    Raises:
      InputError: no scene covers the horizon, or all are of one vehicle.
    """
    rows, index = covered_rows(split, name, setup.horizon_s)
    vehicles = ClusterBootstrap(np.asarray(rows.vehicle))
    scored = score_rows(rows, index, setup, numbered(runs), executor)
    outcomes = outcomes_of(scored, rows, setup)

    def of(key: str) -> dict[str, np.ndarray]:
        return scene_metrics(scored.values[key], scored.human_values[key], outcomes)

    scores = {}
    for row, scorers in runs.items():
        each = [of(f"{row}#{i}") for i in range(len(scorers))]
        scores[row] = {key: np.stack([one[key] for one in each]) for key in each[0]}
    return scores, vehicles


def estimates(
    scores: Mapping[str, np.ndarray], vehicles: ClusterBootstrap
) -> dict[str, Estimate]:
    """Mean over seeds and scenes of each reported metric, with intervals."""
    weights = _weights(scores)
    return {
        name: combine_seeds(scores[name], vehicles, weight=weights[name])
        for name in REPORTED
    }


def seed_means(
    scores: Mapping[str, np.ndarray], vehicles: ClusterBootstrap
) -> list[dict[str, float]]:
    """Mean over the scenes of each reported metric, seed by seed."""
    weights = _weights(scores)
    means = {name: vehicles.mean(scores[name], weights[name]) for name in REPORTED}
    count = len(means[REPORTED[0]])
    return [{name: float(x[i]) for name, x in means.items()} for i in range(count)]


def _weights(scores: Mapping[str, np.ndarray]) -> dict[str, np.ndarray | None]:
    """[S] weights of the scenes for each metric that has some."""
    by = {name: METRICS[name].weight for name in REPORTED}
    return {name: None if w is None else scores[w][0] for name, w in by.items()}


def best(values: Mapping[str, float], metric: str) -> str:
    """The name with the best value of a metric; the first of equals.

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
