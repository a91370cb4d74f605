"""Exact test that a driver has not more rare faults than another, up to a margin.

Host numpy, float64. Sources: the score statistic of Tango, Statistics in Medicine 17
(1998); the exact unconditional test built on it, Sidik, Statistics in Medicine 22
(2003); the interval of the nuisance parameter, Berger and Boos, JASA 89 (1994).
By hand, because scipy's exact tests are of unpaired counts and without a margin.
"""

import numpy as np
from scipy.special import bdtr, bdtrc, ndtr

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.exact import clopper_pearson

ALPHA = 0.025  # 1, size of a one-sided test: the lower end of a 95 % interval
NUISANCE_ALPHA = 1e-4  # 1, error spent on where the nuisance parameter lies
NUISANCE_STEPS = 48  # values of the nuisance parameter that are tried
MAX_DISCORDANT = 250  # above, the normal approximation is as good and quick
TAIL = 1e-12  # 1, probability that is left out of a sum


def scores(gained: np.ndarray, lost: np.ndarray, n: int, margin: float) -> np.ndarray:
    """Tango's statistic at a loss of exactly `margin`; large: a smaller loss.

        z = (gained - lost + n m) / sqrt(n (2 q - m (1 + m)))

    with q the likelihood's best probability of a lost pair under the loss m.

    Args:
      gained: pairs that only the candidate passes; any shape.
      lost: pairs that only the incumbent passes; the same shape.
      n: all pairs.
      margin: m, within (0, 1).
    """
    d = -margin
    linear = (2 * n - gained + lost) * d - gained - lost
    root = np.sqrt(np.maximum(linear**2 + 8 * n * lost * d * (1.0 - d), 0.0))
    q = (root - linear) / (4 * n)
    variance = n * np.maximum(2.0 * q + d * (1.0 - d), 1e-12 / n)
    return (gained - lost - n * d) / np.sqrt(variance)


def no_more_faults(gained: int, lost: int, n: int, margin: float) -> float:
    """Exact one-sided p value of "the candidate fails `margin` n cases more, or worse".

    The sum of the probabilities of all outcomes (g, l) whose score is at least that of
    the outcome seen, where l ~ Binomial(n, q + m) and g of the others with probability
    q / (1 - q - m): the largest over the nuisance parameter q within its exact interval
    of confidence 1 - `NUISANCE_ALPHA`, plus that error. A small p shows that there are
    not more faults, up to the margin. With more than `MAX_DISCORDANT` unlike pairs it
    is the tail of the normal distribution at the score.

    Args:
      gained: pairs in which only the incumbent has a fault.
      lost: pairs in which only the candidate has one.
      n: all pairs.
      margin: m, the loss as a share of all pairs, within (0, 1).

    Raises:
      InputError: counts or a margin that cannot be.
    """
    if min(gained, lost) < 0 or gained + lost > n or not 0.0 < margin < 1.0:
        raise InputError(
            f"no_more_faults: gained, lost, n, margin: {gained}, {lost}, {n}, {margin}:"
            " expected gained + lost <= n and a margin within (0, 1)"
        )
    seen = float(scores(np.array(gained), np.array(lost), n, margin))
    if gained + lost > MAX_DISCORDANT or seen <= 0.0:
        return float(ndtr(-seen))
    low, high = clopper_pearson(gained, n, 1.0 - NUISANCE_ALPHA)
    q = np.linspace(low, min(high, 1.0 - margin), NUISANCE_STEPS)
    return min(1.0, float(_tail(seen, q, n, margin).max()) + NUISANCE_ALPHA)


def _tail(seen: float, q: np.ndarray, n: int, margin: float) -> np.ndarray:
    """[Q] probability of a score of at least `seen`, under each nuisance value [Q]."""
    most = np.arange(n + 1)
    lost = most[bdtrc(most, n, q.max() + margin) > TAIL]
    lost = np.arange(lost.size + 1)  # [L] from 0 to what is still possible
    gained = np.arange(np.sum(bdtrc(most, n, q.max()) > TAIL) + 2)  # [G]
    reached = scores(gained[None], lost[:, None], n, margin) >= seen - 1e-9  # [L, G]
    # the score rises with `gained`: the fewest that reach it, or none at all
    fewest = np.where(reached.any(axis=1), reached.argmax(axis=1), n + 1)
    p = q[:, None] + margin
    here = bdtr(lost, n, p) - np.where(lost > 0, bdtr(lost - 1, n, p), 0.0)
    share = np.minimum(q[:, None] / np.maximum(1.0 - p, 1e-12), 1.0)
    left = n - lost
    above = np.where(fewest == 0, 1.0, bdtrc(np.minimum(fewest - 1, left), left, share))
    return np.sum(here * np.where(fewest > left, 0.0, above), axis=1)
