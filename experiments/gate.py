r"""Judges whether a candidate may replace the incumbent; exit status 0 only to ship.

    python -m experiments.gate --candidate=FILE --incumbent=FILE \
        --data=DATASET --output=verdict.json \
        --flagfile=experiments/flagfiles/gate_full.flags

Both drive the same closed-loop cases; no learned reward judges. The margins
are those of docs/gate.md; `rcirl gate` has a flag for each.
"""

import sys

from absl import flags

import rcirl_jax
from rcirl_jax.cli.running import run
from rcirl_jax.evaluation.gate.types import DRIVES
from rcirl_jax.runtime.executors import make_executor

_CANDIDATE = flags.DEFINE_string(
    "candidate", None, "weights file, own cost or planner:COMMAND", required=True
)
_INCUMBENT = flags.DEFINE_string(
    "incumbent", "hand-set", "as --candidate, or a baseline"
)
_OUTPUT = flags.DEFINE_string("output", None, "JSON to write", required=True)
_DATA = flags.DEFINE_list("data", [], "datasets whose held-out drives are compared")
_DRIVES = flags.DEFINE_integer("drives", DRIVES, "held-out drives in all")
_SUITE = flags.DEFINE_string("suite", "full", "full, smoke, or families with commas")
_CASES = flags.DEFINE_integer("cases", None, "per family; default: as declared")
_DURATION = flags.DEFINE_float("duration", None, "s of a case; 120, of smoke 20")
_WORKERS = flags.DEFINE_integer("workers", 1, "processes at once")


def main() -> None:
    """Drives both, judges, prints the verdict."""
    verdict = rcirl_jax.gate(
        _CANDIDATE.value,
        _INCUMBENT.value,
        data=_DATA.value,
        suite=_SUITE.value,
        cases=_CASES.value,
        duration_s=_DURATION.value,
        drives=_DRIVES.value,
        output=_OUTPUT.value,
        executor=make_executor("local", workers=_WORKERS.value),
    )
    print(rcirl_jax.format_report(verdict))
    print(f"written: {_OUTPUT.value}; exit status {verdict.exit_code}")
    sys.exit(verdict.exit_code)


if __name__ == "__main__":
    run(main)
