"""Each learner at its own step size, trained to a plateau: what a comparison needs.

A comparison at one step size measures the step size too. Here every learner gets the
one that serves it best on validation scenes, and enough steps.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from absl import flags

from experiments.paper.common import QUICK, base, epochs
from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.data.store.splits import with_validation
from rcirl_jax.evaluation.ranking.evaluate import covered_rows
from rcirl_jax.evaluation.ranking.learners import FrozenSets, Learned, train_members
from rcirl_jax.evaluation.ranking.metrics import scene_metrics
from rcirl_jax.evaluation.ranking.score import RankingSetup, score_scenes
from rcirl_jax.train.metrics import plateau_warning
from rcirl_jax.train.state import TrainConfig

STEPS = flags.DEFINE_integer(
    "steps", 2000, "least steps of a training, whatever --epochs says", lower_bound=0
)
# step sizes that are tried
RATES = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 0.9)
SEEDS = 2  # trainings of each


def enough_epochs(data: Demonstrations, batch_size: int) -> int:
    """Passes over the training scenes of a dataset that make --steps, or more."""
    if QUICK.value:
        return epochs()
    batches = -(-data.indices("train").size // batch_size)
    return max(epochs(), -(-STEPS.value // batches))


@dataclasses.dataclass(frozen=True, kw_only=True)
class StepSize:
    """A learner's step size, chosen on validation scenes alone."""

    chosen: float
    # rate that trains -> mean distance of the chosen candidate from the human, m
    distance: Mapping[float, float]
    # the best is the smallest or largest of those tried: a better one may lie beyond
    is_at_the_end: bool


def with_chosen_rates(
    data: Demonstrations, configs: Mapping[str, TrainConfig]
) -> tuple[dict[str, TrainConfig], dict[str, StepSize]]:
    """Gives each learner the step size that serves it best on validation scenes.

    A quarter of the training scenes, of other vehicles, is held out of training; every
    rate of `RATES` is trained with two seeds as members of one program, and the one
    whose chosen candidates end nearest to the humans at 5 s is taken.

    Args:
      data: the learners'; its test split is not looked at.
      configs: by row.

    Returns:
      The configurations with their rates, and how each was found.
    """
    rates = (RATES[1], RATES[-1]) if QUICK.value else RATES
    split, _ = with_validation(data, 0.25, 0)
    sets, told = FrozenSets(split), base()
    setup = RankingSetup(preset=told.features, sampler=told.sampler, split="validation")
    rows, index = covered_rows(split, "validation", setup.horizon_s)
    made, found = {}, {}
    for name, config in configs.items():
        own = dataclasses.replace(
            config, epochs=enough_epochs(split, config.batch_size)
        )
        members = [
            dataclasses.replace(own, learning_rate=rate, seed=seed)
            for rate in rates
            for seed in range(SEEDS)
        ]
        runs = train_members(sets.of(own), own, members)
        scored = score_scenes(
            rows, index, setup, {f"{i}": run.scorer for i, run in enumerate(runs)}
        )
        ends = [
            np.mean(
                scene_metrics(
                    scored.values[f"{i}"], scored.human_values[f"{i}"], scored.outcomes
                )["top1_fde_failure"]
            )
            for i, run in enumerate(runs)
        ]
        trains = np.all(np.reshape([run.finite for run in runs], (-1, SEEDS)), axis=1)
        means = np.reshape(ends, (-1, SEEDS)).mean(axis=1)
        distance = {
            rate: float(mean)
            for rate, mean, fine in zip(rates, means, trains.tolist(), strict=True)
            if fine
        }
        best = min(distance, key=lambda rate: distance[rate])
        found[name] = StepSize(
            chosen=best, distance=distance, is_at_the_end=best in (rates[0], rates[-1])
        )
        said = ", ".join(f"{rate:g} {x:.2f} m" for rate, x in distance.items())
        end = "; the last of those tried" if found[name].is_at_the_end else ""
        print(f"{name}: step size {best:g} of {said}{end}", flush=True)
        made[name] = dataclasses.replace(
            config, learning_rate=best, epochs=enough_epochs(data, config.batch_size)
        )
    return made, found


def plateau_warnings(learned: Mapping[str, Sequence[Learned]]) -> dict[str, list[str]]:
    """Says and returns, by row, which of its trainings ended before a plateau."""
    found = {
        name: [said for one in runs if (said := plateau_warning(one.step_loss))]
        for name, runs in learned.items()
    }
    for name, said in found.items():
        if said:
            print(f"warning: {name}: {len(said)} of its runs: {said[0]}")
    return found
