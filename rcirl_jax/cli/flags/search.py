"""How rivals are tuned."""

from absl import flags

from rcirl_jax.evaluation.rivals.tuned import SEARCHES

SEARCH = flags.DEFINE_enum(
    "search",
    "cma",
    list(SEARCHES),
    "search that tunes rivals; optuna needs the extra [optuna]",
)
