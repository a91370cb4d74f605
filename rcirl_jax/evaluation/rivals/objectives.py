"""What a tuner of the hand-set cost minimises: the error of what it chooses.

A problem knows how many queries (candidates looked at) one evaluation takes, so
that budgets can be compared with a learner's. Vectors are those of
`rcirl_jax.reward.tuned`; zeros are Apollo's weights.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple, TypeVar

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
from rcirl_jax.evaluation.rivals.cma_es import Objective
from rcirl_jax.planner.prediction import as_seen
from rcirl_jax.reward import lattice_terms, tuned, weighted_cost
from rcirl_jax.reward.hand import LatticeTerms
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.sampling.sampler import num_candidates
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


class RankedScenes(NamedTuple):
    """S scenes with K candidates each, on device."""

    terms: LatticeTerms  # [S, K, ...]
    fde: jax.Array  # [S, K] m
    feasible: jax.Array  # [S, K] bool


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
    return Problem(
        objective=functools.partial(mean_fde, scenes), queries=int(scenes.fde.size)
    )


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


def learner_budget(
    dataset: Demonstrations, sampler: SamplerConfig, epochs: int, problem: Problem
) -> int:
    """Evaluations of a problem with the queries of a learner's training.

    The learner compares K candidates with the human in each of S scenes, E times; an
    evaluation of one vector looks at `problem.queries` Q: floor(S K E / Q).

    Args:
      dataset: the learner's.
      sampler: the learner's.
      epochs: the learner's.
      problem: what is tuned on.

    Raises:
      InputError: less than one evaluation.
    """
    scenes = dataset.indices("train").size
    queries = scenes * num_candidates(sampler) * epochs
    if queries < problem.queries:
        raise InputError(
            f"--epochs: {epochs}: {queries:,} queries: expected at least the "
            f"{problem.queries:,} of one evaluation"
        )
    return queries // problem.queries
