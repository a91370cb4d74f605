"""Scenes -> what a learner compares: the human's features beside the candidates'."""

import functools

import jax
import jax.numpy as jnp

from rcirl_jax.features import FeatureMap, feature_map
from rcirl_jax.features.columns import candidate_frames
from rcirl_jax.planner.prediction import select_future, with_predicted_futures
from rcirl_jax.sampling import (
    SamplerConfig,
    hard_negatives,
    sample,
    trajectory_from_positions,
    trajectory_on_path,
)
from rcirl_jax.sampling.sampler import family_index
from rcirl_jax.train.facts import admitted, densities, facts_of
from rcirl_jax.train.state import Batch, Facts, FeatureBatch, TrainConfig
from rcirl_jax.types import Candidates, Demonstration, Scene, Trajectory
from rcirl_jax.units import TIMES_S

LANES = 16  # float32 numbers of the widest vectors of a CPU
SAMPLER_STREAM = 0  # fold_in number of the sampler's key
NEGATIVE_STREAM = 1  # fold_in number of the hard negatives' key
FUTURES_STREAM = 2  # fold_in number of the draw between futures


def human_of(demonstration: Demonstration, sampler: SamplerConfig) -> Trajectory:
    """The human's Trajectory under the sampler's mode.

    Along the given path in `speed` mode, as recorded in `path_speed` mode;
    through the operator that makes the candidates in both.
    """
    scene, human = demonstration.scene, demonstration.human
    if sampler.mode == "speed":
        return trajectory_on_path(scene, human.s)
    return trajectory_from_positions(scene, human.s, human.l)


def candidates_of(
    key: jax.Array, demonstration: Demonstration, config: TrainConfig
) -> Candidates:
    """Sampled candidates of one scene, with hard negatives if configured."""
    sampled = sample(
        jax.random.fold_in(key, SAMPLER_STREAM), demonstration.scene, config.sampler
    )
    if config.hard_negatives == 0:
        return sampled
    near = hard_negatives(
        jax.random.fold_in(key, NEGATIVE_STREAM),
        demonstration.scene,
        human_of(demonstration, config.sampler),
        config.sampler,
        config.hard_drawn,
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), sampled, near)


def _under_futures(key: jax.Array, scene: Scene, futures: str) -> Scene:
    """The others' future as `TrainConfig.futures` says. Key not consumed."""
    if futures == "recorded":
        return scene
    if futures == "predicted":
        return with_predicted_futures(scene)
    return select_future(
        scene, jax.random.bernoulli(jax.random.fold_in(key, FUTURES_STREAM))
    )


def featurise(
    key: jax.Array, batch: Batch, config: TrainConfig, features: FeatureMap
) -> FeatureBatch:
    """Candidates and features of a batch; each scene's key comes from its row.

    With `positive="nearest"` the feasible sampled candidate nearest to the human
    replaces the human's trajectory: training then asks for a trajectory that the
    planner can choose, and errors of the recording teach nothing.
    """
    seen = jnp.asarray(TIMES_S) <= config.train_horizon + 1e-6

    def one(index: jax.Array, demonstration: Demonstration) -> tuple:
        own_key = jax.random.fold_in(key, index)
        scene = _under_futures(own_key, demonstration.scene, config.futures)
        demonstration = demonstration.replace(scene=scene)
        valid = demonstration.scene.time_valid & seen
        candidates = candidates_of(own_key, demonstration, config)
        driven = human_of(demonstration, config.sampler)
        # the human stands behind the candidates, as often as fills whole vectors of a
        # processor: one pass for all
        sampled = candidates.feasible.size
        humans = LANES - sampled % LANES

        def join(many: jax.Array, one: jax.Array) -> jax.Array:
            return jnp.concatenate([many, jnp.tile(one, (humans, 1))])

        everyone = jax.tree.map(join, candidates.trajectory, driven)
        frames = candidate_frames(demonstration.scene, everyone)
        both = jnp.stack(features.of_frames(frames))
        human, rows = both[:, :, sampled].T, both[:, :, :sampled]
        frames = jax.tree.map(lambda x: x[:, :sampled], frames)

        def with_densities(facts: Facts, counts: jax.Array) -> Facts:
            """Those of the candidates that count, where the loss asks for them."""
            if config.loss != "listwise":
                return facts
            of_human, own = densities(driven, candidates.trajectory, counts, valid)
            return facts.replace(human_density=of_human, density=own)

        facts = facts_of(driven, candidates, frames, valid)
        feasible = candidates.feasible
        if config.positive == "human":
            return human, rows, feasible, with_densities(facts, feasible), valid
        # a planner can choose what the sampler made, not a hard negative
        choice = feasible & (candidates.family != family_index("hard_negative"))
        choice = choice & admitted(demonstration.scene, candidates, config)
        near = jnp.argmin(jnp.where(choice, facts.distance, jnp.inf))
        # what is nearer than the positive without being a choice is no worse than it
        feasible = feasible & (choice | (facts.distance > facts.distance[near]))
        feasible = feasible & jnp.any(choice)
        facts = with_densities(facts, feasible)
        facts = facts.replace(
            human_distance=facts.distance[near],
            human_collides=facts.collides[near],
            human_density=facts.density[near],
        )
        feasible = feasible.at[near].set(False)
        return rows[:, :, near].T, rows, feasible, facts, valid

    made = jax.vmap(one)(batch.index, batch.demonstrations)
    human, rows, feasible, facts, valid = made
    return FeatureBatch(
        human=human,
        candidates=rows,
        feasible=feasible,
        time_valid=valid,
        facts=facts,
        weight=batch.weight,
        index=batch.index,
    )


def featurised(key: jax.Array, batch: Batch, config: TrainConfig) -> FeatureBatch:
    """`featurise` as one program, for what is made outside of a step.

    Runs that differ in seed, step size or loss share it.
    """
    return _featurised(key, batch, config.for_features)


@functools.partial(jax.jit, static_argnames="config")
def _featurised(key: jax.Array, batch: Batch, config: TrainConfig) -> FeatureBatch:
    return featurise(key, batch, config, feature_map(config.features))
