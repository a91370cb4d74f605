"""Intervals of the gate: over families as clusters, and within families as strata.

A gain is claimed for driving as such, so families count as draws from all kinds of
scenes: clusters. A loss is judged on the suite as it is, whose families are fixed and
each judged by itself besides: strata, in which cases are independent draws. Host
numpy, float64. Source of the strata: Cochran, Sampling Techniques (1977), 5.3-5.4.
"""

import dataclasses
import math

import numpy as np
from scipy.special import stdtr, stdtrit

from rcirl_jax.evaluation.exact import CONFIDENCE, mcnemar_exact, tango
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    Difference,
    cluster_t,
    paired_difference,
)

MIN_CLUSTERS = 5  # families or vehicles below which no interval over them is made


def counted(pairs: tuple[int, int], total: int) -> Difference:
    """Share of cases gained minus lost, with Tango's interval and McNemar's p.

    Args:
      pairs: (gained, lost) cases.
      total: all cases.
    """
    low, high = tango(*pairs, total, CONFIDENCE)
    mean = (pairs[0] - pairs[1]) / total
    return Difference(mean=mean, low=low, high=high, se=np.nan, p=mcnemar_exact(*pairs))


def over_clusters(
    a: np.ndarray, b: np.ndarray, clusters: ClusterBootstrap
) -> Difference:
    """Mean of a - b over clusters: the wider interval and larger p of two methods.

    The bootstrap alone takes agreement of few clusters by chance for certainty,
    Student's t alone takes skewed ones for normal.

    Args:
      a: [S].
      b: [S].
      clusters: of the S values.
    """
    drawn = paired_difference(a, b, clusters)
    student = cluster_t(a, b, clusters.cluster)
    return Difference(
        mean=drawn.mean,
        low=min(drawn.low, student.low),
        high=max(drawn.high, student.high),
        se=max(drawn.se, student.se),
        p=max(drawn.p, student.p),
    )


def within_strata(
    a: np.ndarray,
    b: np.ndarray,
    stratum: np.ndarray,
) -> Difference:
    """Mean of a - b over S values drawn independently within fixed strata.

        se^2 = sum over strata g of (n_g / S)^2 s_g^2 / n_g

    with s_g^2 the variance of a - b in stratum g, and Student's t with S - G degrees
    of freedom. Strata of one value share one variance: they count as one stratum.
    Values that never differ from one another have no spread to reckon with: the
    interval is then the mean alone.

    Args:
      a: [S].
      b: [S].
      stratum: [S] int.
    """
    d = np.asarray(a, np.float64) - np.asarray(b, np.float64)
    _, index, counts = np.unique(stratum, return_inverse=True, return_counts=True)
    index = np.where(counts[index] > 1, index, -1)
    variance, groups = 0.0, np.unique(index)
    for group in groups:
        values = d[index == group]
        if values.size > 1:
            variance += values.size * float(values.var(ddof=1)) / d.size**2
    mean, se = float(d.mean()), math.sqrt(variance)
    df = max(d.size - groups.size, 1)
    if se == 0.0:
        p = 1.0 if mean == 0.0 else 0.0
        return Difference(mean=mean, low=mean, high=mean, se=0.0, p=p)
    reach = se * float(stdtrit(df, 0.5 * (1.0 + CONFIDENCE)))
    p = 2.0 * float(stdtr(df, -abs(mean) / se))
    return Difference(mean=mean, low=mean - reach, high=mean + reach, se=se, p=p)


def clipped(found: Difference, high: float = 1.0) -> Difference:
    """The same with an interval that stays where a difference can be.

    Args:
      found: with any ends.
      high: largest difference there can be; the smallest is -1.
    """
    return dataclasses.replace(
        found,
        low=min(max(found.low, -1.0), high),
        high=max(min(found.high, high), -1.0),
    )
