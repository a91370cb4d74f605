"""What a tuner of the hand-set cost minimises: ranking error, or driving.

A problem knows how many queries (candidates looked at) one evaluation takes, so
that budgets can be compared with a learner's. Vectors are those of
`rcirl_jax.reward.tuned`; zeros are Apollo's weights.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, covered_rows
from rcirl_jax.evaluation.ranking.score import (
    CHUNK,
    candidates_key,
    distances,
    horizon_mask,
)
from rcirl_jax.evaluation.rivals.cma_es import Objective, equal_budget, tune
from rcirl_jax.planner.prediction import as_seen
from rcirl_jax.planner.rank import RankConfig
from rcirl_jax.reward import TUNABLE, LatticeCost, lattice_terms, tuned, weighted_cost
from rcirl_jax.reward.hand import LatticeTerms
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.sampling.sampler import num_candidates
from rcirl_jax.simulation.metrics import CaseMetrics, nuplan_score
from rcirl_jax.simulation.rows import Row, tuned_row
from rcirl_jax.simulation.suite import (
    FULL_S,
    catalogue_set,
    drive_row,
    rollout_config,
    suite_refs,
)
from rcirl_jax.simulation.world.careful import judges
from rcirl_jax.train.featurise import human_of
from rcirl_jax.types import Candidates, Demonstration
from rcirl_jax.units import HORIZON_S

Scenes = TypeVar("Scenes")  # a pytree of [S, ...] arrays

POPULATION_CHUNK = 8  # vectors per device call; padded, so that it compiles once


@dataclasses.dataclass(frozen=True, kw_only=True)
class Problem:
    """An objective of the hand-set cost's weights."""

    objective: Objective  # [n, 8] -> [n], lower is better
    queries: int  # candidates looked at in one evaluation of one vector
    title: str  # what the value is, with its unit


class RankedScenes(NamedTuple):
    """S scenes with K candidates each, on device."""

    terms: LatticeTerms  # [S, K, ...]
    fde: jax.Array  # [S, K] m
    feasible: jax.Array  # [S, K] bool


# -------------------------------------------------------------------- ranking


def ranking_problem(
    dataset: Demonstrations,
    setup: RankingSetup,
    max_scenes: int | None = None,
    seed: int = 0,
) -> Problem:
    """Mean FDE [m] of the cheapest candidate over scenes of the setup's split.

    The candidates and distances are those of `evaluate_ranking`; like there, a
    scene without a feasible candidate is charged with candidate 0.

    Args:
      dataset: an open dataset.
      setup: sampler, horizon, split; tune on "train" only.
      max_scenes: at most so many, drawn by the seed; None: all.
      seed: of the draw.

    Raises:
      InputError: a horizon out of (0, 8] s, or no scene of the split covers it.
    """
    if not 0.0 < setup.horizon_s <= HORIZON_S:
        raise InputError(
            f"--horizon: {setup.horizon_s}: expected above 0, at most {HORIZON_S:g} s"
        )
    rows, index = drawn_rows(dataset, setup, max_scenes, seed)
    scenes = ranked_scenes(rows, index, setup.sampler, setup.horizon_s)
    return distance_problem(functools.partial(mean_fde, scenes), scenes.fde, setup)


def distance_problem(
    objective: Objective, fde: jax.Array, setup: RankingSetup
) -> Problem:
    """A mean FDE over the candidates whose FDE [S, K] is given, as a problem."""
    title = f"mean FDE at {setup.horizon_s:g} s, m"
    return Problem(objective=objective, queries=int(fde.size), title=title)


def drawn_rows(
    dataset: Demonstrations, setup: RankingSetup, max_scenes: int | None, seed: int
) -> tuple[Demonstration, np.ndarray]:
    """Scenes that cover the horizon and their dataset rows, some drawn by the seed.

    With `setup.futures` of "predicted" they hold what the planner sees.
    """
    rows, index = covered_rows(dataset, setup.split, setup.horizon_s)
    chosen = np.random.default_rng(seed).permutation(index.size)[:max_scenes]
    chosen = np.sort(chosen)
    rows = jax.tree.map(lambda x: x[chosen], rows)
    if setup.futures == "predicted":
        seen = jax.tree.map(np.asarray, _seen(rows.scene))
        rows = rows.replace(scene=seen)
    return rows, index[chosen]


_seen = jax.jit(jax.vmap(as_seen))


def ranked_scenes(
    rows: Demonstration, index: np.ndarray, sampler: SamplerConfig, horizon_s: float
) -> RankedScenes:
    """Candidates, their distances and their terms, made once and kept on device.

    Args:
      rows: S demonstrations (numpy) whose recorded future covers the horizon.
      index: [S] dataset rows; they seed the candidates.
      sampler: sampler configuration.
      horizon_s: s in (0, 8].
    """
    return in_scene_chunks(_make_scenes(sampler, float(horizon_s)), rows, index)


def in_scene_chunks(
    make: Callable[[jax.Array, Demonstration], Scenes],
    rows: Demonstration,
    index: np.ndarray,
) -> Scenes:
    """What `make` makes of S scenes, a few at a time, compiled once."""
    parts = []
    for start in range(0, index.size, CHUNK):
        picked = np.minimum(np.arange(start, start + CHUNK), index.size - 1)
        taken = jax.tree.map(lambda x, picked=picked: jnp.asarray(x[picked]), rows)
        made = make(jnp.asarray(index[picked], jnp.int32), taken)
        keep = min(CHUNK, index.size - start)
        parts.append(jax.tree.map(lambda x, keep=keep: x[:keep], made))
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


@functools.lru_cache(maxsize=8)
def _make_scenes(
    sampler: SamplerConfig, horizon_s: float
) -> Callable[[jax.Array, Demonstration], RankedScenes]:
    def one(index: jax.Array, demonstration: Demonstration) -> RankedScenes:
        scene = demonstration.scene
        candidates, fde = measured(index, demonstration, sampler, horizon_s)
        cut = scene.replace(time_valid=horizon_mask(scene, horizon_s))
        return RankedScenes(
            terms=jax.vmap(lambda x: lattice_terms(cut, x))(candidates.trajectory),
            fde=fde,
            feasible=candidates.feasible,
        )

    return jax.jit(jax.vmap(one))


def measured(
    index: jax.Array,
    demonstration: Demonstration,
    sampler: SamplerConfig,
    horizon_s: float,
) -> tuple[Candidates, jax.Array]:
    """The candidates of a dataset row as evaluations make them, and their FDE [K] m."""
    human = human_of(demonstration, sampler)
    candidates = sample(candidates_key(index), demonstration.scene, sampler)
    far = jax.vmap(lambda x: distances(demonstration, human, x, horizon_s)[0])
    return candidates, far(candidates.trajectory)


def mean_fde(scenes: RankedScenes, vectors: np.ndarray) -> np.ndarray:
    """[n] m, mean FDE of the cheapest feasible candidate under each vector [n, 8]."""
    return in_chunks(functools.partial(_mean_fde, scenes), vectors)


def in_chunks(
    objective: Callable[[jax.Array], jax.Array], vectors: np.ndarray
) -> np.ndarray:
    """[n] float64, an objective of several vectors [n, d], compiled for a few."""
    vectors = np.asarray(vectors, np.float32)
    found = []
    for start in range(0, len(vectors), POPULATION_CHUNK):
        picked = np.arange(start, start + POPULATION_CHUNK)
        some = jnp.asarray(vectors[np.minimum(picked, len(vectors) - 1)])
        found.append(np.asarray(objective(some), np.float64))
    return np.concatenate(found)[: len(vectors)]


@jax.jit
def _mean_fde(scenes: RankedScenes, vectors: jax.Array) -> jax.Array:
    """[n] m, scene by scene: fast on CPUs, and few sums in one fusion (see xla.py)."""

    def of_scene(one: RankedScenes) -> jax.Array:
        def of_vector(vector: jax.Array) -> jax.Array:
            weights = tuned(vector)
            cost = jax.vmap(lambda x: weighted_cost(x, weights))(one.terms)
            return one.fde[jnp.argmin(jnp.where(one.feasible, cost, jnp.inf))]

        return jax.vmap(of_vector)(vectors)

    return jnp.mean(jax.lax.map(of_scene, scenes), axis=0)


# ---------------------------------------------------------------- closed loop


def suite_problem(
    suite: str,
    per_family: int,
    duration_s: float,
    catalogue_seed: int,
    plan_every: int = 1,
) -> Problem:
    """Driving with the hand-set cost behind the ranking planner, over some cases.

        objective = share of cases with an at-fault collision - mean nuPlan score

    An at-fault collision also lowers nuPlan's score of its case, to 0 but for
    objects, so it counts up to twice. IDM's distances are the reference of
    nuPlan's progress, as in the table. One program drives the vectors in turn.

    Args:
      suite: "smoke", "full" or families separated by commas.
      per_family: cases of each family.
      duration_s: of a case, 1 to 120 s.
      catalogue_seed: of the cases.
      plan_every: steps of 0.1 s between two plans.

    Raises:
      InputError: an unknown family, or a count or duration out of range.
    """
    if not 1.0 <= duration_s <= FULL_S:
        raise InputError(f"--duration: {duration_s}: expected 1 to {FULL_S:g} s")
    cases = catalogue_set(suite_refs(suite, per_family, catalogue_seed), duration_s)
    total = len(cases.ids)
    built = cases.build(0, total)
    config = RankConfig()
    idm = next(row for row in judges() if row.name == "IDM")
    rollout = rollout_config(idm, duration_s, plan_every)

    def drive(row: Row) -> CaseMetrics:
        return drive_row(row, lambda *_: built, total, rollout, chunk=total)

    reference = drive(idm).progress

    def objective(vectors: np.ndarray) -> np.ndarray:
        rows = [tuned_row(tuned(jnp.asarray(x, jnp.float32)), config) for x in vectors]
        return np.array([-drive_value(drive(row), reference) for row in rows])

    plans = total * rollout.steps // rollout.plan_every
    return Problem(
        objective=objective,
        queries=plans * num_candidates(config.sampler),
        title="share of at-fault collisions - mean nuPlan score",
    )


def drive_value(metrics: CaseMetrics, reference: jax.Array) -> float:
    """Mean nuPlan score minus the share of cases with an at-fault collision.

    Args:
      metrics: [C].
      reference: [C] m, distance the reference driver made.
    """
    score = np.mean(np.asarray(nuplan_score(metrics, reference)[0], np.float64))
    return float(score - np.mean(np.asarray(metrics.at_fault) > 0))


# --------------------------------------------------------------------- budget


def learner_budget(
    dataset: Demonstrations, sampler: SamplerConfig, epochs: int, problem: Problem
) -> int:
    """Evaluations of a problem with the queries of a learner's training.

    The learner sees every training scene of the dataset with all candidates of its
    sampler in every epoch; see `equal_budget`.

    Args:
      dataset: the learner's.
      sampler: the learner's.
      epochs: the learner's.
      problem: what is tuned on.

    Raises:
      InputError: less than one evaluation.
    """
    return equal_budget(
        scenes=dataset.indices("train").size,
        candidates=num_candidates(sampler),
        epochs=epochs,
        queries_per_evaluation=problem.queries,
    )


def tune_hand_set(
    problem: Problem, held_out: Problem, *, budget: int, sigma: float, seed: int
) -> tuple[LatticeCost, dict[str, Any]]:
    """Search from Apollo's weights; the best cost found and JSON-ready facts.

    Args:
      problem: what is tuned on.
      held_out: what is not; evaluated for Apollo's and the tuned weights only.
      budget: most evaluations.
      sigma: first spread of the log-weights.
      seed: of the search.

    Returns:
      The cost, and: objective (by problem: default, tuned), what it is, the tuned
      vector, the search's history.
    """
    start = np.zeros(len(TUNABLE))
    result = tune(problem.objective, start, sigma, budget, seed)
    named = {"tuned_on": problem, "held_out": held_out}
    both = np.stack([start, result.vector])
    found = {name: x.objective(both).tolist() for name, x in named.items()}
    return tuned(jnp.asarray(result.vector, jnp.float32)), {
        "objective": {k: {"default": v[0], "tuned": v[1]} for k, v in found.items()},
        "objective_is": problem.title,
        "log_factors": dict(zip(TUNABLE, result.vector.tolist(), strict=True)),
        "search": {
            "method": result.method,
            "evaluations": result.evaluations,
            "queries_per_evaluation": problem.queries,
            "seconds": round(result.seconds, 2),
            "history": list(result.history),
        },
    }
