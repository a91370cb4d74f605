"""A black-box tuner with a counted budget: CMA-ES with restarts.

A fair baseline of a learner tunes a few parameters directly on the compared metric,
with as many queries as the learner had.

Source: Hansen, The CMA Evolution Strategy: A Tutorial (arXiv:1604.00772), by the
package `cma`; restarts with twice the population of Auger and Hansen (CEC 2005).
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from rcirl_jax.evaluation.baselines.counted import Counted, Objective, population

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

    normal = np.random.Generator(np.random.Philox(seed)).standard_normal
    options = {**_QUIET, "randn": lambda *shape: normal(shape)}
    evaluate = Counted(objective, start, budget)
    size = population(evaluate.start.size)
    while evaluate.left:
        search = cma.CMAEvolutionStrategy(
            evaluate.start, sigma, {**options, "popsize": size}
        )
        size *= 2
        while evaluate.left and not search.stop():
            # the last generation may be cut short: then there is nothing to tell
            asked = search.ask(min(search.popsize, evaluate.left))
            values = evaluate(np.asarray(asked))
            if len(asked) == search.popsize:
                search.tell(asked, values.tolist())
    return evaluate.result()
