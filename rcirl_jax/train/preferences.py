"""Preferences as pairs of features, and which of them a step compares.

A preference is a scene with one positive and one candidate, so every loss takes it
as it takes a human and a candidate; its own mean is added to that of the step:

    loss = mean over demonstrations + preference_weight * mean over preferences
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.data.store.preferences import Preferences
from rcirl_jax.errors import InputError
from rcirl_jax.features import FeatureMap, feature_map
from rcirl_jax.features.columns import candidate_frames
from rcirl_jax.planner.prediction import as_seen
from rcirl_jax.sampling import trajectory_from_positions, trajectory_on_path
from rcirl_jax.train.state import Facts, FeatureBatch, TrainConfig
from rcirl_jax.types import Scene
from rcirl_jax.units import TIMES_S

CHUNK = 128  # preferences featurised per call
APART_M = 10.0  # m from the positive, what the losses that ask are told of the other


def featurise_preferences(
    preferences: Preferences, dataset: Demonstrations, config: TrainConfig
) -> FeatureBatch:
    """Features of N preferences, numpy leaves [N, ...], K = 1.

    Raises:
      InputError: a pair that differs in nothing that the sampler's mode varies.
    """
    count, parts = preferences.row.size, []
    if config.sampler.mode == "speed":
        better, worse = preferences.s[:, 0], preferences.s[:, 1]
        same = np.flatnonzero(np.all(better == worse, axis=1))
        if same.size:
            raise InputError(
                f"--preferences: scene {preferences.row[same[0]]}: better, worse: the"
                " same s: expected others, for l does not count in mode speed"
            )
    features = feature_map(config.features)
    for start in range(0, count, CHUNK):
        at = np.minimum(np.arange(start, start + CHUNK), count - 1)
        scenes = dataset.read(preferences.row[at]).scene
        made = _make(scenes, preferences.s[at], preferences.l[at], config, features)
        parts.append(jax.tree.map(lambda x, n=count - start: np.asarray(x[:n]), made))
    human, candidates, valid = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    one = np.zeros((count, 1), np.float32)
    facts: dict[str, Any] = {
        "human_distance": one[:, 0],
        "human_collides": one[:, 0] > 0.0,
        "distance": one + APART_M,
        "collides": one > 0.0,
        "breaks_rule": one,
        "human_density": one[:, 0],
        "density": one,
    }
    leaves: dict[str, Any] = {
        "human": human,
        "candidates": candidates,
        "feasible": np.ones((count, 1), bool),
        "time_valid": valid,
        "weight": preferences.weight,
        "index": preferences.row.astype(np.int32),
    }
    return FeatureBatch(facts=Facts(**facts), **leaves)


@functools.partial(jax.jit, static_argnames=("config", "features"))
def _make(
    scenes: Scene, s: jax.Array, l: jax.Array, config: TrainConfig, features: FeatureMap
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(positive [n, T, F], other [n, F, T, 1], time_valid [n, T])."""
    seen = jnp.asarray(TIMES_S) <= config.train_horizon + 1e-6

    def one(scene: Scene, s: jax.Array, l: jax.Array) -> tuple:
        if config.futures != "recorded":
            scene = as_seen(scene)
        along = jax.vmap(trajectory_on_path, in_axes=(None, 0))
        across = jax.vmap(trajectory_from_positions, in_axes=(None, 0, 0))
        speed = config.sampler.mode == "speed"
        pair = along(scene, s) if speed else across(scene, s, l)
        rows = jnp.stack(features.of_frames(candidate_frames(scene, pair)))
        return rows[:, :, 0].T, rows[:, :, 1:], scene.time_valid & seen

    return jax.vmap(one)(scenes, s, l)


def pairs_of_step(
    made: FeatureBatch, step: int, most: int, devices: int, process: int, processes: int
) -> FeatureBatch:
    """Which preferences this process compares at a step: all in turn, round robin.

    Args:
      made: of `featurise_preferences`, N pairs.
      step: number of the step.
      most: pairs of a step, over all processes.
      devices: of all processes; the batch is filled up to a multiple of them with
        pairs of weight 0.
      process: number of this one.
      processes: how many there are.
    """
    count = made.weight.size
    taken = min(most, count)
    size = -(-taken // devices) * devices
    at = (step * taken + np.arange(size)) % count
    real = (np.arange(size) < taken).astype(np.float32)
    own = np.arange(size).reshape(processes, -1)[process]
    batch = jax.tree.map(lambda x: x[at[own]], made)
    return batch.replace(weight=batch.weight * real[own])
