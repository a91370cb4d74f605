"""A search's budget: what it may evaluate, and the best that it has found."""

import math
from collections.abc import Callable

import numpy as np
import tqdm
from numpy.typing import ArrayLike

from rcirl_jax.errors import InputError

Objective = Callable[[np.ndarray], np.ndarray]  # vectors [n, d] -> [n], low is good
# (objective, start, sigma, budget, seed) -> best vector [d] and its value; see `cma_es`
Search = Callable[[Objective, ArrayLike, float, int, int], tuple[np.ndarray, float]]


def population(size: int) -> int:
    """Vectors of a generation, as Hansen's tutorial has it."""
    return 4 + int(3.0 * math.log(size))


class Counted:
    """An objective with a budget; the start is evaluated first."""

    def __init__(self, objective: Objective, start: ArrayLike, budget: int) -> None:
        """Evaluate `start` [d]; `budget` is at least 1."""
        self._objective = objective
        self._bar = tqdm.tqdm(total=budget, desc="tune a baseline", unit="try")
        self.left, self._lowest = budget, math.inf
        self.start = self._best = np.asarray(start, np.float64)
        self.at_start = float(self(self.start[None])[0])

    def __call__(self, vectors: np.ndarray) -> np.ndarray:
        """[n] finite values; those that were not are above all others."""
        found = np.asarray(self._objective(vectors), np.float64)
        finite = np.isfinite(found)
        at = int(np.argmin(np.where(finite, found, np.inf)))
        if finite[at] and found[at] < self._lowest:
            self._best, self._lowest = vectors[at].copy(), float(found[at])
        self.left -= len(vectors)
        self._bar.update(len(vectors))
        self._bar.set_postfix(best=f"{self._lowest:.4g}")
        return np.where(finite, found, found[finite].max(initial=0.0) + 1.0)

    def result(self) -> tuple[np.ndarray, float]:
        """The best vector [d] and its value.

        Raises:
          InputError: no value was finite.
        """
        self._bar.close()
        if not math.isfinite(self._lowest):
            raise InputError(
                "tune: objective: nowhere finite: expected some finite value"
            )
        return self._best, self._lowest
