"""The training step on one page: pure, the same under jit, pmap and shard_map.

scene -> candidates -> features -> V of the human and of the candidates (Siamese) ->
loss -> gradient -> optimiser. Shards carry (sum, count) and divide once after `psum`:
a mean of shard means is wrong when shards hold different numbers of pairs.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike

from rcirl_jax.features import feature_map
from rcirl_jax.reward import (
    LossInputs,
    LossSums,
    Normaliser,
    RewardConfig,
    RewardModel,
    RewardParams,
    init_params,
    loss_sums,
)
from rcirl_jax.reward.network import matmul_f32
from rcirl_jax.sampling import num_candidates
from rcirl_jax.train.featurise import featurise
from rcirl_jax.train.state import (
    Batch,
    FeatureBatch,
    TrainConfig,
    TrainState,
    make_optimizer,
)

Scenes = TypeVar("Scenes", Batch, FeatureBatch)
Apply = Callable[..., jax.Array]  # of a `RewardModel`
TRAJECTORIES = 1 << 11  # made together on a CPU
TINY = 1e-30  # so small a weight that a sum of finite numbers does not overflow


class StepMetrics(flax.struct.PyTreeNode, kw_only=True):
    """Sums over the step's pairs; the loop divides."""

    loss_sum: jax.Array  # []
    terms: jax.Array  # [] what the loss is divided by: pairs or scenes
    wins: jax.Array  # [] pairs the human wins, ties half
    pairs: jax.Array  # [] feasible pairs (queries)
    grad_norm: jax.Array  # []
    finite: jax.Array  # [] bool: features, loss and gradient are; else nothing changed


@functools.lru_cache(maxsize=16)
def apply_of(config: RewardConfig) -> Apply:
    """Returns `apply` of a configuration's module.

    One object for each configuration: `jax.jit` compiles again for another one.
    """
    return cast(Apply, RewardModel(config).apply)


def init_state(
    config: TrainConfig, normaliser: Normaliser, seed: ArrayLike | None = None
) -> TrainState:
    """A fresh state; everything random comes from `seed`, by default the config's."""
    init_key, train_key = jax.random.split(
        jax.random.key(config.seed if seed is None else seed)
    )
    count = feature_map(config.features).num_features
    params = init_params(init_key, count, config.reward)
    if config.loss == "gan":
        params["offset"] = jnp.zeros(())
    if config.residual_on:
        params["log_beta"] = jnp.zeros(())
    made = TrainState.create(
        apply_fn=apply_of(config.reward),
        params=params,
        tx=make_optimizer(config.for_step),
        key=train_key,
        normaliser=normaliser,
    )
    return made.replace(step=jnp.zeros((), jnp.int32))


def make_train_step(
    config: TrainConfig,
) -> Callable[..., tuple[TrainState, StepMetrics]]:
    """Returns `train_step(state, batch, *, leaky_rate=None, axis_name=None)`.

    `batch` is a Batch (candidates and features are made in the step) or a FeatureBatch.
    `leaky_rate` replaces the configuration's and may be traced. With `axis_name` the
    step runs inside pmap or shard_map and sums over that axis. The step returns (state,
    StepMetrics); one that is not finite leaves parameters and optimiser as they were.
    """

    def train_step(
        state: TrainState,
        batch: Batch | FeatureBatch,
        *,
        leaky_rate: ArrayLike | None = None,
        axis_name: str | None = None,
    ) -> tuple[TrainState, StepMetrics]:
        grads, sums, unusable = batch_sums(state, batch, config, leaky_rate)
        if axis_name is not None:
            grads, sums, unusable = jax.lax.psum((grads, sums, unusable), axis_name)
        grads = jax.tree.map(lambda g: g / jnp.maximum(sums.terms, 1.0), grads)
        norm = optax.tree.norm(grads)
        finite = jnp.isfinite(sums.loss) & jnp.isfinite(norm) & (unusable == 0)
        # the optimiser leaves out updates that are not finite (`make_optimizer`)
        grads = jax.tree.map(lambda g: jnp.where(finite, g, jnp.nan), grads)
        metrics = StepMetrics(
            loss_sum=sums.loss,
            terms=sums.terms,
            wins=sums.wins,
            pairs=sums.pairs,
            grad_norm=norm,
            finite=finite,
        )
        return state.apply_gradients(grads=grads), metrics

    return train_step


def batch_sums(
    state: TrainState,
    batch: Batch | FeatureBatch,
    config: TrainConfig,
    leaky_rate: ArrayLike | None = None,
) -> tuple[RewardParams, LossSums, jax.Array]:
    """Returns (gradient of the loss sum, sums, number of scenes that are not finite).

    On a CPU the network takes one scene at a time: its features (0.2 MB for 122
    candidates) and hidden units stay in a core's cache from the forward to the backward
    pass. Candidates and features are made for a block of scenes before that, whose
    features (3 MB) stay in its caches too; all at once takes twice as long. Elsewhere
    the whole batch is one microbatch.
    """
    on_cpu = jax.default_backend() == "cpu"

    def learn(part: FeatureBatch) -> tuple:
        grads, sums = gradient_sums(
            state.apply_fn, state.params, state.normaliser, part, config, leaky_rate
        )
        return grads, sums, unusable_scenes(part)

    def learn_from(part: FeatureBatch) -> tuple:
        return scan_sum(learn, part, 1 if on_cpu else part.weight.shape[0])

    if isinstance(batch, FeatureBatch):
        return learn_from(batch)
    key = jax.random.fold_in(state.key, state.step)
    features, scenes = feature_map(config.features), batch.weight.shape[0]
    most = TRAJECTORIES // (num_candidates(config.sampler) + config.hard_drawn)
    block = _divisor(scenes, most) if on_cpu else scenes
    make = lambda part: featurise(key, part, config, features)  # noqa: E731
    return scan_sum(lambda part: learn_from(make(part)), batch, block)


def gradient_sums(
    apply: Apply,
    params: RewardParams,
    normaliser: Normaliser,
    batch: FeatureBatch,
    config: TrainConfig,
    leaky_rate: ArrayLike | None = None,
) -> tuple[RewardParams, LossSums]:
    """Returns the gradient of the loss sum, and the sums; divide by `terms` later."""
    if config.hard_negatives and config.hard_pool > 1:
        batch = keep_hardest_negatives(apply, params, normaliser, batch, config)
    constants = config.loss_config(leaky_rate)

    def total(params: RewardParams) -> tuple[jax.Array, LossSums]:
        inputs = loss_inputs(apply, params, normaliser, batch)
        sums = loss_sums(config.loss, inputs, constants)
        return sums.loss, sums

    return jax.grad(total, has_aux=True)(params)


def loss_inputs(
    apply: Apply, params: RewardParams, normaliser: Normaliser, batch: FeatureBatch
) -> LossInputs:
    """Returns V of humans and candidates, with what losses read beside it."""

    def siamese(
        human: jax.Array, candidates: jax.Array, valid: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """V of the human [T, F] and of K candidates [F, T, K] of one scene."""
        pair = human.T[:, :, None], candidates
        of_human, of_candidates = apply({"params": params}, normaliser, valid, *pair)
        return of_human[0], of_candidates

    scenes = batch.human, batch.candidates, batch.time_valid
    if batch.weight.shape[0] == 1:  # plain matrix products, which a CPU is faster at
        found = siamese(*(x[0] for x in scenes))
        human, candidates = jax.tree.map(lambda x: x[None], found)
    else:
        human, candidates = jax.vmap(siamese)(*scenes)
    if "log_beta" in params:  # V is a residual: V_total = beta own + V
        beta = jnp.exp(params["log_beta"])
        human = human + beta * batch.info.human_own
        candidates = candidates + beta * batch.info.own
    return LossInputs(
        human=human,
        candidates=candidates,
        feasible=batch.feasible,
        weight=batch.weight,
        info=batch.info,
        offset=params.get("offset", jnp.zeros(())),
    )


def keep_hardest_negatives(
    apply: Apply,
    params: RewardParams,
    normaliser: Normaliser,
    batch: FeatureBatch,
    config: TrainConfig,
) -> FeatureBatch:
    """Of the hard negatives drawn, keeps those the present reward values most.

    The pool stands last among the candidates; the others stop counting.
    """
    pool = config.hard_drawn
    values = loss_inputs(apply, params, normaliser, batch).candidates[:, -pool:]
    feasible = batch.feasible[:, -pool:]
    values = jnp.where(feasible, values, -jnp.inf)
    least = jax.lax.top_k(values, config.hard_negatives)[0][:, -1:]
    kept = feasible & (values >= least)
    return batch.replace(
        feasible=jnp.concatenate([batch.feasible[:, :-pool], kept], axis=1)
    )


def unusable_scenes(batch: FeatureBatch) -> jax.Array:
    """Counts scenes of weight > 0 with a feature or fact that is not finite.

    Clipping hides an infinite feature from the loss. A weighted sum sees it, at the
    speed of the memory.
    """

    def holds_bad(x: jax.Array) -> jax.Array:
        flat = x.reshape(*x.shape[:2], -1)
        sums = matmul_f32(flat, jnp.full((flat.shape[2],), TINY))
        return jnp.any(~jnp.isfinite(sums), axis=1)

    info = batch.info
    of_human = info.human_distance + info.human_density
    of_each = info.distance + info.breaks_rule + info.density
    bad = holds_bad(batch.candidates) | holds_bad(batch.human) | ~jnp.isfinite(of_human)
    bad |= jnp.any(~jnp.isfinite(of_each) & batch.feasible, axis=-1)
    return jnp.sum(bad & (batch.weight > 0.0))


def scan_sum(work: Callable[[Scenes], Any], batch: Scenes, size: int) -> Any:  # noqa: ANN401
    """Sums `work(microbatch)` over microbatches of `size` scenes by a `lax.scan`.

    A microbatch is cut out where it is used: leaves reshaped to [n, size, ...] would be
    copied whole before the loop.
    """
    scenes = batch.weight.shape[0]
    if size == scenes:
        return work(batch)

    def cut(start: ArrayLike) -> Scenes:
        part = lambda x: jax.lax.dynamic_slice_in_dim(x, start, size)  # noqa: E731
        return jax.tree.map(part, batch)

    like = jax.eval_shape(lambda: work(cut(0)))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    add = lambda total, start: (jax.tree.map(jnp.add, total, work(cut(start))), None)  # noqa: E731
    return jax.lax.scan(add, zeros, jnp.arange(0, scenes, size))[0]


def _divisor(size: int, most: int) -> int:
    """The largest divisor of `size` that is not above `most`, at least 1."""
    return next((n for n in range(min(size, most), 1, -1) if size % n == 0), 1)
