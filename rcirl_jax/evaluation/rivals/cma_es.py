"""A black-box tuner with a counted budget: CMA-ES with restarts.

The rival a sceptic names: tune the weights of the hand-set cost directly, on the
number that counts, with as many queries as the learner had. A query is one
candidate of one scene looked at.

Source: Hansen, The CMA Evolution Strategy: A Tutorial (arXiv:1604.00772), by the
package `cma`; restarts with twice the population of Auger and Hansen (CEC 2005).
"""

import dataclasses
import math
import time
from collections.abc import Callable

import numpy as np
import tqdm
from numpy.typing import ArrayLike

from rcirl_jax.errors import InputError

Objective = Callable[[np.ndarray], np.ndarray]  # vectors [n, d] -> [n], low is good

# quiet: no files, no output, no signals file; the only random numbers are ours
_QUIET = {"verbose": -10, "verb_log": 0, "verb_disp": 0, "seed": math.nan}


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuneResult:
    """What a search leaves."""

    vector: np.ndarray  # [d] the best evaluated
    value: float  # its objective
    # after the start and after every generation: evaluations, restart, the best
    # value so far, the generation's median, the step size before it
    history: tuple[dict[str, float], ...]
    evaluations: int  # vectors evaluated, at most the budget
    seconds: float  # wall time
    method: str  # name and version of the search


def equal_budget(
    *, scenes: int, candidates: int, epochs: int, queries_per_evaluation: int
) -> int:
    """Evaluations that take the tuner as many queries as a learner's training.

        budget = floor(S K E / Q),  and floor(S E / S') where Q = S' K

    The learner compares K candidates with the human in each of S scenes, E times;
    an evaluation of one weight vector looks at Q candidates.

    Args:
      scenes: S, training scenes of the learner.
      candidates: K per scene.
      epochs: E.
      queries_per_evaluation: Q, such as S' K on S' scenes, or all plans of a suite
        times the candidates of a plan.

    Raises:
      InputError: less than one evaluation.
    """
    budget = scenes * candidates * epochs // queries_per_evaluation
    if budget < 1:
        raise InputError(
            f"--epochs: {epochs}: {scenes * candidates * epochs:,} queries: expected at"
            f" least the {queries_per_evaluation:,} of one evaluation"
        )
    return budget


def tune(
    objective: Objective,
    start: ArrayLike,
    sigma: float,
    budget: int,
    seed: int,
    progress: bool = True,
) -> TuneResult:
    """Minimise a batch objective by CMA-ES; the same seed gives the same result.

    The start is evaluated first, so the result is never worse. Where the search
    converges with budget left it starts again with twice the population. Values
    that are not finite count as the worst of their generation.

    Args:
      objective: [n, d] -> [n], lower is better; deterministic.
      start: [d] first mean, d >= 2.
      sigma: first standard deviation in every direction, in units of the vector.
      budget: most vectors that may be evaluated.
      seed: non-negative; numpy's global state is neither read nor set.
      progress: show a bar.

    Raises:
      InputError: the package `cma` is missing, a budget below 1, a sigma that is
        not positive, or no finite value at all.
    """
    cma = _package()
    if budget < 1:
        raise InputError(f"--budget: {budget}: expected at least 1 evaluation")
    if not (np.isfinite(sigma) and sigma > 0.0):
        raise InputError(f"--sigma: {sigma}: expected above 0")
    first = np.asarray(start, np.float64)
    normal = np.random.Generator(np.random.Philox(seed)).standard_normal
    options = {**_QUIET, "randn": lambda *shape: normal(shape)}
    population, restart = 4 + int(3.0 * math.log(first.size)), 0
    with tqdm.tqdm(total=budget, desc="CMA-ES", disable=not progress) as bar:
        search = _Search(objective, budget, bar)
        search.log(search.evaluate(first[None]), sigma, restart)
        while search.left:
            size = {"popsize": population * 2**restart}
            strategy = cma.CMAEvolutionStrategy(first, sigma, {**options, **size})
            _one_run(strategy, search, restart)
            restart += 1
    if search.vector is None:
        raise InputError("tune: objective: nowhere finite: expected some finite value")
    return TuneResult(
        vector=search.vector,
        value=search.value,
        history=tuple(search.history),
        evaluations=search.used,
        seconds=time.perf_counter() - search.begin,
        method=f"CMA-ES, cma {cma.__version__}",
    )


def _package():  # noqa: ANN202  # the module
    try:
        import cma
    except ImportError as error:
        raise InputError(
            "--objective: needs the extra tune: pip install 'rcirl-jax[tune]'"
        ) from error
    return cma


def _one_run(strategy, search: "_Search", restart: int) -> None:  # noqa: ANN001  # cma
    """Generations until the strategy has converged or the budget is spent."""
    while search.left and not strategy.stop():
        sigma = float(strategy.sigma)
        # the last generation may be cut short: then there is nothing to tell
        asked = strategy.ask(min(strategy.popsize, search.left))
        values = search.evaluate(np.asarray(asked))
        if len(asked) == strategy.popsize:
            strategy.tell(asked, values.tolist())
        search.log(values, sigma, restart)


class _Search:
    """The budget, the best vector and the history."""

    def __init__(self, objective: Objective, budget: int, bar: tqdm.tqdm) -> None:
        self.objective, self.budget, self.bar = objective, budget, bar
        self.used, self.history = 0, []
        self.vector: np.ndarray | None = None
        self.value = math.inf
        self.begin = time.perf_counter()

    @property
    def left(self) -> int:
        return self.budget - self.used

    def evaluate(self, vectors: np.ndarray) -> np.ndarray:
        """[n] finite values; those that were not are above all others."""
        found = np.asarray(self.objective(vectors), np.float64)
        if found.shape != vectors.shape[:1]:
            raise ValueError(f"objective: shape {found.shape}: expected {len(vectors)}")
        self.used += len(vectors)
        finite = np.isfinite(found)
        worst = found[finite].max(initial=0.0)
        best = int(np.argmin(np.where(finite, found, np.inf)))
        if finite.any() and found[best] < self.value:
            self.vector, self.value = vectors[best].copy(), float(found[best])
        self.bar.update(len(vectors))
        self.bar.set_postfix(best=f"{self.value:.4g}")
        return np.where(finite, found, worst + 1.0)

    def log(self, values: np.ndarray, sigma: float, restart: int) -> None:
        """One generation; a best of None says that nothing was finite so far."""
        self.history.append(
            {
                "evaluations": self.used,
                "restart": restart,
                "best": None if self.vector is None else self.value,
                "median": float(np.median(values)),
                "sigma": sigma,
            }
        )
