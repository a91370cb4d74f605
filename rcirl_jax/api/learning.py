"""From datasets to weights: one training, or the whole loop up to a verdict."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from rcirl_jax.autotune.config import TuneConfig
from rcirl_jax.autotune.evidence import verdict_of
from rcirl_jax.autotune.loop import tune as run_stages
from rcirl_jax.autotune.recipes import (
    DEFAULT,
    NOT_OF_A_RECIPE,
    PRESETS_OWN,
    departing,
    load_recipe,
)
from rcirl_jax.autotune.run import Run
from rcirl_jax.data.store.joined import Demonstrations, open_datasets
from rcirl_jax.evaluation.gate.types import GateConfig, Verdict
from rcirl_jax.export.from_run import export_run
from rcirl_jax.export.reader import Reward
from rcirl_jax.reward import RewardConfig
from rcirl_jax.runtime.executors import Executor, Here
from rcirl_jax.runtime.pipeline import only_one
from rcirl_jax.runtime.provenance import provenance
from rcirl_jax.runtime.settings import typed_fields
from rcirl_jax.train.loop import train
from rcirl_jax.train.running import Running
from rcirl_jax.train.state import TrainConfig

Place = str | os.PathLike[str]


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
    where it was when it is called again; one that is done is not done again. The reward
    stands alone: what a recipe says of rehearsal and anchor, `tune` does.

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
    config = _config(recipe, seed, settings)
    config.reward.check_own()
    folder = Path(workdir)
    named = _named(data)
    dataset = cast(Demonstrations, data) if named is None else open_datasets(named)
    flags = {"data": named, "recipe": recipe, "seed": seed, **settings}
    train(dataset, folder, config, provenance={"flags": flags, **provenance()})
    return export_run(folder, dataset, folder / "weights.msgpack")


def tune(
    data: Place | Sequence[Place],
    workdir: Place,
    *,
    recipe: str = DEFAULT,
    incumbent: Place = "hand-set",
    suite: str = "full",
    cases: int | None = None,
    duration_s: float | None = None,
    drives: int = 240,
    executor: Executor | None = None,
    **settings: Any,  # noqa: ANN401
) -> Verdict:
    """Go through the whole loop: train, export, rank, drive, judge and report.

    The weights are WORKDIR/weights.msgpack, the page to open is WORKDIR/report.html.
    What is done is kept when it is called again. This is `experiments.autotune`.

    Args:
      data: folder of a dataset, or folders of several.
      workdir: folder of the run.
      recipe: as `train_reward`.
      incumbent: what drives today: a weights file, or a baseline's name.
      suite: cases of the closed loop: "full", "smoke", or families with commas.
      cases: of each family; None: as declared.
      duration_s: s of a case; None: 120, of "smoke" 20.
      drives: held-out recorded drives that say how near to people it drives.
      executor: where pieces of work run, of `rcirl_jax.runtime.executors`; None: here.
      **settings: as `train_reward`.

    Returns:
      The verdict: `decision` is "ship", "do not ship", "no difference" or "could not
      judge", `sentence` says why.

    Raises:
      InputError: a setting that cannot be, or bad data.
      Interrupted: the process was told to end; what is done stays.
    """
    chosen = load_recipe(recipe)
    folders = [os.fspath(one) for one in _named(data) or ()]
    config = TuneConfig(
        train=_config(recipe, 0, settings),
        gate=GateConfig(),
        incumbent=os.fspath(incumbent),
        rehearsal=chosen.rehearsal,
        anchor=chosen.anchor,
        recipe=chosen.name,
        seeds=chosen.seeds,
        drives=drives,
        suite=suite,
        cases=cases,
        duration_s=duration_s,
    )
    flags = {"data": folders, "recipe": recipe, "incumbent": config.incumbent}
    run = Run(
        folder=Path(workdir),
        config=config,
        executor=executor or Here(),
        running=Running(),
        facts={"flags": {**flags, **settings}, **provenance()},
    )
    with only_one(run.folder):
        run_stages(run, folders)
    return verdict_of(run)


def _config(recipe: str, seed: int, settings: Mapping[str, Any]) -> TrainConfig:
    """The training of a recipe with settings in place of its own."""
    names = {field.name for field in dataclasses.fields(RewardConfig)}
    of_reward = {name: settings[name] for name in settings if name in names}
    rest = {name: settings[name] for name in settings if name not in names}
    given = typed_fields(TrainConfig, rest, "settings: ", NOT_OF_A_RECIPE)
    given |= typed_fields(RewardConfig, of_reward, "settings: ", PRESETS_OWN)
    return departing(load_recipe(recipe).train, given, seed=seed)


def _named(data: object) -> list[str] | None:
    """Folders by name; None for a dataset that is open."""
    if isinstance(data, str | os.PathLike):
        return [os.fspath(data)]
    if isinstance(data, Sequence):
        return [os.fspath(one) for one in data]
    return None
