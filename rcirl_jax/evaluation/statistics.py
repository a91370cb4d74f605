"""Intervals and tests that respect how the data were made.

Scenes of one vehicle resemble each other, so vehicles (clusters) are resampled, not
scenes; training runs differ by their seed, so runs are resampled too. Counts of cases
have exact or score tests. Host numpy, float64. Axes: `R` runs, `S` scenes, `C`
clusters, `n` resamples.

Sources: Davison and Hinkley, Bootstrap Methods and their Application (1997), chapter 5
(percentile intervals) and 3.8 (clusters); Cochran, Sampling Techniques (1977), 5.3-5.4
(strata); Clopper and Pearson, Biometrika 26 (1934); McNemar, Psychometrika 12 (1947),
in its exact binomial form; Tango, Statistics in Medicine 17 (1998); the exact
unconditional test built on its statistic, Sidik, Statistics in Medicine 22 (2003), with
the nuisance parameter's interval of Berger and Boos, JASA 89 (1994); Holm, Scand. J.
Statist. 6 (1979). `scipy.stats.bootstrap` draws values, not clusters, and anew for each
statistic; scipy has no paired rates with a margin and no family-wise adjustment.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import scipy  # loads scipy.stats, half a second, where it is first used
from numpy.typing import ArrayLike
from scipy.optimize import root_scalar
from scipy.special import bdtr, bdtrc, ndtr, ndtri, stdtr, stdtrit

from rcirl_jax.errors import InputError

CONFIDENCE = 0.95  # 1, of all intervals unless said
NUM_RESAMPLES = 2000  # n; the ends of a 95 % interval rest on 50 draws each
BOOTSTRAP_SEED = 20180814  # one fixed seed: the same data give the same table
CHUNK_CELLS = 4_000_000  # cells of a temporary array, 32 MB of float64
ALPHA = 0.025  # 1, size of a one-sided test: the lower end of a 95 % interval
NUISANCE_ALPHA = 1e-4  # 1, error spent on where the nuisance parameter lies
NUISANCE_STEPS = 48  # values of the nuisance parameter that are tried
MAX_DISCORDANT = 250  # above, the normal approximation is as good and quick
TAIL = 1e-12  # 1, probability that is left out of a sum


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimate:
    """A number with its interval; units are those of the values."""

    value: float
    low: float
    high: float
    se: float  # standard error: spread of the bootstrap replicates
    seed_sd: float | None = None  # between runs; None with a single run
    seed_se: float | None = None  # seed_sd / sqrt(runs)
    exact: bool = False  # the interval is an exact bound, not a bootstrap


@dataclasses.dataclass(frozen=True, kw_only=True)
class Difference:
    """Mean of a - b over the same scenes."""

    mean: float
    low: float
    high: float
    se: float
    p: float  # two-sided, for a difference of zero

    @property
    def is_apart(self) -> bool:
        """True if the interval leaves out 0."""
        return not self.low <= 0.0 <= self.high


# ---------------------------------------------------------------- bootstrap


class ClusterBootstrap:
    """Resampled vehicles, drawn once and shared by every statistic.

    Each resample draws C clusters with replacement, which gives every cluster a
    multinomial weight. Sharing the draws makes all rows of a table face the same
    resampled road, so their differences are paired.

    Args:
      cluster: [S] int, the vehicle of each scene; at least 2 different ones.
      num_resamples: n.
      seed: of the Philox generator.
    """

    def __init__(
        self,
        cluster: np.ndarray,
        num_resamples: int = NUM_RESAMPLES,
        seed: int = BOOTSTRAP_SEED,
    ) -> None:
        found, index = np.unique(np.asarray(cluster), return_inverse=True)
        if found.size < 2:
            raise InputError(
                f"bootstrap: cluster: {found.size} vehicles: expected at least 2,"
                " one vehicle alone says nothing about others"
            )
        self.cluster = index.reshape(-1)  # [S], from 0
        self.num_clusters = int(found.size)
        self.num_resamples = num_resamples
        self._seed = seed
        self._weights = self._draw(found.size, 0)
        self._of_runs: dict[tuple[int, int], np.ndarray] = {}

    def _draw(self, count: int, stream: int) -> np.ndarray:
        """Draws [n, count] multinomial weights, `count` draws each."""
        key = np.random.SeedSequence([self._seed, stream])
        generator = np.random.Generator(np.random.Philox(key))
        weights = np.empty((self.num_resamples, count), np.uint16)
        for rows in _chunks(self.num_resamples, count):
            size = rows.stop - rows.start
            drawn = generator.integers(count, size=(size, count))
            drawn += count * np.arange(size)[:, None]
            counted = np.bincount(drawn.reshape(-1), minlength=size * count)
            weights[rows] = counted.reshape(size, count)
        return weights

    def means(
        self, values: np.ndarray, weight: np.ndarray | None = None, stream: int = 1
    ) -> np.ndarray:
        """Returns [n] replicates of the mean over runs and scenes.

        Per run a ratio of weighted sums, sum(w x) / sum(w); then the mean over
        resampled runs. The plain bootstrap of R runs has only (R - 1) / R of the
        variance of their mean, which matters with few runs, so the run weights are
        stretched about 1 by sqrt(R / (R - 1)).

        Args:
          values: [R, S] or [S].
          weight: [S] >= 0, of the scenes; None weighs them alike.
          stream: of the run draws; rows to be compared need different ones.
        """
        runs, weight = self._inputs(values, weight)
        totals = np.stack(  # [C, R + 1]
            [self._sum(x) for x in [*(runs * weight), weight]], axis=1
        )
        sums = np.empty((self.num_resamples, totals.shape[1]))
        for rows in _chunks(self.num_resamples, self.num_clusters):
            sums[rows] = self._weights[rows].astype(np.float64) @ totals
        ratios = sums[:, :-1] / sums[:, -1:]
        count = runs.shape[0]
        if count == 1:
            return ratios[:, 0]
        key = (count, stream)
        if key not in self._of_runs:
            draws = self._draw(count, stream).astype(np.float64)
            stretch = math.sqrt(count / (count - 1))
            self._of_runs[key] = 1.0 + (draws - 1.0) * stretch
        return np.mean(self._of_runs[key] * ratios, axis=1)

    def mean(self, values: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
        """Returns [R], the mean of each run over the scenes."""
        runs, weight = self._inputs(values, weight)
        return runs @ weight / weight.sum()

    def medians(self, values: np.ndarray) -> np.ndarray:
        """Returns [n] replicates of the median over scenes of values [S]."""
        order = np.argsort(values, kind="stable")
        ranked = np.asarray(values, np.float64)[order]
        index = self.cluster[order]
        out = np.empty(self.num_resamples)
        for rows in _chunks(self.num_resamples, ranked.size):
            reach = np.cumsum(self._weights[rows][:, index], axis=1, dtype=np.int64)
            total = reach[:, -1:]
            lower = np.sum(reach <= (total - 1) // 2, axis=1)
            upper = np.sum(reach <= total // 2, axis=1)
            out[rows] = 0.5 * (ranked[lower] + ranked[upper])
        return out

    def _sum(self, values: np.ndarray) -> np.ndarray:
        return np.bincount(self.cluster, values, minlength=self.num_clusters)

    def _inputs(
        self, values: np.ndarray, weight: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Checks and returns values [R, S] and weights [S]."""
        runs, count = np.atleast_2d(np.asarray(values, np.float64)), self.cluster.size
        if runs.ndim != 2 or runs.shape[1] != count or not np.isfinite(runs).all():
            raise InputError(
                f"bootstrap: values: shape {runs.shape}: expected [runs, {count}],"
                " all finite"
            )
        if weight is None:
            return runs, np.ones(count)
        weight = np.asarray(weight, np.float64)
        bad = weight.shape != (count,) or weight.min() < 0.0
        if bad or self._sum(weight).min() <= 0.0:
            raise InputError(
                "bootstrap: weight: negative, or zero for a whole vehicle:"
                f" expected [{count}] weights with a positive sum per vehicle"
            )
        return runs, weight


def _chunks(rows: int, columns: int) -> list[slice]:
    """Returns slices over the rows that keep a temporary array small."""
    step = max(1, CHUNK_CELLS // max(columns, 1))
    return [slice(at, min(at + step, rows)) for at in range(0, rows, step)]


def _bootstrap(cluster: np.ndarray | ClusterBootstrap) -> ClusterBootstrap:
    known = isinstance(cluster, ClusterBootstrap)
    return cluster if known else ClusterBootstrap(cluster)


def _interval(replicates: np.ndarray) -> tuple[float, float, float]:
    """Returns (low, high, standard error) of bootstrap replicates."""
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = np.quantile(replicates, [tail, 1.0 - tail])
    return float(low), float(high), float(np.std(replicates, ddof=1))


def combine_seeds(
    values: np.ndarray,
    cluster: np.ndarray | ClusterBootstrap,
    *,
    weight: np.ndarray | None = None,
) -> Estimate:
    """Returns the mean over runs and scenes, with an interval that covers both.

    Vehicles and runs are resampled jointly. With one run only the vehicles are, and
    the result says nothing about other seeds.

    Args:
      values: [R, S], or [S] for a single run.
      cluster: [S] int, or the bootstrap to share.
      weight: [S] weights of the scenes, for a ratio of sums.

    Returns:
      Estimate; `seed_sd` is the standard deviation of the runs' means.
    """
    bootstrap = _bootstrap(cluster)
    replicates = bootstrap.means(values, weight)
    return estimate_of(bootstrap.mean(values, weight), replicates)


def estimate_of(means: np.ndarray, replicates: np.ndarray) -> Estimate:
    """Returns the estimate of means [R] and replicates [n]; see `combine_seeds`."""
    low, high, se = _interval(replicates)
    value, count = float(means.mean()), means.size
    if count == 1:
        return Estimate(value=value, low=low, high=high, se=se)
    sd = float(np.std(means, ddof=1))
    return Estimate(
        value=value, low=low, high=high, se=se,
        seed_sd=sd, seed_se=sd / math.sqrt(count),
    )  # fmt: skip


def bootstrap_median(
    values: np.ndarray, cluster: np.ndarray | ClusterBootstrap
) -> Estimate:
    """Returns the median over scenes [S] of one run, over resampled vehicles."""
    low, high, se = _interval(_bootstrap(cluster).medians(values))
    return Estimate(value=float(np.median(values)), low=low, high=high, se=se)


def paired_difference(
    a: np.ndarray,
    b: np.ndarray,
    cluster: np.ndarray | ClusterBootstrap,
    *,
    weight: np.ndarray | None = None,
) -> Difference:
    """Returns the mean of a - b on the same scenes; vehicles are resampled together.

    Runs of a and of b are resampled independently. Where run i of both has the same
    seed, they share the order of the batches and the initial draw; that this is not
    used makes the interval wider, if anything. The p value counts replicates on the
    other side of zero, 2 min(P(d <= 0), P(d >= 0)), each with one added to count and
    total, so that it is never below 2 / (n + 1).

    Args:
      a: [R, S] or [S]; the numbers of runs may differ.
      b: [R', S] or [S].
      cluster: [S] int, or the bootstrap to share.
      weight: [S] weights of the scenes, for a difference of ratios.
    """
    bootstrap = _bootstrap(cluster)
    mean = bootstrap.mean(a, weight).mean() - bootstrap.mean(b, weight).mean()
    replicates = bootstrap.means(a, weight, 1) - bootstrap.means(b, weight, 2)
    return difference_of(float(mean), replicates)


def difference_of(mean: float, replicates: np.ndarray) -> Difference:
    """Returns the difference of replicates [n]; see `paired_difference`."""
    low, high, se = _interval(replicates)
    total = replicates.size + 1
    below = (1 + np.count_nonzero(replicates <= 0.0)) / total
    above = (1 + np.count_nonzero(replicates >= 0.0)) / total
    p = float(min(1.0, 2.0 * min(below, above)))
    return Difference(mean=mean, low=low, high=high, se=se, p=p)


# ---------------------------------------------------------------- Student's t


def family_clusters(families: Sequence[str] | np.ndarray) -> np.ndarray:
    """Returns [C], the number of each case's family; its own where there is one."""
    _, index = np.unique(np.asarray(families), return_inverse=True)
    return index if index.max() > 0 else np.arange(index.size)


def _student(mean: float, se: float, df: int, p: float, reach: float) -> Difference:
    """Returns Student's interval; with `p` and `reach` where there is no spread."""
    if se > 0.0:
        reach = se * float(stdtrit(df, 0.5 * (1.0 + CONFIDENCE)))
        p = 2.0 * float(stdtr(df, -abs(mean) / se))
    return Difference(mean=mean, low=mean - reach, high=mean + reach, se=se, p=p)


def cluster_t(a: np.ndarray, b: np.ndarray, cluster: np.ndarray) -> Difference:
    """Returns the mean of a - b with Student's interval over clusters, for few.

        z_g = G / S * sum of (a - b) in cluster g,   t = mean z / (sd z / sqrt(G))

    with G - 1 degrees of freedom. A percentile bootstrap of two clusters takes
    agreement by chance for certainty; this does not. Clusters that all say the same
    have no spread to reckon with: p is then that of their signs, 2^(1 - G), or 1 if
    they all say 0, and the interval has no ends unless p < 1 - CONFIDENCE.

    Args:
      a: [S].
      b: [S].
      cluster: [S] int; at least 2 different ones.
    """
    found, index = np.unique(np.asarray(cluster), return_inverse=True)
    groups, difference = found.size, np.asarray(a, float) - np.asarray(b, float)
    if groups < 2:
        raise InputError(f"cluster_t: {groups} clusters: expected at least 2")
    z = groups / difference.size * np.bincount(index.reshape(-1), difference)
    mean, se = float(z.mean()), float(z.std(ddof=1)) / math.sqrt(groups)
    p = 1.0 if mean == 0.0 else 2.0 ** (1 - groups)
    reach = 0.0 if mean == 0.0 or p < 1.0 - CONFIDENCE else math.inf
    return _student(mean, se, groups - 1, p, reach)


def over_clusters(
    a: np.ndarray, b: np.ndarray, clusters: ClusterBootstrap
) -> Difference:
    """Returns the mean of a - b: the wider interval and larger p of two methods.

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


def within_strata(a: np.ndarray, b: np.ndarray, stratum: np.ndarray) -> Difference:
    """Returns the mean of a - b over values drawn independently within fixed strata.

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
    groups, members = np.unique(index, return_inverse=True)
    count = np.bincount(members)
    spread = d - (np.bincount(members, d) / count)[members]
    free = np.maximum(count - 1, 1)  # a stratum of one value has no spread
    variance = np.sum(np.bincount(members, spread**2) / free * count) / d.size**2
    mean, df = float(d.mean()), max(d.size - groups.size, 1)
    return _student(mean, math.sqrt(variance), df, float(mean == 0.0), 0.0)


# ---------------------------------------------------------------- counts


def clopper_pearson(
    k: int, n: int, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Returns the exact two-sided interval of a rate with k events in n trials.

    P(X >= k; low) = P(X <= k; high) = (1 - confidence) / 2, X ~ Binomial(n, rate).
    The ends are 0 for k = 0 and 1 for k = n.
    """
    found = scipy.stats.binomtest(k, n).proportion_ci(confidence, method="exact")
    return float(found.low), float(found.high)


def mcnemar_exact(b: int, c: int) -> float:
    """Returns the two-sided exact p value for b against c discordant pairs.

    Under the null hypothesis each discordant pair falls to either side with
    probability 1/2: p = min(1, 2 P(X <= min(b, c))), X ~ Binomial(b + c, 1/2).
    """
    return float(scipy.stats.binomtest(b, b + c).pvalue) if b + c else 1.0


def holm(p_values: ArrayLike) -> np.ndarray:
    """Returns Holm's step-down adjusted p values, in the order given.

    With p sorted upwards, adjusted_i = max over j <= i of min(1, (m - j) p_j), j from
    0. Rejecting where adjusted <= alpha keeps the family-wise error.
    """
    p = np.asarray(p_values, np.float64).reshape(-1)
    if not np.all((p >= 0.0) & (p <= 1.0)):
        raise InputError("holm: p_values: NaN or outside [0, 1]: expected p values")
    order = np.argsort(p, kind="stable")
    scaled = p[order] * (p.size - np.arange(p.size))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(scaled))
    return adjusted


def tango_score(
    gained: np.ndarray | int, lost: np.ndarray | int, n: int, d: float
) -> np.ndarray:
    """Returns Tango's statistic for a difference of two paired rates of exactly d.

        z(d) = (gained - lost - n d) / sqrt(n (2 q + d (1 - d)))

    with q the likelihood's best probability of a lost pair, given the difference d.

    Args:
      gained: pairs that only the first passes; any shape.
      lost: pairs that only the second passes; the same shape.
      n: all pairs.
      d: within [-1, 1].
    """
    linear = (2 * n - gained + lost) * d - gained - lost
    root = np.sqrt(np.maximum(linear**2 + 8 * n * lost * d * (1.0 - d), 0.0))
    q = (root - linear) / (4 * n)
    variance = n * np.maximum(2.0 * q + d * (1.0 - d), 1e-12 / n)
    return (gained - lost - n * d) / np.sqrt(variance)


def paired_rates(pairs: tuple[int, int], total: int) -> Difference:
    """Returns the share gained minus lost, with Tango's interval and McNemar's p.

    The interval's ends are where `tango_score` is +-z of the confidence. It does not
    shrink to nothing where no pair is discordant, and so can prove non-inferiority of
    rare events.

    Args:
      pairs: (gained, lost) cases.
      total: all cases.
    """
    mean, z = (pairs[0] - pairs[1]) / total, float(ndtri(0.5 * (1.0 + CONFIDENCE)))

    def end(outer: float) -> float:
        def beyond(d: float) -> float:
            return abs(float(tango_score(*pairs, total, d))) - z

        # the score is 0 at the mean; a mean of -1 or 1 is its own end
        known = mean == outer or beyond(outer) <= 0.0
        if known:
            return outer
        return float(root_scalar(beyond, bracket=(mean, outer), xtol=1e-13).root)

    low, high, p = end(-1.0), end(1.0), mcnemar_exact(*pairs)
    return Difference(mean=mean, low=low, high=high, se=np.nan, p=p)


def no_more_faults(gained: int, lost: int, n: int, margin: float) -> float:
    """Returns the exact one-sided p of "it fails `margin` n cases more, or worse".

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
    """
    seen = float(tango_score(gained, lost, n, -margin))
    if gained + lost > MAX_DISCORDANT or seen <= 0.0:
        return float(ndtr(-seen))
    low, high = clopper_pearson(gained, n, 1.0 - NUISANCE_ALPHA)
    q = np.linspace(low, min(high, 1.0 - margin), NUISANCE_STEPS)
    return min(1.0, float(_tail(seen, q, n, margin).max()) + NUISANCE_ALPHA)


def _tail(seen: float, q: np.ndarray, n: int, margin: float) -> np.ndarray:
    """Returns [Q], the probability of a score of at least `seen`, by nuisance value."""
    most = np.arange(n + 1)
    lost = most[bdtrc(most, n, q.max() + margin) > TAIL]
    lost = np.arange(lost.size + 1)  # [L] from 0 to what is still possible
    gained = np.arange(np.sum(bdtrc(most, n, q.max()) > TAIL) + 2)  # [G]
    scores = tango_score(gained[None], lost[:, None], n, -margin)  # [L, G]
    # the score rises with `gained`: the fewest that reach it, or none at all
    reached = scores >= seen - 1e-9
    fewest = np.where(reached.any(axis=1), reached.argmax(axis=1), n + 1)
    p = q[:, None] + margin
    here = bdtr(lost, n, p) - np.where(lost > 0, bdtr(lost - 1, n, p), 0.0)
    share = np.minimum(q[:, None] / np.maximum(1.0 - p, 1e-12), 1.0)
    left = n - lost
    above = np.where(fewest == 0, 1.0, bdtrc(np.minimum(fewest - 1, left), left, share))
    return np.sum(here * np.where(fewest > left, 0.0, above), axis=1)
