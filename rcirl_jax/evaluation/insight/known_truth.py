"""Recovery of a reward that is known: experts who follow it, learners who do not.

The recorded human of every frozen scene is replaced by the candidate that a
hidden reward values most (or nearly: Boltzmann experts). What a learner is asked
for is to choose as the hidden reward does on scenes it has not seen.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.evaluation.exact import holm
from rcirl_jax.evaluation.ranking.learners import Learned
from rcirl_jax.evaluation.statistics import Difference, cluster_t
from rcirl_jax.reward import Normaliser, RewardConfig, RewardParams, init_reward, value
from rcirl_jax.train.state import FeatureBatch, TrainConfig

HIDDEN_SPREAD = 3.0  # std of the hidden kernels relative to Glorot's


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class HiddenReward:
    """A reward that only the experts know."""

    params: RewardParams
    normaliser: Normaliser
    config: RewardConfig

    def values(self, frozen: FeatureBatch) -> jax.Array:
        """[S, K] of the candidates; -inf where infeasible."""
        found = value(
            self.params,
            self.normaliser,
            frozen.points,
            frozen.points_valid,
            self.config,
        )
        return jnp.where(frozen.feasible, found, -jnp.inf)


def hidden_reward(
    seed: int, normaliser: Normaliser, hidden: tuple[int, ...] = (15,)
) -> HiddenReward:
    """A random network with saturating units and fading time weights."""
    config = RewardConfig(hidden=hidden)
    count = int(normaliser.scale.shape[0])
    params = init_reward(jax.random.key(seed), count, config)
    kernels = tuple(HIDDEN_SPREAD * kernel for kernel in params.kernels[:-1])
    fading = jnp.exp(-jnp.arange(params.gamma.shape[0]) / 8.0)
    params = params.replace(
        kernels=(*kernels, params.kernels[-1]), gamma=fading * params.gamma
    )
    return HiddenReward(params=params, normaliser=normaliser, config=config)


def experts(
    frozen: FeatureBatch, hidden: HiddenReward, temperature: float, seed: int
) -> FeatureBatch:
    """The same scenes with the hidden reward's choice in the human's place.

        P(choice = k) = softmax(V_hidden / temperature)

    Args:
      frozen: scenes whose own positive is dropped; every feasible candidate may
        be chosen.
      hidden: whom the experts follow.
      temperature: in units of V; 0 chooses the best.
      seed: of the experts' draws.
    """
    values = hidden.values(frozen)
    if temperature > 0.0:
        key = jax.random.key(seed)
        noise = jax.random.gumbel(key, values.shape)
        values = values + temperature * noise
    chosen = jnp.argmax(values, axis=1)
    rows = jnp.arange(chosen.shape[0])
    facts = frozen.facts.replace(
        human_distance=frozen.facts.distance[rows, chosen],
        human_collides=frozen.facts.collides[rows, chosen],
        human_density=frozen.facts.density[rows, chosen],
    )
    return frozen.replace(
        human=frozen.points[rows, chosen],
        feasible=frozen.feasible.at[rows, chosen].set(False),
        facts=facts,
    )


def learns_from_choices(config: TrainConfig) -> bool:
    """Whether all that a learner is told of a scene is which candidate was chosen.

    Soft labels and the margin of the hinge are distances to the recorded human, whom
    the experts replace; hard negatives are candidates that other learners lack.
    """
    return config.loss not in ("soft", "hinge") and not config.hard_negatives


def agreement(
    frozen: FeatureBatch, hidden: HiddenReward, learned: Learned
) -> tuple[float, float]:
    """How a learned reward chooses where the hidden one would.

        lost = sum over scenes (V* - V(chosen)) / sum over scenes (V* - median V)

    V is the hidden reward, V* its best. A ratio of sums: scenes in which all
    candidates are worth the same have nothing to lose and must not count.

    Returns:
      share of scenes with the same choice, and the share lost of the hidden value
      (0: none; 1: as the median candidate).
    """
    truth = np.asarray(hidden.values(frozen), np.float64)
    points, valid = np.asarray(frozen.points), np.asarray(frozen.points_valid)
    own = np.asarray(learned.scorer(points, valid), np.float64)
    own = np.where(np.isfinite(truth), own, -np.inf)
    chosen, best = own.argmax(axis=1), truth.argmax(axis=1)
    rows = np.arange(best.size)
    middle = np.nanmedian(np.where(np.isfinite(truth), truth, np.nan), axis=1)
    best_value = truth[rows, best]
    lost, stake = best_value - truth[rows, chosen], best_value - middle
    return float(np.mean(chosen == best)), float(lost.sum() / stake.sum())


def differences(
    same: Mapping[str, np.ndarray], against: str
) -> dict[str, tuple[Difference, float]]:
    """Does agreement rise with data, and is it above another learner's?

    Paired over hidden rewards, Student's intervals, p values by Holm's correction
    over all of these questions.

    Args:
      same: learner -> [H, C] agreement with each hidden reward, from few scenes to
        many.
      against: the learner that the others are compared with, at most scenes.

    Returns:
      Question in words -> (difference, adjusted p).
    """
    pairs = {
        f"{name}, most scenes minus fewest": (runs[:, -1], runs[:, 0])
        for name, runs in same.items()
    }
    pairs |= {
        f"{name} minus {against}, most scenes": (runs[:, -1], same[against][:, -1])
        for name, runs in same.items()
        if name != against
    }
    found = {
        words: cluster_t(a, b, np.arange(a.size)) for words, (a, b) in pairs.items()
    }
    adjusted = holm(np.array([d.p for d in found.values()]))
    return {
        words: (d, float(p))
        for (words, d), p in zip(found.items(), adjusted, strict=True)
    }
