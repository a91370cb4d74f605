"""How sure the data leave the learned reward: Laplace on its last layer.

The value is linear in the output weights, so under the logistic pair loss and a
Gaussian prior their posterior is nearly Gaussian, with the Hessian of the loss
as its precision. That gives every difference of values a standard deviation. All
layers below are taken as exact: the figure is a lower bound of the uncertainty.

The pair loss must have been trained with a free scale (`pin="none"`): on a pinned
scale the loss is not a likelihood at its minimum. Candidates of one scene, and
scenes of one vehicle, are not independent: with the vehicles given, the spread of
their scores takes the place of the pairs' (the sandwich of Huber and White), and
the precision is that of as many vehicles, not of as many pairs.

Sources: MacKay, Neural Computation 4 (1992), 448 and 720; Kristiadi, Hein and
Hennig, Being Bayesian, Even Just a Bit (ICML 2020) for the last layer alone.
"""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular
from scipy.special import expit

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.insight.attribution import check_network_inputs
from rcirl_jax.evaluation.insight.identify import pair_minimum
from rcirl_jax.reward import Normaliser, RewardParams, normalise
from rcirl_jax.reward.module import ACTIVATIONS, conditioned


def last_layer_features(
    effective_params: RewardParams,
    normaliser: Normaliser,
    features: jax.Array,
    time_valid: jax.Array,
    activation: str,
) -> jax.Array:
    """What the output weights multiply: Phi = sum over valid t of gamma_t h(f_t).

    h are the outputs of the last hidden layer, or the normalised features
    themselves for the linear reward. V = Phi @ kernels[-1][:, 0]. Pure: it may
    be traced; `activation` is static.

    Args:
      effective_params: pinned parameters (`reward.pinned`, or a weights file's).
      normaliser: [F].
      features: [..., T, F] in declared units.
      time_valid: [..., T] bool.
      activation: key of ACTIVATIONS.

    Returns:
      Phi [..., H], no unit.

    Raises:
      InputError: a shape that does not fit, or an unknown activation.
    """
    features, time_valid = jnp.asarray(features), jnp.asarray(time_valid)
    check_network_inputs(
        "last_layer_features",
        effective_params,
        normaliser,
        features,
        time_valid,
        activation,
    )
    x = conditioned(effective_params.context, normalise(normaliser, features))
    hidden = zip(effective_params.kernels[:-1], effective_params.biases, strict=True)
    for kernel, bias in hidden:
        x = ACTIVATIONS[activation](x @ kernel + bias)
    weighted = effective_params.gamma[:, None] * x
    return jnp.sum(jnp.where(time_valid[..., None], weighted, 0.0), axis=-2)


def most_probable(
    phi_human: ArrayLike,
    phi_candidates: ArrayLike,
    feasible: ArrayLike,
    prior_precision: float,
) -> np.ndarray:
    """Output weights [H] where the posterior is highest; arguments as in `laplace`.

    A network that was trained for some epochs is near its minimum, not at it, and
    had no prior: what `laplace` says holds around these weights, not around its own.

    Raises:
      InputError: as `laplace`, or no minimum was found.
    """
    pairs = _pairs(phi_human, phi_candidates, feasible, prior_precision)
    return pair_minimum(pairs, prior_precision / pairs.shape[0])


def laplace(
    phi_human: ArrayLike,
    phi_candidates: ArrayLike,
    feasible: ArrayLike,
    w: ArrayLike,
    prior_precision: float,
    cluster: ArrayLike | None = None,
) -> np.ndarray:
    """Posterior precision of the output weights under the logistic pair loss.

        P = prior I + sum over feasible pairs of s(y) (1 - s(y)) d d^T
        d = Phi_candidate - Phi_human,   y = d . w,   s the logistic function

    This is the Hessian of sum log(1 + exp(y)) + prior / 2 |w|^2 at w, which
    should be its minimum (`most_probable`). With C clusters

        P (prior I + C / (C - 1) sum over clusters of (g_c - g)(g_c - g)^T)^-1 P
        g_c = sum over the cluster's pairs of s(y) d,   g their mean over clusters

    Host numpy, float64: the condition number of P can be
    beyond float32.

    Args:
      phi_human: [S, H].
      phi_candidates: [S, K, H]; infeasible ones are not read.
      feasible: [S, K] bool.
      w: [H] output weights, kernels[-1][:, 0].
      prior_precision: > 0, 1 / variance of each weight before the data.
      cluster: [S] int, scenes that depend on each other; None: pairs do not.

    Returns:
      Precision [H, H], symmetric, positive definite.

    Raises:
      InputError: a shape that does not fit, a feasible feature that is not
        finite, or a prior precision that is not positive.
    """
    weights, mask = np.asarray(w, np.float64), np.asarray(feasible, bool)
    pairs = _pairs(phi_human, phi_candidates, mask, prior_precision)
    if weights.shape != pairs.shape[1:]:
        raise InputError(
            f"laplace: w: shape {weights.shape}: expected {pairs.shape[1:]}"
        )
    chance = expit(pairs @ weights)
    curvature = pairs.T @ (pairs * (chance * (1.0 - chance))[:, None])
    prior = prior_precision * np.eye(weights.size)
    precision = prior + 0.5 * (curvature + curvature.T)
    if cluster is None:
        return precision
    scores = np.zeros((mask.shape[0], weights.size))  # of scenes
    np.add.at(scores, np.nonzero(mask)[0], pairs * chance[:, None])
    return _sandwich(precision, scores, np.asarray(cluster), prior)


def _sandwich(
    precision: np.ndarray, scores: np.ndarray, cluster: np.ndarray, prior: np.ndarray
) -> np.ndarray:
    """Precision of the weights whose scores [S, H] spread as their clusters say."""
    found, index = np.unique(cluster, return_inverse=True)
    if found.size < 2:
        raise InputError(
            f"laplace: cluster: {found.size} clusters: expected at least 2"
        )
    sums = np.zeros((found.size, scores.shape[1]))
    np.add.at(sums, index.reshape(-1), scores)
    meat = prior + found.size * np.cov(sums, rowvar=False).reshape(prior.shape)
    made = precision @ np.linalg.solve(meat, precision)
    return 0.5 * (made + made.T)


def _pairs(
    phi_human: ArrayLike,
    phi_candidates: ArrayLike,
    feasible: ArrayLike,
    prior_precision: float,
) -> np.ndarray:
    """[n, H] Phi of the candidate minus Phi of the human, of the feasible pairs."""
    human = np.asarray(phi_human, np.float64)
    candidates = np.asarray(phi_candidates, np.float64)
    mask = np.asarray(feasible, bool)
    shapes = human.shape, candidates.shape, mask.shape
    fits = candidates.ndim == 3 and shapes == (
        (candidates.shape[0], candidates.shape[2]),
        candidates.shape,
        candidates.shape[:2],
    )
    if not fits:
        raise InputError(
            "laplace: phi_human, phi_candidates, feasible: shapes"
            f" {', '.join(map(str, shapes))}: expected [S, H], [S, K, H], [S, K]"
        )
    if not 0.0 < prior_precision < np.inf:
        raise InputError(
            f"laplace: prior_precision: {prior_precision}: expected > 0 and finite"
        )
    pairs = (candidates - human[:, None])[mask]
    if not np.isfinite(pairs).all():
        raise InputError(
            "laplace: phi: NaN or infinite in a feasible pair: expected finite values"
        )
    return pairs


def difference_std(
    precision: ArrayLike, phi_a: ArrayLike, phi_b: ArrayLike
) -> np.ndarray:
    """Posterior standard deviation of V(a) - V(b).

        std = sqrt(d^T P^-1 d),   d = Phi_a - Phi_b

    Args:
      precision: P [H, H], of `laplace`.
      phi_a: [..., H], of `last_layer_features`.
      phi_b: [..., H]; leading axes broadcast against those of `phi_a`.

    Returns:
      [...], in units of V; float64.

    Raises:
      InputError: shapes that do not fit, or a precision that is not positive
        definite.
    """
    matrix = np.asarray(precision, np.float64)
    a, b = np.asarray(phi_a, np.float64), np.asarray(phi_b, np.float64)
    size = matrix.shape[0] if matrix.ndim else 0
    shapes = f"{matrix.shape}, {a.shape}, {b.shape}"
    if (matrix.shape, a.shape[-1:], b.shape[-1:]) != ((size, size), (size,), (size,)):
        raise InputError(
            f"difference_std: precision, phi_a, phi_b: shapes {shapes}:"
            " expected [H, H], [..., H], [..., H]"
        )
    try:
        difference = a - b
    except ValueError:
        raise InputError(
            f"difference_std: phi_a, phi_b: shapes {a.shape}, {b.shape}:"
            " expected leading axes that broadcast"
        ) from None
    try:
        lower = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise InputError(
            "difference_std: precision: not positive definite:"
            " expected the result of `laplace`"
        ) from None
    rows = difference.reshape(-1, size)
    whitened = solve_triangular(lower, rows.T, lower=True)
    return np.sqrt(np.sum(whitened**2, axis=0)).reshape(difference.shape[:-1])
