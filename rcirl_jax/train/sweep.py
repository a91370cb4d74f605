"""Members of one training, side by side: the train step under `jax.vmap`.

All members see the same candidates, which are made once (`freeze`), and the same
batches; they share network shape and loss and differ in seed, learning rate and leaky
rate, which are arrays, so all of them are one compiled program.
"""

import functools
from collections.abc import Sequence
from typing import cast

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax

from rcirl_jax.reward import Normaliser, RewardParams
from rcirl_jax.train.featurise import in_chunks
from rcirl_jax.train.state import FeatureBatch, TrainConfig, TrainState
from rcirl_jax.train.step import init_state, make_train_step
from rcirl_jax.types import Demonstration

ORDER_STREAM = 3  # fold_in number of the batch order's key
PROGRAM = "jit(_fit)"  # JAX's name of what `fit` compiles


class Members(flax.struct.PyTreeNode, kw_only=True):
    """The settings in which members of one training differ; all [M]."""

    seed: jax.Array  # of the initial weights
    learning_rate: jax.Array
    leaky_rate: jax.Array


class Fitted(flax.struct.PyTreeNode, kw_only=True):
    """Trained members."""

    params: RewardParams  # leaves [M, ...]
    loss: jax.Array  # [M, epochs] mean loss of each epoch
    wins: jax.Array  # [M, epochs] share of pairs the human wins
    step_loss: jax.Array  # [M, steps] mean loss of each step
    finite: jax.Array  # [M] bool, no step was refused for a NaN or infinity


def members_of(configs: Sequence[TrainConfig]) -> Members:
    """Returns the members of configurations that share everything else."""
    types = {
        "seed": jnp.uint32,
        "learning_rate": jnp.float32,
        "leaky_rate": jnp.float32,
    }
    columns = {
        name: jnp.asarray([getattr(config, name) for config in configs], dtype)
        for name, dtype in types.items()
    }
    return Members(**columns)


def freeze(rows: Demonstration, index: np.ndarray, config: TrainConfig) -> FeatureBatch:
    """Makes candidates and features of S scenes, once for all epochs.

    Args:
      rows: S demonstrations (numpy).
      index: [S] dataset rows; with `config.seed` they seed the candidates.
      config: sampler, positive, features; the loss decides which facts.

    Returns:
      Leaves [S, ...], without the times that are valid in no scene.
    """
    parts = in_chunks(jax.random.key(config.seed), rows, index, config)
    frozen = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    seen = np.flatnonzero(np.any(np.asarray(frozen.time_valid), axis=0))
    times = int(np.max(seen, initial=0)) + 1
    frozen = frozen.replace(
        human=frozen.human[:, :times],
        candidates=frozen.candidates[:, :, :times],
        time_valid=frozen.time_valid[:, :times],
    )
    return jax.tree.map(jnp.asarray, frozen)


def fit(
    frozen: FeatureBatch, normaliser: Normaliser, config: TrainConfig, members: Members
) -> Fitted:
    """Trains all members on a frozen set.

    The same steps as a training run's, except that candidates do not change from
    epoch to epoch. The batch order comes from `config.seed` and is shared.

    Args:
      frozen: of `freeze`, leaves [S, ...].
      normaliser: fitted on the same scenes.
      config: everything that the members share.
      members: what they do not.

    Raises:
      InputError: not of the package's own network.
    """
    config.reward.check_own()
    order = jax.random.fold_in(jax.random.key(config.seed), ORDER_STREAM)
    return _fit(frozen, normaliser, order, members, config.for_members)


@functools.partial(jax.jit, static_argnames="config")
def _fit(
    frozen: FeatureBatch,
    normaliser: Normaliser,
    order: jax.Array,
    members: Members,
    config: TrainConfig,
) -> Fitted:
    """Trains members; `config` holds none of their differences: one compile."""
    count = frozen.feasible.shape[0]
    size = min(config.batch_size, count)
    batches = -(-count // size)
    train_step = make_train_step(config)

    def first(member: Members) -> TrainState:
        state = init_state(config, normaliser, member.seed)
        rates = optax.tree.set(state.opt_state, learning_rate=member.learning_rate)
        return state.replace(opt_state=rates)

    def step(states: TrainState, at: tuple) -> tuple:
        rows, weight = at
        batch = jax.tree.map(lambda x: x[rows], frozen)
        batch = batch.replace(weight=weight * batch.weight)
        one = lambda state, rate: train_step(state, batch, leaky_rate=rate)  # noqa: E731
        return jax.vmap(one)(states, members.leaky_rate)

    def epoch(states: TrainState, number: jax.Array) -> tuple:
        key = jax.random.fold_in(order, number)
        padded = jnp.resize(jax.random.permutation(key, count), (batches, size))
        real = jnp.arange(batches * size).reshape(batches, size) < count
        states, seen = jax.lax.scan(step, states, (padded, real.astype(jnp.float32)))
        sums = jax.tree.map(lambda x: jnp.sum(x, axis=0), seen)
        loss = sums.loss_sum / jnp.maximum(sums.terms, 1.0)
        wins = sums.wins / jnp.maximum(sums.pairs, 1.0)
        steps = seen.loss_sum / jnp.maximum(seen.terms, 1.0)
        return states, (loss, wins, steps, jnp.all(seen.finite, axis=0))

    states, (loss, wins, steps, fine) = jax.lax.scan(
        epoch, jax.vmap(first)(members), jnp.arange(config.epochs)
    )
    return Fitted(
        params=cast(RewardParams, states.params),
        loss=loss.T,
        wins=wins.T,
        step_loss=steps.reshape(-1, steps.shape[-1]).T,
        finite=jnp.all(fine, axis=0),
    )
