"""The flag that names a recipe: everything that decides a training run."""

from absl import flags

from rcirl_jax.autotune.recipes import DEFAULT, Recipe, load_recipe

RECIPE = flags.DEFINE_string(
    "recipe", DEFAULT, "name in data_specs/recipes, or a TOML file"
)
AS_SAID = "; default: as the recipe says"  # end of the help of a flag beside it


def recipe() -> Recipe:
    """The recipe that the flag names, as its file has it."""
    return load_recipe(RECIPE.value)
