"""The training step: pure, written once for jit, pmap and shard_map.

Shards carry (sum, count) and divide once after `psum`: a mean of shard means
is wrong when shards hold different numbers of pairs.
"""

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax

from rcirl_jax.features import FeatureMap, feature_map
from rcirl_jax.reward import init_reward, pair_sums, value
from rcirl_jax.sampling import (
    SamplerConfig,
    hard_negatives,
    sample,
    trajectory_from_positions,
    trajectory_on_path,
)
from rcirl_jax.train.state import (
    Batch,
    FeatureBatch,
    TrainConfig,
    TrainState,
    make_optimizer,
)
from rcirl_jax.types import (
    Candidates,
    Demonstration,
    Normaliser,
    RewardParams,
    Trajectory,
)

SAMPLER_STREAM = 0  # fold_in number of the sampler's key
NEGATIVE_STREAM = 1  # fold_in number of the hard negatives' key


class StepMetrics(flax.struct.PyTreeNode, kw_only=True):
    """Sums over the step's pairs; the loop divides."""

    loss_sum: jax.Array  # []
    wins: jax.Array  # [] pairs the human wins, ties half
    pairs: jax.Array  # [] feasible pairs (queries)
    grad_norm: jax.Array  # []
    nonfinite: jax.Array  # [F] values that are NaN or infinite, per feature
    first_bad: jax.Array  # [] dataset row of a scene with such a value, or -1
    finite: jax.Array  # [] bool: loss and gradient are finite


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
        config.hard_negatives,
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), sampled, near)


def nearest_candidate(
    demonstration: Demonstration, driven: Trajectory, candidates: Candidates
) -> jax.Array:
    """Index of the feasible candidate with the least mean distance to the human.

    Ranking this one above the rest asks for what a planner can choose, and
    leaves nothing to learn from how the human's curve was recorded.
    """
    valid = demonstration.scene.time_valid
    apart = jnp.abs(candidates.trajectory.s - driven.s)
    apart = apart + jnp.abs(candidates.trajectory.l - driven.l)
    mean = jnp.sum(jnp.where(valid, apart, 0.0), axis=1) / jnp.sum(valid)
    return jnp.argmin(jnp.where(candidates.feasible, mean, jnp.inf))


def featurise(
    key: jax.Array, batch: Batch, config: TrainConfig, features: FeatureMap
) -> FeatureBatch:
    """Candidates and features of a batch; each scene's key comes from its row."""

    def one(index: jax.Array, demonstration: Demonstration) -> tuple:
        own_key = jax.random.fold_in(key, index)
        candidates = candidates_of(own_key, demonstration, config)
        driven = human_of(demonstration, config.sampler)
        of_candidates = features.of_candidates(demonstration.scene, candidates)
        if config.positive == "nearest":
            near = nearest_candidate(demonstration, driven, candidates)
            feasible = candidates.feasible.at[near].set(False)
            return of_candidates[near], of_candidates, feasible
        human = features(demonstration.scene, driven)
        return human, of_candidates, candidates.feasible

    human, of_candidates, feasible = jax.vmap(one)(batch.index, batch.demonstrations)
    return FeatureBatch(
        human=human,
        candidates=of_candidates,
        feasible=feasible,
        time_valid=batch.demonstrations.scene.time_valid,
        weight=batch.weight,
        index=batch.index,
    )


def batch_sums(
    params: RewardParams,
    normaliser: Normaliser,
    batch: FeatureBatch,
    config: TrainConfig,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Loss sum, wins and pairs of a batch under the Siamese network."""
    valid = batch.time_valid
    human_value = value(params, normaliser, batch.human, valid, config.reward)
    shape = batch.candidates.shape[:3]
    candidate_values = value(
        params,
        normaliser,
        batch.candidates,
        jnp.broadcast_to(valid[:, None], shape),
        config.reward,
    )
    return pair_sums(
        config.loss,
        human_value,
        candidate_values,
        batch.feasible,
        batch.weight,
        config.leaky_rate,
    )


def _nonfinite(batch: FeatureBatch) -> tuple[jax.Array, jax.Array]:
    """Bad values per feature, and the row of one bad scene (or -1)."""
    bad = ~jnp.isfinite(batch.candidates)
    bad_human = ~jnp.isfinite(batch.human)
    per_scene = jnp.any(bad, axis=(1, 2)) | jnp.any(bad_human, axis=1)  # [B, F]
    per_scene = per_scene & (batch.weight > 0.0)[:, None]
    row = jnp.max(jnp.where(jnp.any(per_scene, axis=1), batch.index, -1))
    return jnp.sum(per_scene, axis=0), row


def as_tree(params: RewardParams) -> Any:  # noqa: ANN401
    """The same object under optax's type for parameter trees."""
    return params


def make_train_step(
    config: TrainConfig,
) -> Callable[..., tuple[TrainState, StepMetrics]]:
    """`train_step(state, batch, *, axis_name=None) -> (state, metrics)`.

    `batch` is a Batch (everything is made on the device) or a FeatureBatch.
    With `axis_name` the step runs inside pmap or shard_map and sums over that
    axis. A step whose loss or gradient is not finite leaves the state as it
    was and says so in the metrics.
    """
    features = feature_map(config.features)
    optimizer = make_optimizer(config)

    def train_step(
        state: TrainState, batch: Batch | FeatureBatch, *, axis_name: str | None = None
    ) -> tuple[TrainState, StepMetrics]:
        if isinstance(batch, Batch):
            key = jax.random.fold_in(state.key, state.step)
            batch = featurise(key, batch, config, features)

        def loss_sum(params: RewardParams) -> tuple[jax.Array, tuple]:
            loss, wins, pairs = batch_sums(params, state.normaliser, batch, config)
            return loss, (wins, pairs)

        (loss, (wins, pairs)), grads = jax.value_and_grad(loss_sum, has_aux=True)(
            state.params
        )
        nonfinite, first_bad = _nonfinite(batch)
        sums = (loss, wins, pairs, grads, nonfinite)
        if axis_name is not None:
            sums = jax.lax.psum(sums, axis_name)
            first_bad = jax.lax.pmax(first_bad, axis_name)
        loss, wins, pairs, grads, nonfinite = sums
        grads = jax.tree.map(lambda g: g / jnp.maximum(pairs, 1.0), grads)
        norm = optax.tree.norm(grads)
        finite = jnp.isfinite(loss) & jnp.isfinite(norm)
        before = as_tree(state.params)
        updates, opt_state = optimizer.update(grads, state.opt_state, before)
        params = optax.apply_updates(before, updates)
        keep = lambda new, old: jnp.where(finite, new, old)  # noqa: E731
        new_state = TrainState(
            step=state.step + 1,
            params=jax.tree.map(keep, params, state.params),
            opt_state=jax.tree.map(keep, opt_state, state.opt_state),
            key=state.key,
            normaliser=state.normaliser,
        )
        metrics = StepMetrics(
            loss_sum=loss,
            wins=wins,
            pairs=pairs,
            grad_norm=norm,
            nonfinite=nonfinite,
            first_bad=first_bad,
            finite=finite & (first_bad < 0),
        )
        return new_state, metrics

    return train_step


def init_state(config: TrainConfig, normaliser: Normaliser) -> TrainState:
    """A fresh state; everything random comes from `config.seed`."""
    features = feature_map(config.features)
    init_key, train_key = jax.random.split(jax.random.key(config.seed))
    params = init_reward(init_key, features.num_features, config.reward)
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        opt_state=make_optimizer(config).init(as_tree(params)),
        key=train_key,
        normaliser=normaliser,
    )
