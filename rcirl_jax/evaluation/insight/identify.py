"""Which weights of a linear reward the data support, and which they cannot tell.

Two features that always move together (a gap and its time headway, say) leave
only their joint weight to the data; a feature that is the same for the human and
every candidate leaves none. A fitted weight alone does not show that. Here the
linear reward is fitted by logistic regression on the pairs, and every weight
comes with an interval that treats a vehicle's scenes as dependent, with how much
its correlation with other features widens the interval, and with the share of
it that the data decide rather than the ridge.

Host numpy, float64. Axes: `S` scenes, `K` candidates, `n` feasible pairs, `F`
features, `C` clusters (vehicles). Intervals hold for one weight at a time: of 20
features without any effect one is expected to look supported.

Sources: Bradley and Terry, Biometrika 39 (1952), pairs; Liang and Zeger,
Biometrika 73 (1986), and Cameron and Miller, J. Human Resources 50 (2015), the
cluster sandwich with C / (C - 1) and Student's t; Belsley, Kuh and Welsch,
Regression Diagnostics (1980), variance inflation and weak directions; Menke,
Geophysical Data Analysis (1989), the resolution matrix; Albert and Anderson,
Biometrika 71 (1984), separated data.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit, stdtrit

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.exact import CONFIDENCE

RIDGE = 1e-8  # of the mean loss; so small that it decides only what data cannot
MIN_RESOLUTION = 0.99  # below, the ridge has a say in the weight
NUM_DIRECTIONS = 3  # weak directions in the report
NUM_NAMED = 3  # features that name a direction
_MAX_STEPS = 100  # Newton steps; about ten are needed
_DECREMENT = 1e-12  # of the loss, below which one more step is the last


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureWeight:
    """What the data say about the weight of one feature."""

    name: str
    unit: str  # of the feature
    # value per unit of the feature at a time weight of 1, and its interval
    weight: float
    low: float
    high: float
    se: float
    normalised: float  # value per scale of the normaliser: weight * scale
    varies: bool  # the feature differs in at least one pair
    # variance over that without correlation with others; None: never varies
    variance_inflation: float | None
    # share of the weight that the data decide, 0..1; the rest is the ridge's
    resolution: float
    identified: bool  # the data decide the weight, up to MIN_RESOLUTION
    supported: bool  # identified, and the interval excludes 0

    @property
    def verdict(self) -> str:
        """In words: supported or why not."""
        if self.supported:
            return "supported"
        if not self.varies:
            return "never differs"
        return "may be 0" if self.identified else "not identified"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Direction:
    """A combination of normalised weights, named by its largest features."""

    curvature: float  # of the mean loss along it, without ridge
    features: tuple[str, ...]  # largest loading first
    loadings: tuple[float, ...]  # parts of the unit vector, the first positive


@dataclasses.dataclass(frozen=True, kw_only=True)
class IdentifiabilityReport:
    """All weights, and the combinations of weights that the data see least."""

    features: tuple[FeatureWeight, ...]
    # largest over smallest eigenvalue of the curvature without ridge, over the
    # features that vary; 1 / machine epsilon stands for infinity
    condition_number: float
    weak_directions: tuple[Direction, ...]  # the weakest first
    loss: float  # mean over pairs, without ridge
    # the human wins every pair: the larger the weights the better, no limit
    separated: bool
    pairs: int
    clusters: int
    ridge: float
    confidence: float


def identify(
    differences: ArrayLike,
    feasible: ArrayLike,
    cluster: ArrayLike,
    scale: ArrayLike,
    names: Sequence[str],
    units: Sequence[str],
    *,
    ridge: float = RIDGE,
    confidence: float = CONFIDENCE,
) -> IdentifiabilityReport:
    """Fit the linear reward to pairs and report what the data say of each weight.

        w = argmin of mean over pairs log(1 + exp(d . w)) + ridge / 2 |w|^2
        H = mean s (1 - s) d d^T + ridge I,   s = 1 / (1 + exp(-d . w))
        J = C / (C - 1) sum over clusters of u u^T,
            u = 1 / n * sum over its pairs of (s d + ridge w)
        covariance = H^-1 J H^-1,   interval = w +- t(C - 1) standard errors
        variance inflation_i = H0_ii (H0^-1)_ii,   H0 = H without ridge
        resolution_i = (H^-1 H0)_ii

    A weight is supported if its interval excludes 0 and its resolution is at
    least MIN_RESOLUTION. The second matters: along a direction that the data do
    not see, the ridge alone sets the weights and the sandwich finds no variance.
    The same holds for a feature on which the human always wins (candidates
    collide, humans never): its weight grows until the ridge stops it, so its
    size is the ridge's. Where the human wins every pair that holds for all.

    The time weights gamma are taken as known. With those of a trained linear
    reward, d is the difference of `laplace.last_layer_features`.

    Args:
      differences: [S, K, F] or [n, F], d = sum over valid t of gamma_t (x_candidate
        - x_human) with x the normalised features (no unit). Those of infeasible
        pairs are not read.
      feasible: [S, K] or [n] bool.
      cluster: [S] or [n], the vehicle of each scene; at least 2 of them.
      scale: [F] > 0, of the normaliser, in the features' units.
      names: F feature names.
      units: F units, for the report.
      ridge: > 0, pull on the weights, on the scale of the mean loss.
      confidence: of the intervals, between 0 and 1.

    Raises:
      InputError: a shape that does not fit, a value out of range, or feasible
        pairs of fewer than 2 vehicles.
    """
    size = _check_features(scale, names, units)
    pairs, groups = _read_pairs(differences, feasible, cluster, size)
    if not 0.0 < ridge < np.inf:
        raise InputError(f"identify: ridge: {ridge}: expected > 0 and finite")
    if not 0.0 < confidence < 1.0:
        raise InputError(f"identify: confidence: {confidence}: expected in (0, 1)")
    weights = pair_minimum(pairs, ridge)
    _, curvature = _slopes(pairs, weights)
    inverse = np.linalg.inv(curvature + ridge * np.eye(size))
    seen = np.flatnonzero(np.diag(curvature))
    among_seen = curvature[np.ix_(seen, seen)]
    inflation = np.full(size, np.nan)
    inflation[seen] = _variance_inflation(among_seen)
    condition, directions = _weakest(among_seen, [names[int(i)] for i in seen])
    found = _Estimates(
        weights=weights,
        se=_sandwich_errors(pairs, groups, weights, ridge, inverse),
        inflation=inflation,
        resolution=np.clip(1.0 - ridge * np.diag(inverse), 0.0, 1.0),
        separated=bool(np.all(pairs @ weights < 0.0)),
    )
    clusters = int(groups.max()) + 1
    reach = float(stdtrit(clusters - 1, 0.5 + 0.5 * confidence))
    scales = np.asarray(scale, np.float64).tolist()
    return IdentifiabilityReport(
        features=tuple(
            _feature(names[i], units[i], scales[i], found, i, reach)
            for i in range(size)
        ),
        condition_number=condition,
        weak_directions=directions,
        loss=_loss(pairs, weights),
        separated=found.separated,
        pairs=pairs.shape[0],
        clusters=clusters,
        ridge=float(ridge),
        confidence=float(confidence),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Estimates:
    """Of all features [F], in normalised units."""

    weights: np.ndarray
    se: np.ndarray
    inflation: np.ndarray  # NaN where the feature never varies
    resolution: np.ndarray
    separated: bool


def _feature(
    name: str, unit: str, scale: float, found: _Estimates, i: int, reach: float
) -> FeatureWeight:
    """Row i of the report; the interval is +- `reach` standard errors."""
    weight, se = float(found.weights[i]), float(found.se[i])
    inflation, resolution = float(found.inflation[i]), float(found.resolution[i])
    varies = not math.isnan(inflation)
    identified = resolution >= MIN_RESOLUTION and not found.separated
    return FeatureWeight(
        name=name,
        unit=unit,
        weight=weight / scale,
        low=(weight - reach * se) / scale,
        high=(weight + reach * se) / scale,
        se=se / scale,
        normalised=weight,
        varies=varies,
        variance_inflation=inflation if varies else None,
        resolution=resolution,
        identified=identified,
        supported=identified and abs(weight) > reach * se,
    )


def _check_features(
    scale: ArrayLike, names: Sequence[str], units: Sequence[str]
) -> int:
    """F, if scale, names and units agree on it."""
    found = np.asarray(scale, np.float64)
    if found.ndim != 1 or not np.all((found > 0.0) & np.isfinite(found)):
        raise InputError(
            f"identify: scale: {found.tolist()}: expected [F] positive numbers"
        )
    if len(set(names)) != found.size or len(names) != found.size:
        raise InputError(
            f"identify: names: {list(names)}: expected {found.size} different names"
        )
    if len(units) != found.size:
        raise InputError(
            f"identify: units: {list(units)}: expected {found.size} of them"
        )
    return found.size


def _read_pairs(
    differences: ArrayLike, feasible: ArrayLike, cluster: ArrayLike, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Feasible pairs [n, F] and the number of each one's vehicle [n], 0 .. C - 1."""
    values, mask = np.asarray(differences, np.float64), np.asarray(feasible, bool)
    vehicles = np.asarray(cluster)
    shapes = f"{values.shape}, {mask.shape}, {vehicles.shape}"
    if (
        values.ndim not in (2, 3)
        or values.shape[-1] != size
        or mask.shape != values.shape[:-1]
        or vehicles.shape != values.shape[:1]
    ):
        raise InputError(
            f"identify: differences, feasible, cluster: shapes {shapes}: expected"
            f" [S, K, {size}], [S, K], [S] or [n, {size}], [n], [n]"
        )
    pairs = values[mask]
    if not np.isfinite(pairs).all():
        raise InputError(
            "identify: differences: NaN or infinite in a feasible pair:"
            " expected finite values"
        )
    spread = vehicles.reshape(-1, *[1] * (mask.ndim - 1))
    owners = np.broadcast_to(spread, mask.shape)[mask]
    found, groups = np.unique(owners, return_inverse=True)
    if found.size < 2:
        raise InputError(
            f"identify: cluster: {found.size} vehicles with feasible pairs:"
            " expected at least 2"
        )
    return pairs, groups.reshape(-1)


def _loss(pairs: np.ndarray, weights: np.ndarray) -> float:
    """Mean over pairs of log(1 + exp(d . w))."""
    return float(np.mean(np.logaddexp(0.0, pairs @ weights)))


def _slopes(pairs: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient [F] and Hessian [F, F] of the mean loss, without ridge."""
    chance = expit(pairs @ weights)
    gradient = pairs.T @ chance / chance.size
    curved = pairs * (chance * (1.0 - chance))[:, None]
    curvature = pairs.T @ curved / chance.size
    return gradient, 0.5 * (curvature + curvature.T)


def pair_minimum(pairs: np.ndarray, ridge: float) -> np.ndarray:
    """Weights [F] at the minimum, by Newton's method with halved steps.

        mean over pairs d of log(1 + exp(d . w)) + ridge / 2 |w|^2   (convex)

    Args:
      pairs: [n, F] features of the candidate minus those of the positive.
      ridge: > 0.

    Raises:
      InputError: the ridge is too small to find a minimum.
    """
    weights = np.zeros(pairs.shape[1])
    for _ in range(_MAX_STEPS):
        gradient, curvature = _slopes(pairs, weights)
        gradient += ridge * weights
        curvature += ridge * np.eye(weights.size)
        step = np.linalg.solve(curvature, gradient)
        decrement = float(gradient @ step)
        if decrement < _DECREMENT:
            return weights - step
        weights = weights - _step_length(pairs, ridge, weights, step, decrement) * step
    raise InputError(
        f"identify: ridge: {ridge}: no minimum after {_MAX_STEPS} Newton steps:"
        " expected a larger ridge"
    )


def _step_length(
    pairs: np.ndarray,
    ridge: float,
    weights: np.ndarray,
    step: np.ndarray,
    decrement: float,
) -> float:
    """Largest of 1, 1/2, 1/4, ... that lowers the loss (Armijo's rule)."""

    def objective(w: np.ndarray) -> float:
        return _loss(pairs, w) + 0.5 * ridge * float(w @ w)

    now, length = objective(weights), 1.0
    while objective(weights - length * step) > now - 1e-4 * length * decrement:
        length *= 0.5
    return length


def _sandwich_errors(
    pairs: np.ndarray,
    groups: np.ndarray,
    weights: np.ndarray,
    ridge: float,
    inverse: np.ndarray,
) -> np.ndarray:
    """Standard errors [F] of the weights from the scores of whole vehicles."""
    count = int(groups.max()) + 1
    scores = pairs * expit(pairs @ weights)[:, None] + ridge * weights
    sums = np.stack(
        [np.bincount(groups, column, minlength=count) for column in scores.T], axis=1
    )
    spread = sums @ inverse / pairs.shape[0]
    return np.sqrt(count / (count - 1) * np.sum(spread**2, axis=0))


def _eigen(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues, upwards and not below rounding; eigenvectors in columns."""
    values, vectors = np.linalg.eigh(matrix)
    least = np.finfo(np.float64).eps * values.max(initial=0.0)
    return np.maximum(values, least), vectors


def _variance_inflation(curvature: np.ndarray) -> np.ndarray:
    """Diagonal of the inverse of the curvature scaled to a unit diagonal."""
    size = np.sqrt(np.diag(curvature))
    values, vectors = _eigen(curvature / np.outer(size, size))
    return np.sum(vectors**2 / values, axis=1)


def _weakest(
    curvature: np.ndarray, names: list[str]
) -> tuple[float, tuple[Direction, ...]]:
    """Condition number, and the directions with the least curvature."""
    if not names:
        return 1.0, ()
    values, vectors = _eigen(curvature)
    directions = []
    for value, vector in zip(values, vectors.T, strict=True):
        order = np.argsort(-np.abs(vector), kind="stable")[:NUM_NAMED]
        sign = np.sign(vector[order[0]])
        directions.append(
            Direction(
                curvature=float(value),
                features=tuple(names[i] for i in order),
                loadings=tuple(float(sign * vector[i]) for i in order),
            )
        )
    return float(values[-1] / values[0]), tuple(directions[:NUM_DIRECTIONS])


def to_json(report: IdentifiabilityReport) -> dict:
    """The report as plain JSON types; the verdicts in words beside the numbers.

    `variance_inflation` is null for a feature that never varies.
    """
    content = dataclasses.asdict(report)
    for row, feature in zip(content["features"], report.features, strict=True):
        row["verdict"] = feature.verdict
    for direction in content["weak_directions"]:
        direction["features"] = list(direction["features"])
        direction["loadings"] = list(direction["loadings"])
    content["features"] = list(content["features"])
    content["weak_directions"] = list(content["weak_directions"])
    return content
