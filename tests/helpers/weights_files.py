"""Weights and weights files for tests: made up, random, as training leaves them."""

import dataclasses
import math
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.export import Anchor, FeatureSpec, RewardWeights, pack, reader, save
from rcirl_jax.features import feature_map
from rcirl_jax.reward import RewardConfig, init_reward, pinned
from rcirl_jax.reward import value as trained_value
from rcirl_jax.reward.module import LEAKY_SLOPE
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
    seed=0,
    features=3,
    times=4,
    hidden=(5,),
    activation="tanh",
    by_context=False,
    seen=False,
    anchored=False,
):
    rng = np.random.default_rng(seed)
    sizes = (features, *hidden, 1)
    draw = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    return RewardWeights(
        preset="test",
        features=tuple(
            FeatureSpec(
                name=f"feature{i}", unit="m/s²" if i else "m", none_value=10 * i
            )
            for i in range(features)
        ),
        lower=-1.0 - rng.random(features, np.float32),
        upper=1.0 + rng.random(features, np.float32),
        location=draw(features),
        scale=0.5 + rng.random(features, np.float32),
        times=np.linspace(0.0, 8.0, times, dtype=np.float32),
        gamma=draw(times),
        context=draw(features, features) if by_context else None,
        seen=np.sort(draw(2, features), axis=0) if seen or anchored else None,
        anchor=example_anchor(seed, features) if anchored else None,
        kernels=tuple(draw(*pair) for pair in pairwise(sizes)),
        biases=tuple(draw(size) for size in sizes[1:]),
        activation=activation,
        leaky_slope=0.01,
        loss={"name": "rank", "leaky_rate": 0.05},
        provenance=provenance(),
    )


def example_anchor(seed=0, features=3, units=4):
    """Its first feature does not matter, if there is another."""
    rng = np.random.default_rng(seed)
    draw = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    kernel = draw(features, units)
    kernel[: features - 1 and 1] = 0.0
    return Anchor(
        incumbent="hand-set",
        low=0.25,
        high=1.5,
        location=draw(features),
        scale=0.2 + rng.random(features, np.float32),
        kernel=kernel,
        bias=draw(units),
        out=draw(units),
        offset=draw(1),
    )


def example_samples(weights, count=4, seed=1):
    """Features that often leave [lower, upper], masks, float64 values."""
    rng = np.random.default_rng(seed)
    size = (count, len(weights.times), len(weights.features))
    features = rng.normal(scale=2.0, size=size).astype(np.float32)
    valid = rng.random(size[:2]) < 0.7
    valid[:, 0] |= weights.context is not None or weights.anchor is not None
    values = [loop_value(weights, *one) for one in zip(features, valid, strict=True)]
    return features, valid, np.array(values)


def packed(**changes):
    weights = example_weights(**changes)
    return pack(weights, *example_samples(weights))


def loop_value(weights, features, valid):
    """V by plain float64 loops, from the equation and nothing else."""
    act = {
        "tanh": math.tanh,
        "relu": lambda x: x if x > 0.0 else 0.0,
        "leaky_relu": lambda x: x if x > 0.0 else float(weights.leaky_slope) * x,
        "identity": lambda x: x,
    }[weights.activation]
    count = len(weights.features)

    def normalised(t):
        x = []
        for f in range(count):
            clipped = max(float(features[t, f]), float(weights.lower[f]))
            clipped = min(clipped, float(weights.upper[f]))
            x.append((clipped - float(weights.location[f])) / float(weights.scale[f]))
        return x

    gain, first = [1.0] * count, normalised(0)
    if weights.context is not None:
        for f in range(count):
            sums = [first[i] * float(weights.context[i, f]) for i in range(count)]
            gain[f] = 2.0 / (1.0 + math.exp(-sum(sums)))
    total = 0.0
    for t in range(len(weights.times)):
        x = [g * v for g, v in zip(gain, normalised(t), strict=True)]
        for layer in range(len(weights.kernels)):
            kernel, bias = weights.kernels[layer], weights.biases[layer]
            y = []
            for column in range(kernel.shape[1]):
                start = float(bias[column])
                products = [
                    x[row] * float(kernel[row, column]) for row in range(len(x))
                ]
                y.append(start + sum(products))
            last = layer == len(weights.kernels) - 1
            x = y if last else [act(item) for item in y]
        total += float(weights.gamma[t]) * x[0] if valid[t] else 0.0
    return total


def loop_gain(anchor, first):
    """The gain of V by plain float64 loops; `first` is [F]."""
    total = float(anchor.offset[0])
    for unit in range(len(anchor.bias)):
        x = float(anchor.bias[unit])
        for f in range(len(first)):
            z = (float(first[f]) - float(anchor.location[f])) / float(anchor.scale[f])
            x += max(-5.0, min(5.0, z)) * float(anchor.kernel[f, unit])
        total += float(anchor.out[unit]) * math.tanh(x)
    return anchor.low + (anchor.high - anchor.low) / (1.0 + math.exp(-total))


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


def trained_network(hidden, activation, by_context, count):
    """Effective weights of a random network, inputs, masks and the trainer's values."""
    specs, rng = feature_map("paper21").specs, np.random.default_rng(3)
    lower = np.array([spec.lower for spec in specs], np.float32)
    upper = np.array([spec.upper for spec in specs], np.float32)
    normaliser = Normaliser(
        lower=jnp.asarray(lower),
        upper=jnp.asarray(upper),
        location=jnp.asarray(rng.uniform(lower, upper), jnp.float32),
        scale=jnp.asarray(0.2 * (upper - lower)),
    )
    context = feature_map("paper21").context if by_context else ()
    config = RewardConfig(hidden=hidden, activation=activation, context=context)
    raw = init_reward(jax.random.key(5), len(specs), config)
    raw = raw.replace(gamma=jnp.asarray(rng.normal(size=18), jnp.float32))
    if by_context:
        drawn = rng.normal(scale=0.2, size=(len(specs),) * 2)
        raw = raw.replace(context=jnp.asarray(drawn, jnp.float32))
    effective = pinned(raw, config)
    wide = 0.5 * (upper - lower)
    features = rng.uniform(lower - wide, upper + wide, (count, 18, len(specs)))
    features = features.astype(np.float32)
    valid = np.arange(18) < rng.integers(11, 19, (count, 1))
    expected = np.asarray(
        trained_value(
            raw, normaliser, jnp.asarray(features), jnp.asarray(valid), config
        )
    )
    weights = dataclasses.replace(
        example_weights(),
        features=tuple(
            FeatureSpec(name=spec.name, unit=spec.unit, none_value=spec.none)
            for spec in specs
        ),
        **{name: getattr(normaliser, name) for name in reader.RANGES},
        times=TIMES_S,
        gamma=effective.gamma,
        context=effective.context,
        kernels=effective.kernels,
        biases=(*effective.biases, np.zeros(1)),
        activation=activation,
        leaky_slope=LEAKY_SLOPE,
    )
    return weights, features, valid, expected
