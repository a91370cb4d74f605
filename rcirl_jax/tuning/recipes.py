"""Recipes: TOML files that hold everything that decides a run.

    data_specs/recipes/tuned.toml   the default
    data_specs/recipes/paper.toml   the paper's own setting
    data_specs/recipes/quick.toml   for the demo
    data_specs/recipes/terms.toml   the weights of own terms (`features.terms`)

[train] are fields of `TrainConfig`, [train.reward] of `RewardConfig` (`scene_gating`
stands for the preset's context columns), [train.sampler] of `SamplerConfig`, [collect]
of `CollectConfig`, [simulated_demonstrations] of `SimulatedDemonstrations`;
[prior_cost] has the `gain` of V on top of the own cost. What a file leaves out is the
field's own default. Nothing else has a default of its own: commands take a recipe, and
flags given beside it win.
"""

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.features import feature_map
from rcirl_jax.reward import RewardConfig
from rcirl_jax.runtime.checked import check_names, typed_fields, typed_settings
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.sampling import SamplerConfig
from rcirl_jax.train.state import TrainConfig

DEFAULT = "tuned"
TERMS = "terms"  # of own terms
SIMULATED = "simulated_demonstrations"
TABLES = ("about", "train", "collect", SIMULATED, "prior_cost", "autotune")
# of a run, not of a recipe
NOT_OF_A_RECIPE = ("terms_sha256", "seed", "reward", "sampler")
# of a reward, what its feature preset says
PRESETS_OWN = ("scene_gating", "signs", "today")
OWN_TERMS = "own terms"  # as features of a recipe: the user's, by --terms
# own cost: the incumbent where it is one, else the hand-set cost
EXPERTS = ("none", "driver model", "own cost", "incumbent")
SUITE_SEED = 0  # of the catalogue that rewards are judged on


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimulatedDemonstrations:
    """Settings of an expert's drives; [simulated_demonstrations] of a recipe."""

    # who drives, one of EXPERTS
    expert: str = "none"
    # cases of each family, and their seed
    cases: int = 12
    catalogue_seed: int = 1000
    # s of a drive, and between two of its scenes
    duration_s: float = 120.0
    stride_s: float = 3.0
    # above 0, where a recorded source has 1
    weight: float = 1.2

    def __post_init__(self) -> None:
        """Rejects values out of range."""
        above = f"above {SUITE_SEED}, the suite's own"
        for name, fits, expected in (
            ("expert", self.expert in EXPERTS, f"one of {', '.join(EXPERTS)}"),
            ("cases", self.cases >= 1, "at least 1"),
            ("catalogue_seed", self.catalogue_seed > SUITE_SEED, above),
            ("weight", self.weight > 0.0, "above 0"),
        ):
            if not fits:
                value = getattr(self, name)
                raise InputError(f"{name}: {value}: expected {expected}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recipe:
    """Everything that decides a run but the data and the seed."""

    name: str
    about: str
    train: TrainConfig
    collect: CollectConfig
    simulated: SimulatedDemonstrations
    gain: float  # of V on top of the own cost; 0: V drives alone
    seeds: int  # training runs of which the median one drives


def recipe_names() -> list[str]:
    """Lists those in data_specs/recipes."""
    return sorted(path.stem for path in (spec_root() / "recipes").glob("*.toml"))


def load_recipe(name: str) -> Recipe:
    """Loads a recipe by its name or by its file.

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
            f"recipe: {name}: expected one of {', '.join(known)}, or a .toml file"
            + did_you_mean(name, known)
        )
    body = load_toml(path)
    check_names(f"{path}: ", body, TABLES)
    train = _table(path, "train", body)
    network = _table(path, "train.reward", train)
    scene_gating = network.pop("scene_gating", False)
    if not isinstance(scene_gating, bool):
        raise InputError(
            f"{path}: [train.reward] scene_gating: {scene_gating}: expected true or "
            "false"
        )
    sampler = _table(path, "train.sampler", train)
    settings = typed_fields(TrainConfig, train, f"{path}: [train] ", NOT_OF_A_RECIPE)
    features = settings.get("features", "paper21")
    with _inside(path, "train.reward") as where:
        of_reward = typed_fields(RewardConfig, network, where, PRESETS_OWN)
        if features == OWN_TERMS:  # not known yet
            of_reward["today"] = (1.0,)
            reward = RewardConfig(**of_reward)
        else:
            reward = reward_config(features, of_reward, scene_gating)
    with _inside(path, "train.sampler") as where:
        sampler = SamplerConfig(**typed_fields(SamplerConfig, sampler, where))
    with _inside(path, "train"):
        trained = TrainConfig(**settings, reward=reward, sampler=sampler)
    with _inside(path, SIMULATED) as where:
        found = _table(path, SIMULATED, body)
        simulated = typed_settings(SimulatedDemonstrations, found, where)
    with _inside(path, "prior_cost") as where:
        found = _table(path, "prior_cost", body)
        check_names(where, found, ("gain",))
        gain = found.get("gain", 0.0)
        if type(gain) not in (int, float) or not 0.0 <= gain < math.inf:
            raise InputError(f"gain: {gain}: expected a number, at least 0")
    with _inside(path, "collect") as where:
        found = _table(path, "collect", body)
        kept = typed_fields(CollectConfig, found, where, ("signal_checks",))
        collect = CollectConfig(**kept)
    tuned = _table(path, "autotune", body)
    check_names(f"{path}: [autotune] ", tuned, ("seeds",))
    seeds = tuned.get("seeds", 1)
    if type(seeds) is not int or seeds < 1:
        raise InputError(f"{path}: [autotune] seeds: {seeds}: expected at least 1")
    if trained.residual_on:
        where = f"{path}: [train] residual_on: {trained.residual_on}"
        if trained.residual_on != "own cost":
            raise InputError(f'{where}: expected "own cost", the incumbent\'s')
        if gain or simulated.expert == "none":
            raise InputError(
                f"{where}: expected no [prior_cost], and [{SIMULATED}]: they show "
                "where nobody was recorded"
            )
    return Recipe(
        name=path.stem if name in known else name,
        about=str(body.get("about", "")),
        train=trained,
        collect=collect,
        simulated=simulated,
        gain=float(gain),
        seeds=seeds,
    )


@contextlib.contextmanager
def _inside(path: Path, table: str) -> Iterator[str]:
    """Yields how messages about a table begin; puts it before errors without it."""
    where = f"{path}: [{table}] "
    try:
        yield where
    except ValueError as error:
        said = str(error)
        raise InputError(
            said if said.startswith(str(path)) else where + said
        ) from error


def _table(path: Path, where: str, body: dict) -> dict:
    """Takes the table [where] out of the one that holds it; empty without one."""
    found = body.pop(where.rpartition(".")[2], {})
    if not isinstance(found, dict):
        raise InputError(f"{path}: {where}: {found}: expected a table [{where}]")
    return dict(found)


def reward_config(
    features: str, settings: Mapping[str, Any], scene_gating: bool
) -> RewardConfig:
    """The network with the preset's context and signs where they are asked for."""
    if features == OWN_TERMS:
        raise InputError("terms: not given: expected FILE.py:NAME of your own terms")
    preset, constraint = feature_map(features), settings.get("constraint")
    weights = preset.own.weights if preset.own else ()
    return RewardConfig(
        **settings,
        scene_gating=preset.context if scene_gating else (),
        signs=preset.signs if constraint == "monotone" else (),
        today=weights if constraint == "terms" else (),
    )


def override(
    base: TrainConfig,
    given: Mapping[str, Any],
    *,
    seed: int = 0,
    scene_gating: bool | None = None,
) -> TrainConfig:
    """Overrides settings of a recipe's training.

    Args:
      base: the recipe's.
      given: fields of `TrainConfig`, and of its `RewardConfig` beside them.
      seed: of initial weights, batches, candidates.
      scene_gating: whether the scene sets the gains; None: as in the recipe.

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
        bool(base.reward.scene_gating) if scene_gating is None else scene_gating,
    )
    other = {"terms_sha256": ""} if "features" in rest else {}
    return dataclasses.replace(base, **rest, **other, seed=seed, reward=reward)
