"""Scenes, candidates, features and values; what a reward wants.

The functions of candidates take one scene and give numpy arrays. K is the number of
candidates, the 18 times are `rcirl_jax.units.TIMES_S`: 0 to 8 s.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.export.closed_loop import score_of
from rcirl_jax.export.loading import features_of, own_cost_of, reward_params
from rcirl_jax.export.reader import Reward
from rcirl_jax.export.responses import Response, prices, responses
from rcirl_jax.features import feature_map
from rcirl_jax.planner import prediction
from rcirl_jax.planner.rank import Params, Score, learned_score
from rcirl_jax.sampling import (
    SamplerConfig,
    sample,
    trajectory_from_positions,
    trajectory_on_path,
)
from rcirl_jax.sampling.sampler import MODES, family_index, within_limits
from rcirl_jax.train.featurise import in_chunks
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.types import Candidates, Scene, Trajectory
from rcirl_jax.units import NUM_TIMES


def with_predicted_futures(scene: Scene) -> Scene:
    """Make of a recorded scene what a planner sees at its first moment.

    In a dataset the others drive on as they did. A planner does not know that: here
    they drive as it predicts. Rewards are trained and ranked on such scenes, so look at
    a reward through them too.

    Examples:
        >>> dataset = rcirl_jax.open_dataset("data")
        >>> scene = rcirl_jax.with_predicted_futures(dataset[0].scene)
        >>> float(scene.ego.v) == float(dataset[0].scene.ego.v)
        True
    """
    return jax.device_get(_predicted(scene))


def sample_candidates(
    scene: Scene, *, mode: str = "speed", seed: int = 0
) -> Candidates:
    """Sample what a car could do in a scene over the next 8 s.

    Args:
      scene: one scene, for example `dataset[0].scene`.
      mode: "speed": along the scene's path; "path_speed": beside it too.
      seed: of the random ones among the candidates.

    Returns:
      K candidates, as many for every scene. Trajectories are [K, 18]: station `s` in m
      along the road, lateral offset `l` in m, speed `v`, acceleration `a` and jerk `j`.
      `feasible` [K] says which keep the vehicle's limits.

    Raises:
      InputError: another mode.

    Examples:
        >>> scene = rcirl_jax.open_dataset("data")[0].scene
        >>> candidates = rcirl_jax.sample_candidates(scene)
        >>> candidates.trajectory.s.shape
        (122, 18)
    """
    if mode not in MODES:
        raise InputError(f"mode: {mode}: expected one of {', '.join(MODES)}")
    return jax.device_get(
        _sample(jax.random.key(seed), scene, SamplerConfig(mode=mode))
    )


def candidates_from(
    scene: Scene, s: ArrayLike, l: ArrayLike | None = None
) -> Candidates:
    """Take a planner's own trajectories as the candidates of a scene.

    Args:
      scene: one scene.
      s: [K, 18] m, stations of the car's centre at 0 to 8 s; the first is
        `scene.ego.s`.
      l: [K, 18] m, lateral offsets, left positive; None: along the scene's path.

    Returns:
      Candidates as of `sample_candidates`: speeds, accelerations and jerks are made of
      the positions as in training.

    Raises:
      InputError: other shapes, or numbers that are not finite.

    Examples:
        >>> import numpy as np
        >>> scene = rcirl_jax.open_dataset("data")[0].scene
        >>> time = np.linspace(0.0, 8.0, 18)
        >>> mine = rcirl_jax.candidates_from(scene, [time * 10.0, time * 12.0])
        >>> mine.trajectory.v[:, 5].round(3)
        array([10., 12.], dtype=float32)
    """
    along = _positions("s", s, None)
    if l is None:
        made = _on_path(scene, along)
    else:
        made = _free(scene, along, _positions("l", l, along.shape))
    return jax.device_get(made)


def compute_features(
    scene: Scene, candidates: Candidates, *, preset: str = "paper21"
) -> np.ndarray:
    """Compute what a reward reads of candidates.

    Args:
      scene: one scene.
      candidates: K of them.
      preset: which features, a file of data_specs/features; that of a reward is
        `reward.preset`. docs/features.md defines them.

    Returns:
      [K, 18, F] float32, raw, each in the unit of its column; the columns of a reward
      are `reward.names` and `reward.units`.

    Raises:
      InputError: no such preset.

    Examples:
        >>> scene = rcirl_jax.open_dataset("data")[0].scene
        >>> candidates = rcirl_jax.sample_candidates(scene)
        >>> rcirl_jax.compute_features(scene, candidates).shape
        (122, 18, 21)
    """
    feature_map(preset)  # an unknown one is refused before anything is traced
    return np.array(_features(scene, candidates, preset))


def score_candidates(
    reward: Reward, scene: Scene, candidates: Candidates
) -> np.ndarray:
    """Value candidates as a planner that drives by a reward does.

    Args:
      reward: of `load_weights`; one with a prior cost is added to that cost.
      scene: one scene, as the planner sees it (`with_predicted_futures`, `scene_from`).
      candidates: K of them, sampled or your own.

    Returns:
      [K] float32, higher is better; only differences within the scene mean something.
      Candidates that are not feasible have values too.

    Raises:
      InputError: features that are not this package's, or a reward on top of a cost
        that is not known here.

    Examples:
        >>> reward = rcirl_jax.load_weights("weights.msgpack")
        >>> recorded = rcirl_jax.open_dataset("data")[0].scene
        >>> scene = rcirl_jax.with_predicted_futures(recorded)
        >>> candidates = rcirl_jax.sample_candidates(scene)
        >>> values = rcirl_jax.score_candidates(reward, scene, candidates)
        >>> values[~candidates.feasible] = -float("inf")
        >>> best = values.argmax()
        >>> bool(candidates.feasible[best])
        True
    """
    if reward.prior_cost is None:  # compiles in less than half the time
        score = learned_score(features_of(reward), reward.activation)
        return np.array(_score(reward_params(reward), scene, candidates, score))
    features_of(reward)
    score, params = score_of(reward, own_cost_of([reward]))
    return np.array(_score(params, scene, candidates, score))


def _positions(
    name: str, given: ArrayLike, shape: tuple[int, ...] | None
) -> np.ndarray:
    """[K, 18] float32 numbers."""
    wanted = f"finite numbers [K, {NUM_TIMES}]" if shape is None else f"{shape} as s"
    try:
        numbers = np.asarray(given, np.float32)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"candidates_from: {name}: {error}: expected {wanted}"
        ) from None
    good = numbers.ndim == 2 and numbers.shape[1] == NUM_TIMES
    if not good or (shape is not None and numbers.shape != shape):
        raise InputError(
            f"candidates_from: {name}: shape {numbers.shape}: expected {wanted}"
        )
    if not np.isfinite(numbers).all():
        raise InputError(f"candidates_from: {name}: not finite: expected {wanted}")
    return numbers


_predicted = jax.jit(prediction.with_predicted_futures)
_sample = jax.jit(sample, static_argnames="config")


@jax.jit
def _on_path(scene: Scene, s: jax.Array) -> Candidates:
    return _given(scene, jax.vmap(trajectory_on_path, in_axes=(None, 0))(scene, s))


@jax.jit
def _free(scene: Scene, s: jax.Array, l: jax.Array) -> Candidates:
    made = jax.vmap(trajectory_from_positions, in_axes=(None, 0, 0))(scene, s, l)
    return _given(scene, made)


def _given(scene: Scene, trajectories: Trajectory) -> Candidates:
    limits = SamplerConfig()
    inside = jax.vmap(lambda one: within_limits(scene, one, limits))(trajectories)
    family = jnp.full(inside.shape, family_index("given"), jnp.int32)
    return Candidates(trajectory=trajectories, feasible=inside, family=family)


@functools.partial(jax.jit, static_argnames="preset")
def _features(scene: Scene, candidates: Candidates, preset: str) -> jax.Array:
    return feature_map(preset).of_candidates(scene, candidates)


@functools.partial(jax.jit, static_argnames="score")
def _score(
    params: Params, scene: Scene, candidates: Candidates, score: Score
) -> jax.Array:
    return score(params, scene, candidates)


def response_curves(
    reward: Reward, dataset: Demonstrations, *, split: str = "test", scenes: int = 48
) -> dict[str, Response]:
    """Follow a reward over each feature, all others as people drove.

    Args:
      reward: of `load_weights`; of one with a prior cost, what is added to it.
      dataset: whose scenes are taken.
      split: "test" or "train".
      scenes: so many, spread over the split.

    Returns:
      By feature that the reward uses: `at` in the feature's unit; `value` there, with 0
      at what people drove in the median, in standard deviations of V among the
      candidates of a scene; `supported`, outside of which the reward does not change.

    Raises:
      InputError: no such split, or features that are not this package's.

    Examples:
        >>> reward = rcirl_jax.load_weights("weights.msgpack")
        >>> dataset = rcirl_jax.open_dataset("data")
        >>> curves = rcirl_jax.response_curves(reward, dataset, scenes=8)
        >>> curve = curves["acceleration"]
        >>> curve.at.shape == curve.value.shape
        True
    """
    return responses(reward, *_described(reward, dataset, split, scenes))


def feature_prices(
    reward: Reward,
    dataset: Demonstrations,
    *,
    against: str = "velocity",
    split: str = "test",
    scenes: int = 48,
) -> dict[str, float]:
    """Say what a unit of each feature is worth in units of one of them.

    Args:
      reward: as `response_curves`.
      dataset: as `response_curves`.
      against: the feature that is paid with.
      split: as `response_curves`.
      scenes: as `response_curves`.

    Returns:
      By feature: how many units of `against` are worth as much as one unit more of it,
      at all times and in the mean of scenes as people drove them. Below 0: it costs.
      With "velocity", -2 for "jerk" reads: 1 m/s^3 of jerk is not made up for before
      the car is 2 m/s faster.

    Raises:
      InputError: as `response_curves`, or a feature that the reward does not use or
        does not care for.

    Examples:
        >>> reward = rcirl_jax.load_weights("weights.msgpack")
        >>> dataset = rcirl_jax.open_dataset("data")
        >>> rcirl_jax.feature_prices(reward, dataset, scenes=8)["velocity"]
        1.0
    """
    mine, _, valid = _described(reward, dataset, split, scenes)
    found = prices(reward, mine, valid)
    if not found.get(against):
        raise InputError(
            f"against: {against}: expected a feature that {reward.file} cares for"
            + did_you_mean(against, found)
        )
    return {name: price / found[against] for name, price in found.items()}


def _described(
    reward: Reward, dataset: Demonstrations, split: str, scenes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features of humans [S, T, F] and candidates [S, K, T, F], and times [S, T]."""
    if scenes < 1:
        raise InputError(f"scenes: {scenes}: expected at least 1")
    mode = str(reward.provenance.get("mode", "speed"))
    config = TrainConfig(
        features=features_of(reward).preset,
        sampler=SamplerConfig(mode=mode),
        positive="human",
    )
    rows = dataset.indices(split)
    if rows.size == 0:
        raise InputError(f"split: {split}: no scene: expected some")
    spread = np.linspace(0, rows.size - 1, min(scenes, rows.size)).astype(int)
    rows = rows[spread]
    key = jax.random.key(config.seed)
    made = list(in_chunks(key, dataset.read(rows), rows, config))
    return (
        np.concatenate([np.asarray(one.human) for one in made]),
        np.concatenate([np.asarray(one.points) for one in made]),
        np.concatenate([np.asarray(one.time_valid) for one in made]),
    )
