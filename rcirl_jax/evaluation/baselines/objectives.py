"""What a tuner of a baseline minimises: the error of what the baseline chooses.

A baseline is the hand-set cost or the IDM. A problem knows how many queries (candidates
looked at) one evaluation takes, so that budgets can be compared with a learner's. A
vector of zeros is the usual baseline.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.baselines.counted import Objective
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup, covered_rows
from rcirl_jax.evaluation.ranking.score import CHUNK, Baseline, horizon_mask, measured
from rcirl_jax.planner.baselines import Idm, closeness, idm_trajectory
from rcirl_jax.planner.prediction import with_predicted_futures
from rcirl_jax.reward import TUNABLE, lattice_terms, tuned, weighted_cost
from rcirl_jax.reward.hand import LatticeTerms
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.sampling.sampler import num_candidates
from rcirl_jax.types import Demonstration, Scene, Trajectory

POPULATION_CHUNK = 8  # vectors per device call; padded, so that it compiles once

# What a tuner may change of the driver model, in the order of its vector.
TUNABLE_IDM = (
    *("headway", "standstill_gap", "acceleration", "braking"),
    "speed_share",
)
LARGEST_IDM_LOG = 3.0  # a parameter is within a factor exp(3) = 20 of the usual one


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tunable:
    """A kind of baseline: its parameters, and how it values candidates."""

    names: tuple[str, ...]  # of the parameters, in the order of a vector
    baseline: Callable[[jax.Array], Baseline]  # of a vector [d], which may be traced
    # (scene, candidates [K, T], mask [T]) -> what the values need
    known: Callable[[Scene, Trajectory, jax.Array], Any]
    # (that, a baseline, whether candidates keep to the path) -> [K], higher is better
    values: Callable[[Any, Any, bool], jax.Array]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Problem:
    """An objective of a baseline's parameters."""

    objective: Objective  # [n, d] -> [n], lower is better
    queries: int  # candidates looked at in one evaluation of one vector


class ValuedScenes(NamedTuple):
    """S scenes with K candidates each, on device."""

    known: Any  # of `Tunable.known`, leaves [S, ...]
    fde: jax.Array  # [S, K] m
    feasible: jax.Array  # [S, K] bool


def idm_of(vector: Float[Array, " d"]) -> Idm:
    """The driver model of a tuner's vector of logarithms; zeros are the usual one.

        parameter_i = usual_i exp(clip(x_i, -3, 3))

    Args:
      vector: [5] x, in the order of `TUNABLE_IDM`; may be traced.
    """
    usual = Idm()
    factor = jnp.exp(jnp.clip(vector, -LARGEST_IDM_LOG, LARGEST_IDM_LOG))
    changed = {n: getattr(usual, n) * factor[i] for i, n in enumerate(TUNABLE_IDM)}
    return dataclasses.replace(usual, **changed)


def _cost_terms(scene: Scene, everyone: Trajectory, mask: jax.Array) -> LatticeTerms:
    cut = scene.replace(time_valid=mask)
    return jax.vmap(lambda x: lattice_terms(cut, x))(everyone)


def _nearness(known: tuple, driver: Idm, on_path: bool) -> jax.Array:
    scene, everyone, mask = known
    way = idm_trajectory(scene, on_path, driver)
    return jax.vmap(lambda x: closeness(x, way, mask))(everyone)


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


def problem(
    kind: Tunable,
    dataset: Demonstrations,
    setup: RankingSetup,
    max_scenes: int,
    seed: int = 0,
) -> Problem:
    """Mean FDE [m] of the candidate that a baseline values most.

    The candidates and distances are those of `evaluate_ranking`; like there, a
    scene without a feasible candidate is charged with candidate 0.

    Args:
      kind: of the baseline.
      dataset: an open dataset.
      setup: sampler, horizon, split; tune on "train" only. With `futures` of
        "predicted" baselines see what the planner sees.
      max_scenes: at most so many, drawn by the seed.
      seed: of the draw.

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
    return Problem(objective=objective, queries=int(scenes.fde.size))


_seen = jax.jit(jax.vmap(with_predicted_futures))


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
    make, parts = _make_scenes(kind, sampler, float(horizon_s)), []
    for start in range(0, index.size, CHUNK):
        picked = np.minimum(np.arange(start, start + CHUNK), index.size - 1)
        taken = jax.tree.map(lambda x, picked=picked: jnp.asarray(x[picked]), rows)
        made = make(jnp.asarray(index[picked], jnp.int32), taken)
        keep = min(CHUNK, index.size - start)
        parts.append(jax.tree.map(lambda x, keep=keep: x[:keep], made))
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


@functools.lru_cache(maxsize=8)
def _make_scenes(kind: Tunable, sampler: SamplerConfig, horizon_s: float) -> Callable:
    def one(index: jax.Array, demonstration: Demonstration) -> ValuedScenes:
        scene = demonstration.scene
        candidates, fde, _ = measured(index, demonstration, scene, sampler, horizon_s)
        mask = horizon_mask(scene, horizon_s)
        return ValuedScenes(
            known=kind.known(scene, candidates.trajectory, mask),
            fde=fde,
            feasible=candidates.feasible,
        )

    return jax.jit(jax.vmap(one))


def mean_fde(
    kind: Tunable, scenes: ValuedScenes, vectors: np.ndarray, *, on_path: bool = True
) -> np.ndarray:
    """[n] m, mean FDE of the feasible candidate that each baseline [n, d] values most.

    Args:
      kind: of the baselines.
      scenes: of `valued_scenes`.
      vectors: their parameters, a few at a time.
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
    """[n] m, scene by scene: fast on CPUs, and few sums in one fusion (see xla.py)."""

    def of_scene(one: ValuedScenes) -> jax.Array:
        def of_vector(vector: jax.Array) -> jax.Array:
            values = kind.values(one.known, kind.baseline(vector), on_path)
            return one.fde[jnp.argmax(jnp.where(one.feasible, values, -jnp.inf))]

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
            f"epochs: {epochs}: {queries:,} queries: expected at least the "
            f"{problem.queries:,} of one evaluation"
        )
    return queries // problem.queries
