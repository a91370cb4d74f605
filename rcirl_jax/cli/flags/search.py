"""How baselines are tuned."""

from absl import flags

from rcirl_jax.evaluation.baselines.tuned import SEARCHES

SEARCH = flags.DEFINE_enum(
    "search",
    "cma",
    list(SEARCHES),
    "search that tunes baselines; optuna needs the extra [optuna]",
)
