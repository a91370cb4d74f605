"""The recipe: everything that decides a training run."""

import dataclasses
from typing import Any

from absl import flags

from rcirl_jax.tune.recipes import DEFAULT, Recipe, load_recipe

RECIPE = flags.DEFINE_string(
    "recipe",
    DEFAULT,
    "tuned, paper, quick or a TOML of your own: settings that no flag gives",
)


def said_by(recipe: Recipe) -> dict[str, Any]:
    """What a recipe says, by the flag that departs from it."""
    train, collect = recipe.train, recipe.collect
    of_import = {
        name.removesuffix("_s").removesuffix("_m"): value
        for name, value in _fields(collect).items()
    }
    return {
        **_fields(train.reward),
        **_fields(train),
        **of_import,
        "keep_steady": not collect.require_speed_change,
        "keep_free_road": not collect.require_obstacles,
        "hidden_size": train.reward.hidden or 0,
        "by_context": bool(train.reward.context),
        "mode": train.sampler.mode,
        "margins": (train.margin_distance, train.margin_collision, train.margin_rule),
        "learning_rates": train.learning_rate,
        "teacher": recipe.rehearsal.teacher,
        "seeds": recipe.seeds,
    }


def _fields(settings: Any) -> dict[str, Any]:  # noqa: ANN401
    return {x.name: getattr(settings, x.name) for x in dataclasses.fields(settings)}


def recipe() -> Recipe:
    """The recipe that the flag names, as its file has it."""
    return load_recipe(RECIPE.value)
