"""The feature map F."""

from rcirl_jax.features.mapping import FeatureMap, FeatureSpec, feature_map

__all__ = ["FeatureMap", "FeatureSpec", "feature_map"]
