"""What the data say of a learned reward, and how sure it is where it chooses.

Three questions of a sceptic, answered on frozen candidates:

    which weights do the data support?   `weights_supported` (the linear reward)
    how sure is a choice?                `choices_of`: seeds and Laplace
    why this one and not the human's?    `reasons`: integrated gradients

An uncertainty is useful only if choices that are unsure are also worse; that is
measured too, as the rank correlation of both.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_triangular
from scipy.stats import rankdata

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.insight.attribution import attribute
from rcirl_jax.evaluation.insight.identify import IdentifiabilityReport, identify
from rcirl_jax.evaluation.insight.laplace import (
    laplace,
    last_layer_features,
    most_probable,
)
from rcirl_jax.evaluation.ranking.learners import Learned
from rcirl_jax.evaluation.statistics import ClusterBootstrap
from rcirl_jax.features import feature_map
from rcirl_jax.reward import pinned
from rcirl_jax.train.state import FeatureBatch
from rcirl_jax.units import TIMES_S

CHUNK = 64  # scenes per call; more may meet jax-ml/jax issue 39103 on CPUs
DRAWS = 64  # of the posterior
PRIOR_PRECISION = 1.0  # 1 / variance of an output weight before the data


@dataclasses.dataclass(frozen=True, kw_only=True)
class Choices:
    """What each scene's candidates come to, and how far that may be off."""

    chosen: np.ndarray  # [S] index of the best by the mean of all runs
    nearest: np.ndarray  # [S] index of the candidate nearest to the human
    error: np.ndarray  # [S] m, mean distance of the chosen to the human
    station: np.ndarray  # [S] m, where the chosen ends
    ahead: np.ndarray  # [S, T] m, station of the chosen minus that of the nearest
    # m, standard deviation of the chosen one's end ...
    spread_of_seeds: np.ndarray  # [S] ... over the runs
    spread_of_posterior: np.ndarray  # [S] ... over draws of the first run's weights


def sums_over_time(run: Learned, frozen: FeatureBatch) -> tuple[np.ndarray, np.ndarray]:
    """Phi of humans [S, H] and candidates [S, K, H]; see `last_layer_features`."""
    config = run.config.reward
    effective = pinned(run.params, config)

    @jax.jit
    def of(x: jax.Array, valid: jax.Array) -> jax.Array:
        return last_layer_features(
            effective, run.normaliser, x, valid, config.hidden_activation
        )

    human, candidates = [], []
    for start in range(0, frozen.weight.shape[0], CHUNK):
        part = jax.tree.map(lambda x, a=start: x[a : a + CHUNK], frozen)
        human.append(np.asarray(of(part.human, part.time_valid)))
        candidates.append(np.asarray(of(part.points, part.points_valid)))
    return np.concatenate(human), np.concatenate(candidates)


def weights_supported(
    run: Learned, frozen: FeatureBatch, vehicle: np.ndarray
) -> IdentifiabilityReport:
    """Which weights of a trained linear reward the data support.

    Of a non-negative one these are two for each feature, of its part above the
    training median and of its part below, and any sign is allowed here: that the
    data ask for a cost shows in an interval below 0.

    Args:
      run: trained with `hidden = ()`; its gamma is taken as known, with a mean of
        1 over the times that some scene has: only the product with the weights is
        in the reward, and times beyond every horizon were never trained.
      frozen: scenes, positive against candidates.
      vehicle: [S], scenes of one vehicle are dependent.
    """
    seen = np.asarray(frozen.time_valid).any(axis=0)
    gauge = float(np.mean(pinned(run.params, run.config.reward).gamma[seen]))
    human, candidates = (phi / gauge for phi in sums_over_time(run, frozen))
    specs = feature_map(run.config.features).specs
    sided = run.config.reward.constraint == "nonnegative"
    sides = (" above", " below") if sided else ("",)
    return identify(
        candidates - human[:, None],
        np.asarray(frozen.feasible),
        np.asarray(vehicle),
        np.tile(np.asarray(run.normaliser.scale), len(sides)),
        [f"{spec.name}{side}" for side in sides for spec in specs],
        [spec.unit for spec in specs] * len(sides),
    )


def choices_of(
    runs: Sequence[Learned],
    train: FeatureBatch,
    test: FeatureBatch,
    vehicle: np.ndarray,
) -> Choices:
    """What the mean of several runs chooses, and how unsure it is.

    The two doubts are of two things: the seeds' is of the runs whose mean is
    chosen by, the posterior's of the first run alone.

    Args:
      runs: of one configuration with a free scale (`pin="none"`), other seeds.
      train: what they were trained on; gives the Laplace posterior.
      test: scenes to choose in, with the positive `nearest`.
      vehicle: [S] of the training scenes; those of one are dependent.

    Raises:
      InputError: the positive of a test scene is none of its candidates.
    """
    facts = test.facts
    near = np.asarray(facts.distance == facts.human_distance[:, None])
    if not near.any(axis=1).all():
        raise InputError("choices_of: test: expected the positive `nearest`")
    feasible = np.asarray(test.feasible) | near
    phis = [sums_over_time(run, test)[1] for run in runs]
    weights = [_output_weights(run) for run in runs]
    values = [phi @ w for phi, w in zip(phis, weights, strict=True)]
    pairs = *sums_over_time(runs[0], train), np.asarray(train.feasible)
    centre = most_probable(*pairs, PRIOR_PRECISION)
    precision = laplace(*pairs, centre, PRIOR_PRECISION, vehicle)
    drawn = _posterior_draws(centre, precision)
    place = feature_map(runs[0].config.features).names.index("station")
    # float64: equal ends have no spread at all
    stations = np.asarray(test.points[..., place], np.float64)
    last = np.asarray(test.time_valid).sum(axis=1) - 1
    station = np.take_along_axis(stations, last[:, None, None], axis=2)[..., 0]
    best = lambda v: np.where(feasible, v, -np.inf).argmax(axis=-1)  # noqa: E731
    ends = lambda v: np.take_along_axis(station, best(v)[:, None], 1)[:, 0]  # noqa: E731
    chosen, rows = best(np.mean(values, axis=0)), np.arange(station.shape[0])
    nearest = near.argmax(axis=1)
    return Choices(
        chosen=chosen,
        nearest=nearest,
        error=np.asarray(facts.distance)[rows, chosen],
        station=station[rows, chosen],
        ahead=stations[rows, chosen] - stations[rows, nearest],
        spread_of_seeds=np.std([ends(v) for v in values], axis=0, ddof=1),
        spread_of_posterior=np.std([ends(phis[0] @ w) for w in drawn], axis=0, ddof=1),
    )


def _output_weights(run: Learned) -> np.ndarray:
    return np.asarray(pinned(run.params, run.config.reward).kernels[-1])[:, 0]


def _posterior_draws(mean: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """[DRAWS, H] output weights from N(mean, precision^-1)."""
    factor = np.linalg.cholesky(precision)
    noise = np.random.default_rng(0).normal(size=(mean.size, DRAWS))
    return mean + solve_triangular(factor, noise, lower=True, trans=1).T


def rank_correlation(
    a: np.ndarray, b: np.ndarray, vehicle: np.ndarray
) -> tuple[float, float, float]:
    """Spearman's rho with an interval from vehicles drawn again.

    The correlation of the ranks of all scenes; the replicates weigh scenes by
    how often their vehicle is drawn.
    """
    x, y = (rankdata(v) - 0.5 * (len(v) + 1) for v in (a, b))
    draws = ClusterBootstrap(vehicle)
    xy, xx, yy, mx, my = map(draws.means, (x * y, x * x, y * y, x, y))
    rho = (xy - mx * my) / np.sqrt((xx - mx**2) * (yy - my**2))
    low, high = np.quantile(rho, [0.025, 0.975]).tolist()
    return float(np.sum(x * y) / np.sqrt(np.sum(x * x) * np.sum(y * y))), low, high


def growth(ahead: np.ndarray, time_valid: np.ndarray) -> np.ndarray:
    """[T, 3] mean |ahead| m, mean ahead m, and the steady acceleration it is worth.

    2 |ahead| / t^2 m/s^2 (0 at t = 0): what the choice gets wrong if the error were
    one of acceleration, held from the start. NaN at times that no scene has.
    """
    seen = np.where(time_valid, ahead, np.nan)
    some = time_valid.any(axis=0)
    size, bias = np.full(some.shape, np.nan), np.full(some.shape, np.nan)
    size[some] = np.nanmean(np.abs(seen[:, some]), axis=0)
    bias[some] = np.nanmean(seen[:, some], axis=0)
    worth = np.divide(
        2.0 * size, TIMES_S**2, out=np.zeros(some.shape), where=TIMES_S > 0
    )
    return np.stack([size, bias, worth], axis=1)


def reasons(
    run: Learned, frozen: FeatureBatch, a: np.ndarray, b: np.ndarray
) -> np.ndarray:
    """[S, F] share of each feature in V(candidate a) - V(candidate b), summed over t.

    Args:
      run: any trained reward.
      frozen: S scenes.
      a: [S] candidate that is explained.
      b: [S] candidate that it is compared with.
    """
    config, rows = run.config.reward, np.arange(len(a))
    effective = pinned(run.params, config)

    @jax.jit
    def of(xa: jax.Array, xb: jax.Array, valid: jax.Array) -> jax.Array:
        one = lambda p, q, v: attribute(  # noqa: E731
            effective, run.normaliser, p, q, v, config.hidden_activation
        )
        return jnp.sum(jax.vmap(one)(xa, xb, valid), axis=1)

    candidates = np.asarray(frozen.points)
    pairs = candidates[rows, a], candidates[rows, b], np.asarray(frozen.time_valid)
    parts = [
        np.asarray(of(*(x[i : i + CHUNK] for x in pairs)))
        for i in range(0, len(a), CHUNK)
    ]
    return np.concatenate(parts)
