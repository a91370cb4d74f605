"""Weights and weights files for tests: made up, random, as training leaves them."""

import dataclasses
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.export import PriorCost, Reward, pack, reader, save
from rcirl_jax.features import feature_map
from rcirl_jax.reward import RewardConfig, RewardModel, effective_params, init_params
from rcirl_jax.reward import value as trained_value
from rcirl_jax.reward.network import LEAKY_SLOPE, layers_of
from rcirl_jax.reward.normaliser import Normaliser
from rcirl_jax.units import TIMES_S

ACTIVATIONS = tuple(reader.ACTIVATIONS)


def provenance():
    return {
        "dataset_sha256": "0" * 64,
        "git_commit": "2fe49aa",
        "seed": 7,
        "flags": {"loss": "rank", "hidden": [15], "resume": False},
        "metrics": {"pairwise_accuracy": np.float32(0.75), "steps": np.int64(10)},
        "versions": {"rcirl_jax": "0.1.0"},
        "created": "2026-11-21T00:00:00Z",
    }


def example_weights(
    seed=0, features=3, times=4, hidden=(5,), activation="tanh", scene_gating=False,
    with_prior=False,
):  # fmt: skip
    rng = np.random.default_rng(seed)
    sizes = (features, *hidden, 1)
    draw = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    return Reward(
        preset="test",
        names=tuple(f"feature{i}" for i in range(features)),
        units=("m", *["m/s²"] * (features - 1)),
        none_values=tuple(10 * i for i in range(features)),
        lower=-1.0 - rng.random(features, np.float32),
        upper=1.0 + rng.random(features, np.float32),
        location=draw(features),
        scale=0.5 + rng.random(features, np.float32),
        times=np.linspace(0.0, 8.0, times, dtype=np.float32),
        gamma=draw(times),
        scene_gating=draw(features, features) if scene_gating else None,
        training_range=np.sort(
            np.random.default_rng(seed).normal(size=(2, features)), axis=0
        ),
        prior_cost=PriorCost(incumbent="hand-set", gain=1.5) if with_prior else None,
        kernels=tuple(draw(*pair) for pair in pairwise(sizes)),
        biases=tuple(draw(size) for size in sizes[1:]),
        activation=activation,
        leaky_slope=0.01,
        loss={"name": "rank", "leaky_rate": 0.05},
        provenance=provenance(),
    )


def example_samples(weights, count=4, seed=1):
    """Features that often leave [lower, upper], masks, float64 values."""
    rng = np.random.default_rng(seed)
    size = (count, len(weights.times), len(weights.names))
    features = rng.normal(scale=2.0, size=size).astype(np.float32)
    valid = rng.random(size[:2]) < 0.7
    valid[:, 0] |= weights.scene_gating is not None
    values = [loop_value(weights, *one) for one in zip(features, valid, strict=True)]
    return features, valid, np.array(values)


def packed(**changes):
    weights = example_weights(**changes)
    return pack(weights, *example_samples(weights))


def loop_value(weights, features, valid):
    """V by a float64 loop over the times, from the equation and nothing else."""
    act = {
        "tanh": np.tanh,
        "relu": lambda x: np.where(x > 0.0, x, 0.0),
        "leaky_relu": lambda x: np.where(x > 0.0, x, float(weights.leaky_slope) * x),
        "identity": lambda x: x,
    }[weights.activation]
    lower, upper, location, scale = (
        np.asarray(getattr(weights, name), np.float64) for name in reader.RANGES
    )
    rows = (np.clip(np.asarray(features, np.float64), lower, upper) - location) / scale
    if weights.scene_gating is not None:
        rows = (
            rows
            * 2.0
            / (1.0 + np.exp(-rows[0] @ np.asarray(weights.scene_gating, np.float64)))
        )
    total, last = 0.0, len(weights.kernels) - 1
    for t in np.flatnonzero(valid):
        x = rows[t]
        for layer in range(last + 1):
            x = (
                x @ np.asarray(weights.kernels[layer], np.float64)
                + weights.biases[layer]
            )
            x = x if layer == last else act(x)
        total += float(weights.gamma[t]) * x[0]
    return total


def saved(path, weights, features):
    """The reward of a file of weights, with the values of these features in it."""
    valid = np.ones(features.shape[:2], bool)
    values = [loop_value(weights, *one) for one in zip(features, valid, strict=True)]
    return save(path, weights, features, valid, np.array(values))


SPECS = feature_map("paper21").specs
LOWER = np.array([spec.lower for spec in SPECS], np.float32)
UPPER = np.array([spec.upper for spec in SPECS], np.float32)


def columns_of(specs):
    """The fields of a reward that name its columns."""
    keys = {"names": "name", "units": "unit", "none_values": "none"}
    return {k: tuple(getattr(s, key) for s in specs) for k, key in keys.items()}


def of_the_preset(made, **changes):
    """Weights that read the features of the paper's preset at the usual times."""
    own = {"preset": "paper21", "times": TIMES_S, "leaky_slope": LEAKY_SLOPE}
    own |= {"lower": LOWER, "upper": UPPER, "training_range": np.stack([LOWER, UPPER])}
    own |= columns_of(SPECS)
    return dataclasses.replace(made, **{**own, **changes})


def random_weights(path, draw=2, **provenance):
    """A file of the paper's shape, 21-15-1, that every main accepts."""
    made = example_weights(features=len(SPECS), times=TIMES_S.size, hidden=(15,))
    made = of_the_preset(
        made,
        location=0.5 * (LOWER + UPPER),
        scale=0.3 * (UPPER - LOWER),
        biases=(*made.biases[:-1], np.zeros(1, np.float32)),  # as training leaves it
        provenance={**made.provenance, **provenance},
    )
    shape = (3, TIMES_S.size, len(SPECS))
    x = np.random.default_rng(draw).normal(size=shape).astype(np.float32)
    saved(path, made, x)
    return path


def trained_network(hidden, activation, scene_gating, count):
    """Effective weights of a random network, inputs, masks and the trainer's values."""
    rng, size = np.random.default_rng(3), len(SPECS)
    normaliser = Normaliser(
        lower=jnp.asarray(LOWER),
        upper=jnp.asarray(UPPER),
        location=jnp.asarray(rng.uniform(LOWER, UPPER), jnp.float32),
        scale=jnp.asarray(0.2 * (UPPER - LOWER)),
    )
    context = feature_map("paper21").context if scene_gating else ()
    config = RewardConfig(hidden=hidden, activation=activation, scene_gating=context)
    raw = init_params(jax.random.key(5), size, config)
    raw["gamma"] = jnp.asarray(rng.normal(size=18), jnp.float32)
    for layer in raw["point"].values():
        if "bias" in layer:
            drawn = rng.normal(size=layer["bias"].shape)
            layer["bias"] = jnp.asarray(drawn, jnp.float32)
    if scene_gating:
        drawn = rng.normal(scale=0.2, size=(size, size))
        raw["scene_gating"] = jnp.asarray(drawn, jnp.float32)
    effective = effective_params(raw, config)
    kernels, biases = layers_of(effective["point"])
    wide = 0.5 * (UPPER - LOWER)
    features = rng.uniform(LOWER - wide, UPPER + wide, (count, 18, size))
    features = features.astype(np.float32)
    valid = np.arange(18) < rng.integers(11, 19, (count, 1))
    x, mask = jnp.asarray(features), jnp.asarray(valid)
    expected = np.asarray(trained_value(RewardModel(config), raw, normaliser, x, mask))
    weights = of_the_preset(
        example_weights(),
        **{name: getattr(normaliser, name) for name in reader.RANGES},
        gamma=effective["gamma"],
        scene_gating=effective.get("scene_gating"),
        kernels=tuple(kernels),
        biases=(*biases, np.zeros(1)),
        activation=activation,
    )
    return weights, features, valid, expected
