"""A black-box tuner with a counted budget: Optuna's tree-structured Parzen estimator.

Beside CMA-ES, for whoever trusts another search more. Source: Bergstra et al.,
Algorithms for Hyper-Parameter Optimization (NeurIPS 2011), by the package `optuna`.
"""

import warnings
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from rcirl_jax.errors import extra_module
from rcirl_jax.evaluation.baselines.counted import Counted, Objective, population

if TYPE_CHECKING:
    import optuna  # an extra

REACH = 4.0  # standard deviations to either side that are searched


def new_study(seed: int, direction: str = "minimize") -> "optuna.Study":
    """A study in memory that may be asked for several trials before it is told."""
    optuna = extra_module("optuna", "optuna")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with warnings.catch_warnings():  # of its options that may change
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        sampler = optuna.samplers.TPESampler(
            seed=seed, multivariate=True, constant_liar=True
        )
    return optuna.create_study(sampler=sampler, direction=direction)


def tune(
    objective: Objective, start: ArrayLike, sigma: float, budget: int, seed: int
) -> tuple[np.ndarray, float]:
    """Minimise a batch objective by TPE, asked and told in batches.

    Arguments, result and errors as of `cma_es.tune`, but for `sigma`: the search is in
    a box of `REACH` times as much to either side of the start.
    """
    study = new_study(seed)
    import optuna

    evaluate = Counted(objective, start, budget)
    names = [f"x{i}" for i in range(evaluate.start.size)]
    space: dict[str, optuna.distributions.BaseDistribution] = {
        name: optuna.distributions.FloatDistribution(
            at - REACH * sigma, at + REACH * sigma
        )
        for name, at in zip(names, evaluate.start.tolist(), strict=True)
    }
    first = dict(zip(names, evaluate.start.tolist(), strict=True))
    study.add_trial(
        optuna.trial.create_trial(
            params=first, distributions=space, value=evaluate.at_start
        )
    )
    while evaluate.left:
        count = min(population(len(names)), evaluate.left)
        trials = [study.ask(space) for _ in range(count)]
        asked = np.array([[trial.params[name] for name in names] for trial in trials])
        for trial, value in zip(trials, evaluate(asked).tolist(), strict=True):
            study.tell(trial, value)
    return evaluate.result()
