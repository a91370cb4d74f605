"""Closed loop: which cases are driven, and how often is planned."""

from typing import Any

from absl import flags

SUITE = flags.DEFINE_string(
    "suite", "full", "full, smoke (one case of each family), or families with commas"
)
CASES = flags.DEFINE_integer(
    "cases",
    None,
    "cases per family, 1 or more; fewer are quicker and prove less (default: as the "
    "suite says)",
)
DURATION = flags.DEFINE_float(
    "duration", None, "s per case at most, 1 to 120 (default: 120, smoke 20)"
)
SEED = flags.DEFINE_integer("catalogue_seed", 0, "seed of the cases")
EVERY = flags.DEFINE_integer("plan_every", 1, "steps of 0.1 s between two plans")


def suite() -> dict[str, Any]:
    """What the flags say, by the names of `gate_job` and `TuneConfig`."""
    return {
        "suite": SUITE.value,
        "cases": CASES.value,
        "duration_s": DURATION.value,
        "catalogue_seed": SEED.value,
        "plan_every": EVERY.value,
    }
