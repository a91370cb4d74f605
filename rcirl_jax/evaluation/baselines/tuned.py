"""Baselines tuned on the learners' own training scenes, by the compared metric.

The hand-set cost and the Intelligent Driver Model have few parameters; a search
looks for those whose choices end nearest to the human. Rows:

    hand-set, tuned        eight weights, as many queries as a learner's training
    hand-set, tuned long   the same with a stated number of evaluations
    IDM, tuned             five parameters, as many queries as a learner's training
"""

import dataclasses
from collections.abc import Iterable, Sequence

import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.evaluation.baselines import cma_es, tpe
from rcirl_jax.evaluation.baselines.counted import Search
from rcirl_jax.evaluation.baselines.objectives import (
    DRIVER,
    HAND_SET,
    Problem,
    Tunable,
    learner_budget,
    problem,
)
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup
from rcirl_jax.evaluation.ranking.score import Baseline
from rcirl_jax.planner.baselines import TUNED_IDM_ROW, Idm
from rcirl_jax.reward import LONG_ROW, TUNED_ROW

TUNING_SCENES = 256  # training scenes of a search with a learner's queries, at most
LONG_SCENES = 1024  # of the long search
SIGMA = 1.0  # first spread of the log-weights
SEARCHES: dict[str, Search] = {"cma": cma_es.tune, "optuna": tpe.tune}


def tuned_baselines(
    dataset: Demonstrations,
    setup: RankingSetup,
    *,
    epochs: int,
    seeds: Sequence[int],
    long: int,
    search: str = "cma",
) -> dict[str, list[Baseline]]:
    """The three rows, one search per seed each.

    Args:
      dataset: the learners'; only its training split is read.
      setup: sampler and horizon of the comparison.
      epochs: the learners'; their queries are the budget of the first and last row.
      seeds: of the searches and their drawn scenes.
      long: evaluations of the long row; 0 leaves it out.
      search: one of `SEARCHES`.
    """
    own = dataclasses.replace(setup, split="train")
    # row -> what is tuned, scenes, evaluations
    searches = {
        TUNED_IDM_ROW: (DRIVER, TUNING_SCENES, 0),
        TUNED_ROW: (HAND_SET, TUNING_SCENES, 0),
        LONG_ROW: (HAND_SET, LONG_SCENES, long),
    }
    if not long:
        del searches[LONG_ROW]
    found: dict[str, list[Baseline]] = {row: [] for row in searches}
    for row, (kind, scenes, evaluations) in searches.items():
        for seed in seeds:
            made = problem(kind, dataset, own, scenes, seed)
            budget = evaluations or learner_budget(dataset, setup.sampler, epochs, made)
            found[row].append(_best(kind, made, budget, seed, search))
    return found


def _best(
    kind: Tunable, made: Problem, budget: int, seed: int, search: str
) -> Baseline:
    """The baseline that a search finds."""
    start = np.zeros(len(kind.names))
    best, _ = SEARCHES[search](made.objective, start, SIGMA, budget, seed)
    return kind.baseline(jnp.asarray(best, jnp.float32))


def tune_idm(
    dataset: Demonstrations,
    setup: RankingSetup,
    evaluations: int = 300,
    search: str = "cma",
) -> Idm:
    """The driver model that ends nearest to the humans of the training split.

    Args:
      dataset: only its training split is read.
      setup: sampler, horizon and what is seen of the others.
      evaluations: of the search.
      search: one of `SEARCHES`.
    """
    own = dataclasses.replace(setup, split="train")
    made = problem(DRIVER, dataset, own, LONG_SCENES)
    found = _best(DRIVER, made, evaluations, 0, search).fields()
    return Idm(**{name: float(value) for name, value in found.items()})


def as_numbers(baselines: Iterable[Baseline]) -> list[dict[str, float]]:
    """The parameters of each, for a JSON file."""
    return [
        {n: float(x) for n, x in baseline.fields().items()} for baseline in baselines
    ]
