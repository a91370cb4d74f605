"""Learners by name, trained on one frozen set of candidates.

Every learner is a value of the training configuration; nothing else differs.
`train_learners` gives each the same scenes, candidates, features and steps.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import tqdm

from rcirl_jax.data.store.dataset import Demonstrations
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.score import Scorer
from rcirl_jax.features import feature_map
from rcirl_jax.reward import (
    LOSSES,
    Normaliser,
    RewardConfig,
    RewardModel,
    RewardParams,
    fit_normaliser,
    value,
)
from rcirl_jax.train.featurise import CHUNK, NORMALISER_SCENES, valid_feature_rows
from rcirl_jax.train.state import FeatureBatch, TrainConfig
from rcirl_jax.train.step import init_state
from rcirl_jax.train.sweep import fit, freeze, members_of

# What a learner changes of the shared configuration: loss, fields of its network,
# others of its training. The linear rewards are not pinned: with unit norm their
# values cannot grow to the spread that a logistic or listwise loss asks for. "Free"
# says the same of the paper's network, whatever the loss; the rank loss has no such
# row, for it is homogeneous in the scale.
FREE = {"scale_constraint": "none"}
LINEAR = {"hidden": (), **FREE}
COSTS = {**LINEAR, "constraint": "nonnegative"}
MONOTONE = {"constraint": "monotone"}
ON_CURVES = {"positive": "human"}  # as in the paper: the recorded curve itself
LEARNERS: dict[str, tuple[str, dict, dict]] = {
    "RC-IRL rank": ("rank", {}, {}),
    "rank linear": ("rank", {"hidden": ()}, {}),
    "rank non-negative": ("rank", {"hidden": (), "constraint": "nonnegative"}, {}),
    "RC-IRL logistic": ("logistic", {}, {}),
    "logistic free": ("logistic", FREE, {}),
    "hinge": ("hinge", {}, {}),
    "hinge free": ("hinge", FREE, {}),
    "MaxEnt": ("listwise", {}, {}),
    "MaxEnt free": ("listwise", FREE, {}),
    "MaxEnt linear": ("listwise", LINEAR, {}),
    "MaxEnt 64": ("listwise", {"hidden": (64,)}, {}),
    "MaxEnt monotone": ("listwise", MONOTONE, {}),
    "MaxEnt monotone 64": ("listwise", {"hidden": (64,), **MONOTONE}, {}),
    "MaxEnt 32-16": ("listwise", {"hidden": (32, 16)}, {}),
    "MaxEnt monotone 32-16": ("listwise", {"hidden": (32, 16), **MONOTONE}, {}),
    "soft labels": ("soft", {}, {}),
    "soft labels free": ("soft", FREE, {}),
    "soft labels linear": ("soft", LINEAR, {}),
    "GAN": ("gan", {}, {}),
    "GAN free": ("gan", FREE, {}),
    "RC-IRL rank on curves": ("rank", {}, ON_CURVES),
    "RC-IRL logistic on curves": ("logistic", {}, ON_CURVES),
    "logistic free on curves": ("logistic", FREE, ON_CURVES),
    "GAN on curves": ("gan", {}, ON_CURVES),
    "GAN free on curves": ("gan", FREE, ON_CURVES),
    "logistic linear": ("logistic", LINEAR, {}),
    "logistic non-negative": ("logistic", COSTS, {}),
    "logistic 64": ("logistic", {"hidden": (64,)}, {}),
    "logistic 32-16": ("logistic", {"hidden": (32, 16)}, {}),
    "logistic monotone": ("logistic", MONOTONE, {}),
    "logistic by context": ("logistic", {}, {}),
    "non-negative by context": ("logistic", COSTS, {}),
    "logistic, hard negatives": (
        "logistic", {}, {"hard_negatives": 12, "hard_pool": 3},
    ),
}  # fmt: skip

# one program for all runs of a shape: their weights are arguments
_value = jax.jit(value, static_argnums=0)

# learners whose features are scaled by the scene; the columns come from the preset
BY_CONTEXT = ("logistic by context", "non-negative by context")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Learned:
    """One trained reward."""

    params: RewardParams
    normaliser: Normaliser
    config: TrainConfig
    loss: np.ndarray  # [epochs]
    wins: np.ndarray  # [epochs]
    step_loss: np.ndarray  # [steps]
    finite: bool  # no step was refused for a NaN or infinity

    @property
    def scorer(self) -> Scorer:
        """(features [S, ..., T, F], time_valid [S, ..., T]) -> value [S, ...].

        In calls of `CHUNK` scenes: jaxlib 0.10.2 sums wrongly on CPUs in some
        fusions with more than 32,768 results (jax-ml/jax issue 39103).
        """

        def scorer(x: np.ndarray, valid: np.ndarray) -> np.ndarray:
            of = (RewardModel(self.config.reward), self.params, self.normaliser)
            parts = [slice(i, i + CHUNK) for i in range(0, len(x), CHUNK)]
            values = [_value(*of, x[part], valid[part]) for part in parts]
            return np.concatenate([np.asarray(made) for made in values])

        return scorer


def learner_config(name: str, base: TrainConfig) -> TrainConfig:
    """Returns the configuration of a row of `LEARNERS`, or of a loss by its name.

    Raises:
      InputError: no learner or loss of that name.
    """
    if name not in LEARNERS and name not in LOSSES:
        known = sorted([*LEARNERS, *LOSSES])
        raise InputError(f"learners: {name}: expected some of {known}")
    loss, network, more = LEARNERS.get(name, (name, {}, {}))
    config = dataclasses.replace(base, loss=loss, **more)
    features = feature_map(config.features)
    reward = dataclasses.replace(base.reward, **network)
    if reward.constraint == "monotone":
        reward = dataclasses.replace(reward, signs=features.signs)
    if name in BY_CONTEXT:
        reward = dataclasses.replace(reward, scene_gating=features.context)
    return dataclasses.replace(config, reward=reward)


def learner_configs(names: Sequence[str], base: TrainConfig) -> dict[str, TrainConfig]:
    """The configurations of some learners, by name.

    Raises:
      InputError: no name, or one that is not known.
    """
    if not names:
        raise InputError(f"learners: none: expected some of {sorted(LEARNERS)}")
    return {name: learner_config(name, base) for name in names}


class FrozenSets:
    """Frozen scenes of one split, made once for all configurations that share them.

    Args:
      dataset: any dataset.
      split: which scenes.
    """

    def __init__(self, dataset: Demonstrations, split: str = "train") -> None:
        self.rows, self.index = dataset.load(split), dataset.indices(split)
        self.weights = dataset.weights(self.index)
        self._made: dict[TrainConfig, FeatureBatch] = {}

    def of(self, config: TrainConfig) -> FeatureBatch:
        """Features for a configuration."""
        key = config.for_features
        if key not in self._made:
            made = freeze(self.rows, self.index, key)
            made = made.replace(weight=jnp.asarray(self.weights))
            self._made[key] = made
        return self._made[key]


def fitting_rows(frozen: FeatureBatch, config: TrainConfig) -> np.ndarray:
    """[n, F] features of some scenes of a frozen set, to fit a normaliser on."""
    count = frozen.weight.shape[0]
    chosen = np.random.default_rng(config.seed).permutation(count)
    some = jax.tree.map(lambda x: np.asarray(x)[chosen[:NORMALISER_SCENES]], frozen)
    return valid_feature_rows(some)


def normaliser_of(
    frozen: FeatureBatch, config: TrainConfig, keep: Sequence[str] | None = None
) -> Normaliser:
    """Fitted on a frozen set; features that are not kept lose all spread.

    An infinite scale turns a feature into 0 for the network.
    """
    features = feature_map(config.features)
    rows = fitting_rows(frozen, config)
    made = fit_normaliser(rows, features, config.reward.today)
    if keep is None:
        return made
    kept = jnp.asarray([name in keep for name in features.names])
    return made.replace(scale=jnp.where(kept, made.scale, jnp.inf))


def train_learner(
    frozen: FeatureBatch,
    config: TrainConfig,
    seeds: Iterable[int],
    *,
    keep: Sequence[str] | None = None,
    together: bool = False,
) -> list[Learned]:
    """Trains one configuration with several seeds.

    Args:
      frozen: of `FrozenSets`.
      config: all but the seed.
      seeds: of the weights, and of the batch order.
      keep: names of the features that the network sees; None: all.
      together: as members of one program, which share the batch order of `config`.
    """
    members = [dataclasses.replace(config, seed=seed) for seed in seeds]
    if together:
        return train_members(frozen, config, members, keep)
    runs = [train_members(frozen, one, [one], keep) for one in members]
    return [run for group in runs for run in group]


def train_members(
    frozen: FeatureBatch,
    config: TrainConfig,
    members: Sequence[TrainConfig],
    keep: Sequence[str] | None = None,
) -> list[Learned]:
    """Trains members of one program: they differ in seed, step size and leaky rate.

    Args:
      frozen: of `FrozenSets`.
      config: what they share; its seed decides the batch order.
      members: what is trained.
      keep: names of the features that the network sees; None: all.
    """
    normaliser = normaliser_of(frozen, config, keep)
    fitted = fit(frozen, normaliser, config, members_of(members))
    found = []
    for n, own in enumerate(members):
        one = jax.tree.map(lambda leaf, n=n: leaf[n], fitted)
        found.append(
            Learned(
                params=one.params,
                normaliser=normaliser,
                config=own,
                loss=np.asarray(one.loss),
                wins=np.asarray(one.wins),
                step_loss=np.asarray(one.step_loss),
                finite=bool(one.finite),
            )
        )
    return found


def untrained(runs: Sequence[Learned]) -> list[Learned]:
    """Networks 21-15-1 before their first step, with the runs' inputs and seeds."""
    nothing = dict.fromkeys(("loss", "wins", "step_loss"), np.zeros(0))
    made = []
    for run in runs:
        config = dataclasses.replace(run.config, reward=RewardConfig(), loss="rank")
        params = init_state(config, run.normaliser).params
        made.append(dataclasses.replace(run, params=params, config=config, **nothing))
    return made


def train_learners(
    dataset: Demonstrations,
    configs: Mapping[str, TrainConfig],
    seeds: Sequence[int],
) -> dict[str, list[Learned]]:
    """All learners of a comparison on the dataset's training split."""
    sets, found = FrozenSets(dataset), {}
    with tqdm.tqdm(configs.items(), desc="train the learners", unit="learner") as bar:
        for name, config in bar:
            bar.set_postfix_str(name)
            found[name] = train_learner(sets.of(config), config, seeds)
    return found


def scorers(learned: Mapping[str, Sequence[Learned]]) -> dict[str, list[Scorer]]:
    """Row -> one scorer per seed, as `evaluate_ranking` takes them."""
    return {name: [one.scorer for one in runs] for name, runs in learned.items()}
