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

from rcirl_jax.features import feature_map
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
from rcirl_jax.sampling import num_candidates
from rcirl_jax.train.featurise import featurise
from rcirl_jax.train.finite import bad_facts, bad_values, count_bad
from rcirl_jax.train.pieces import Scenes, added_and_kept, block_size, in_pieces
from rcirl_jax.train.state import (
    Batch,
    FeatureBatch,
    TrainConfig,
    TrainState,
    make_optimizer,
)
from rcirl_jax.types import Normaliser, Parameters, RewardParams


class StepMetrics(flax.struct.PyTreeNode, kw_only=True):
    """Sums over the step's pairs; the loop divides."""

    loss_sum: jax.Array  # []
    terms: jax.Array  # [] what the loss is divided by: pairs or scenes
    wins: jax.Array  # [] pairs the human wins, ties half
    pairs: jax.Array  # [] feasible pairs (queries)
    grad_norm: jax.Array  # []
    # [F + 1] scenes with values that are NaN or infinite, per feature; last: facts
    nonfinite: jax.Array
    first_bad: jax.Array  # [] dataset row of a scene with such a value, or -1
    finite: jax.Array  # [] bool: loss and gradient are finite


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
    state: TrainState, batch: Batch | FeatureBatch, config: TrainConfig
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
        return _by_pieces(learn, featurise(key, part, config, features))

    if isinstance(batch, FeatureBatch):
        return _by_pieces(learn, batch)
    candidates = num_candidates(config.sampler) + config.hard_drawn
    size = block_size(batch.weight.shape[0], candidates)
    return _by_pieces(learn_from, batch, size)


def make_train_step(
    config: TrainConfig,
) -> Callable[..., tuple[TrainState, StepMetrics]]:
    """`train_step(state, batch, *, axis_name=None) -> (state, metrics)`.

    `batch` is a Batch (everything is made on the device) or a FeatureBatch.
    With `axis_name` the step runs inside pmap or shard_map and sums over that
    axis. A step whose loss or gradient is not finite leaves the state as it was and
    says so in the metrics; not by `optax.apply_if_finite`, which sees updates only: it
    cannot name scene and feature.
    """
    optimizer = make_optimizer(config)

    def train_step(
        state: TrainState, batch: Batch | FeatureBatch, *, axis_name: str | None = None
    ) -> tuple[TrainState, StepMetrics]:
        (grads, sums), bad = batch_sums(state, batch, config)
        nonfinite, first_bad = count_bad(bad, batch.index)
        if axis_name is not None:
            sums, grads, nonfinite = jax.lax.psum((sums, grads, nonfinite), axis_name)
            first_bad = jax.lax.pmax(first_bad, axis_name)
        grads = jax.tree.map(lambda g: g / jnp.maximum(sums.terms, 1.0), grads)
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
