"""The training step: pure, written once for jit, pmap and shard_map.

Shards carry (sum, count) and divide once after `psum`: a mean of shard means
is wrong when shards hold different numbers of pairs.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax

from rcirl_jax.features import FeatureMap, feature_map
from rcirl_jax.features.columns import candidate_frames
from rcirl_jax.planner.prediction import as_seen, either
from rcirl_jax.reward import (
    Compared,
    LossConfig,
    LossSums,
    RewardConfig,
    init_reward,
    init_tree,
    loss_sums,
    pinned,
    scenes_value,
    value,
)
from rcirl_jax.sampling import (
    SamplerConfig,
    hard_negatives,
    num_candidates,
    sample,
    trajectory_from_positions,
    trajectory_on_path,
)
from rcirl_jax.sampling.speed import family_index
from rcirl_jax.train.facts import admitted, densities, facts_of
from rcirl_jax.train.finite import bad_facts, bad_values, count_bad
from rcirl_jax.train.pieces import Scenes, added_and_kept, block_size, in_pieces
from rcirl_jax.train.state import (
    Batch,
    Facts,
    FeatureBatch,
    TrainConfig,
    TrainState,
    make_optimizer,
)
from rcirl_jax.types import (
    Candidates,
    Demonstration,
    Normaliser,
    Parameters,
    RewardParams,
    Scene,
    Trajectory,
)
from rcirl_jax.units import TIMES_S

SAMPLER_STREAM = 0  # fold_in number of the sampler's key
NEGATIVE_STREAM = 1  # fold_in number of the hard negatives' key
FUTURES_STREAM = 2  # fold_in number of the draw between futures


class StepMetrics(flax.struct.PyTreeNode, kw_only=True):
    """Sums over the step's pairs; the loop divides."""

    loss_sum: jax.Array  # []
    terms: jax.Array  # [] what the loss is divided by: pairs or scenes
    wins: jax.Array  # [] pairs the human wins, ties half
    pairs: jax.Array  # [] feasible pairs (queries)
    preferred: jax.Array  # [2] preferences that the better one wins, and all
    grad_norm: jax.Array  # []
    # [F + 1] scenes with values that are NaN or infinite, per feature; last: facts
    nonfinite: jax.Array
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
        config.hard_drawn,
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), sampled, near)


def _under_futures(key: jax.Array, scene: Scene, futures: str) -> Scene:
    """The others' future as `TrainConfig.futures` says. Key not consumed."""
    if futures == "recorded":
        return scene
    if futures == "predicted":
        return as_seen(scene)
    return either(scene, jax.random.bernoulli(jax.random.fold_in(key, FUTURES_STREAM)))


def featurise(
    key: jax.Array, batch: Batch, config: TrainConfig, features: FeatureMap
) -> FeatureBatch:
    """Candidates and features of a batch; each scene's key comes from its row.

    With `positive="nearest"` the feasible sampled candidate nearest to the human takes
    the human's place: ranking it above the rest asks for what a planner can
    choose, and leaves nothing to learn from how the human's curve was recorded.
    """
    seen = jnp.asarray(TIMES_S) <= config.train_horizon + 1e-6

    def one(index: jax.Array, demonstration: Demonstration) -> tuple:
        own_key = jax.random.fold_in(key, index)
        scene = _under_futures(own_key, demonstration.scene, config.futures)
        demonstration = demonstration.replace(scene=scene)
        valid = demonstration.scene.time_valid & seen
        candidates = candidates_of(own_key, demonstration, config)
        driven = human_of(demonstration, config.sampler)
        # the human stands last among the candidates: one pass for all
        join = lambda many, one: jnp.concatenate([many, one[None]])  # noqa: E731
        everyone = jax.tree.map(join, candidates.trajectory, driven)
        frames = candidate_frames(demonstration.scene, everyone)
        both = jnp.stack(features.of_frames(frames))
        human, rows = both[:, :, -1].T, both[:, :, :-1]
        frames = jax.tree.map(lambda x: x[:, :-1], frames)

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


def siamese_values(
    params: Parameters,
    normaliser: Normaliser,
    batch: FeatureBatch,
    reward: RewardConfig,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(V of the positives [B], of the candidates [B, K], the prior's logit []).

    In the fast layout for the package's own network, by `value` for any other.
    """
    if not isinstance(params, RewardParams):
        human = value(params, normaliser, batch.human, batch.time_valid, reward)
        others = value(params, normaliser, batch.points, batch.points_valid, reward)
        return human, others, params.get("offset", jnp.zeros(()))
    both = (batch.human.swapaxes(1, 2)[..., None], batch.candidates)
    activation = reward.hidden_activation
    human, candidates = scenes_value(
        pinned(params, reward), normaliser, both, batch.time_valid, activation
    )
    offset = jnp.zeros(()) if params.offset is None else params.offset
    return human[:, 0], candidates, offset


def compare(
    params: Parameters,
    normaliser: Normaliser,
    batch: FeatureBatch,
    reward: RewardConfig,
) -> Compared:
    """Values of a batch under the Siamese network, with what losses need beside."""
    facts = batch.facts
    human, candidates, offset = siamese_values(params, normaliser, batch, reward)
    return Compared(
        human=human,
        candidates=candidates,
        counts=batch.feasible,
        weight=batch.weight,
        human_distance=facts.human_distance,
        human_collides=facts.human_collides,
        distance=facts.distance,
        collides=facts.collides,
        breaks_rule=facts.breaks_rule,
        human_density=facts.human_density,
        density=facts.density,
        offset=offset,
    )


def mined(
    params: Parameters,
    normaliser: Normaliser,
    batch: FeatureBatch,
    config: TrainConfig,
) -> FeatureBatch:
    """Of the hard negatives drawn, only those the present reward values most.

    The pool stands last among the candidates; the others stop counting.
    """
    pool = config.hard_drawn
    values = compare(params, normaliser, batch, config.reward).candidates[:, -pool:]
    feasible = batch.feasible[:, -pool:]
    values = jnp.where(feasible, values, -jnp.inf)
    least = jax.lax.top_k(values, config.hard_negatives)[0][:, -1:]
    kept = feasible & (values >= least)
    return batch.replace(
        feasible=jnp.concatenate([batch.feasible[:, :-pool], kept], axis=1)
    )


def gradient_sums(
    params: Parameters,
    normaliser: Normaliser,
    batch: FeatureBatch,
    config: TrainConfig,
    constants: LossConfig | None = None,
) -> tuple[Parameters, LossSums]:
    """Gradient of the loss sum, and the sums; divide by `terms` afterwards.

    `constants` replaces those of the configuration and may hold tracers.
    """
    if config.hard_negatives and config.hard_pool > 1:
        batch = mined(params, normaliser, batch, config)

    def total(params: Parameters) -> tuple[jax.Array, LossSums]:
        compared = compare(params, normaliser, batch, config.reward)
        sums = loss_sums(config.loss, compared, constants or config.loss_config)
        return sums.loss, sums

    return jax.grad(total, has_aux=True)(params)


def _by_pieces(
    work: Callable[[Scenes], tuple], batch: Scenes, size: int | None = None
) -> tuple:
    """`work(batch)` piece by piece: (sums, rows of the batch)."""
    numbers, piece = in_pieces(batch, size)
    sums, rows = added_and_kept(lambda number: work(piece(number)), numbers)
    return sums, rows.reshape(-1, rows.shape[-1])


def as_tree(params: Parameters) -> Any:  # noqa: ANN401
    """The same object under optax's type for parameter trees."""
    return params


def batch_sums(
    state: TrainState, batch: Batch | FeatureBatch, config: TrainConfig, *, whole: bool
) -> tuple[tuple[Parameters, LossSums], jax.Array]:
    """((gradient of the loss sum, sums), scenes with bad values [B, F + 1]) of a batch.

    The last column is of the facts that losses read besides features.

    Of a Batch, candidates and features are made block by block (`block_size`), and
    the network reads them while they are in the cache; values are checked there too.
    """
    key = jax.random.fold_in(state.key, state.step)
    features = feature_map(config.features)

    def learn(part: FeatureBatch) -> tuple:
        found = gradient_sums(state.params, state.normaliser, part, config)
        return found, jnp.concatenate([bad_values(part), bad_facts(part)], axis=1)

    def learn_from(part: Batch) -> tuple:
        made = featurise(key, part, config, features)
        return learn(made) if whole else _by_pieces(learn, made)

    if isinstance(batch, FeatureBatch):
        return learn(batch) if whole else _by_pieces(learn, batch)
    scenes = batch.replace(preferences=None)  # those have rows of their own
    if whole:
        return learn_from(scenes)
    candidates = num_candidates(config.sampler) + config.hard_drawn
    size = block_size(batch.weight.shape[0], candidates)
    return _by_pieces(learn_from, scenes, size)


def make_train_step(
    config: TrainConfig, *, whole: bool = False
) -> Callable[..., tuple[TrainState, StepMetrics]]:
    """`train_step(state, batch, *, axis_name=None) -> (state, metrics)`.

    `batch` is a Batch (everything is made on the device) or a FeatureBatch.
    With `axis_name` the step runs inside pmap or shard_map and sums over that
    axis. `whole` works the batch off at once, for a compiler that shares it over
    devices by itself and would gather it for a loop. A step whose loss or gradient
    is not finite leaves the state as it was and says so in the metrics; not by
    `optax.apply_if_finite`, which sees updates only: it cannot name scene and feature.
    Preferences of a Batch add their own mean loss, times `preference_weight`.
    """
    optimizer = make_optimizer(config)
    alone = dataclasses.replace(config, hard_negatives=0)  # preferences are as given

    def train_step(
        state: TrainState, batch: Batch | FeatureBatch, *, axis_name: str | None = None
    ) -> tuple[TrainState, StepMetrics]:
        judged = batch.preferences if isinstance(batch, Batch) else None
        (grads, sums), bad = batch_sums(state, batch, config, whole=whole)
        nonfinite, first_bad = count_bad(bad, batch.index)
        if judged is not None:
            also, worst = count_bad(bad_values(judged), judged.index)
            nonfinite = nonfinite.at[:-1].add(also)
            first_bad = jnp.maximum(first_bad, worst)
        if axis_name is not None:
            sums, grads, nonfinite = jax.lax.psum((sums, grads, nonfinite), axis_name)
            first_bad = jax.lax.pmax(first_bad, axis_name)
        grads = jax.tree.map(lambda g: g / jnp.maximum(sums.terms, 1.0), grads)
        preferred = jnp.zeros(2)
        if judged is not None:
            more, wanted = gradient_sums(state.params, state.normaliser, judged, alone)
            if axis_name is not None:
                more, wanted = jax.lax.psum((more, wanted), axis_name)
            terms = jnp.where(wanted.terms > 0.0, wanted.terms, 1.0)
            scale = config.preference_weight / terms
            grads = jax.tree.map(lambda g, m: g + scale * m, grads, more)
            preferred = jnp.stack([wanted.wins, wanted.pairs])
        norm = optax.tree.norm(grads)
        finite = jnp.isfinite(sums.loss) & jnp.isfinite(norm)
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
            loss_sum=sums.loss,
            terms=sums.terms,
            wins=sums.wins,
            pairs=sums.pairs,
            preferred=preferred,
            grad_norm=norm,
            nonfinite=nonfinite,
            first_bad=first_bad,
            finite=finite & (first_bad < 0),
        )
        return new_state, metrics

    return train_step


def init_params(key: jax.Array, num_features: int, config: TrainConfig) -> Parameters:
    """Random parameters, with the discriminator's offset for the GAN loss."""
    if config.reward.module:
        tree = init_tree(key, num_features, config.reward)
        return {**tree, "offset": jnp.zeros(())} if config.loss == "gan" else tree
    params = init_reward(key, num_features, config.reward)
    if config.loss == "gan":
        params = params.replace(offset=jnp.zeros(()))
    return params


def init_state(config: TrainConfig, normaliser: Normaliser) -> TrainState:
    """A fresh state; everything random comes from `config.seed`."""
    features = feature_map(config.features)
    init_key, train_key = jax.random.split(jax.random.key(config.seed))
    params = init_params(init_key, features.num_features, config)
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        opt_state=make_optimizer(config).init(as_tree(params)),
        key=train_key,
        normaliser=normaliser,
    )
