"""Baselines tuned on the learners' own training scenes, by the compared metric.

The hand-set cost and the Intelligent Driver Model have few parameters; a search looks
for those whose choices end nearest to the human, with as many queries (candidates
looked at) as a learner's training has. Rows:

    hand-set, tuned        eight weights, as many queries as a learner's training
    hand-set, tuned long   the same with a stated number of evaluations
    IDM, tuned             five parameters, as many queries as a learner's training
    own terms, by search   the weights of a user's own terms, at least as many queries

A vector of zeros is the usual baseline. Sources of the searches: Hansen, The CMA
Evolution Strategy: A Tutorial (arXiv:1604.00772), by the package `cma`, with restarts
of twice the population (Auger and Hansen, CEC 2005); beside it, for whoever trusts
another search more, Bergstra et al., Algorithms for Hyper-Parameter Optimization
(NeurIPS 2011), by the package `optuna`.
"""

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tqdm
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.errors import InputError, extra_module
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, covered_rows
from rcirl_jax.evaluation.ranking.score import Baseline, chunks, horizon_mask, measured
from rcirl_jax.features.terms import OwnTerms
from rcirl_jax.planner.baselines import (
    TUNED_IDM_ROW,
    Idm,
    closeness,
    idm_trajectory,
)
from rcirl_jax.planner.prediction import with_predicted_futures
from rcirl_jax.reward import (
    LONG_ROW,
    TUNABLE,
    TUNED_ROW,
    lattice_terms,
    tuned,
    weighted_cost,
)
from rcirl_jax.reward.hand import LatticeTerms
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.sampling.sampler import num_candidates
from rcirl_jax.types import Demonstration, Scene, Trajectory

if TYPE_CHECKING:
    import optuna  # an extra

TUNING_SCENES = 256  # training scenes of a search with a learner's queries, at most
LONG_SCENES = 1024  # of the long search
SIGMA = 1.0  # first spread of the log-weights
REACH = 4.0  # standard deviations to either side that TPE searches
POPULATION_CHUNK = 8  # vectors per device call; padded, so that it compiles once

# What a tuner may change of the driver model, in the order of its vector.
TUNABLE_IDM = ("headway", "standstill_gap", "acceleration", "braking", "speed_share")
TERMS_ROW = "own terms, by search"  # name of its row in all tables
LARGEST_IDM_LOG = 3.0  # a parameter is within a factor exp(3) = 20 of the usual one
LARGEST_TERM_LOG = 10.0  # a weight of an own term within exp(10) = 22,000 of today's

Objective = Callable[[np.ndarray], np.ndarray]  # vectors [n, d] -> [n], low is good
# yields vectors [n, d] that are to be evaluated, and is sent their values [n]
Proposals = Generator[np.ndarray, np.ndarray, None]


# ---------------------------------------------------------------- searches


def _by_cma_es(start: np.ndarray, _: float, sigma: float, seed: int) -> Proposals:
    import cma  # a second, which only tuning takes

    normal = np.random.Generator(np.random.Philox(seed)).standard_normal
    # quiet: no files, no output, no signals file; the only random numbers are ours
    options: dict[str, Any] = {
        "verbose": -10, "verb_log": 0, "verb_disp": 0, "seed": math.nan,
        "randn": lambda *shape: normal(shape), "popsize": _generation(start.size),
    }  # fmt: skip
    while True:
        search = cma.CMAEvolutionStrategy(start, sigma, options)
        while not search.stop():
            asked = search.ask()
            search.tell(asked, (yield np.asarray(asked)).tolist())
        options["popsize"] *= 2  # converged: again, and broader


def _generation(size: int) -> int:
    """Returns the number of vectors of a generation, as Hansen's tutorial has it."""
    return 4 + int(3.0 * math.log(size))


def new_study(seed: int, direction: str = "minimize") -> "optuna.Study":
    """Makes a study in memory that may be asked several times before it is told."""
    optuna = extra_module("optuna", "optuna")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with warnings.catch_warnings():  # of its options that may change
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        sampler = optuna.samplers.TPESampler(
            seed=seed, multivariate=True, constant_liar=True
        )
    return optuna.create_study(sampler=sampler, direction=direction)


def _by_tpe(start: np.ndarray, at_start: float, sigma: float, seed: int) -> Proposals:
    study = new_study(seed)
    import optuna

    first = {f"x{i}": at for i, at in enumerate(start.tolist())}
    reach, of = REACH * sigma, optuna.distributions.FloatDistribution
    space: dict[str, optuna.distributions.BaseDistribution] = {
        name: of(at - reach, at + reach) for name, at in first.items()
    }
    study.add_trial(
        optuna.trial.create_trial(params=first, distributions=space, value=at_start)
    )
    while True:
        trials = [study.ask(space) for _ in range(_generation(start.size))]
        asked = [[one.params[name] for name in first] for one in trials]
        values = yield np.array(asked)
        for trial, value in zip(trials, values.tolist(), strict=True):
            study.tell(trial, value)


SEARCHES = {"cma": _by_cma_es, "optuna": _by_tpe}


def tune(
    objective: Objective,
    start: ArrayLike,
    sigma: float,
    budget: int,
    seed: int,
    search: str = "cma",
) -> tuple[np.ndarray, float]:
    """Minimises a batch objective; the same seed gives the same result.

    The start is evaluated first, so the result is never worse. Values that are not
    finite count as the worst of their generation.

    Args:
      objective: [n, d] -> [n], lower is better; deterministic.
      start: [d] first mean, d >= 2.
      sigma: first standard deviation in every direction, in units of the vector; TPE
        searches in a box of `REACH` times as much to either side of the start.
      budget: vectors that are evaluated, at least 1.
      seed: non-negative; numpy's global state is neither read nor set.
      search: one of `SEARCHES`.

    Returns:
      The best vector [d] and its value.

    Raises:
      InputError: no value is finite.
    """
    best = np.asarray(start, np.float64)
    asked, proposals, left, lowest = best[None], None, budget, math.inf
    with tqdm.tqdm(total=budget, desc="tune a baseline", unit="try") as bar:
        while True:
            found = np.asarray(objective(asked), np.float64)
            finite = np.isfinite(found)
            at = int(np.argmin(np.where(finite, found, np.inf)))
            if finite[at] and found[at] < lowest:
                best, lowest = asked[at].copy(), float(found[at])
            left -= len(asked)
            bar.update(len(asked))
            bar.set_postfix(best=f"{lowest:.4g}")
            if not left:
                break
            values = np.where(finite, found, found[finite].max(initial=0.0) + 1.0)
            if proposals is None:
                begin = asked[0], float(values[0]), sigma, seed
                proposals = SEARCHES[search](*begin)
                asked = next(proposals)[:left]
            else:
                asked = proposals.send(values)[:left]
    if not math.isfinite(lowest):
        raise InputError("tune: objective: nowhere finite: expected some finite value")
    return best, lowest


# ---------------------------------------------------------------- objectives


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tunable:
    """A kind of baseline: its parameters, and how it values candidates."""

    names: tuple[str, ...]  # of the parameters, in the order of a vector
    baseline: Callable[[jax.Array], Any]  # of a vector [d], which may be traced
    # (scene, candidates [K, T], mask [T]) -> what the values need
    known: Callable[[Scene, Trajectory, jax.Array], Any]
    # (that, a baseline, whether candidates keep to the path) -> [K], higher is better
    values: Callable[[Any, Any, bool], jax.Array]


def idm_of(vector: Float[Array, " d"]) -> Idm:
    """Returns the driver model of a vector of logarithms; zeros are the usual one.

        parameter_i = usual_i exp(clip(x_i, -3, 3))

    Args:
      vector: [5] x, in the order of `TUNABLE_IDM`; may be traced.
    """
    usual = Idm()
    factor = jnp.exp(jnp.clip(vector, -LARGEST_IDM_LOG, LARGEST_IDM_LOG))
    changed = {n: getattr(usual, n) * factor[i] for i, n in enumerate(TUNABLE_IDM)}
    return dataclasses.replace(usual, **changed)


def _cost_terms(scene: Scene, candidates: Trajectory, mask: jax.Array) -> LatticeTerms:
    cut = scene.replace(time_valid=mask)
    return jax.vmap(lambda x: lattice_terms(cut, x))(candidates)


def _nearness(known: tuple, driver: Idm, on_path: bool) -> jax.Array:
    scene, candidates, mask = known
    way = idm_trajectory(scene, on_path, driver)
    return jax.vmap(lambda x: closeness(x, way, mask))(candidates)


HAND_SET = Tunable(
    names=TUNABLE,
    baseline=tuned,
    known=_cost_terms,
    values=lambda terms, cost, _: -jax.vmap(lambda x: weighted_cost(x, cost))(terms),
)
DRIVER = Tunable(
    names=TUNABLE_IDM,
    baseline=idm_of,
    known=lambda *known: known,
    values=_nearness,
)


@functools.cache
def of_own_terms(own: OwnTerms) -> Tunable:
    """Returns what may be tuned of own terms: their weights, today's at zeros.

        weight_i = today_i exp(clip(x_i, -10, 10)),   value = -sum_i weight_i sum_t f_i

    Args:
      own: the terms.
    """

    def sums(scene: Scene, candidates: Trajectory, mask: jax.Array) -> jax.Array:
        rows = jnp.stack(own.rows(scene, candidates), axis=-1)  # [T, K, F]
        return jnp.sum(jnp.where(mask[:, None, None], rows, 0.0), axis=0)

    def weights(vector: jax.Array) -> jax.Array:
        times = jnp.exp(jnp.clip(vector, -LARGEST_TERM_LOG, LARGEST_TERM_LOG))
        return jnp.asarray(own.weights, jnp.float32) * times

    return Tunable(
        names=own.names,
        baseline=weights,
        known=sums,
        values=lambda known, weights, _: -jnp.sum(known * weights, axis=-1),
    )


class ValuedScenes(NamedTuple):
    """S scenes with K candidates each, on device."""

    known: Any  # of `Tunable.known`, leaves [S, ...]
    fde: jax.Array  # [S, K] m
    feasible: jax.Array  # [S, K] bool


@functools.lru_cache(maxsize=8)
def _make_scenes(kind: Tunable, sampler: SamplerConfig, horizon_s: float) -> Callable:
    def one(index: jax.Array, demonstration: Demonstration) -> ValuedScenes:
        scene = demonstration.scene
        candidates, fde, _ = measured(index, demonstration, scene, sampler, horizon_s)
        mask = horizon_mask(scene, horizon_s)
        known = kind.known(scene, candidates.trajectory, mask)
        return ValuedScenes(known=known, fde=fde, feasible=candidates.feasible)

    return jax.jit(jax.vmap(one))


def valued_scenes(
    kind: Tunable,
    rows: Demonstration,
    index: np.ndarray,
    sampler: SamplerConfig,
    horizon_s: float,
) -> ValuedScenes:
    """Makes candidates, their distances and what a baseline needs, a few at a time.

    Args:
      kind: of the baseline.
      rows: S demonstrations (numpy) whose recorded future covers the horizon.
      index: [S] dataset rows; they seed the candidates.
      sampler: sampler configuration.
      horizon_s: s in (0, 8].
    """
    make = _make_scenes(kind, sampler, float(horizon_s))
    parts = [
        jax.tree.map(lambda x, keep=keep: x[:keep], make(at, taken))
        for taken, at, keep in chunks(rows, index)
    ]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def mean_fde(
    kind: Tunable, scenes: ValuedScenes, vectors: np.ndarray, *, on_path: bool = True
) -> np.ndarray:
    """Returns [n] m, mean FDE of the feasible candidate that each baseline values most.

    Args:
      kind: of the baselines.
      scenes: of `valued_scenes`.
      vectors: [n, d] their parameters, a few at a time.
      on_path: the candidates keep to the given path.
    """
    vectors, found = np.asarray(vectors, np.float32), []
    for start in range(0, len(vectors), POPULATION_CHUNK):
        picked = np.arange(start, start + POPULATION_CHUNK)
        some = jnp.asarray(vectors[np.minimum(picked, len(vectors) - 1)])
        found.append(np.asarray(_mean_fde(kind, on_path, scenes, some), np.float64))
    return np.concatenate(found)[: len(vectors)]


@functools.partial(jax.jit, static_argnums=(0, 1))
def _mean_fde(
    kind: Tunable, on_path: bool, scenes: ValuedScenes, vectors: jax.Array
) -> jax.Array:
    """Returns [n] m, scene by scene: fast on CPUs, and few sums in one fusion."""

    def of_scene(one: ValuedScenes) -> jax.Array:
        def of_vector(vector: jax.Array) -> jax.Array:
            values = kind.values(one.known, kind.baseline(vector), on_path)
            return one.fde[jnp.argmax(jnp.where(one.feasible, values, -jnp.inf))]

        return jax.vmap(of_vector)(vectors)

    return jnp.mean(jax.lax.map(of_scene, scenes), axis=0)


_seen = jax.jit(jax.vmap(with_predicted_futures))


def problem(
    kind: Tunable,
    dataset: Demonstrations,
    setup: RankingSetup,
    max_scenes: int,
    seed: int = 0,
) -> tuple[Objective, int]:
    """Makes the objective: mean FDE [m] of the candidate that a baseline values most.

    The candidates and distances are those of `evaluate_ranking`; like there, a scene
    without a feasible candidate is charged with candidate 0.

    Args:
      kind: of the baseline.
      dataset: an open dataset.
      setup: sampler, horizon, split; tune on "train" only. With `futures` of
        "predicted" baselines see what the planner sees.
      max_scenes: at most so many, drawn by the seed.
      seed: of the draw.

    Returns:
      The objective, and the candidates looked at in one evaluation of one vector.

    Raises:
      InputError: no scene of the split covers the horizon.
    """
    rows, index = covered_rows(dataset, setup.split, setup.horizon_s)
    chosen = np.random.default_rng(seed).permutation(index.size)[:max_scenes]
    chosen = np.sort(chosen)
    rows = jax.tree.map(lambda x: x[chosen], rows)
    if setup.futures == "predicted":
        rows = rows.replace(scene=jax.tree.map(np.asarray, _seen(rows.scene)))
    scenes = valued_scenes(kind, rows, index[chosen], setup.sampler, setup.horizon_s)
    on_path = setup.sampler.mode == "speed"
    objective = functools.partial(mean_fde, kind, scenes, on_path=on_path)
    return objective, int(scenes.fde.size)


# ---------------------------------------------------------------- rows


def _best(
    kind: Tunable, objective: Objective, budget: int, seed: int, search: str
) -> Any:  # noqa: ANN401
    start = np.zeros(len(kind.names))
    best, _ = tune(objective, start, SIGMA, budget, seed, search)
    return kind.baseline(jnp.asarray(best, jnp.float32))


def tuned_baselines(
    dataset: Demonstrations,
    setup: RankingSetup,
    *,
    epochs: int,
    seeds: Sequence[int],
    long: int,
    search: str = "cma",
) -> dict[str, list[Baseline]]:
    """Tunes the three rows, one search per seed each.

    A learner compares K candidates with the human in each of S scenes, E times; an
    evaluation of one vector looks at Q: the rows that have the queries of a learner's
    training are searched with floor(S K E / Q) evaluations.

    Args:
      dataset: the learners'; only its training split is read.
      setup: sampler and horizon of the comparison.
      epochs: the learners'; their queries are the budget of the first and last row.
      seeds: of the searches and their drawn scenes.
      long: evaluations of the long row; 0 leaves it out.
      search: one of `SEARCHES`.

    Raises:
      InputError: less than one evaluation.
    """
    own = dataclasses.replace(setup, split="train")
    queries = dataset.indices("train").size * num_candidates(setup.sampler) * epochs
    # row -> what is tuned, scenes, evaluations
    searches = {
        TUNED_IDM_ROW: (DRIVER, TUNING_SCENES, 0),
        TUNED_ROW: (HAND_SET, TUNING_SCENES, 0),
    }
    if long:
        searches[LONG_ROW] = (HAND_SET, LONG_SCENES, long)
    found: dict[str, list[Baseline]] = {row: [] for row in searches}
    for row, (kind, scenes, evaluations) in searches.items():
        for seed in seeds:
            objective, each = problem(kind, dataset, own, scenes, seed)
            budget = evaluations or queries // each
            if not budget:
                raise InputError(
                    f"epochs: {epochs}: {queries:,} queries: expected at least the "
                    f"{each:,} of one evaluation"
                )
            found[row].append(_best(kind, objective, budget, seed, search))
    return found


def tune_idm(
    dataset: Demonstrations,
    setup: RankingSetup,
    evaluations: int = 300,
    search: str = "cma",
) -> Idm:
    """Finds the driver model that ends nearest to the humans of the training split.

    Args:
      dataset: only its training split is read.
      setup: sampler, horizon and what is seen of the others.
      evaluations: of the search.
      search: one of `SEARCHES`.
    """
    own = dataclasses.replace(setup, split="train")
    objective, _ = problem(DRIVER, dataset, own, LONG_SCENES)
    found = _best(DRIVER, objective, evaluations, 0, search).fields()
    return Idm(**{name: float(value) for name, value in found.items()})


def search_own_terms(
    own: OwnTerms,
    dataset: Demonstrations,
    setup: RankingSetup,
    epochs: int,
    evaluations: int = 300,
    search: str = "cma",
) -> tuple[float, ...]:
    """Finds weights of own terms by a search: the rival of learning them.

    Args:
      own: the terms; the search starts at today's weights.
      dataset: only its training split is read.
      setup: sampler, horizon and what is seen of the others.
      epochs: the learner's, whose queries are looked at here too, if they are more.
      evaluations: of the search, at least.
      search: one of `SEARCHES`.

    Returns:
      [F] the weights with which the chosen candidates end nearest to the humans.
    """
    split = dataclasses.replace(setup, split="train")
    kind = of_own_terms(own)
    objective, each = problem(kind, dataset, split, LONG_SCENES)
    queries = dataset.indices("train").size * num_candidates(setup.sampler) * epochs
    budget = max(evaluations, queries // each)
    if len(own.names) == 1:  # one weight alone decides nothing
        return own.weights
    return tuple(np.asarray(_best(kind, objective, budget, 0, search)).tolist())


def as_numbers(baselines: Iterable[Baseline]) -> list[dict[str, float]]:
    """Returns the parameters of each, for a JSON file."""
    return [{n: float(x) for n, x in one.fields().items()} for one in baselines]
