"""The frozen robust normaliser of features, stored with the weights."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from rcirl_jax.errors import InputError
from rcirl_jax.features import FeatureMap
from rcirl_jax.features.mapping import UNBOUNDED
from rcirl_jax.types import Normaliser

SEEN_QUANTILES = (0.001, 0.999)  # what counts as seen in training
VARYING_SHARE = 0.002  # of rows that have to differ from the median: one in 500
TINY = 1e-12  # smallest scale of a feature without a declared range
SCALE_FLOOR = 0.03  # share of a feature's declared range; the smallest scale


def normalise(
    normaliser: Normaliser, features: Float[Array, "*batch f"]
) -> Float[Array, "*batch f"]:
    """Apply the normaliser; any leading axes."""
    clipped = jnp.clip(features, normaliser.lower, normaliser.upper)
    return (clipped - normaliser.location) / normaliser.scale


def fit_normaliser(
    features: np.ndarray, feature_map: FeatureMap, today: Sequence[float] = ()
) -> Normaliser:
    """Robust location and scale over rows [n, F] of the TRAINING split.

        location = median,  scale = (q95 - q05) / 2

    A feature that sits at its "none" value most of the time has no spread
    between the quantiles; its standard deviation is used, and at least
    SCALE_FLOOR of the declared range: a feature that is seldom active must not
    arrive at the network as 20 or 1,000 of its own standard deviations.

    A feature that does not vary (`varies`) has no effect by construction: its range
    is its median, so its normalised value is 0 everywhere and nothing untrained drives.

    With `today`, the weights of own terms (see `RewardConfig.today`), all features
    stay as they are but for one scale, the spread of today's cost.
    """
    if today:
        low, high = np.quantile(features.astype(np.float64) @ today, [0.05, 0.95])
        if not high > low:
            raise InputError(
                f"{feature_map.preset}: today's cost is {low:g} nearly everywhere: "
                "expected terms that tell trajectories apart"
            )
        whole = np.ones(len(today), np.float32)
        return Normaliser(
            lower=jnp.asarray(-UNBOUNDED * whole),
            upper=jnp.asarray(UNBOUNDED * whole),
            location=jnp.asarray(0.0 * whole),
            scale=jnp.asarray(0.5 * (high - low) * whole, jnp.float32),
        )
    lower = np.array([spec.lower for spec in feature_map.specs])
    upper = np.array([spec.upper for spec in feature_map.specs])
    rows = np.clip(np.asarray(features, np.float64), lower, upper)
    low, middle, high = np.quantile(rows, [0.05, 0.5, 0.95], axis=0)
    spread = np.maximum(0.5 * (high - low), rows.std(axis=0))
    reach = np.where(upper < UNBOUNDED, upper - lower, 0.0)
    scale = np.maximum(spread, np.maximum(SCALE_FLOOR * reach, TINY))
    seen = varies(rows, middle)
    lower, upper = np.where(seen, lower, middle), np.where(seen, upper, middle)
    as_array = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return Normaliser(
        lower=as_array(lower),
        upper=as_array(upper),
        location=as_array(middle),
        scale=as_array(scale),
    )


def identity_normaliser(size: int) -> Normaliser:
    """Makes a normaliser that leaves `size` features as they are."""
    zeros = jnp.zeros(size)
    return Normaliser(
        lower=zeros - jnp.inf, upper=zeros + jnp.inf, location=zeros, scale=zeros + 1.0
    )


def varies(rows: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Returns the features [F] that vary in `VARYING_SHARE` of rows [n, F]."""
    # float32 is what the features are made in
    differs = rows.astype(np.float32) != middle.astype(np.float32)
    return differs.mean(axis=0) >= VARYING_SHARE


def unsupported(lower: ArrayLike, upper: ArrayLike, names: Sequence[str]) -> list[str]:
    """Names of the features without effect: those whose normaliser has no range.

    Args:
      lower: [F], of the normaliser.
      upper: [F].
      names: F names.
    """
    empty = np.asarray(lower) >= np.asarray(upper)
    return [name for name, none in zip(names, empty, strict=True) if none]


def supported(normaliser: Normaliser, first: Float[Array, " f"]) -> Bool[Array, ""]:
    """Returns whether V knows scenes like this one, from the features [F] at t = 0.

        all over f with lower_f >= upper_f:  |x_f - location_f| <= scale_f

    A feature that never varied in training has no effect on V. Where it has another
    value than it always had, a stop line ahead for one, people were not recorded, and
    V says nothing of what they would do.

    Args:
      normaliser: [F].
      first: of one trajectory, raw.
    """
    empty = normaliser.lower >= normaliser.upper
    other = jnp.abs(first - normaliser.location) > normaliser.scale
    return ~jnp.any(empty & other)


def seen_range(features: np.ndarray, feature_map: FeatureMap) -> np.ndarray:
    """Lowest and highest value seen, [2, F] float32: `SEEN_QUANTILES` of rows [n, F].

    Of clipped features, as the network sees them.
    """
    lower = np.array([spec.lower for spec in feature_map.specs])
    upper = np.array([spec.upper for spec in feature_map.specs])
    rows = np.clip(np.asarray(features, np.float64), lower, upper)
    return np.quantile(rows, SEEN_QUANTILES, axis=0).astype(np.float32)
