"""From demonstrations to arrays: candidates, distances, crashes, values.

Every scorer ranks the same candidates of the same scenes. Distances are to the
recorded human in the scene's Frenet frame, at the chosen horizon.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store.rows import refuse_scenes
from rcirl_jax.evaluation.ranking.lanes import LaneOutcomes, lanes_of
from rcirl_jax.evaluation.ranking.metrics import Outcomes
from rcirl_jax.features import feature_map
from rcirl_jax.features.columns import COLUMNS
from rcirl_jax.features.mapping import candidate_frames
from rcirl_jax.geometry.polynomial import hermite
from rcirl_jax.planner.baselines import (
    Idm,
    closeness,
    constant_speed_trajectory,
    idm_trajectory,
)
from rcirl_jax.planner.mobil import MOBIL_ROW, Mobil, mobil_trajectory
from rcirl_jax.planner.own_cost import OwnCost
from rcirl_jax.planner.prediction import select_future, with_predicted_futures
from rcirl_jax.reward import (
    SPEED_DP_ROW,
    LatticeCost,
    SpeedDpCost,
    lattice_cost,
    speed_dp_cost,
)
from rcirl_jax.runtime.compiling import CompilesFirst
from rcirl_jax.runtime.executors import Executor, Serial
from rcirl_jax.sampling import SamplerConfig, sample
from rcirl_jax.sampling.sampler import as_candidates, as_planned
from rcirl_jax.train.featurise import human_of
from rcirl_jax.types import Candidates, Demonstration, Scene, Trajectory
from rcirl_jax.units import DT_S, NUM_TIMES, TIMES_S

CHUNK = 128  # scenes per device call; padded, so that it compiles once
EVALUATION_SEED = 20180814  # candidates of an evaluation are the same for all

BASELINES = ("constant speed", "IDM", "hand-set", SPEED_DP_ROW)


Run = TypeVar("Run")


def numbered(rows: Mapping[str, Sequence[Run]]) -> dict[str, Run]:
    """Returns every run as a row: row -> runs becomes "row#0" -> run, ..."""
    return {f"{n}#{i}": x for n, runs in rows.items() for i, x in enumerate(runs)}


# (features [..., T, F], time_valid [..., T]) -> value [...]
Scorer = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class PriorCostScorer:
    """A reward on top of a baseline's values."""

    incumbent: str  # of `RankingSetup.baselines`
    # (features [..., T, F], the incumbent's values [...], time_valid [..., T]) -> [...]
    total: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


# a baseline with parameters; `fields()` is what may be traced of it
Baseline = LatticeCost | SpeedDpCost | Idm
COSTS: dict[type, Callable] = {
    LatticeCost: lattice_cost,
    SpeedDpCost: speed_dp_cost,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class RankingSetup:
    """The settings that all scorers share in one evaluation."""

    preset: str = "paper21"
    sampler: SamplerConfig = dataclasses.field(default_factory=SamplerConfig)
    horizon_s: float = 5.0  # s
    split: str = "test"
    # what scorers see of the others' future (`train.state.FUTURES`); crashes are
    # always judged by the record
    futures: str = "predicted"
    # rank only among candidates that meet nothing: the same safety filter for all
    drop_collisions: bool = False
    # further hand-set costs and drivers that are ranked: row -> runs
    tuned: Mapping[str, Sequence[Baseline]] = dataclasses.field(default_factory=dict)
    # the user's own cost, a further baseline
    own: OwnCost | None = None

    @property
    def baselines(self) -> tuple[str, ...]:
        """Names of the baselines without parameters."""
        mobil = [] if self.sampler.mode == "speed" else [MOBIL_ROW]
        return (*BASELINES, *mobil, *([self.own.name] if self.own else []))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scored:
    """S scenes with K candidates each (numpy)."""

    outcomes: Outcomes
    values: dict[str, np.ndarray]  # scorer -> [S, K], higher is better
    human_values: dict[str, np.ndarray]  # scorer -> [S]
    lanes: LaneOutcomes | None = None  # where paths are planned


class Measured(NamedTuple):
    """The distances at which K candidates of S scenes end from the human."""

    feasible: np.ndarray | jax.Array  # [S, K]
    fde: np.ndarray | jax.Array  # [S, K] m at the horizon
    ade: np.ndarray | jax.Array  # [S, K] m, mean over times up to the horizon


def horizon_mask(scene: Scene, horizon_s: float) -> jax.Array:
    """Returns [T] bool: valid times up to the horizon."""
    return scene.time_valid & (jnp.asarray(TIMES_S) <= horizon_s + 1e-6)


def position_at(trajectory: Trajectory, horizon_s: float) -> tuple:
    """Returns (s, l) [m] at the horizon: cubic Hermite in s, linear in l."""
    low = min(int(horizon_s / DT_S + 1e-6), NUM_TIMES - 2)
    u = horizon_s / DT_S - low
    slopes = trajectory.v[low] * DT_S, trajectory.v[low + 1] * DT_S
    s = hermite(u, trajectory.s[low], trajectory.s[low + 1], slopes)
    return s, trajectory.l[low] + u * (trajectory.l[low + 1] - trajectory.l[low])


def distances(
    demonstration: Demonstration,
    human: Trajectory,
    candidate: Trajectory,
    horizon_s: float,
) -> tuple[jax.Array, jax.Array]:
    """Returns (FDE, ADE) [m] of a candidate to the human, at and up to the horizon."""
    mask = horizon_mask(demonstration.scene, horizon_s)
    apart = jnp.sqrt((candidate.s - human.s) ** 2 + (candidate.l - human.l) ** 2)
    ade = jnp.sum(jnp.where(mask, apart, 0.0)) / jnp.sum(mask)
    s, l = position_at(candidate, horizon_s)
    s_human, l_human = position_at(human, horizon_s)
    s_human = jnp.where(jnp.abs(horizon_s - 5.0) < 1e-6, demonstration.s_at_5s, s_human)
    return jnp.sqrt((s - s_human) ** 2 + (l - l_human) ** 2), ade


def candidates_key(index: jax.Array) -> jax.Array:
    """Returns the sampler's key of a row: every evaluation ranks the same candidates.

    Args:
      index: dataset row.
    """
    return jax.random.fold_in(jax.random.key(EVALUATION_SEED), index)


def measured(
    index: jax.Array,
    demonstration: Demonstration,
    scene: Scene,
    sampler: SamplerConfig,
    horizon_s: float,
) -> tuple[Candidates, jax.Array, jax.Array]:
    """Makes candidates of a dataset row as evaluations do, FDE and ADE [K] m.

    Args:
      index: dataset row, which seeds the candidates.
      demonstration: the row.
      scene: its own, or as the planner sees it.
      sampler: sampler configuration.
      horizon_s: s in (0, 8].
    """
    human = human_of(demonstration, sampler)
    made = sample(candidates_key(index), scene, sampler)
    far = jax.vmap(lambda x: distances(demonstration, human, x, horizon_s))
    return made, *far(made.trajectory)


def chunks(
    rows: Demonstration, index: np.ndarray
) -> Iterator[tuple[Demonstration, np.ndarray, int]]:
    """Yields chunks of equal size, the last padded: rows, index, how many are real."""
    count = index.size
    for start in range(0, count, CHUNK):
        at = np.minimum(np.arange(start, start + CHUNK), count - 1)
        taken = jax.tree.map(lambda x, at=at: np.asarray(x[at]), rows)
        yield taken, index[at].astype(np.int32), min(CHUNK, count - start)


def measure_scenes(
    rows: Demonstration, index: np.ndarray, setup: RankingSetup
) -> Measured:
    """Measures the distances of `score_scenes` alone: no features, little memory.

    Args: as there.
    """
    measure = _measure_batch(setup.sampler, float(setup.horizon_s), setup.futures)
    parts = [
        jax.tree.map(lambda x, keep=keep: np.asarray(x)[:keep], measure(at, taken))
        for taken, at, keep in chunks(rows, index)
    ]
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


@functools.cache
def _measure_batch(sampler: SamplerConfig, horizon_s: float, futures: str) -> Callable:
    def one(index: jax.Array, demonstration: Demonstration) -> Measured:
        scene = as_planned(demonstration.scene, sampler)
        scene = with_predicted_futures(scene) if futures == "predicted" else scene
        made, fde, ade = measured(index, demonstration, scene, sampler, horizon_s)
        return Measured(made.feasible, fde, ade)

    return jax.jit(jax.vmap(one))


def score_scenes(
    rows: Demonstration,
    index: np.ndarray,
    setup: RankingSetup,
    scorers: Mapping[str, Scorer | PriorCostScorer],
    executor: Executor | None = None,
) -> Scored:
    """Samples, featurises, measures and values S scenes, in chunks of bounded memory.

    Args:
      rows: S demonstrations (numpy) whose recorded future covers the horizon;
        see `covers`.
      index: [S] dataset rows; they seed the candidates.
      setup: features, sampler, horizon, and the tuned baselines, which are valued by
        the names of `numbered`.
      scorers: rewards to apply to the features; the baselines are added. An executor
        with other processes sends them: `reader.Reward.value` can be sent.
      executor: where chunks are scored; the result does not depend on it.

    Raises:
      InputError: a feature or a value is not a number (names the scene).
    """
    tuned = numbered(setup.tuned)
    program = (
        setup.preset,
        setup.sampler,
        float(setup.horizon_s),
        tuple((name, type(baseline)) for name, baseline in tuned.items()),
        setup.own,
    )
    given = (
        {name: baseline.fields() for name, baseline in tuned.items()},
        np.bool_(setup.futures == "predicted"),
    )
    piece = functools.partial(
        _score_chunk, program=program, given=given, scorers=scorers
    )
    parts = []
    with CompilesFirst(total=len(index), desc="rank the scenes", unit="scene") as bar:
        for part in (executor or Serial()).stream(piece, chunks(rows, index)):
            parts.append(part)
            bar.update(len(part["fde"]))
    made = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    values, human_values = made.pop("values"), made.pop("human_values")
    lanes = None
    if ways := made.pop("lanes", None):
        lanes = LaneOutcomes(ways[0], ways[1], setup.horizon_s)
    if setup.drop_collisions:
        made["feasible"] = made["feasible"] & ~made["crash"]
    outcomes = Outcomes(
        **made, cluster=np.asarray(rows.vehicle), horizon_s=setup.horizon_s
    )
    return Scored(
        outcomes=outcomes, values=values, human_values=human_values, lanes=lanes
    )


@functools.cache
def _score_batch(
    preset: str,
    sampler: SamplerConfig,
    horizon_s: float,
    kinds: tuple[tuple[str, type[Baseline]], ...],
    own: OwnCost | None,
) -> Callable:
    """Compiles what makes the arrays of a chunk.

    Its arguments are the `fields` of the tuned baselines, whether futures are
    predicted, index and rows.

    Args: as `RankingSetup`; `kinds` of the tuned baselines by name.
    """
    features, on_path = feature_map(preset), sampler.mode == "speed"

    def one(
        fields: Mapping[str, Mapping],
        predicted: jax.Array,
        index: jax.Array,
        demonstration: Demonstration,
    ) -> dict:
        recorded = as_planned(demonstration.scene, sampler)
        scene = select_future(recorded, predicted)
        mask, human = horizon_mask(scene, horizon_s), human_of(demonstration, sampler)
        cut = scene.replace(time_valid=mask)
        candidates, fde, ade = measured(index, demonstration, scene, sampler, horizon_s)

        # the human's stands behind the candidates: one pass for all
        both = jax.tree.map(
            lambda many, one: jnp.concatenate([many, one]),
            candidates,
            as_candidates(human),
        )
        ways = both.trajectory

        def near_to(way: Trajectory) -> jax.Array:
            return jax.vmap(lambda x: closeness(x, way, mask))(ways)

        def valued(baseline: Baseline) -> jax.Array:
            if isinstance(baseline, Idm):
                return near_to(idm_trajectory(scene, on_path, baseline))
            return -jax.vmap(lambda x: COSTS[type(baseline)](cut, x, baseline))(ways)

        tuned = {name: kind(**fields[name]) for name, kind in kinds}
        usual = {"IDM": Idm(), "hand-set": LatticeCost(), SPEED_DP_ROW: SpeedDpCost()}
        values = {
            "constant speed": near_to(constant_speed_trajectory(scene, on_path)),
            **{name: valued(x) for name, x in {**usual, **tuned}.items()},
        }
        if own is not None:
            values[own.name] = own.score(None, cut, both)
        lanes = {}
        if not on_path:
            values[MOBIL_ROW] = near_to(mobil_trajectory(scene, Mobil()))
            ends = jax.vmap(lambda x: position_at(x, horizon_s)[1])(ways)
            made = lanes_of(ways.l, ends, scene.path, horizon_s)
            parts = [jax.tree.map(lambda x, i=i: x[i], made) for i in (np.s_[:-1], -1)]
            lanes = {"lanes": tuple(parts)}
        hit = COLUMNS["collision"](candidate_frames(recorded, ways))  # [T, K + 1]
        crash = jnp.any((hit > 0.0) & mask[:, None], axis=0)
        made = features.of_candidates(scene, both)
        return {
            "features_human": made[-1],
            "features": made[:-1],
            "feasible": candidates.feasible,
            "fde": fde,
            "ade": ade,
            "crash": crash[:-1],
            "human_crash": crash[-1],
            "time_valid": mask,
            **lanes,
            "values": {name: x[:-1] for name, x in values.items()},
            "human_values": {name: x[-1] for name, x in values.items()},
        }

    return jax.jit(jax.vmap(one, in_axes=(None, None, 0, 0)))


def _score_chunk(
    item: tuple[Demonstration, np.ndarray, int],
    program: tuple,
    given: tuple,
    scorers: Mapping[str, Scorer | PriorCostScorer],
) -> Iterator[dict]:
    """Yields the arrays of one padded chunk of `chunks`, with the scorers' values."""
    rows, index, keep = item
    made = _score_batch(*program)(*given, index, rows)
    made = jax.tree.map(lambda x: np.asarray(x[:keep]), made)
    valid = made.pop("time_valid")
    both = (made.pop("features"), made.pop("features_human"))
    if not all(np.isfinite(x).all() for x in both):  # by feature only then: slow
        names = feature_map(program[0]).names
        columns = {
            f"feature {n}": [x[..., i] for x in both] for i, n in enumerate(names)
        }
        refuse_scenes("rank", rows, index, _not_finite(columns, keep))
    tables = (made["values"], made["human_values"])
    spread = np.broadcast_to(valid[:, None], both[0].shape[:3])
    for name, scorer in scorers.items():
        for values, features, counts in zip(tables, both, (spread, valid), strict=True):
            if isinstance(scorer, PriorCostScorer):
                values[name] = scorer.total(features, values[scorer.incumbent], counts)
            else:
                values[name] = scorer(features, counts)
    found = {f"value of {name}": [x[name] for x in tables] for name in tables[0]}
    refuse_scenes("rank", rows, index, _not_finite(found, keep))
    yield made


def _not_finite(
    found: Mapping[str, Sequence[np.ndarray]], count: int
) -> dict[str, np.ndarray]:
    """Returns name -> [count] bool: a number of the scene, in any array, is not finite.

    Args:
      found: name -> arrays [count, ...].
      count: scenes.
    """
    fine = lambda x: np.isfinite(x).reshape(count, -1).all(axis=1)  # noqa: E731
    return {n: ~np.logical_and.reduce([*map(fine, xs)]) for n, xs in found.items()}


def covers(rows: Demonstration, horizon_s: float) -> np.ndarray:
    """Returns [n] bool: the recorded future reaches the horizon."""
    return np.asarray(rows.future_s) >= horizon_s - 1e-3
