"""From a dataset to trained weights; loads no simulator."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from rcirl_jax.api.logs import Place
from rcirl_jax.data.store.dataset import Demonstrations, open_datasets
from rcirl_jax.export.from_run import export_run
from rcirl_jax.export.reader import Reward
from rcirl_jax.reward import RewardConfig
from rcirl_jax.runtime.checked import typed_fields
from rcirl_jax.runtime.provenance import provenance
from rcirl_jax.train.loop import train
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.tuning.recipes import (
    DEFAULT,
    NOT_OF_A_RECIPE,
    PRESETS_OWN,
    load_recipe,
    override,
)


def train_reward(
    data: Place | Sequence[Place] | Demonstrations,
    workdir: Place,
    *,
    recipe: str = DEFAULT,
    seed: int = 0,
    **settings: Any,  # noqa: ANN401
) -> Reward:
    """Train a reward on the training scenes of a dataset, and write its weights.

    The weights are WORKDIR/weights.msgpack. A training that was interrupted goes on
    where it was when it is called again; one that is done is not done again. The
    reward stands alone: `tune` adds a recipe's simulated demonstrations and prior cost.

    Args:
      data: a dataset, its folder, or the folders of several, which count alike.
      workdir: folder of the run: checkpoints, metrics, weights.
      recipe: name in data_specs/recipes ("tuned", "paper", "quick"), or a TOML file.
      seed: of initial weights, batches and candidates.
      **settings: in place of the recipe's: fields of `TrainConfig` and `RewardConfig`,
        for example `epochs=40`, `loss="listwise"`, `hidden=(15,)`, `constraint="none"`.

    Returns:
      The reward as `load_weights` reads it.

    Raises:
      InputError: a setting that cannot be, a workdir of other settings or data, or a
        scene with a feature that is not finite.
      Interrupted: the process was told to end; the last step is saved.

    Examples:
        >>> reward = rcirl_jax.train_reward("data", "run", recipe="quick", epochs=1)
        >>> reward.preset, len(reward.names)
        ('paper21', 21)
        >>> rcirl_jax.load_weights("run/weights.msgpack").sha256 == reward.sha256
        True
    """
    config = training_of(recipe, seed, settings)
    config.reward.check_own()
    folder = Path(workdir)
    named = folders_of(data)
    dataset = cast(Demonstrations, data) if named is None else open_datasets(named)
    flags = {"data": named, "recipe": recipe, "seed": seed, **settings}
    train(dataset, folder, config, provenance={"flags": flags, **provenance()})
    return export_run(folder, dataset, folder / "weights.msgpack")


def training_of(recipe: str, seed: int, settings: Mapping[str, Any]) -> TrainConfig:
    """The training of a recipe with settings in place of its own."""
    names = {field.name for field in dataclasses.fields(RewardConfig)}
    of_reward = {name: settings[name] for name in settings if name in names}
    rest = {name: settings[name] for name in settings if name not in names}
    given = typed_fields(TrainConfig, rest, "settings: ", NOT_OF_A_RECIPE)
    given |= typed_fields(RewardConfig, of_reward, "settings: ", PRESETS_OWN)
    return override(load_recipe(recipe).train, given, seed=seed)


def folders_of(data: object) -> list[str] | None:
    """Folders by name; None for a dataset that is open."""
    if isinstance(data, str | os.PathLike):
        return [os.fspath(data)]
    if isinstance(data, Sequence):
        return [os.fspath(one) for one in data]
    return None
