"""Tune the hand-set cost's weights by CMA-ES: the rival with an equal budget.

    python -m experiments.tune_hand_set --data=DATASET --epochs=20 --output=tuned.json
    python -m experiments.tune_hand_set --objective=smoke --budget=200 --output=FILE

--epochs: as many queries as so many epochs of experiments.train on --data, split by
--holdout as in experiments.human_likeness. The file is a row of experiments.evaluate,
human_likeness and simulate (--hand_weights); files of several --seed are its runs.
Measured on one core: 17 s for a search of 10 epochs on US-101 (the chosen ends 8.8 m
from the human before, 4.5 to 5.1 after), 167 s for 97 evaluations of the smoke suite.
"""

import functools
from pathlib import Path

from absl import flags

from experiments.common import provenance, run
from experiments.holdout import split
from rcirl_jax.data.store.joined import Demonstrations, open_datasets
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup
from rcirl_jax.evaluation.rivals import objectives
from rcirl_jax.evaluation.rivals.tuned import SIGMA, TUNING_SCENES
from rcirl_jax.export.hand_weights import write_hand_weights
from rcirl_jax.sampling import SamplerConfig

_DATA = flags.DEFINE_list("data", [], "datasets, of ranking and --epochs")
_OBJECTIVE = flags.DEFINE_enum(
    "objective", "ranking", ["ranking", "smoke"], "held-out: test split; other cases"
)
_BUDGET = flags.DEFINE_integer(
    "budget", 0, "evaluations of one weight vector at most", 0
)
_EPOCHS = flags.DEFINE_integer("epochs", 0, "instead: a learner's, same queries", 0)
_SCENES = flags.DEFINE_integer("scenes", TUNING_SCENES, "training scenes at most", 1)
_HORIZON = flags.DEFINE_float("horizon", 5.0, "s at which distances are taken")
_SUITE = flags.DEFINE_string("suite", "smoke", "smoke, or families with commas")
_CASES = flags.DEFINE_integer("cases", 1, "cases per family")
_DURATION = flags.DEFINE_float("duration", 20.0, "s per case")
_CATALOGUE = flags.DEFINE_integer(
    "catalogue_seed", 0, "of the cases; held-out: next", 0
)
_SIGMA = flags.DEFINE_float("sigma", SIGMA, "first spread of the log-weights")
_SEED = flags.DEFINE_integer("seed", 0, "of the search and the drawn scenes", 0)
_OUTPUT = flags.DEFINE_string("output", None, "JSON to write", required=True)


@functools.cache
def _data() -> Demonstrations:
    """--data, split by --holdout."""
    return split(open_datasets(_DATA.value))[0]


def _problem(held_out: bool) -> objectives.Problem:
    """What is tuned on, or what is not."""
    if _OBJECTIVE.value == "smoke":
        cases = (_SUITE.value, _CASES.value, _DURATION.value)
        return objectives.suite_problem(*cases, _CATALOGUE.value + held_out)
    name, count = ("test", None) if held_out else ("train", _SCENES.value)
    setup = RankingSetup(split=name, horizon_s=_HORIZON.value)
    return objectives.ranking_problem(_data(), setup, count, _SEED.value)


def main() -> None:
    """Flags -> one search."""
    budget, epochs, learner = _BUDGET.value, _EPOCHS.value, SamplerConfig()
    if (budget > 0) == (epochs > 0):
        raise InputError("--budget, --epochs: expected one of them, above 0")
    Path(_OUTPUT.value).parent.mkdir(parents=True, exist_ok=True)
    problem = _problem(False)
    if epochs > 0:
        budget = objectives.learner_budget(_data(), learner, epochs, problem)
    cost, facts = objectives.tune_hand_set(
        problem,
        _problem(True),
        budget=budget,
        sigma=_SIGMA.value,
        seed=_SEED.value,
    )
    if _OBJECTIVE.value == "ranking":
        facts["data_hash"] = _data().hash  # of the split too
    write_hand_weights(_OUTPUT.value, cost, {**facts, "made_by": provenance()})
    print(f"{facts['objective_is']}, low is better")
    for name, pair in facts["objective"].items():
        print(f"{name}: default {pair['default']:.4f}, tuned {pair['tuned']:.4f}")
    print(f"{facts['search']['evaluations']:,} evaluations: {_OUTPUT.value}")


if __name__ == "__main__":
    run(main)
