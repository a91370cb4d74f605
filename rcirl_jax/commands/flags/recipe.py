"""The recipe: everything that decides a training run."""

from absl import flags

from rcirl_jax.autotune.recipes import DEFAULT, Recipe, load_recipe

RECIPE = flags.DEFINE_string(
    "recipe",
    DEFAULT,
    "tuned, paper, quick, or a TOML file: decides all that no flag beside it says",
)


def recipe() -> Recipe:
    """The recipe that the flag names, as its file has it."""
    return load_recipe(RECIPE.value)
