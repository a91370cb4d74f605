"""Exact and score tests of counts: intervals of rates, paired rates, many tests.

Host floats. Sources: Clopper and Pearson, Biometrika 26 (1934); McNemar,
Psychometrika 12 (1947), in its exact binomial form; Tango, Statistics in Medicine 17
(1998); the exact unconditional test built on its statistic, Sidik, Statistics in
Medicine 22 (2003), with the nuisance parameter's interval of Berger and Boos, JASA 89
(1994); Holm, Scand. J. Statist. 6 (1979). All but the first two are by hand, because
scipy has no interval or test with a margin of paired rates and no family-wise
adjustment.
"""

import math
import statistics

import numpy as np
import scipy  # loads scipy.stats, half a second, where it is first used
from scipy.special import bdtr, bdtrc, ndtr

from rcirl_jax.errors import InputError

CONFIDENCE = 0.95  # 1, of all intervals unless said
ALPHA = 0.025  # 1, size of a one-sided test: the lower end of a 95 % interval
NUISANCE_ALPHA = 1e-4  # 1, error spent on where the nuisance parameter lies
NUISANCE_STEPS = 48  # values of the nuisance parameter that are tried
MAX_DISCORDANT = 250  # above, the normal approximation is as good and quick
TAIL = 1e-12  # 1, probability that is left out of a sum


def rule_of_three(n: int) -> float:
    """Upper 95 % bound of a rate that was 0 in n trials: 3 / n.

    The exact one-sided bound is 1 - 0.05^(1/n) < -ln(0.05) / n < 3 / n.
    """
    if n < 1:
        raise InputError(f"rule_of_three: n: {n}: expected at least 1")
    return min(1.0, 3.0 / n)


def clopper_pearson(
    k: int, n: int, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Exact two-sided interval of a rate with k events in n trials.

    P(X >= k; low) = P(X <= k; high) = (1 - confidence) / 2, X ~ Binomial(n, rate).
    The ends are 0 for k = 0 and 1 for k = n.
    """
    if not 0 <= k <= n or n < 1 or not 0.0 < confidence < 1.0:
        raise InputError(
            f"clopper_pearson: k, n, confidence: {k}, {n}, {confidence}:"
            " expected 0 <= k <= n, n >= 1 and confidence in (0, 1)"
        )
    found = scipy.stats.binomtest(k, n).proportion_ci(confidence, method="exact")
    return float(found.low), float(found.high)


def mcnemar_exact(b: int, c: int) -> float:
    """Two-sided exact p value for b against c discordant pairs.

    Under the null hypothesis each discordant pair falls to either side with
    probability 1/2: p = min(1, 2 P(X <= min(b, c))), X ~ Binomial(b + c, 1/2).
    """
    if min(b, c) < 0:
        raise InputError(f"mcnemar_exact: b, c: {b}, {c}: expected counts >= 0")
    return float(scipy.stats.binomtest(b, b + c).pvalue) if b + c else 1.0


def tango(
    b: int, c: int, n: int, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Score interval of (b - c) / n, a difference of two rates of paired trials.

    The ends are where the score statistic

        z(d) = (b - c - n d) / sqrt(n (2 q + d (1 - d)))

    is +-z of the confidence; q is the likelihood's best probability of a pair of
    kind c, given the difference d. It does not shrink to nothing where no pair is
    discordant (b = c = 0), and so can prove non-inferiority of rare events.

    Args:
      b: pairs that only the first passes.
      c: pairs that only the second passes.
      n: all pairs.
      confidence: of the interval; its one-sided ends have (1 + confidence) / 2.
    """
    if min(b, c) < 0 or b + c > n or n < 1:
        raise InputError(f"tango: b, c, n: {b}, {c}, {n}: expected b + c <= n, n >= 1")
    z = statistics.NormalDist().inv_cdf(0.5 * (1.0 + confidence))
    middle = (b - c) / n

    def end(outer: float) -> float:
        inner = middle
        while True:
            d = 0.5 * (inner + outer)
            if d in (inner, outer) or abs(outer - inner) < 1e-12:
                return d
            if abs(_score(b, c, n, d)) < z:
                inner = d
            else:
                outer = d

    return end(-1.0), end(1.0)


def _score(b: int, c: int, n: int, d: float) -> float:
    """Tango's statistic for a difference of d."""
    linear = (2 * n - b + c) * d - b - c
    q = (math.sqrt(linear**2 + 8 * n * c * d * (1.0 - d)) - linear) / (4 * n)
    variance = n * (2.0 * q + d * (1.0 - d))
    over = b - c - n * d
    if variance <= 0.0:
        return math.copysign(math.inf, over) if over else 0.0
    return over / math.sqrt(variance)


def holm(p_values: np.ndarray) -> np.ndarray:
    """Holm's step-down adjusted p values, in the order given.

    With p sorted upwards, adjusted_i = max over j <= i of min(1, (m - j) p_j),
    j from 0. Rejecting where adjusted <= alpha keeps the family-wise error.
    """
    p = np.asarray(p_values, np.float64).reshape(-1)
    if not np.all((p >= 0.0) & (p <= 1.0)):
        raise InputError("holm: p_values: NaN or outside [0, 1]: expected p values")
    order = np.argsort(p, kind="stable")
    scaled = p[order] * (p.size - np.arange(p.size))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(scaled))
    return adjusted


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
