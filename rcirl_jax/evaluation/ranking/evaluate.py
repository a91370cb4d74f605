"""Held-out scenes ranked with learned rewards beside all baselines."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import numpy as np

from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.data.store.rows import check_some
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.lanes import LaneOutcomes, lane_metrics
from rcirl_jax.evaluation.ranking.metrics import (
    fit_temperature,
    oracle_scorer,
    random_scorer,
    scene_metrics,
)
from rcirl_jax.evaluation.ranking.report import (
    Ranked,
    RankingReport,
    build_report,
    ranking_warnings,
)
from rcirl_jax.evaluation.ranking.score import (
    PriorCostScorer,
    RankingSetup,
    Scorer,
    covers,
    measure_scenes,
    numbered,
    score_scenes,
)
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.types import Demonstration

TEMPERATURE_SCENES = 512  # training scenes on which NLL temperatures are fitted
RANDOM_RUNS = 5  # random orders averaged in the random row


def covered_rows(
    dataset: Demonstrations, split: str, horizon_s: float
) -> tuple[Demonstration, np.ndarray]:
    """Returns scenes of a split whose recording covers the horizon, and their rows.

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


def rank_scenes(
    dataset: Demonstrations,
    learned: Mapping[str, Sequence[Scorer | PriorCostScorer]],
    setup: RankingSetup,
    executor: Executor | None = None,
) -> Ranked:
    """Ranks the held-out scenes with learned rewards beside all baselines.

    Rows: every learned reward (its runs are seeds), random, constant speed, IDM,
    hand-set (Apollo's lattice weights), hand-set DP (those of its speed DP), further
    hand-set costs of the setup and the oracle, on the same candidates. The scale of
    each row's values, for their likelihood, is fitted on TRAINING scenes.

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
    own, at = covered_rows(dataset, "train", setup.horizon_s)
    chosen = np.random.default_rng(0).permutation(at.size)[:TEMPERATURE_SCENES]
    own, at = jax.tree.map(lambda x: x[chosen], own), at[chosen]
    trained = score_scenes(own, at, setup, flat, executor)
    scored = score_scenes(rows, index, setup, flat, executor)

    def metrics(
        name: str, on_training: np.ndarray, values: np.ndarray, human: np.ndarray
    ) -> dict[str, np.ndarray]:
        if name not in temperatures:
            temperatures[name] = fit_temperature(on_training, trained.outcomes)
        found = scene_metrics(values, human, scored.outcomes, temperatures[name])
        if scored.lanes:
            found |= lane_metrics(values, scored.outcomes.feasible, scored.lanes)
        return found

    def of(name: str) -> dict[str, np.ndarray]:
        values = trained.values[name], scored.values[name], scored.human_values[name]
        return metrics(name, *values)

    def runs(some: Mapping[str, Sequence[object]]) -> dict[str, list[dict]]:
        return {n: [of(f"{n}#{i}") for i in range(len(r))] for n, r in some.items()}

    temperatures: dict[str, float] = {}
    shapes = [np.shape(x.outcomes.fde) for x in (trained, scored)]
    unknown = random_scorer(RANDOM_RUNS, shapes[0])[0]
    random = [
        metrics("random", unknown, *random_scorer(seed, shapes[1]))
        for seed in range(RANDOM_RUNS)
    ]
    best = oracle_scorer(trained.outcomes)[0], *oracle_scorer(scored.outcomes)
    table = {
        **runs(learned),
        "random": random,
        **{name: [of(name)] for name in setup.baselines},
        **runs(setup.tuned),
        "oracle": [metrics("oracle", *best)],
    }
    group = np.asarray(rows.group)
    return Ranked(
        table=table, outcomes=scored.outcomes, group=group, lanes=scored.lanes
    )


def pooled(parts: Sequence[Ranked]) -> Ranked:
    """Joins the scenes of several splits of one dataset in one table.

    Run r of a row is run r of every part. Rewards and temperatures are each part's
    own, so every scene is judged by what has not seen it.

    Args:
      parts: of `rank_scenes`, with the same rows, runs, candidates and horizon.
    """

    def join(*x: np.ndarray) -> np.ndarray:
        return np.concatenate(x)

    first = parts[0].outcomes
    arrays = [name for name, x in vars(first).items() if isinstance(x, np.ndarray)]
    several = {
        name: join(*(getattr(part.outcomes, name) for part in parts)) for name in arrays
    }
    # by name, for a tree map would sort the rows
    table = {
        row: jax.tree.map(join, *(list(part.table[row]) for part in parts))
        for row in parts[0].table
    }
    lanes = [part.lanes for part in parts if part.lanes]
    return Ranked(
        table=table,
        outcomes=dataclasses.replace(first, **several),
        group=join(*(np.asarray(part.group) for part in parts)),
        lanes=LaneOutcomes(
            jax.tree.map(join, *(x.candidates for x in lanes)),
            jax.tree.map(join, *(x.human for x in lanes)),
            first.horizon_s,
        )
        if lanes
        else None,
    )


def evaluate_ranking(
    dataset: Demonstrations,
    learned: Mapping[str, Sequence[Scorer | PriorCostScorer]],
    setup: RankingSetup,
    executor: Executor | None = None,
    references: Sequence[str] | None = None,
) -> RankingReport:
    """Makes the report of `rank_scenes`, whose arguments these are.

    Args:
      dataset: as there.
      learned: as there.
      setup: as there.
      executor: as there.
      references: rows that the others are compared with; default: the usual baselines.
    """
    ranked = rank_scenes(dataset, learned, setup, executor)
    report = build_report(ranked, references)
    easy = ("random", setup.own.name if setup.own else "hand-set")
    warnings = ranking_warnings(report, list(learned), easy)
    return dataclasses.replace(report, warnings=warnings)


def oracle_floor(dataset: Demonstrations, setup: RankingSetup, max_scenes: int) -> dict:
    """Measures how close the best candidate comes to the human, over all splits.

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
    near = measure_scenes(dataset.read(keep), keep, setup)
    fde, ade = (
        np.where(near.feasible, x, np.inf).min(axis=1) for x in (near.fde, near.ade)
    )
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
