"""Drive rewards and rivals through the closed-loop suite; print the paper's table.

    python -m experiments.simulate --weights=FILE[,FILE...] --suite=full|smoke|FAMILY \
        --output=DIR

Every case is driven at 10 Hz; safety filter and candidates are the same for all
rows. Writes table.txt, suite.json and cases.csv. A case is drawn by
experiments.replay from its id.
"""

from pathlib import Path

from absl import flags

from experiments.common import provenance, run
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop import (
    SuiteConfig,
    run_suite,
    worst_cases,
    write_suite,
)
from rcirl_jax.export.closed_loop import table_rows
from rcirl_jax.simulation.rows import BASELINES
from rcirl_jax.simulation.suite import FULL_S, SMOKE_S, suite_refs

_WEIGHTS = flags.DEFINE_list("weights", None, "weights files", required=True)
_SUITE = flags.DEFINE_string("suite", "smoke", "full, smoke, or families with commas")
_OUTPUT = flags.DEFINE_string("output", None, "folder to write", required=True)
_BASELINES = flags.DEFINE_list("baselines", ",".join(BASELINES), "rival rows, or empty")
_DP = flags.DEFINE_bool("dp", False, "also drive the first weights by DP")
_CASES = flags.DEFINE_integer("cases", None, "cases per family (default: as declared)")
_DURATION = flags.DEFINE_float("duration", None, "s per case (full 120, smoke 20)")
_EVERY = flags.DEFINE_integer("plan_every", 1, "steps of 0.1 s between two plans")
_CHUNK = flags.DEFINE_integer("chunk", 180, "cases driven together; bounds memory")
_SEED = flags.DEFINE_integer("catalogue_seed", 0, "seed of the cases")


def main() -> None:
    """Flags -> one suite."""
    duration = _DURATION.value or (SMOKE_S if _SUITE.value == "smoke" else FULL_S)
    if not 1.0 <= duration <= FULL_S:
        raise InputError(f"--duration: {duration}: expected 1 to {FULL_S:g} s")
    if _CHUNK.value < 1:
        raise InputError(f"--chunk: {_CHUNK.value}: expected at least 1")
    refs = suite_refs(_SUITE.value, _CASES.value, _SEED.value)
    rows = table_rows(_WEIGHTS.value, _BASELINES.value, _EVERY.value, dp=_DP.value)
    config = SuiteConfig(
        duration_s=duration, plan_every=_EVERY.value, chunk=_CHUNK.value
    )
    result = run_suite(rows, refs, config)
    print(write_suite(result, Path(_OUTPUT.value), provenance()))
    print(f"wall time and plans/s: {result.facts['timings']}")
    print(f"peak memory: {result.facts['peak_memory_gib']} GiB")
    print(f"look first at: {', '.join(worst_cases(result, rows[0].name, 5))}")
    print(f"written: {_OUTPUT.value}/table.txt, suite.json, cases.csv")


if __name__ == "__main__":
    run(main)
