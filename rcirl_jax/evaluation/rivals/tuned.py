"""Rivals tuned on the learners' own training scenes, by the number that counts.

The hand-set cost and the Intelligent Driver Model have few parameters; CMA-ES
looks for those whose choices end nearest to the human. Rows:

    hand-set, tuned        eight weights, as many queries as a learner's training
    hand-set, tuned long   the same with a stated number of evaluations
    IDM, tuned             five parameters, as many queries as a learner's training
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.evaluation.ranking.evaluate import RankingSetup
from rcirl_jax.evaluation.ranking.score import (
    Rival,
    horizon_mask,
)
from rcirl_jax.evaluation.rivals.cma_es import tune
from rcirl_jax.evaluation.rivals.objectives import (
    Problem,
    drawn_rows,
    in_chunks,
    in_scene_chunks,
    learner_budget,
    measured,
    ranking_problem,
)
from rcirl_jax.planner.baselines import (
    TUNED_IDM_ROW,
    Idm,
    closeness,
    idm_trajectory,
)
from rcirl_jax.reward import LONG_ROW, TUNABLE, TUNED_ROW, tuned
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.types import Demonstration, Scene, Trajectory

TUNING_SCENES = 256  # training scenes of a search with a learner's queries, at most
LONG_SCENES = 1024  # of the long search
SIGMA = 1.0  # first spread of the log-weights

# What a tuner may change of the driver model, in the order of its vector.
TUNABLE_IDM = (
    "headway",
    "standstill_gap",
    "acceleration",
    "braking",
    "speed_share",
)
LARGEST_IDM_LOG = 3.0  # a parameter is within a factor exp(3) = 20 of the usual one


class DrivenScenes(NamedTuple):
    """S scenes with K candidates each, on device."""

    scene: Scene  # [S, ...]
    everyone: Trajectory  # [S, K, T]
    mask: jax.Array  # [S, T] bool, valid times up to the horizon
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


def idm_problem(
    dataset: Demonstrations,
    setup: RankingSetup,
    max_scenes: int | None = None,
    seed: int = 0,
) -> Problem:
    """Mean FDE [m] of the candidate nearest to the IDM driver, as `ranking_problem`.

    Args:
      dataset: an open dataset.
      setup: sampler, horizon, split; tune on "train" only.
      max_scenes: at most so many, drawn by the seed; None: all.
      seed: of the draw.

    Raises:
      InputError: no scene of the split covers the horizon.
    """
    rows, index = drawn_rows(dataset, setup, max_scenes, seed)
    scenes = driven_scenes(rows, index, setup.sampler, setup.horizon_s)
    on_path = setup.sampler.mode == "speed"
    objective = functools.partial(mean_driven_fde, scenes, on_path=on_path)
    return Problem(objective=objective, queries=int(scenes.fde.size))


def driven_scenes(
    rows: Demonstration, index: np.ndarray, sampler: SamplerConfig, horizon_s: float
) -> DrivenScenes:
    """Candidates and their distances, made once and kept on device.

    Args:
      rows: S demonstrations (numpy) whose recorded future covers the horizon.
      index: [S] dataset rows; they seed the candidates.
      sampler: sampler configuration.
      horizon_s: s in (0, 8].
    """
    return in_scene_chunks(_make_scenes(sampler, float(horizon_s)), rows, index)


@functools.lru_cache(maxsize=8)
def _make_scenes(
    sampler: SamplerConfig, horizon_s: float
) -> Callable[[jax.Array, Demonstration], DrivenScenes]:
    def one(index: jax.Array, demonstration: Demonstration) -> DrivenScenes:
        candidates, fde = measured(index, demonstration, sampler, horizon_s)
        return DrivenScenes(
            scene=demonstration.scene,
            everyone=candidates.trajectory,
            mask=horizon_mask(demonstration.scene, horizon_s),
            fde=fde,
            feasible=candidates.feasible,
        )

    return jax.jit(jax.vmap(one))


def mean_driven_fde(
    scenes: DrivenScenes, vectors: np.ndarray, on_path: bool
) -> np.ndarray:
    """[n] m, mean FDE of the feasible candidate nearest to each driver [n, 5]."""
    return in_chunks(functools.partial(_mean_fde, on_path, scenes), vectors)


@functools.partial(jax.jit, static_argnums=0)
def _mean_fde(on_path: bool, scenes: DrivenScenes, vectors: jax.Array) -> jax.Array:
    """[n] m for vectors [n, 5]; scene by scene, few sums in one fusion (see xla.py)."""

    def of_scene(one: DrivenScenes) -> jax.Array:
        def of_vector(vector: jax.Array) -> jax.Array:
            way = idm_trajectory(one.scene, on_path, idm_of(vector))
            near = jax.vmap(lambda x: closeness(x, way, one.mask))(one.everyone)
            return one.fde[jnp.argmax(jnp.where(one.feasible, near, -jnp.inf))]

        return jax.vmap(of_vector)(vectors)

    return jnp.mean(jax.lax.map(of_scene, scenes), axis=0)


def tuned_rivals(
    dataset: Demonstrations,
    setup: RankingSetup,
    *,
    epochs: int,
    seeds: Sequence[int],
    long: int,
) -> dict[str, list[Rival]]:
    """The three rows, one search per seed each.

    Args:
      dataset: the learners'; only its training split is read.
      setup: sampler and horizon of the comparison.
      epochs: the learners'; their queries are the budget of the first and last row.
      seeds: of the searches and their drawn scenes.
      long: evaluations of the long row; 0 leaves it out.
    """
    own = dataclasses.replace(setup, split="train")
    # row -> what is tuned on, parameters, what a vector means, scenes, evaluations
    searches = {
        TUNED_IDM_ROW: (idm_problem, TUNABLE_IDM, idm_of, TUNING_SCENES, 0),
        TUNED_ROW: (ranking_problem, TUNABLE, tuned, TUNING_SCENES, 0),
        LONG_ROW: (ranking_problem, TUNABLE, tuned, LONG_SCENES, long),
    }
    if not long:
        del searches[LONG_ROW]
    found: dict[str, list[Rival]] = {row: [] for row in searches}
    for row, (make, names, rival, scenes, evaluations) in searches.items():
        for seed in seeds:
            problem = make(dataset, own, scenes, seed)
            budget = evaluations or learner_budget(
                dataset, setup.sampler, epochs, problem
            )
            start = np.zeros(len(names))
            best, _ = tune(problem.objective, start, SIGMA, budget, seed)
            found[row].append(rival(jnp.asarray(best, jnp.float32)))
    return found


def tune_idm(
    dataset: Demonstrations, setup: RankingSetup, evaluations: int = 300
) -> Idm:
    """The driver model that ends nearest to the humans of the training split.

    Args:
      dataset: only its training split is read.
      setup: sampler, horizon and what is seen of the others.
      evaluations: of the search.
    """
    own = dataclasses.replace(setup, split="train")
    problem = idm_problem(dataset, own, LONG_SCENES)
    start = np.zeros(len(TUNABLE_IDM))
    best, _ = tune(problem.objective, start, SIGMA, evaluations, 0)
    found = idm_of(jnp.asarray(best, jnp.float32)).fields()
    return Idm(**{name: float(value) for name, value in found.items()})


def as_numbers(rivals: Iterable[Rival]) -> list[dict[str, float]]:
    """The parameters of each, for a JSON file."""
    return [{n: float(x) for n, x in rival.fields().items()} for rival in rivals]
