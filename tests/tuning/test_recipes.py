"""Recipes: complete, closed, typed; flags given beside one win."""

import dataclasses

import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.tuning.recipes import load_recipe, recipe_names
from tests.helpers.commands import python

SIMULATED = "[simulated_demonstrations]\n"
PAPER = spec_root() / "recipes" / "paper.toml"


def write(tmp_path, text):
    path = tmp_path / "own.toml"
    path.write_text(text)
    return str(path)


def test_the_recipes_say_what_decides_a_run():
    assert recipe_names() == ["paper", "quick", "residual", "terms", "tuned"]
    needed = {"loss", "positive", "futures", "admissible_in", "epochs", "learning_rate"}
    for name in recipe_names():
        body = load_toml(spec_root() / "recipes" / f"{name}.toml")
        assert needed <= set(body["train"]), name
        network = {"hidden", "scale_constraint", "scene_gating"}
        assert network <= set(body["train"]["reward"]), name


def test_the_papers_own_setting():
    recipe = load_recipe("paper")
    train = recipe.train
    assert (train.loss, train.leaky_rate, train.epochs) == ("rank", 0.05, 2)
    assert (train.positive, train.futures) == ("human", "recorded")
    assert train.reward.hidden == (15,)
    assert not train.reward.scene_gating
    assert recipe.simulated.expert == "none"
    assert recipe.collect.require_obstacles
    assert recipe.collect.require_speed_change


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "[train]\npositive = 'nearest'\nresidual_on = 'mine'",
            r"residual_on: mine: expected",
        ),
        ("[train]\nlos = 'rank'", r"los: unknown: .*did you mean loss\?"),
        (SIMULATED + "expert = 'nobody'", "expert: nobody: expected one of"),
        (SIMULATED + "catalogue_seed = 0", "catalogue_seed: 0: expected above 0"),
        ("[prior_cost]\ngain = -1.0", "gain: -1.0: expected a number, at least 0"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path, text, says):
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=says) as caught:
        load_recipe(path)
    assert str(caught.value).startswith(path)


def test_an_unknown_name_is_one_line():
    with pytest.raises(InputError, match=r"tunde: expected one of .*tuned"):
        load_recipe("tunde")


def test_a_file_of_ones_own(tmp_path):
    own = load_recipe(write(tmp_path, PAPER.read_text().replace("0.05", "0.2")))
    paper = load_recipe("paper")
    assert own.train == dataclasses.replace(paper.train, leaky_rate=0.2)


FLAGS = """
from absl import flags
from absl.testing import flagsaver
from rcirl_jax.cli.flags import training
asked = training()
for given in {given}:
    with flagsaver.flagsaver():
        flags.FLAGS(["x", *given])
        c, r = asked.config(), asked.config().reward
        print(c.loss, r.hidden, c.leaky_rate, c.futures, c.positive, r.scale_constraint)
"""
SWEEP = """
from pathlib import Path
from absl.testing import flagsaver
from rcirl_jax.cli import sweep
class Stop(Exception): pass
def shown(config, *_):
    print(config)
    raise Stop
sweep.run_sweep = shown
for given in {given}:
    with flagsaver.flagsaver():
        sweep.flags.FLAGS(["x", "--data=d", "--output=o", *given])
        try:
            sweep.main()
        except Stop:
            pass
"""


def said(code, *given):
    """What the flags make of the recipe, a line each, in an interpreter of its own."""
    done = python(code.format(given=list(given)), check=True)
    return done.stdout.splitlines()


def test_a_flag_given_beside_the_recipe_wins():
    paper, usual = ["--recipe=paper"], load_recipe("tuned").train
    changed = [*paper, "--loss=hinge", "--hidden_size=8,4", "--scale_constraint=none"]
    assert said(FLAGS, paper, changed, []) == [
        "rank (15,) 0.05 recorded human unit",
        "hinge (8, 4) 0.05 recorded human none",
        f"{usual.loss} {usual.reward.hidden} {usual.leaky_rate} {usual.futures} "
        f"{usual.positive} {usual.reward.scale_constraint}",
    ]


def test_a_sweep_trains_as_the_recipe_says(tmp_path):
    own = write(
        tmp_path,
        "[train]\nloss = 'rank'\nepochs = 7\npositive = 'human'\n"
        "learning_rate = 0.001\n[train.reward]\nscale_constraint = 'none'",
    )
    made, plain, few = said(
        SWEEP,
        [f"--recipe={own}", "--positive=nearest"],
        [],
        ["--constraint=nonnegative", "--hidden_sizes=0", "--noscene_gating"],
    )
    for words in (
        "epochs=7, positive='nearest'", "train_horizon=8.0", "scale_constraint='none'",
        "leaky_rates=(0.01, 0.05, 0.2), learning_rates=(0.001,)", "horizon_s=5.0",
    ):  # fmt: skip
        assert words in made
    rate = load_recipe("tuned").train.leaky_rate
    assert f"leaky_rates=({rate},)" in plain  # no rate to look for
    assert "hidden_sizes=((15,),)" in plain
    assert "constraint='nonnegative'" in few
