"""A sweep whose configurations Optuna proposes, within the bounds of the grid's axes.

It proposes a round of them, they train side by side as a grid's do, and it learns their
values on the validation scenes before it proposes the next round.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rcirl_jax.errors import extra_module
from rcirl_jax.evaluation.baselines import new_study
from rcirl_jax.evaluation.ranking.metrics import METRICS
from rcirl_jax.evaluation.ranking.sweep import (
    Point,
    SweepConfig,
    point_name,
    shape_name,
)
from rcirl_jax.export.sweep.choice import Found

ROUND = 8  # configurations of a round
DIGITS = 3  # of a proposed rate: more would tell nothing, and lengthen names


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
