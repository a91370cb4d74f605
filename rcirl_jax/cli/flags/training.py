"""Training: what may depart from the recipe.

A recipe holds everything that decides a run; no command has a default of its own.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from absl import flags

from rcirl_jax.cli.flags.common import floats, hidden_sizes
from rcirl_jax.cli.flags.help import AS_SAID
from rcirl_jax.cli.flags.recipe import recipe
from rcirl_jax.data.store.joined import EQUAL
from rcirl_jax.errors import InputError
from rcirl_jax.reward import LOSSES
from rcirl_jax.reward.config import CONSTRAINTS, PINS
from rcirl_jax.sampling.config import MODES
from rcirl_jax.train.state import (
    ADMISSIBLE_IN,
    LEARNED_FUTURES,
    POSITIVES,
    TrainConfig,
)
from rcirl_jax.tune.recipes import departing


def _text(name: str, text: str) -> flags.FlagHolder:
    return flags.DEFINE_string(name, None, text + AS_SAID)


def _number(name: str, text: str) -> flags.FlagHolder:
    return flags.DEFINE_float(name, None, text + AS_SAID)


def _count(name: str, text: str) -> flags.FlagHolder:
    return flags.DEFINE_integer(name, None, text + AS_SAID)


def _one_of(name: str, values: Sequence[str], text: str) -> flags.FlagHolder:
    return flags.DEFINE_enum(name, None, list(values), text + AS_SAID)


# fields of TrainConfig by the flag of the same name
_TRAIN = {
    "features": _text("features", "preset in data_specs/features"),
    "loss": _one_of("loss", sorted(LOSSES), "what training minimises"),
    "soft_distance": _number("soft_distance", "m, temperature of soft labels"),
    "leaky_rate": _number("leaky_rate", "a of the rank loss"),
    "optimizer": _text("optimizer", "gradient method, by its name in optax"),
    "learning_rate": _number(
        "learning_rate", "step size, above 0, below 1; smaller if the loss jumps"
    ),
    "halve_every": _count("halve_every", "steps per halving; 0: never"),
    "weight_decay": _number("weight_decay", "L2 pull on the weights"),
    "clip_norm": _number("clip_norm", "norm the gradient is cut down to; 0: none"),
    "batch_size": _count("batch_size", "scenes per step, all devices"),
    "epochs": _count(
        "epochs",
        "passes over the training scenes, 1 or more; more if the loss still falls",
    ),
    "positive": _one_of(
        "positive",
        POSITIVES,
        "ranked first: the human's trajectory, or the candidate nearest to it",
    ),
    "futures": _one_of(
        "futures", LEARNED_FUTURES, "of the others, as a learner sees them"
    ),
    "admissible_in": _one_of(
        "admissible_in",
        ADMISSIBLE_IN,
        "scenes whose nearest candidate is admissible",
    ),
    "train_horizon": _number("train_horizon", "s that are compared"),
    "hard_negatives": _count("hard_negatives", "near negatives per scene"),
    "hard_pool": _count(
        "hard_pool", "near negatives drawn for each that the present reward keeps"
    ),
}
_REWARD = {
    "activation": _one_of(
        "activation", ("tanh", "relu", "leaky_relu"), "of the hidden layers"
    ),
    "constraint": _one_of(
        "constraint", CONSTRAINTS, "nonnegative costs (linear), monotone in safety"
    ),
    "pin": _one_of("pin", PINS, "scale pinning"),
    "module": _text("module", "PACKAGE.MODULE:CLASS, a linen module as R_theta"),
}
_MODE = _one_of("mode", MODES, "what the sampler varies")
_MARGINS = flags.DEFINE_list(
    "margins", None, "hinge: per metre from the human, collision, rule" + AS_SAID
)
_HIDDEN = flags.DEFINE_list(
    "hidden_size",
    None,
    "units per layer, 1 to 4096 each; 0: linear, easily read" + AS_SAID,
)
_BY_CONTEXT = flags.DEFINE_bool(
    "by_context", None, "scale features by what the scene is like at t = 0" + AS_SAID
)
DATA_WEIGHTS = flags.DEFINE_string(
    "data_weights",
    EQUAL,
    "share of each of several --data: equal, scenes (as many as it has), or numbers",
)


def training_config(
    *, seed: int = 0, hidden: tuple[int, ...] | None = None
) -> TrainConfig:
    """The recipe's training, and what flags say besides.

    Args:
      seed: of initial weights, batches, candidates.
      hidden: units per layer, whatever recipe and flags say.
    """
    base = recipe().train
    given = _given({**_TRAIN, **_REWARD})
    if (margins := _value(_MARGINS)) is not None:
        if len(margins) != 3:
            raise InputError(f"--margins: {margins}: expected three numbers")
        names = ("margin_distance", "margin_collision", "margin_rule")
        given |= dict(zip(names, floats(margins, "margins"), strict=True))
    if (mode := _value(_MODE)) is not None:
        given["sampler"] = dataclasses.replace(base.sampler, mode=mode)
    if (units := _value(_HIDDEN)) is not None:
        given["hidden"] = hidden_sizes(units)
    if hidden is not None:
        given["hidden"] = hidden
    return departing(base, given, seed=seed, by_context=_value(_BY_CONTEXT))


def _given(named: Mapping[str, flags.FlagHolder]) -> dict[str, Any]:
    """The values of those flags that were given."""
    values = {name: _value(flag) for name, flag in named.items()}
    return {name: value for name, value in values.items() if value is not None}


def _value(flag: flags.FlagHolder) -> Any:  # noqa: ANN401
    """What was given; None also where the command does not read the flag."""
    return flag.value if flag.name in flags.FLAGS else None
