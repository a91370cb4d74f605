"""Learners by name, trained on one frozen set of candidates.

Every learner is a value of the training configuration; nothing else differs.
`train_learners` gives each the same scenes, candidates, features and steps.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import jax
import numpy as np
import tqdm

from rcirl_jax.data.joined import Demonstrations
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.score import Scorer
from rcirl_jax.features import feature_map
from rcirl_jax.reward import Normaliser, RewardConfig, RewardParams, value
from rcirl_jax.train.frozen import fit, freeze, members_of
from rcirl_jax.train.loop import fit_normaliser_on
from rcirl_jax.train.state import FeatureBatch, TrainConfig

LINEAR = RewardConfig(hidden=(), pin="none")

# What a learner changes of the shared configuration. The linear rewards are not
# pinned: with unit norm their values cannot grow to the spread that a logistic or
# listwise loss asks for.
LEARNERS: dict[str, dict] = {
    "RC-IRL rank": {"loss": "rank"},
    "RC-IRL logistic": {"loss": "logistic"},
    "hinge": {"loss": "hinge"},
    "MaxEnt": {"loss": "listwise"},
    "MaxEnt linear": {"loss": "listwise", "reward": LINEAR},
    "soft labels": {"loss": "soft"},
    "soft labels linear": {"loss": "soft", "reward": LINEAR},
    "GAN": {"loss": "gan"},
    "logistic linear": {"loss": "logistic", "reward": LINEAR},
    "logistic non-negative": {
        "loss": "logistic",
        "reward": RewardConfig(hidden=(), pin="none", constraint="nonnegative"),
    },
    "logistic 64": {"loss": "logistic", "reward": RewardConfig(hidden=(64,))},
    "logistic monotone": {
        "loss": "logistic",
        "reward": RewardConfig(constraint="monotone"),
    },
    "logistic, hard negatives": {
        "loss": "logistic",
        "hard_negatives": 12,
        "hard_pool": 3,
    },
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Learned:
    """One trained reward."""

    params: RewardParams
    normaliser: Normaliser
    config: TrainConfig
    loss: np.ndarray  # [epochs]
    wins: np.ndarray  # [epochs]
    finite: bool  # no step was refused for a NaN or infinity

    @property
    def scorer(self) -> Scorer:
        """(features [..., T, F], time_valid [..., T]) -> value [...]."""
        apply = jax.jit(
            lambda x, valid: value(
                self.params, self.normaliser, x, valid, self.config.reward
            )
        )
        return lambda x, valid: np.asarray(apply(x, valid))


def learner_config(name: str, base: TrainConfig) -> TrainConfig:
    """The configuration of a named learner.

    Raises:
      InputError: no learner of that name.
    """
    if name not in LEARNERS:
        raise InputError(f"--learners: {name}: expected some of {sorted(LEARNERS)}")
    config = dataclasses.replace(base, **LEARNERS[name])
    if config.reward.constraint != "monotone":
        return config
    signs = feature_map(config.features).signs
    return dataclasses.replace(
        config, reward=dataclasses.replace(config.reward, signs=signs)
    )


class FrozenSets:
    """Frozen training sets of one dataset, made once for all that share them."""

    def __init__(self, dataset: Demonstrations) -> None:
        self.rows, self.index = dataset.load("train"), dataset.indices("train")
        self._made: dict[TrainConfig, tuple[FeatureBatch, Normaliser]] = {}

    def of(self, config: TrainConfig) -> tuple[FeatureBatch, Normaliser]:
        """Features and normaliser for a configuration."""
        key = TrainConfig(
            features=config.features,
            loss="listwise" if config.loss == "listwise" else "rank",
            positive=config.positive,
            train_horizon=config.train_horizon,
            hard_negatives=config.hard_negatives,
            hard_pool=config.hard_pool,
            sampler=config.sampler,
        )
        if key not in self._made:
            normaliser = fit_normaliser_on(self.rows, key, feature_map(key.features))
            self._made[key] = freeze(self.rows, self.index, key), normaliser
        return self._made[key]


def train_learner(
    sets: FrozenSets, config: TrainConfig, seeds: Iterable[int]
) -> list[Learned]:
    """One configuration trained with several seeds (weights and batch order)."""
    frozen, normaliser = sets.of(config)
    found = []
    for seed in seeds:
        own = dataclasses.replace(config, seed=seed)
        fitted = fit(frozen, normaliser, own, members_of(own, [seed]))
        first = jax.tree.map(lambda leaf: leaf[0], fitted)
        found.append(
            Learned(
                params=first.params,
                normaliser=normaliser,
                config=own,
                loss=np.asarray(first.loss),
                wins=np.asarray(first.wins),
                finite=bool(first.finite),
            )
        )
    return found


def train_learners(
    dataset: Demonstrations,
    configs: Mapping[str, TrainConfig],
    seeds: Sequence[int],
) -> dict[str, list[Learned]]:
    """All learners of a comparison on the dataset's training split."""
    sets, found = FrozenSets(dataset), {}
    with tqdm.tqdm(configs.items(), desc="train", unit="learner") as bar:
        for name, config in bar:
            bar.set_postfix_str(name)
            found[name] = train_learner(sets, config, seeds)
    return found


def scorers(learned: Mapping[str, Sequence[Learned]]) -> dict[str, list[Scorer]]:
    """Row -> one scorer per seed, as `evaluate_ranking` takes them."""
    return {name: [one.scorer for one in runs] for name, runs in learned.items()}
