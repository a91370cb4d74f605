"""Losses between the human and the candidates of a scene, as values of one option.

Pair losses are functions of y = V(candidate) - V(human). Listwise losses are
functions of the whole set {human} + candidates. The GAN loss compares nothing
within a scene. All are linear sums over scenes: sums and counts are carried
apart, so that uneven shards add up correctly.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from rcirl_jax.types import CandidateInfo

# m, at which hinge's margin and risk's charge saturate; what a collision is charged
CEILING_M = 10.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Constants of the losses. Each loss reads its own; sweeps may trace them.

    Every field has one of its name in `train.state.TrainConfig`, whose default holds.
    """

    # rank: a, the slope for candidates below the human
    leaky_rate: ArrayLike = 0.05
    # hinge: margin per metre of mean distance to the human
    margin_distance: float = 0.2
    # hinge: margin of a candidate that collides, and of one against the rules
    margin_collision: float = 4.0
    margin_rule: float = 2.0
    # soft: m, temperature of the labels softmax(-distance / tau)
    soft_distance: float = 1.0


class LossInputs(NamedTuple):
    """Values of the trajectories of B scenes, and what losses know about them."""

    human: Float[Array, " b"]  # V of the positive
    candidates: Float[Array, "b k"]  # V
    feasible: Bool[Array, "b k"]  # candidates that count
    weight: Float[Array, " b"]  # 0 for padding rows
    info: CandidateInfo
    offset: Float[Array, ""]  # of the discriminator


class LossSums(NamedTuple):
    """Scalars to be added over shards; divide only afterwards."""

    loss: jax.Array
    terms: jax.Array  # what `loss` is divided by: pairs or scenes
    wins: jax.Array  # pairs the human wins, ties half
    pairs: jax.Array


def rank_loss(y: Float[Array, "*n"], leaky_rate: ArrayLike) -> Float[Array, "*n"]:
    """The paper's leaky-ReLU rank loss: L(y) = y if y >= 0 else a y, a = 0.05.

    A candidate valued above the human costs its lead; one below earns a small
    reward for its distance. Needs a fixed scale
    (`network.effective_params`).
    """
    return jnp.where(y >= 0.0, y, leaky_rate * y)


def logistic_loss(y: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Bradley-Terry: L(y) = log(1 + exp(y))."""
    return jax.nn.softplus(y)


def task_margin(c: LossInputs, config: LossConfig) -> Float[Array, "b k"]:
    """Lead that the human must have: far, colliding and unlawful ones more.

        margin = m_d min(distance, ceiling) + m_c collides + m_r breaks_rule

    Source: Ratliff et al. (ICML 2006), with the task loss of Sadat et al. (2019).
    """
    near = jnp.minimum(c.info.distance, CEILING_M)
    return (
        config.margin_distance * near
        + config.margin_collision * c.info.collides
        + config.margin_rule * c.info.breaks_rule
    )


def _over_pairs(c: LossInputs, per_pair: jax.Array) -> tuple[jax.Array, jax.Array]:
    share = c.feasible * c.weight[:, None]
    return jnp.sum(jnp.where(c.feasible, per_pair, 0.0) * share), jnp.sum(share)


def _over_scenes(c: LossInputs, per_scene: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Scenes without a feasible candidate compare nothing."""
    share = jnp.where(jnp.any(c.feasible, axis=1), c.weight, 0.0)
    return jnp.sum(jnp.where(share > 0.0, per_scene, 0.0) * share), jnp.sum(share)


def _all(human: jax.Array, candidates: jax.Array) -> jax.Array:
    """[B, 1 + K], the positive first."""
    return jnp.concatenate([human[:, None], candidates], axis=1)


def _counted(c: LossInputs) -> jax.Array:
    return _all(jnp.ones(c.human.shape, bool), c.feasible)


def _rank(c: LossInputs, config: LossConfig) -> tuple[jax.Array, jax.Array]:
    y = c.candidates - c.human[:, None]
    return _over_pairs(c, rank_loss(y, config.leaky_rate))


def _logistic(c: LossInputs, config: LossConfig) -> tuple[jax.Array, jax.Array]:
    del config
    return _over_pairs(c, logistic_loss(c.candidates - c.human[:, None]))


def _hinge(c: LossInputs, config: LossConfig) -> tuple[jax.Array, jax.Array]:
    """L = max(0, y + margin), mean over pairs."""
    y = c.candidates - c.human[:, None]
    return _over_pairs(c, jax.nn.relu(y + task_margin(c, config)))


def _listwise(c: LossInputs, config: LossConfig) -> tuple[jax.Array, jax.Array]:
    """MaxEnt IRL: -log of the human's share of a sampled partition function.

        P(human) = exp(V_h) / Z,   Z = sum over {human} + candidates of exp(V) / q

    with the proposal's density q, so that a dense corner of the sampler does not
    count more than a sparse one (Finn et al. 2016; Wu et al., RA-L 2020).
    """
    del config
    counted = _counted(c)
    log_q = jnp.where(counted, _all(c.info.human_density, c.info.density), 0.0)
    mean = jnp.sum(log_q, axis=1) / jnp.sum(counted, axis=1)
    logits = _all(c.human, c.candidates) - (log_q - mean[:, None])
    log_z = jax.nn.logsumexp(jnp.where(counted, logits, -jnp.inf), axis=1)
    return _over_scenes(c, log_z - c.human)


def _soft(c: LossInputs, config: LossConfig) -> tuple[jax.Array, jax.Array]:
    """Cross-entropy with labels softmax(-distance / tau) over the whole set.

    Near candidates share the label unless they collide, which is no good answer
    however near; where all do, they share it all the same. With the nearest
    candidate as the positive, the human curve itself is not in the set.
    """
    counted = _counted(c)
    good = counted & ~_all(c.info.human_collides, c.info.collides)
    good = jnp.where(jnp.any(good, axis=1, keepdims=True), good, counted)
    apart = _all(c.info.human_distance, c.info.distance) / config.soft_distance
    labels = jax.nn.softmax(jnp.where(good, -apart, -jnp.inf), axis=1)
    values = jnp.where(counted, _all(c.human, c.candidates), -jnp.inf)
    log_p = jnp.where(counted, jax.nn.log_softmax(values, axis=1), 0.0)
    return _over_scenes(c, -jnp.sum(labels * log_p, axis=1))


def _risk(c: LossInputs, config: LossConfig) -> tuple[jax.Array, jax.Array]:
    """Expected distance to the human of a choice at random by exp(V), in m.

        L = sum_i P_i d_i,   P = softmax(V),   d = min(distance, 10), 10 if it collides

    A smooth form of the top-1 distance. It is bounded, so a term with heavy tails in
    few scenes does not decide the weights of the others, as it does where log P counts.
    Source: minimum risk training (Och, ACL 2003; Shen et al., ACL 2016).
    """
    del config
    counted = _counted(c)
    apart = jnp.minimum(_all(c.info.human_distance, c.info.distance), CEILING_M)
    hit = _all(c.info.human_collides, c.info.collides)
    values = jnp.where(counted, _all(c.human, c.candidates), -jnp.inf)
    share = jax.nn.softmax(values, axis=1)
    return _over_scenes(c, jnp.sum(share * jnp.where(hit, CEILING_M, apart), axis=1))


def _gan(c: LossInputs, config: LossConfig) -> tuple[jax.Array, jax.Array]:
    """The paper's GAN baseline: a discriminator that never compares in a scene.

        L = log(1 + exp(-(V_h + b))) + mean_k log(1 + exp(V_k + b))

    Human 1, sample 0, one threshold -b for all scenes: background that differs
    from scene to scene ends up in V.
    """
    del config
    real = jax.nn.softplus(-(c.human + c.offset))
    fake = jnp.where(c.feasible, jax.nn.softplus(c.candidates + c.offset), 0.0)
    mean = jnp.sum(fake, axis=1) / jnp.maximum(jnp.sum(c.feasible, axis=1), 1)
    return _over_scenes(c, real + mean)


LOSSES: dict[str, Callable[[LossInputs, LossConfig], tuple[jax.Array, jax.Array]]] = {
    "rank": _rank,
    "logistic": _logistic,
    "hinge": _hinge,
    "listwise": _listwise,
    "soft": _soft,
    "risk": _risk,
    "gan": _gan,
}


def loss_sums(name: str, inputs: LossInputs, config: LossConfig) -> LossSums:
    """A loss with its count, and how many pairs the human wins.

    Args:
      name: key of `LOSSES`.
      inputs: values of B scenes.
      config: constants.

    Returns:
      Scalars; divide only after summing over all shards.
    """
    loss, terms = LOSSES[name](inputs, config)
    y = inputs.candidates - inputs.human[:, None]
    share = inputs.feasible * inputs.weight[:, None]
    wins = jnp.sum(share * jnp.where(y < 0.0, 1.0, jnp.where(y == 0.0, 0.5, 0.0)))
    return LossSums(loss=loss, terms=terms, wins=wins, pairs=jnp.sum(share))
