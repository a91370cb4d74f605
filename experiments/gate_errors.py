"""Counts wrong verdicts of the gate, on drivers whose truth is known.

    python -m experiments.gate_errors --output=out/gate_errors.json

Hand-set and drivers made of it drive the catalogue with --seeds seeds, --cases of each
family. The gate judges the cases of every seed, too few to show that nothing got worse,
and all as one suite; any size may ship (docs/gate.md). What it refuses of the equal
driver is a false alarm, of the worse ones its power. Nobody is compared with
recordings: likeness counts as equal, and there are no trivial
baselines.
"""

import dataclasses
from pathlib import Path

from absl import flags

from experiments.known_drivers import made_rows, table, tallied, with_faults
from rcirl_jax.cli import flags as shared
from rcirl_jax.cli.running import provenance, run
from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, run_suite
from rcirl_jax.runtime.atomic_files import write_json
from rcirl_jax.simulation.suite import catalogue_set, suite_refs

_OUTPUT = flags.DEFINE_string("output", None, "JSON to write", required=True)
_SEEDS = flags.DEFINE_integer(
    "seeds", 20, "drawings of all cases, 1 or more: the more, the surer the rates", 1
)
_SUITE = flags.DEFINE_string("suite", "full", "full, or families with commas")
_CASES = flags.DEFINE_integer("cases", 10, "cases per family and seed, 1 or more")
_DURATION = flags.DEFINE_float("duration", 30.0, "s per case, 1 to 120", 1.0, 120.0)
_MARGINS = shared.margins()


def main() -> None:
    """Drive, judge, print, write."""
    seeds, asked = _SEEDS.value, (_SUITE.value, _CASES.value)
    refs = [ref for seed in range(seeds) for ref in suite_refs(*asked, seed)]
    cases = catalogue_set(refs, _DURATION.value)
    runs = with_faults(run_suite(made_rows(), cases, SuiteConfig()))
    config = dataclasses.replace(_MARGINS(), trivial_baselines=())  # for recordings
    found = tallied(runs, seeds, config)
    body = {"cases": len(refs), "seeds": seeds, "kinds": found, "config": config}
    write_json(Path(_OUTPUT.value), {**body, "made_by": provenance()})
    print(f"{len(refs):,} cases\n{table(found)}\nwritten: {_OUTPUT.value}")


if __name__ == "__main__":
    run(main)
