"""Weights files with random weights and the planner's own features."""

import dataclasses

import numpy as np

from rcirl_jax.export import save
from rcirl_jax.features import feature_map
from rcirl_jax.reward.network import LEAKY_SLOPE
from rcirl_jax.units import TIMES_S
from tests.export.test_weights import FeatureSpec, example_weights, loop_value


def random_weights(path, seed=2):
    """A file of the paper's shape, 21-15-1, that every main accepts."""
    rng, specs = np.random.default_rng(seed), feature_map("paper21").specs
    made = example_weights(features=len(specs), times=TIMES_S.size, hidden=(15,))
    made = dataclasses.replace(
        made,
        preset="paper21",
        features=tuple(
            FeatureSpec(name=s.name, unit=s.unit, none_value=s.none) for s in specs
        ),
        lower=np.array([s.lower for s in specs]),
        upper=np.array([s.upper for s in specs]),
        location=np.array([0.5 * (s.lower + s.upper) for s in specs]),
        scale=np.array([0.3 * (s.upper - s.lower) for s in specs]),
        times=TIMES_S,
        leaky_slope=LEAKY_SLOPE,
        biases=(*made.biases[:-1], np.zeros(1, np.float32)),  # as training leaves it
    )
    x = rng.normal(size=(3, TIMES_S.size, len(specs))).astype(np.float32)
    valid = np.ones(x.shape[:2], bool)
    values = [loop_value(made, *one) for one in zip(x, valid, strict=True)]
    save(path, made, x, valid, np.array(values))
    return path
