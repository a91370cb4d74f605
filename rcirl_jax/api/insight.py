"""What a reward wants: how it follows each feature, and what each is worth."""

import jax
import numpy as np

from rcirl_jax.data.store.joined import Demonstrations
from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.export.loading import features_of
from rcirl_jax.export.reader import Reward
from rcirl_jax.export.responses import Response, prices, responses
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.loop import in_chunks
from rcirl_jax.train.state import TrainConfig


def response_curves(
    reward: Reward, dataset: Demonstrations, *, split: str = "test", scenes: int = 48
) -> dict[str, Response]:
    """Follow a reward over each feature, all others as people drove.

    Args:
      reward: of `load_weights`; of one with a prior cost, what is added to it.
      dataset: whose scenes are taken.
      split: "test" or "train".
      scenes: so many, spread over the split.

    Returns:
      By feature that the reward uses: `at` in the feature's unit; `value` there, with 0
      at what people drove in the median, in standard deviations of V among the
      candidates of a scene; `supported`, outside of which the reward does not change.

    Raises:
      InputError: no such split, or features that are not this package's.

    Examples:
        >>> reward = rcirl_jax.load_weights("weights.msgpack")
        >>> dataset = rcirl_jax.open_dataset("data")
        >>> curves = rcirl_jax.response_curves(reward, dataset, scenes=8)
        >>> curve = curves["acceleration"]
        >>> curve.at.shape == curve.value.shape
        True
    """
    return responses(reward, *_described(reward, dataset, split, scenes))


def feature_prices(
    reward: Reward,
    dataset: Demonstrations,
    *,
    against: str = "velocity",
    split: str = "test",
    scenes: int = 48,
) -> dict[str, float]:
    """Say what a unit of each feature is worth in units of one of them.

    Args:
      reward: as `response_curves`.
      dataset: as `response_curves`.
      against: the feature that is paid with.
      split: as `response_curves`.
      scenes: as `response_curves`.

    Returns:
      By feature: how many units of `against` are worth as much as one unit more of it,
      at all times and in the mean of scenes as people drove them. Below 0: it costs.
      With "velocity", -2 for "jerk" reads: 1 m/s^3 of jerk is not made up for before
      the car is 2 m/s faster.

    Raises:
      InputError: as `response_curves`, or a feature that the reward does not use or
        does not care for.

    Examples:
        >>> reward = rcirl_jax.load_weights("weights.msgpack")
        >>> dataset = rcirl_jax.open_dataset("data")
        >>> rcirl_jax.feature_prices(reward, dataset, scenes=8)["velocity"]
        1.0
    """
    mine, _, valid = _described(reward, dataset, split, scenes)
    found = prices(reward, mine, valid)
    if not found.get(against):
        raise InputError(
            f"against: {against}: expected a feature that {reward.file} cares for"
            + did_you_mean(against, found)
        )
    return {name: price / found[against] for name, price in found.items()}


def _described(
    reward: Reward, dataset: Demonstrations, split: str, scenes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features of humans [S, T, F] and candidates [S, K, T, F], and times [S, T]."""
    if scenes < 1:
        raise InputError(f"scenes: {scenes}: expected at least 1")
    mode = str(reward.provenance.get("mode", "speed"))
    config = TrainConfig(
        features=features_of(reward).preset,
        sampler=SamplerConfig(mode=mode),
        positive="human",
    )
    rows = dataset.indices(split)
    if rows.size == 0:
        raise InputError(f"split: {split}: no scene: expected some")
    spread = np.linspace(0, rows.size - 1, min(scenes, rows.size)).astype(int)
    rows = rows[spread]
    key = jax.random.key(config.seed)
    made = list(in_chunks(key, dataset.read(rows), rows, config))
    return (
        np.concatenate([np.asarray(one.human) for one in made]),
        np.concatenate([np.asarray(one.points) for one in made]),
        np.concatenate([np.asarray(one.time_valid) for one in made]),
    )
