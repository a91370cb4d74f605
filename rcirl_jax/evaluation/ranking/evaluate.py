"""The ranking report of exported rewards on a dataset's held-out split."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TypeVar

import jax
import numpy as np

from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.data.store.rows import check_some
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.metrics import (
    Outcomes,
    fit_temperature,
    oracle_scorer,
    random_scorer,
    scene_metrics,
)
from rcirl_jax.evaluation.ranking.report import RankingReport, build_report
from rcirl_jax.evaluation.ranking.score import (
    BASELINES,
    Baseline,
    PriorCostScorer,
    Scored,
    Scorer,
    covers,
    measure_scenes,
    score_scenes,
)
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.types import Demonstration

Run = TypeVar("Run")

TEMPERATURE_SCENES = 512  # training scenes on which NLL temperatures are fitted
RANDOM_RUNS = 5  # random orders averaged in the random row


@dataclasses.dataclass(frozen=True, kw_only=True)
class RankingSetup:
    """What all scorers share in one evaluation."""

    preset: str = "paper21"
    sampler: SamplerConfig = dataclasses.field(default_factory=SamplerConfig)
    horizon_s: float = 5.0  # s
    split: str = "test"
    # what scorers see of the others' future (`train.state.FUTURES`); crashes are
    # always judged by the record
    futures: str = "predicted"
    # rank only among candidates that meet nothing: the same safety filter for all
    drop_collisions: bool = False
    # further hand-set costs and drivers that are ranked: row -> runs
    tuned: Mapping[str, Sequence[Baseline]] = dataclasses.field(default_factory=dict)


def covered_rows(
    dataset: Demonstrations, split: str, horizon_s: float
) -> tuple[Demonstration, np.ndarray]:
    """Scenes of a split whose recording covers the horizon, and their rows.

    Raises:
      InputError: there is none.
    """
    rows, index = dataset.load(split), dataset.indices(split)
    check_some(f"split {split}", index)
    keep = np.flatnonzero(covers(rows, horizon_s))
    if keep.size == 0:
        raise InputError(
            f"horizon_s: {horizon_s:g}: no scene of split {split} is recorded so "
            "long: expected a shorter horizon"
        )
    return jax.tree.map(lambda x: x[keep], rows), index[keep]


def outcomes_of(scored: Scored, rows: Demonstration, setup: RankingSetup) -> Outcomes:
    """Outcomes of all candidates, for the metrics of the scored scenes."""
    feasible = scored.feasible
    if setup.drop_collisions:
        feasible = feasible & ~scored.crash
    return Outcomes(
        fde=scored.fde,
        ade=scored.ade,
        crash=scored.crash,
        feasible=feasible,
        cluster=np.asarray(rows.vehicle),
        human_crash=scored.human_crash,
        horizon_s=setup.horizon_s,
    )


def _temperatures(
    dataset: Demonstrations,
    setup: RankingSetup,
    scorers: Mapping[str, Scorer | PriorCostScorer],
    executor: Executor | None,
) -> dict[str, float]:
    """Scale of each row's values, fitted on TRAINING scenes."""
    rows, index = covered_rows(dataset, "train", setup.horizon_s)
    chosen = np.random.default_rng(0).permutation(index.size)[:TEMPERATURE_SCENES]
    rows, index = jax.tree.map(lambda x: x[chosen], rows), index[chosen]
    scored = score_rows(rows, index, setup, scorers, executor)
    outcomes = outcomes_of(scored, rows, setup)
    values = {
        **scored.values,
        "random": random_scorer(RANDOM_RUNS, scored.fde.shape)[0],
        "oracle": oracle_scorer(outcomes)[0],
    }
    return {name: fit_temperature(v, outcomes) for name, v in values.items()}


def numbered(rows: Mapping[str, Sequence[Run]]) -> dict[str, Run]:
    """Every run as a row of its own: row -> runs becomes "row#0" -> run, ..."""
    return {f"{n}#{i}": x for n, runs in rows.items() for i, x in enumerate(runs)}


def score_rows(
    rows: Demonstration,
    index: np.ndarray,
    setup: RankingSetup,
    scorers: Mapping[str, Scorer | PriorCostScorer],
    executor: Executor | None = None,
) -> Scored:
    """`score_scenes` of a setup; its tuned baselines by the names of `numbered`."""
    return score_scenes(
        rows,
        index,
        preset=setup.preset,
        sampler=setup.sampler,
        horizon_s=setup.horizon_s,
        scorers=scorers,
        futures=setup.futures,
        tuned=numbered(setup.tuned),
        executor=executor,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ranked:
    """All rows on the same S held-out scenes; what a report is made of."""

    # row -> one `scene_metrics` per run, metric -> [S]
    table: Mapping[str, Sequence[Mapping[str, np.ndarray]]]
    outcomes: Outcomes
    group: np.ndarray  # [S] int, vehicle-disjoint group


def rank_scenes(
    dataset: Demonstrations,
    learned: Mapping[str, Sequence[Scorer | PriorCostScorer]],
    setup: RankingSetup,
    executor: Executor | None = None,
) -> Ranked:
    """Rank the held-out scenes with learned rewards beside all baselines.

    Rows: every learned reward (its runs are seeds), random, constant speed, IDM,
    hand-set (Apollo's lattice weights), hand-set DP (those of its speed DP), further
    hand-set costs of the setup and the oracle, on the same candidates.

    Args:
      dataset: an open dataset.
      learned: row name -> one scorer per training run.
      setup: features, sampler, horizon, split.
      executor: where scenes are scored; default: this process.

    Raises:
      InputError: no scene of the split covers the horizon.
    """
    flat = numbered(learned)
    rows, index = covered_rows(dataset, setup.split, setup.horizon_s)
    temperatures = _temperatures(dataset, setup, flat, executor)
    scored = score_rows(rows, index, setup, flat, executor)
    outcomes = outcomes_of(scored, rows, setup)

    def metrics(name: str) -> dict[str, np.ndarray]:
        values, human = scored.values[name], scored.human_values[name]
        return scene_metrics(values, human, outcomes, temperatures[name])

    shape = scored.fde.shape

    def runs(some: Mapping[str, Sequence[object]]) -> dict[str, list[dict]]:
        return {
            n: [metrics(f"{n}#{i}") for i in range(len(r))] for n, r in some.items()
        }

    table = runs(learned)
    table["random"] = [
        scene_metrics(*random_scorer(seed, shape), outcomes, temperatures["random"])
        for seed in range(RANDOM_RUNS)
    ]
    table |= {name: [metrics(name)] for name in BASELINES} | runs(setup.tuned)
    best = oracle_scorer(outcomes)
    table["oracle"] = [scene_metrics(*best, outcomes, temperatures["oracle"])]
    return Ranked(table=table, outcomes=outcomes, group=np.asarray(rows.group))


def pooled(parts: Sequence[Ranked]) -> Ranked:
    """The scenes of several splits of one dataset in one table.

    Run r of a row is run r of every part. Rewards and temperatures are each part's
    own, so every scene is judged by what has not seen it.

    Args:
      parts: of `rank_scenes`, with the same rows, runs, candidates and horizon.
    """
    join = lambda *x: np.concatenate(x)  # noqa: E731
    first = parts[0].outcomes
    arrays = ("fde", "ade", "crash", "feasible", "cluster", "human_crash")
    several = {
        name: join(*(getattr(part.outcomes, name) for part in parts)) for name in arrays
    }
    # by name, for a tree map would sort the rows
    table = {
        row: jax.tree.map(join, *(list(part.table[row]) for part in parts))
        for row in parts[0].table
    }
    return Ranked(
        table=table,
        outcomes=dataclasses.replace(first, **several),
        group=join(*(part.group for part in parts)),
    )


def report_of(ranked: Ranked, references: Sequence[str] | None = None) -> RankingReport:
    """Estimates and paired differences; see `build_report`."""
    return build_report(
        ranked.table, ranked.outcomes, group=ranked.group, references=references
    )


def evaluate_ranking(
    dataset: Demonstrations,
    learned: Mapping[str, Sequence[Scorer | PriorCostScorer]],
    setup: RankingSetup,
    executor: Executor | None = None,
    references: Sequence[str] | None = None,
) -> RankingReport:
    """The report of `rank_scenes`.

    Args:
      dataset: as there.
      learned: as there.
      setup: as there.
      executor: as there.
      references: rows that the others are compared with; default: the usual baselines.

    Raises:
      InputError: no scene of the split covers the horizon.
    """
    return report_of(rank_scenes(dataset, learned, setup, executor), references)


def oracle_floor(dataset: Demonstrations, setup: RankingSetup, max_scenes: int) -> dict:
    """How close the best candidate comes to the human, over all splits.

    Reads no more scenes at once than `max_scenes`, drawn at random. Makes no
    features: those of a broken scene are named by training and ranking.

    Returns:
      mode, horizon, scenes, mean and median FDE and ADE [m] of the best
      feasible candidate, share of scenes without a feasible one.

    Raises:
      InputError: no scene is recorded up to the horizon.
    """
    order, parts = np.random.default_rng(0).permutation(dataset.indices(None)), []
    while order.size and sum(map(len, parts)) < max_scenes:
        some, order = order[:max_scenes], order[max_scenes:]
        parts.append(some[covers(dataset.read(some), setup.horizon_s)])
    keep = np.sort(np.concatenate(parts)[:max_scenes])
    if not keep.size:
        raise InputError(
            f"horizon_s: {setup.horizon_s}: no scene is recorded that long: "
            "expected a shorter one"
        )
    near = measure_scenes(
        dataset.read(keep),
        keep,
        sampler=setup.sampler,
        horizon_s=setup.horizon_s,
        futures=setup.futures,
    )
    fde = np.where(near.feasible, near.fde, np.inf).min(axis=1)
    ade = np.where(near.feasible, near.ade, np.inf).min(axis=1)
    some = np.isfinite(fde)
    return {
        "mode": setup.sampler.mode,
        "horizon_s": setup.horizon_s,
        "scenes": int(keep.size),
        "candidates": int(near.fde.shape[1]),
        "best_fde_mean_m": float(fde[some].mean()),
        "best_fde_median_m": float(np.median(fde[some])),
        "best_ade_mean_m": float(ade[some].mean()),
        "nothing_feasible": float(1.0 - some.mean()),
    }
