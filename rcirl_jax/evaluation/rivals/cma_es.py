"""A black-box tuner with a counted budget: CMA-ES with restarts.

A fair rival of a learner tunes a few parameters directly on the compared metric, with
as many queries as the learner had.

Source: Hansen, The CMA Evolution Strategy: A Tutorial (arXiv:1604.00772), by the
package `cma`; restarts with twice the population of Auger and Hansen (CEC 2005).
"""

import math
from collections.abc import Callable

import numpy as np
import tqdm
from numpy.typing import ArrayLike

from rcirl_jax.errors import InputError

Objective = Callable[[np.ndarray], np.ndarray]  # vectors [n, d] -> [n], low is good

# quiet: no files, no output, no signals file; the only random numbers are ours
_QUIET = {"verbose": -10, "verb_log": 0, "verb_disp": 0, "seed": math.nan}


def tune(
    objective: Objective, start: ArrayLike, sigma: float, budget: int, seed: int
) -> tuple[np.ndarray, float]:
    """Minimise a batch objective by CMA-ES; the same seed gives the same result.

    The start is evaluated first, so the result is never worse. Where the search
    converges with budget left it starts again with twice the population. Values
    that are not finite count as the worst of their generation.

    Args:
      objective: [n, d] -> [n], lower is better; deterministic.
      start: [d] first mean, d >= 2.
      sigma: first standard deviation in every direction, in units of the vector.
      budget: vectors that are evaluated, at least 1.
      seed: non-negative; numpy's global state is neither read nor set.

    Returns:
      The best vector [d] and its value.

    Raises:
      InputError: no value is finite.
    """
    import cma  # a second, which only tuning takes

    best, lowest, used = np.asarray(start, np.float64), math.inf, 0
    normal = np.random.Generator(np.random.Philox(seed)).standard_normal
    options = {**_QUIET, "randn": lambda *shape: normal(shape)}
    first, population = best, 4 + int(3.0 * math.log(best.size))

    def evaluate(vectors: np.ndarray) -> np.ndarray:
        """[n] finite values; those that were not are above all others."""
        nonlocal best, lowest, used
        found = np.asarray(objective(vectors), np.float64)
        finite = np.isfinite(found)
        at = int(np.argmin(np.where(finite, found, np.inf)))
        if finite[at] and found[at] < lowest:
            best, lowest = vectors[at].copy(), float(found[at])
        used += len(vectors)
        bar.update(len(vectors))
        bar.set_postfix(best=f"{lowest:.4g}")
        return np.where(finite, found, found[finite].max(initial=0.0) + 1.0)

    with tqdm.tqdm(total=budget, desc="tune a rival", unit="try") as bar:
        evaluate(first[None])
        while used < budget:
            search = cma.CMAEvolutionStrategy(
                first, sigma, {**options, "popsize": population}
            )
            population *= 2
            while used < budget and not search.stop():
                # the last generation may be cut short: then there is nothing to tell
                asked = search.ask(min(search.popsize, budget - used))
                values = evaluate(np.asarray(asked))
                if len(asked) == search.popsize:
                    search.tell(asked, values.tolist())
    if not math.isfinite(lowest):
        raise InputError("tune: objective: nowhere finite: expected some finite value")
    return best, lowest
