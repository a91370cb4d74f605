"""The learned value on top of the planner's own cost; see `planner.prior_cost`.

The familiarity is fitted on recorded scenes against scenes of the rehearsed catalogue,
and stands in the weights file with the gains, so that a planner adds its own cost and
nothing else.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.errors import InputError
from rcirl_jax.export.reader import PriorCost
from rcirl_jax.features import FeatureMap
from rcirl_jax.reward.familiarity import of_the_scene
from rcirl_jax.runtime.atomic_files import read_json, write_json
from rcirl_jax.tune.familiarity import fit_familiarity, scene_features

OWN_COST = "hand-set"  # what stands for the planner's own cost here
ARRAYS = ("location", "scale", "kernel", "bias", "out", "offset")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PriorCostConfig:
    """[prior_cost] of a recipe; gains of V on top of the own cost."""

    low: float = 0.0  # where nothing like the scene was recorded
    high: float = 0.0  # where all of it was; 0: no prior cost, V drives alone
    # shares of the ego's speed at which the rehearsed scenes are shown once more: who
    # is slow on an empty road is not in recorded traffic for being slow
    slowed: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """0 <= low <= high, and 0 <= slowed < 1."""
        if not 0.0 <= self.low <= self.high:
            raise InputError(
                f"prior_cost: low, high: {self.low}, {self.high}: expected "
                "0 <= low <= high"
            )

        if not all(0.0 <= share < 1.0 for share in self.slowed):
            raise InputError(
                f"prior_cost: slowed: {list(self.slowed)}: expected shares of the "
                "speed, each at least 0 and below 1"
            )

    @property
    def wanted(self) -> bool:
        """Whether there is a prior cost."""
        return self.high > 0.0


def fitted_prior_cost(
    config: PriorCostConfig,
    recorded: Sequence[Dataset],
    shares: Sequence[float],
    elsewhere: Sequence[Dataset],
    features: FeatureMap,
) -> PriorCost:
    """The prior cost of a weights file, from the training splits.

    Args:
      config: gains.
      recorded: the sources.
      shares: > 0, how much each of them counts.
      elsewhere: rehearsed drives.
      features: of the reward.
    """
    mine = [_training_scenes(one, features) for one in recorded]
    pairs = zip(mine, shares, strict=True)
    weights = np.concatenate([np.full(len(x), share / len(x)) for x, share in pairs])
    others = [_training_scenes(one, features, config.slowed) for one in elsewhere]
    made = fit_familiarity(
        np.concatenate(mine),
        weights,
        np.concatenate(others),
        np.asarray(of_the_scene(features)),
    )
    arrays = {name: np.asarray(getattr(made, name)) for name in ARRAYS}
    arrays["offset"] = arrays["offset"].reshape(1)
    return PriorCost(incumbent=OWN_COST, low=config.low, high=config.high, **arrays)


def write_prior_cost(path: Path, prior_cost: PriorCost) -> None:
    """The prior cost as JSON; float32 survives it."""
    fields = dataclasses.asdict(prior_cost)
    as_lists = {n: x.tolist() for n, x in fields.items() if isinstance(x, np.ndarray)}
    write_json(path, {**fields, **as_lists})


def read_prior_cost(path: Path) -> PriorCost:
    """The prior cost of a file that `write_prior_cost` wrote.

    Raises:
      InputError: it is not.
    """
    found = read_json(path, "a prior cost as written")
    try:
        arrays = {n: np.asarray(found[n], np.float32) for n in ARRAYS}
        own = str(found["incumbent"]), float(found["low"]), float(found["high"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: {error}: expected a prior cost as written"
        ) from error
    return PriorCost(incumbent=own[0], low=own[1], high=own[2], **arrays)


def _training_scenes(
    dataset: Dataset, features: FeatureMap, slowed: Sequence[float] = ()
) -> np.ndarray:
    """Features of the training scenes, then of the same with a slower, steady ego."""
    scene = dataset.load("train").scene
    egos = [scene.ego.replace(v=x * scene.ego.v, a=0.0 * scene.ego.a) for x in slowed]
    scenes = [scene, *[scene.replace(ego=ego) for ego in egos]]
    return np.concatenate([scene_features(one, features) for one in scenes])
