"""Distances to the human: when they are taken."""

from absl import flags

HORIZON = flags.DEFINE_float(
    "horizon",
    5.0,
    "s at which distances to the human are taken, 0.4 to 8",
    lower_bound=0.4,
    upper_bound=8.0,
)
