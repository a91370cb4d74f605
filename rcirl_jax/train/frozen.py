"""Training on candidates that are made once, several members side by side.

All learners of a comparison see the same candidates, and a sweep pays for
sampling and features once. Members of one call share network shape, loss and
batches; they differ in seed, step size and leaky rate, which are arrays, so the whole
grid is one compiled program.

A batch is worked off in pieces of scenes (`pieces`). A piece is gathered once for
all members and stays in a CPU's cache while they use it; memory does not grow with
batch size times members.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import cast

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax

from rcirl_jax.reward import Normaliser, RewardParams
from rcirl_jax.train.loop import in_chunks
from rcirl_jax.train.pieces import added, piece_size
from rcirl_jax.train.state import (
    FeatureBatch,
    TrainConfig,
    make_rule,
)
from rcirl_jax.train.step import as_tree, gradient_sums, init_params
from rcirl_jax.types import Demonstration

ORDER_STREAM = 3  # fold_in number of the batch order's key

# hidden values of all members in one piece of a batch, not on a CPU: 1 GB, for
# large kernels in little memory
PIECE_VALUES = 1 << 28
PROGRAM = "jit(_fit)"  # JAX's name of what `fit` compiles


class Members(flax.struct.PyTreeNode, kw_only=True):
    """What differs between the members of one training; all [M]."""

    seed: jax.Array  # of the initial weights
    learning_rate: jax.Array
    leaky_rate: jax.Array


class Fitted(flax.struct.PyTreeNode, kw_only=True):
    """Trained members."""

    params: RewardParams  # leaves [M, ...]
    loss: jax.Array  # [M, epochs] mean loss of each epoch
    wins: jax.Array  # [M, epochs] share of pairs the human wins
    finite: jax.Array  # [M] bool, no step was refused for a NaN or infinity


def members_of(configs: Sequence[TrainConfig]) -> Members:
    """What is a member's own, of configurations that share everything else."""
    column = lambda name: [getattr(config, name) for config in configs]  # noqa: E731
    return Members(
        seed=jnp.asarray(column("seed"), jnp.uint32),
        learning_rate=jnp.asarray(column("learning_rate"), jnp.float32),
        leaky_rate=jnp.asarray(column("leaky_rate"), jnp.float32),
    )


def first_params(
    seed: int | jax.Array, num_features: int, config: TrainConfig
) -> RewardParams:
    """A member's parameters before its first step, as a training run has them.

    Raises:
      InputError: not of the package's own network.
    """
    config.reward.check_own()
    key = jax.random.split(jax.random.key(seed))[0]
    return cast("RewardParams", init_params(key, num_features, config))


def freeze(rows: Demonstration, index: np.ndarray, config: TrainConfig) -> FeatureBatch:
    """Candidates and features of S scenes, made once.

    Args:
      rows: S demonstrations (numpy).
      index: [S] dataset rows; with `config.seed` they seed the candidates.
      config: sampler, positive, features; the loss decides which facts.
    """
    parts = in_chunks(jax.random.key(config.seed), rows, index, config)
    return jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)), *parts)


def fit(
    frozen: FeatureBatch, normaliser: Normaliser, config: TrainConfig, members: Members
) -> Fitted:
    """Train all members on a frozen set.

    The same steps as `make_train_step`, except that candidates do not change
    from epoch to epoch. The batch order comes from `config.seed` and is shared.

    Args:
      frozen: of `freeze`, leaves [S, ...].
      normaliser: fitted on the same scenes.
      config: everything that the members share.
      members: what they do not.
    """
    shared = dataclasses.replace(config, learning_rate=0.5, leaky_rate=0.5, seed=0)
    order = jax.random.fold_in(jax.random.key(config.seed), ORDER_STREAM)
    seen = np.flatnonzero(np.any(np.asarray(frozen.time_valid), axis=0))
    times = int(np.max(seen, initial=0)) + 1
    return _fit(frozen, normaliser, order, members, shared, times)


def _taken(frozen: FeatureBatch, part: tuple, times: int) -> FeatureBatch:
    """Some scenes of the set, (rows, weights), without times valid in none of it."""
    batch = jax.tree.map(lambda x: x[part[0]], frozen)
    return batch.replace(
        weight=part[1] * batch.weight,
        human=batch.human[:, :times],
        candidates=batch.candidates[:, :, :times],
        time_valid=batch.time_valid[:, :times],
    )


@functools.partial(jax.jit, static_argnames=("config", "times"))
def _fit(
    frozen: FeatureBatch,
    normaliser: Normaliser,
    order: jax.Array,
    members: Members,
    config: TrainConfig,
    times: int,
) -> Fitted:
    """What members differ in is not read from `config`: one compile for all."""
    count, candidates = frozen.feasible.shape
    size = min(config.batch_size, count)
    batches = -(-count // size)
    points = members.seed.size * candidates * times
    widest = max(config.reward.hidden, default=1)
    piece = piece_size(size, PIECE_VALUES // (points * widest))
    params = jax.vmap(lambda seed: first_params(seed, frozen.human.shape[-1], config))(
        members.seed
    )
    rule = lambda rate: make_rule(config, rate)  # noqa: E731
    state = jax.vmap(lambda params, rate: rule(rate).init(as_tree(params)))(
        params, members.learning_rate
    )

    def one_step(batch: tuple, step: jax.Array, member: tuple) -> tuple:
        who, params, state = member
        constants = dataclasses.replace(config.loss_config, leaky_rate=who.leaky_rate)
        sums_of = lambda part: gradient_sums(  # noqa: E731
            params, normaliser, _taken(frozen, part, times), config, constants
        )
        grads, sums = added(sums_of, batch)
        grads = jax.tree.map(lambda g: g / jnp.maximum(sums.terms, 1.0), grads)
        rate = who.learning_rate
        if config.halve_every:
            rate = rate * 0.5 ** (step / config.halve_every)
        updates, after = rule(rate).update(grads, state, as_tree(params))
        moved = optax.apply_updates(as_tree(params), updates)
        fine = jnp.isfinite(sums.loss) & jnp.isfinite(optax.tree.norm(grads))
        keep = lambda new, old: jnp.where(fine, new, old)  # noqa: E731
        kept = jax.tree.map(keep, (moved, after), (params, state))
        return *kept, (sums, fine)

    def step(carry: tuple, at: tuple) -> tuple:
        params, state = carry
        number, rows, weight = at
        batch = (rows.reshape(-1, piece), weight.reshape(-1, piece))
        member = (members, params, state)
        params, state, seen = jax.vmap(lambda m: one_step(batch, number, m))(member)
        return (params, state), seen

    def epoch(carry: tuple, number: jax.Array) -> tuple:
        key = jax.random.fold_in(order, number)
        padded = jnp.resize(jax.random.permutation(key, count), (batches, size))
        real = jnp.arange(batches * size).reshape(batches, size) < count
        steps = number * batches + jnp.arange(batches)
        carry, (sums, fine) = jax.lax.scan(
            step, carry, (steps, padded, real.astype(jnp.float32))
        )
        sums = jax.tree.map(lambda x: jnp.sum(x, axis=0), sums)
        terms, pairs = jnp.maximum(sums.terms, 1.0), jnp.maximum(sums.pairs, 1.0)
        return carry, (sums.loss / terms, sums.wins / pairs, jnp.all(fine, axis=0))

    (params, _), (loss, wins, fine) = jax.lax.scan(
        epoch, (params, state), jnp.arange(config.epochs)
    )
    return Fitted(params=params, loss=loss.T, wins=wins.T, finite=jnp.all(fine, axis=0))
