"""Responses of a reward to each feature: curves, and prices in physical units.

    R_i(u) = mean over scenes of V(x with x_ti = u at all t), minus its value at the
             median of what people drove, over the standard deviation of V among the
             candidates of a scene
    p_i    = mean over scenes of V(x + h e_i) - V(x - h e_i), over 2 h

x are the features of held-out humans. A reward's scale is free, so the unit of a curve
is the spread among candidates: what one more standard deviation is worth. A price p_i
is what a unit more of a feature at all times is worth; the ratio of two is free of the
scale: so many of the one are worth one of the other.
"""

import dataclasses

import numpy as np

from rcirl_jax.export.reader import Reward

POINTS = 33  # of a curve
SCENES = 24  # of those given that curves are the mean of
OUTER = (0.005, 0.995)  # quantiles of the data between which curves are drawn
STEP = 0.05  # h of a price, share of the feature's range in training


@dataclasses.dataclass(frozen=True, kw_only=True)
class Response:
    """One feature's curve for one reward."""

    at: np.ndarray  # [POINTS] in the feature's unit
    value: np.ndarray  # [POINTS] in standard deviations of V among candidates
    supported: tuple[float, float]  # outside, the reward does not change


def responses(
    reward: Reward, mine: np.ndarray, theirs: np.ndarray, valid: np.ndarray
) -> dict[str, Response]:
    """Return curves of all features that the reward uses.

    Args:
      reward: V is its `value`, also where it has a prior cost.
      mine: [S, T, F] raw features of humans.
      theirs: [S, K, T, F] of candidates of the same scenes.
      valid: [S, T] bool; elsewhere features do not count.
    """
    few = slice(None, None, max(len(mine) // SCENES, 1))
    spread = float(np.mean(np.std(reward.value(theirs, valid[:, None]), axis=1)))
    human, mask = mine[few], valid[few]
    found = {}
    for i, name in enumerate(reward.names):
        if reward.lower[i] >= reward.upper[i]:
            continue
        seen = (
            mine[..., i][valid],
            theirs[..., i][np.broadcast_to(valid[:, None], theirs.shape[:-1])],
        )
        low, high = np.quantile(np.concatenate(seen), OUTER)
        low, high = min(low, reward.lower[i]), max(high, reward.upper[i])
        low, high = np.clip((low, high), *_around(reward, i))
        at = np.linspace(low, high, POINTS)
        held = np.repeat(human[None], POINTS + 1, axis=0)
        held[..., i] = np.append(at, np.median(seen[0]))[:, None, None]
        values = np.mean(reward.value(held, mask), axis=1)
        found[name] = Response(
            at=at,
            value=(values[:-1] - values[-1]) / max(spread, 1e-9),
            supported=(float(reward.lower[i]), float(reward.upper[i])),
        )
    return found


def _around(reward: Reward, i: int) -> tuple[float, float]:
    """Return a feature's range in training, a quarter of it more on either side."""
    low, high = float(reward.lower[i]), float(reward.upper[i])
    more = 0.25 * (high - low)
    return low - more, high + more


def prices(reward: Reward, mine: np.ndarray, valid: np.ndarray) -> dict[str, float]:
    """Return V per unit of each feature; arguments as of `responses`.

    Where the data lie at an end of a feature's range, the step beyond it counts as the
    reward has it: as nothing.
    """
    found = {}
    for i, name in enumerate(reward.names):
        step = np.float32(STEP * (reward.upper[i] - reward.lower[i]))
        if step <= 0.0:
            continue
        moved = np.repeat(mine[None], 2, axis=0)
        moved[0, ..., i] += step
        moved[1, ..., i] -= step
        values = np.asarray(reward.value(moved, valid).mean(axis=1, dtype=np.float64))
        found[name] = float(values[0] - values[1]) / (2.0 * float(step))
    return found
