"""From demonstrations to arrays: candidates, distances, crashes, values.

Every scorer ranks the same candidates of the same scenes. Distances are to the
recorded human in the scene's Frenet frame, at the chosen horizon.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store.rows import refuse_scenes
from rcirl_jax.features import FeatureMap, feature_map
from rcirl_jax.features.columns import COLUMNS
from rcirl_jax.features.mapping import make_frame
from rcirl_jax.geometry.polynomial import hermite
from rcirl_jax.planner.baselines import (
    Idm,
    closeness,
    constant_speed_trajectory,
    idm_trajectory,
)
from rcirl_jax.planner.prediction import with_predicted_futures
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
from rcirl_jax.train.featurise import human_of
from rcirl_jax.types import Candidates, Demonstration, Scene, Trajectory
from rcirl_jax.units import DT_S, NUM_TIMES, TIMES_S

CHUNK = 128  # scenes per device call; padded, so that it compiles once
EVALUATION_SEED = 20180814  # candidates of an evaluation are the same for all

BASELINES = ("constant speed", "IDM", "hand-set", SPEED_DP_ROW)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scored:
    """Arrays of S scenes with K candidates each (numpy)."""

    feasible: np.ndarray  # [S, K]
    fde: np.ndarray  # [S, K] m at the horizon
    ade: np.ndarray  # [S, K] m, mean over times up to the horizon
    crash: np.ndarray  # [S, K] the candidate meets something up to the horizon
    human_crash: np.ndarray  # [S]
    values: dict[str, np.ndarray]  # scorer -> [S, K], higher is better
    human_values: dict[str, np.ndarray]  # scorer -> [S]


# (features [..., T, F], time_valid [..., T]) -> value [...]
Scorer = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class PriorCostScorer:
    """A reward on top of a baseline's values."""

    incumbent: str  # of BASELINES
    # (features [..., T, F], the incumbent's values [...], time_valid [..., T]) -> [...]
    total: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


# a baseline with parameters; `fields()` is what may be traced of it
Baseline = LatticeCost | SpeedDpCost | Idm
COSTS: dict[type, Callable] = {
    LatticeCost: lattice_cost,
    SpeedDpCost: speed_dp_cost,
}


def horizon_mask(scene: Scene, horizon_s: float) -> jax.Array:
    """[T] bool: valid times up to the horizon."""
    return scene.time_valid & (jnp.asarray(TIMES_S) <= horizon_s + 1e-6)


def position_at(trajectory: Trajectory, horizon_s: float) -> tuple:
    """(s, l) [m] at the horizon: cubic Hermite in s, linear in l between times."""
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
    """(FDE, ADE) [m] of a candidate to the human, at and up to the horizon."""
    mask = horizon_mask(demonstration.scene, horizon_s)
    apart = jnp.sqrt((candidate.s - human.s) ** 2 + (candidate.l - human.l) ** 2)
    ade = jnp.sum(jnp.where(mask, apart, 0.0)) / jnp.sum(mask)
    s, l = position_at(candidate, horizon_s)
    s_human, l_human = position_at(human, horizon_s)
    s_human = jnp.where(jnp.abs(horizon_s - 5.0) < 1e-6, demonstration.s_at_5s, s_human)
    return jnp.sqrt((s - s_human) ** 2 + (l - l_human) ** 2), ade


def _crashes(scene: Scene, trajectory: Trajectory, mask: jax.Array) -> jax.Array:
    hit = COLUMNS["collision"](make_frame(scene, trajectory))
    return jnp.any((hit > 0.0) & mask)


def _score_one(
    key: jax.Array,
    demonstration: Demonstration,
    tuned: Mapping[str, Baseline],
    features: FeatureMap,
    sampler: SamplerConfig,
    horizon_s: float,
    futures: str,
) -> dict:
    recorded = demonstration.scene
    scene = with_predicted_futures(recorded) if futures == "predicted" else recorded
    mask = horizon_mask(scene, horizon_s)
    human = human_of(demonstration, sampler)
    candidates = sample(key, scene, sampler)
    everyone = candidates.trajectory
    fde, ade = jax.vmap(lambda x: distances(demonstration, human, x, horizon_s))(
        everyone
    )
    on_path = sampler.mode == "speed"
    baselines: dict[str, Callable[[Trajectory], jax.Array]] = {
        "constant speed": lambda x: closeness(
            x, constant_speed_trajectory(scene, on_path), mask
        ),
    }
    cut = scene.replace(time_valid=mask)
    usual = {"IDM": Idm(), "hand-set": LatticeCost(), SPEED_DP_ROW: SpeedDpCost()}
    for name, baseline in {**usual, **tuned}.items():
        if isinstance(baseline, Idm):
            way = idm_trajectory(scene, on_path, baseline)
            baselines[name] = lambda x, way=way: closeness(x, way, mask)
        else:
            cost_of = COSTS[type(baseline)]
            baselines[name] = lambda x, f=cost_of, baseline=baseline: (
                -f(cut, x, baseline)
            )
    return {
        "features_human": features(scene, human),
        "features": features.of_candidates(scene, candidates),
        "feasible": candidates.feasible,
        "fde": fde,
        "ade": ade,
        "crash": jax.vmap(lambda x: _crashes(recorded, x, mask))(everyone),
        "human_crash": _crashes(recorded, human, mask),
        "time_valid": mask,
        "values": {name: jax.vmap(f)(everyone) for name, f in baselines.items()},
        "human_values": {name: f(human) for name, f in baselines.items()},
    }


def candidates_key(index: jax.Array) -> jax.Array:
    """Sampler's key of a dataset row: every evaluation ranks the same candidates."""
    return jax.random.fold_in(jax.random.key(EVALUATION_SEED), index)


@functools.cache
def _score_batch(
    preset: str,
    sampler: SamplerConfig,
    horizon_s: float,
    futures: str,
    kinds: tuple[tuple[str, type[Baseline]], ...],
) -> Callable:
    features = feature_map(preset)

    def one(
        fields: Mapping[str, Mapping], index: jax.Array, demonstration: Demonstration
    ) -> dict:
        key = candidates_key(index)
        tuned = {name: kind(**fields[name]) for name, kind in kinds}
        return _score_one(
            key, demonstration, tuned, features, sampler, horizon_s, futures
        )

    return jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))


def score_scenes(
    rows: Demonstration,
    index: np.ndarray,
    *,
    preset: str,
    sampler: SamplerConfig,
    horizon_s: float,
    scorers: Mapping[str, Scorer | PriorCostScorer],
    futures: str = "predicted",
    tuned: Mapping[str, Baseline] | None = None,
    executor: Executor | None = None,
) -> Scored:
    """Sample, featurise, measure and value S scenes, in chunks of bounded memory.

    Args:
      rows: S demonstrations (numpy) whose recorded future covers the horizon;
        see `covers`.
      index: [S] dataset rows; they seed the candidates.
      preset: feature preset.
      sampler: sampler configuration.
      horizon_s: 5 or 8 s (any in (0, 8]).
      scorers: rewards to apply to the features; the baselines are added. An executor
        with other processes sends them: `reader.Reward.value` can be sent.
      futures: "predicted", as the planner sees the others, or "recorded"; crashes are
        judged by the record either way.
      tuned: further hand-set costs and drivers by name, beside the usual ones.
      executor: where chunks are scored; the result does not depend on it.

    Returns:
      Scored, numpy.

    Raises:
      InputError: a feature or a value is not a number (names the scene).
    """
    piece = functools.partial(
        _score_chunk,
        shared=(preset, sampler, float(horizon_s), futures),
        scorers=scorers,
        tuned=tuned or {},
    )
    parts = []
    with CompilesFirst(total=len(index), desc="rank the scenes", unit="scene") as bar:
        for part in (executor or Serial()).stream(piece, chunks(rows, index)):
            parts.append(part)
            bar.update(len(part["fde"]))
    return Scored(**jax.tree.map(lambda *x: np.concatenate(x), *parts))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measured:
    """How far K candidates of S scenes end from the human (numpy)."""

    feasible: np.ndarray  # [S, K]
    fde: np.ndarray  # [S, K] m at the horizon
    ade: np.ndarray  # [S, K] m, mean over times up to the horizon


def measured(
    index: jax.Array,
    demonstration: Demonstration,
    scene: Scene,
    sampler: SamplerConfig,
    horizon_s: float,
) -> tuple[Candidates, jax.Array, jax.Array]:
    """Candidates of a dataset row as evaluations make them, FDE and ADE [K] m.

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


@functools.cache
def _measure_batch(sampler: SamplerConfig, horizon_s: float, futures: str) -> Callable:
    def one(index: jax.Array, demonstration: Demonstration) -> dict:
        scene = demonstration.scene
        scene = with_predicted_futures(scene) if futures == "predicted" else scene
        made, fde, ade = measured(index, demonstration, scene, sampler, horizon_s)
        return {"feasible": made.feasible, "fde": fde, "ade": ade}

    return jax.jit(jax.vmap(one))


def measure_scenes(
    rows: Demonstration,
    index: np.ndarray,
    *,
    sampler: SamplerConfig,
    horizon_s: float,
    futures: str = "predicted",
) -> Measured:
    """The distances of `score_scenes` alone: no features, no values, little memory.

    Args: as there.
    """
    measure = _measure_batch(sampler, float(horizon_s), futures)
    parts = [
        jax.tree.map(lambda x, keep=keep: np.asarray(x)[:keep], measure(at, taken))
        for taken, at, keep in chunks(rows, index)
    ]
    return Measured(**jax.tree.map(lambda *x: np.concatenate(x), *parts))


def chunks(
    rows: Demonstration, index: np.ndarray
) -> Iterator[tuple[Demonstration, np.ndarray, int]]:
    """Chunks of equal size, the last padded: (rows, index, how many are real)."""
    count = index.size
    for start in range(0, count, CHUNK):
        at = np.minimum(np.arange(start, start + CHUNK), count - 1)
        taken = jax.tree.map(lambda x, at=at: np.asarray(x[at]), rows)
        yield taken, index[at].astype(np.int32), min(CHUNK, count - start)


def _score_chunk(
    item: tuple[Demonstration, np.ndarray, int],
    shared: tuple[str, SamplerConfig, float, str],
    scorers: Mapping[str, Scorer | PriorCostScorer],
    tuned: Mapping[str, Baseline],
) -> Iterator[dict]:
    """The arrays of one padded chunk; (rows, index, how many are real)."""
    rows, index, keep = item
    kinds = tuple((name, type(baseline)) for name, baseline in tuned.items())
    fields = {name: baseline.fields() for name, baseline in tuned.items()}
    made = _score_batch(*shared, kinds)(fields, index, rows)
    made = jax.tree.map(lambda x: np.asarray(x[:keep]), made)
    both = (made["features"], made["features_human"])
    if not all(np.isfinite(x).all() for x in both):  # by feature only then: slow
        names = feature_map(shared[0]).names
        columns = {
            f"feature {n}": [x[..., i] for x in both] for i, n in enumerate(names)
        }
        refuse_scenes("rank", rows, index, _not_finite(columns, keep))
    made = _with_values(made, scorers)
    both = (made["values"], made["human_values"])
    values = {f"value of {name}": [x[name] for x in both] for name in both[0]}
    refuse_scenes("rank", rows, index, _not_finite(values, keep))
    yield made


def _not_finite(
    found: Mapping[str, Sequence[np.ndarray]], count: int
) -> dict[str, np.ndarray]:
    """Name -> [count] bool: one of the scene's numbers, in any array, is not finite."""
    fine = lambda x: np.isfinite(x).reshape(count, -1).all(axis=1)  # noqa: E731
    return {n: ~np.logical_and.reduce([*map(fine, xs)]) for n, xs in found.items()}


def _with_values(made: dict, scorers: Mapping[str, Scorer | PriorCostScorer]) -> dict:
    """Replace the features of a chunk by the scorers' values."""
    valid = made.pop("time_valid")
    of_candidates, of_human = made.pop("features"), made.pop("features_human")
    spread = np.broadcast_to(valid[:, None], of_candidates.shape[:3])
    tables = (
        (made["values"], of_candidates, spread),
        (made["human_values"], of_human, valid),
    )
    for name, scorer in scorers.items():
        for values, features, counts in tables:
            if isinstance(scorer, PriorCostScorer):
                values[name] = scorer.total(features, values[scorer.incumbent], counts)
            else:
                values[name] = scorer(features, counts)
    return made


def covers(rows: Demonstration, horizon_s: float) -> np.ndarray:
    """[n] bool: the recorded future reaches the horizon."""
    return np.asarray(rows.future_s) >= horizon_s - 1e-3
