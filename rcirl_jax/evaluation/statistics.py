"""Intervals and tests that respect how the data were made.

Scenes of one vehicle resemble each other, so vehicles (clusters) are resampled,
not scenes; training runs differ by their seed, so runs are resampled too. Host
numpy, float64. Axes: `R` runs, `S` scenes, `C` clusters, `n` resamples.

Sources: Davison and Hinkley, Bootstrap Methods and their Application (1997),
chapter 5 (percentile intervals) and 3.8 (clusters). Tests of counts: `exact`.
By hand, because `scipy.stats.bootstrap` draws values, not clusters, and anew for each
statistic.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy.special import stdtr, stdtrit

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.exact import CONFIDENCE

NUM_RESAMPLES = 2000  # n; the ends of a 95 % interval rest on 50 draws each
BOOTSTRAP_SEED = 20180814  # one fixed seed: the same data give the same table
_CHUNK_CELLS = 4_000_000  # cells of a temporary array, 32 MB of float64


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
        """Whether the interval leaves out 0."""
        return not self.low <= 0.0 <= self.high


class ClusterBootstrap:
    """Resampled vehicles, drawn once and shared by every statistic.

    Each resample draws C clusters with replacement, which gives every cluster
    a multinomial weight. Sharing the draws makes all rows of a table face the
    same resampled road, so their differences are paired.

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
        self._index = index.reshape(-1)
        self._seed = seed
        self._weights = self._draw(found.size, 0)
        self._of_runs: dict[tuple[int, int], np.ndarray] = {}

    def _run_weights(self, count: int, stream: int) -> np.ndarray:
        """[n, count] weights of runs, drawn once for all statistics."""
        key = (count, stream)
        if key not in self._of_runs:
            draws = self._draw(count, stream).astype(np.float64)
            stretch = math.sqrt(count / (count - 1))
            self._of_runs[key] = 1.0 + (draws - 1.0) * stretch
        return self._of_runs[key]

    def _draw(self, count: int, stream: int) -> np.ndarray:
        """[n, count] multinomial weights, `count` draws each."""
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

    def _sums(self, values: np.ndarray) -> np.ndarray:
        """[n, M] weighted sums over the scenes of values [S, M]."""
        totals = np.stack(
            [
                np.bincount(self._index, column, minlength=self.num_clusters)
                for column in values.T
            ],
            axis=1,
        )
        out = np.empty((self.num_resamples, values.shape[1]))
        for rows in _chunks(self.num_resamples, self.num_clusters):
            out[rows] = self._weights[rows].astype(np.float64) @ totals
        return out

    def means(
        self, values: np.ndarray, weight: np.ndarray | None = None, stream: int = 1
    ) -> np.ndarray:
        """[n] replicates of the mean over runs and scenes.

        Per run a ratio of weighted sums, sum(w x) / sum(w); then the mean over
        resampled runs. The plain bootstrap of R runs has only (R - 1) / R of
        the variance of their mean, which matters with few runs, so the run
        weights are stretched about 1 by sqrt(R / (R - 1)).

        Args:
          values: [R, S] or [S].
          weight: [S] >= 0, of the scenes; None weighs them alike.
          stream: of the run draws; rows to be compared need different ones.
        """
        runs, weight = self._inputs(values, weight)
        sums = self._sums(np.concatenate([runs * weight, weight[None]]).T)
        ratios = sums[:, :-1] / sums[:, -1:]
        count = runs.shape[0]
        if count == 1:
            return ratios[:, 0]
        return np.mean(self._run_weights(count, stream) * ratios, axis=1)

    def mean(self, values: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
        """[R] mean of each run over the scenes."""
        runs, weight = self._inputs(values, weight)
        return runs @ weight / weight.sum()

    def medians(self, values: np.ndarray) -> np.ndarray:
        """[n] replicates of the median over scenes of values [S]."""
        order = np.argsort(values, kind="stable")
        ranked = np.asarray(values, np.float64)[order]
        index = self._index[order]
        out = np.empty(self.num_resamples)
        for rows in _chunks(self.num_resamples, ranked.size):
            reach = np.cumsum(self._weights[rows][:, index], axis=1, dtype=np.int64)
            total = reach[:, -1:]
            lower = np.sum(reach <= (total - 1) // 2, axis=1)
            upper = np.sum(reach <= total // 2, axis=1)
            out[rows] = 0.5 * (ranked[lower] + ranked[upper])
        return out

    def _inputs(
        self, values: np.ndarray, weight: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        runs = np.atleast_2d(np.asarray(values, np.float64))
        count = self._index.size
        if runs.ndim != 2 or runs.shape[1] != count or not np.isfinite(runs).all():
            raise InputError(
                f"bootstrap: values: shape {runs.shape}: expected [runs, {count}],"
                " all finite"
            )
        if weight is None:
            return runs, np.ones(count)
        weight = np.asarray(weight, np.float64)
        totals = np.bincount(self._index, weight, minlength=self.num_clusters)
        if weight.shape != (count,) or weight.min() < 0.0 or totals.min() <= 0.0:
            raise InputError(
                "bootstrap: weight: negative, or zero for a whole vehicle:"
                f" expected [{count}] weights with a positive sum per vehicle"
            )
        return runs, weight


def _chunks(rows: int, columns: int) -> list[slice]:
    """Slices over the rows that keep a temporary array small."""
    step = max(1, _CHUNK_CELLS // max(columns, 1))
    return [slice(at, min(at + step, rows)) for at in range(0, rows, step)]


def _bootstrap(cluster: np.ndarray | ClusterBootstrap) -> ClusterBootstrap:
    return (
        cluster if isinstance(cluster, ClusterBootstrap) else ClusterBootstrap(cluster)
    )


def _interval(replicates: np.ndarray) -> tuple[float, float, float]:
    """(low, high, standard error) of bootstrap replicates."""
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = np.quantile(replicates, [tail, 1.0 - tail])
    return float(low), float(high), float(np.std(replicates, ddof=1))


def combine_seeds(
    values: np.ndarray,
    cluster: np.ndarray | ClusterBootstrap,
    *,
    weight: np.ndarray | None = None,
) -> Estimate:
    """Mean over runs and scenes, with an interval that covers both.

    Vehicles and runs are resampled jointly. With one run only the vehicles are,
    and the result says nothing about other seeds.

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
    """From the means of runs [R] and bootstrap replicates [n]; see `combine_seeds`."""
    low, high, se = _interval(replicates)
    value, count = float(means.mean()), means.size
    if count == 1:
        return Estimate(value=value, low=low, high=high, se=se)
    seed_sd = float(np.std(means, ddof=1))
    seed_se = seed_sd / math.sqrt(count)
    return Estimate(
        value=value, low=low, high=high, se=se, seed_sd=seed_sd, seed_se=seed_se
    )


def bootstrap_median(
    values: np.ndarray,
    cluster: np.ndarray | ClusterBootstrap,
) -> Estimate:
    """Median over scenes [S] of one run, with the interval of resampled vehicles."""
    bootstrap = _bootstrap(cluster)
    low, high, se = _interval(bootstrap.medians(values))
    return Estimate(value=float(np.median(values)), low=low, high=high, se=se)


def paired_difference(
    a: np.ndarray,
    b: np.ndarray,
    cluster: np.ndarray | ClusterBootstrap,
    *,
    weight: np.ndarray | None = None,
) -> Difference:
    """Mean of a - b on the same scenes; the vehicles are resampled together.

    Runs of a and of b are resampled independently. Where run i of both has the
    same seed, they share the order of the batches and the initial draw; that this
    is not used makes the interval wider, if anything. The p value counts
    replicates on the other side of zero, 2 min(P(d <= 0), P(d >= 0)), each with
    one added to count and total, so that it is never below 2 / (n + 1).

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
    """A difference from its bootstrap replicates [n]; see `paired_difference`."""
    low, high, se = _interval(replicates)
    total = replicates.size + 1
    below = (1 + np.count_nonzero(replicates <= 0.0)) / total
    above = (1 + np.count_nonzero(replicates >= 0.0)) / total
    return Difference(
        mean=mean,
        low=low,
        high=high,
        se=se,
        p=float(min(1.0, 2.0 * min(below, above))),
    )


def family_clusters(families: Sequence[str] | np.ndarray) -> np.ndarray:
    """[C] number of each case's family; each case its own where there is one family."""
    _, index = np.unique(np.asarray(families), return_inverse=True)
    return index if index.max() > 0 else np.arange(index.size)


def cluster_t(a: np.ndarray, b: np.ndarray, cluster: np.ndarray) -> Difference:
    """Mean of a - b with Student's interval over clusters, for few of them.

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
    df = groups - 1
    if se == 0.0:
        p = 1.0 if mean == 0.0 else 2.0 ** (1 - groups)
        reach = 0.0 if mean == 0.0 or p < 1.0 - CONFIDENCE else math.inf
        return Difference(mean=mean, low=mean - reach, high=mean + reach, se=0.0, p=p)
    reach = se * float(stdtrit(df, 0.5 * (1.0 + CONFIDENCE)))
    p = 2.0 * float(stdtr(df, -abs(mean) / se))
    return Difference(mean=mean, low=mean - reach, high=mean + reach, se=se, p=p)
