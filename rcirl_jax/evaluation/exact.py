"""Exact and score tests of counts: intervals of rates, paired rates, many tests.

Host floats. Sources: Clopper and Pearson, Biometrika 26 (1934); McNemar,
Psychometrika 12 (1947), in its exact binomial form; Tango, Statistics in Medicine 17
(1998); Holm, Scand. J. Statist. 6 (1979). The last two are by hand, because scipy has
no interval of paired rates and no family-wise adjustment.
"""

import math
import statistics

import numpy as np
import scipy  # loads scipy.stats, half a second, where it is first used

from rcirl_jax.errors import InputError

CONFIDENCE = 0.95  # 1, of all intervals unless said


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
