"""Recipes: TOML files that hold everything that decides a run.

    data_specs/recipes/tuned.toml   the default
    data_specs/recipes/paper.toml   the paper's own setting
    data_specs/recipes/quick.toml   for the demo

[train] are fields of `TrainConfig`, [train.reward] of `RewardConfig` (`by_context`
stands for the preset's context columns), [train.sampler] of `SamplerConfig`, [collect]
of `CollectConfig`, [rehearsal] of `Rehearsal`, [prior_cost] of `PriorCostConfig`.
What a file leaves out is the field's own default. Nothing else has a default of
its own: commands take a recipe, and flags given beside it win.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.features import feature_map
from rcirl_jax.reward import RewardConfig
from rcirl_jax.runtime.settings import check_names, typed_fields
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.state import TrainConfig
from rcirl_jax.tune.prior_cost import PriorCostConfig
from rcirl_jax.tune.rehearsal import Rehearsal

DEFAULT = "tuned"
TABLES = ("about", "train", "collect", "rehearsal", "prior_cost", "autotune")
# of a run, not of a recipe
NOT_OF_A_RECIPE = ("seed", "reward", "sampler")
PRESETS_OWN = ("context", "signs")  # of a reward, what its feature preset says


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recipe:
    """Everything that decides a run but the data and the seed."""

    name: str
    about: str
    train: TrainConfig
    collect: CollectConfig
    rehearsal: Rehearsal
    prior_cost: PriorCostConfig
    seeds: int  # training runs of which the median one drives


def recipe_names() -> list[str]:
    """Those in data_specs/recipes."""
    return sorted(path.stem for path in (spec_root() / "recipes").glob("*.toml"))


def load_recipe(name: str) -> Recipe:
    """A recipe by its name or by its file.

    Raises:
      InputError: no such recipe; an unknown table or key (with the nearest known one);
        a value of another type or out of range.
    """
    known = recipe_names()
    if name in known:
        path = spec_root() / "recipes" / f"{name}.toml"
    elif name.endswith(".toml"):
        path = Path(name)
    else:
        raise InputError(
            f"--recipe: {name}: expected one of {', '.join(known)}, or a .toml file"
            + did_you_mean(name, known)
        )
    body = load_toml(path)
    check_names(f"{path}: ", body, TABLES)
    train = _table(path, "train", body)
    reward = _table(path, "train.reward", train)
    sampler = _table(path, "train.sampler", train)
    tuning = _table(path, "autotune", body)
    check_names(f"{path}: [autotune] ", tuning, ("seeds",))
    seeds = tuning.get("seeds", 1)
    if type(seeds) is not int or seeds < 1:
        raise InputError(f"{path}: [autotune] seeds: {seeds}: expected at least 1")
    settings = typed_fields(TrainConfig, train, f"{path}: [train] ", NOT_OF_A_RECIPE)
    settings["reward"] = _reward(path, reward, settings.get("features", "paper21"))
    settings["sampler"] = _made(path, "train.sampler", SamplerConfig, sampler)
    rehearsal = _made(path, "rehearsal", Rehearsal, _table(path, "rehearsal", body))
    prior_cost = _made(
        path, "prior_cost", PriorCostConfig, _table(path, "prior_cost", body)
    )
    if prior_cost.wanted and not rehearsal.datasets:
        raise InputError(
            f"{path}: [rehearsal] teacher: none: expected one with a [prior_cost]: its "
            "drives show what was not recorded"
        )
    collect, none = _table(path, "collect", body), ("signal_checks",)
    return Recipe(
        name=path.stem if name in known else name,
        about=str(body.get("about", "")),
        train=_built(path, "train", TrainConfig, settings),
        collect=_made(path, "collect", CollectConfig, collect, none),
        rehearsal=rehearsal,
        prior_cost=prior_cost,
        seeds=seeds,
    )


def reward_config(
    features: str, settings: Mapping[str, Any], by_context: bool
) -> RewardConfig:
    """The network with the preset's context and signs where they are asked for."""
    preset = feature_map(features)
    monotone = settings.get("constraint") == "monotone"
    return RewardConfig(
        **settings,
        context=preset.context if by_context else (),
        signs=preset.signs if monotone else (),
    )


def departing(
    base: TrainConfig,
    given: Mapping[str, Any],
    *,
    seed: int = 0,
    by_context: bool | None = None,
) -> TrainConfig:
    """A training that departs from a recipe's.

    Args:
      base: the recipe's.
      given: fields of `TrainConfig`, and of its `RewardConfig` beside them.
      seed: of initial weights, batches, candidates.
      by_context: whether the scene sets the gains; None: as in the recipe.

    Raises:
      InputError: a value that cannot be.
    """
    fields = [field.name for field in dataclasses.fields(RewardConfig)]
    of_reward = [name for name in fields if name not in PRESETS_OWN]
    settings = {name: getattr(base.reward, name) for name in of_reward}
    settings |= {name: value for name, value in given.items() if name in of_reward}
    rest = {name: value for name, value in given.items() if name not in of_reward}
    reward = reward_config(
        rest.get("features", base.features),
        settings,
        bool(base.reward.context) if by_context is None else by_context,
    )
    return dataclasses.replace(base, **rest, seed=seed, reward=reward)


def _reward(path: Path, found: dict, features: str) -> RewardConfig:
    where = "train.reward"
    by_context = found.pop("by_context", False)
    if not isinstance(by_context, bool):
        raise InputError(
            f"{path}: [{where}] by_context: {by_context}: expected true or false"
        )
    known = f"{path}: [{where}] "
    typed = typed_fields(RewardConfig, found, known, PRESETS_OWN)
    made = lambda **settings: reward_config(features, settings, by_context)  # noqa: E731
    return _built(path, where, made, typed)


def _made(
    path: Path, where: str, kind: type, found: dict, without: tuple[str, ...] = ()
) -> Any:  # noqa: ANN401
    typed = typed_fields(kind, found, f"{path}: [{where}] ", without)
    return _built(path, where, kind, typed)


def _built(path: Path, where: str, kind: Callable, values: dict) -> Any:  # noqa: ANN401
    try:
        return kind(**values)
    except (InputError, ValueError) as error:
        raise InputError(f"{path}: [{where}] {error}") from error


def _table(path: Path, where: str, body: dict) -> dict:
    """The table [where], taken out of the one that holds it; empty without one."""
    found = body.pop(where.rpartition(".")[2], {})
    if not isinstance(found, dict):
        raise InputError(f"{path}: {where}: {found}: expected a table [{where}]")
    return dict(found)
