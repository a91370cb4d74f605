r"""Drives rewards and baselines through the closed-loop suite.

    python -m experiments.simulate --weights=FILE[,FILE...] --output=DIR \
        --flagfile=experiments/flagfiles/full_suite.flags

Every case is driven at 10 Hz; safety filter and candidates are the same for all rows.
Writes table.txt, suite.json and cases.csv.
"""

from absl import flags

import rcirl_jax
from rcirl_jax.cli.running import run
from rcirl_jax.runtime.executors import make_executor
from rcirl_jax.simulation.rows import BASELINES

_WEIGHTS = flags.DEFINE_list("weights", None, "files, with commas", required=True)
_OUTPUT = flags.DEFINE_string("output", None, "folder to write", required=True)
_SUITE = flags.DEFINE_string("suite", "smoke", "full, smoke, or families with commas")
_CASES = flags.DEFINE_integer("cases", None, "per family; default: as declared")
_DURATION = flags.DEFINE_float("duration", None, "s of a case; 120, of smoke 20")
_BASELINES = flags.DEFINE_list("baselines", list(BASELINES), "baselines that drive too")
_EVERY = flags.DEFINE_integer("plan_every", 1, "steps of 0.1 s between two plans")
_WORKERS = flags.DEFINE_integer("workers", 1, "processes at once")


def main() -> None:
    """Drives the suite and prints the table."""
    result = rcirl_jax.simulate(
        _WEIGHTS.value,
        suite=_SUITE.value,
        cases=_CASES.value,
        duration_s=_DURATION.value,
        baselines=tuple(name for name in _BASELINES.value if name),
        plan_every=_EVERY.value,
        output=_OUTPUT.value,
        executor=make_executor("local", workers=_WORKERS.value),
    )
    print(rcirl_jax.format_report(result))
    print(f"written: {_OUTPUT.value}/table.txt, suite.json, cases.csv")


if __name__ == "__main__":
    run(main)
