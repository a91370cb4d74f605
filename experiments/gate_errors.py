"""How often is the gate wrong? Verdicts over seeds of the catalogue, truth known.

    python -m experiments.gate_errors --candidate=FILE --output=out/gate_errors.json
    python -m experiments.gate_errors --driven=RUN/suite/metrics.npz --output=FILE

Every seed is a suite of its own cases. Candidate and incumbent with their drives
swapped by coins, and the incumbent against itself on the cases of two seeds, are equal:
what the gate detects there is a false alarm. Against random weights, and random weights
against the incumbent, it should see the difference. `--driven` takes suites of
`autotune` instead of driving. docs/gate.md has results.
"""

from pathlib import Path

import numpy as np
from absl import flags

from experiments import margins
from experiments.common import provenance, run
from experiments.executor import executor
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop import SuiteConfig, drive_here, run_suite
from rcirl_jax.evaluation.gate_errors import (
    SAID,
    as_driven,
    equal_pairs,
    every_pair,
    format_errors,
)
from rcirl_jax.evaluation.gate_runs import CANDIDATE
from rcirl_jax.evaluation.gate_types import Pair
from rcirl_jax.evaluation.suite_files import SuiteRuns, read_runs, runs_of
from rcirl_jax.export.gate_job import gate_job
from rcirl_jax.export.spread import spread
from rcirl_jax.stages import file_sha256
from rcirl_jax.whole import write_json

WORSE = "random weights"
_CANDIDATE = flags.DEFINE_string("candidate", None, "weights file")
_INCUMBENT = flags.DEFINE_string("incumbent", "hand-set", "weights file, or a baseline")
_DRIVEN = flags.DEFINE_list("driven", None, "metrics.npz of suites, one per seed")
_OUTPUT = flags.DEFINE_string("output", None, "JSON to write", required=True)
_SEEDS = flags.DEFINE_integer("seeds", 40, "seeds of the catalogue", lower_bound=1)
_SWAPS = flags.DEFINE_integer("swaps", 25, "coins per seed", lower_bound=1)
_SUITE = flags.DEFINE_string("suite", "full", "full, or families with commas")
_CASES = flags.DEFINE_integer("cases", 10, "cases per family")
_DURATION = flags.DEFINE_float("duration", 30.0, "s per case")

Three = tuple[Pair, Pair, Pair]  # candidate/incumbent, incumbent/random, and back


def main() -> None:
    """Flags -> one table."""
    config, incumbent = margins.gate_config(), _INCUMBENT.value
    if bool(_CANDIDATE.value) == bool(_DRIVEN.value):
        raise InputError("--candidate, --driven: expected one of the two")
    if incumbent == WORSE:
        raise InputError(f"--incumbent: {WORSE}: expected one that is better")
    suites = map(_read, _DRIVEN.value) if _DRIVEN.value else _all_driven()
    mine, random, worse = zip(*suites, strict=True)
    tallies = [
        *equal_pairs(mine, config, _SWAPS.value),
        as_driven(f"candidate, {incumbent}", "unknown", mine, config),
        as_driven(f"{incumbent}, {WORSE}", "better", random, config),
        as_driven(f"{WORSE}, {incumbent}", "worse", worse, config),
    ]
    others = []
    if _DRIVEN.value:
        others = every_pair(mine[0], read_runs(Path(_DRIVEN.value[0])).rows, config)
        shipped = sum(one["decision"] == "ship" for one in others)
        print(f"{_DRIVEN.value[0]}: of {len(others)} pairs of its rows {shipped} ship")
    print(f"{len(mine)} suites of {len(mine[0].ids):,} cases; share of the verdicts")
    print(format_errors(tallies))
    files = {"candidate": _CANDIDATE.value, "incumbent": incumbent}
    known = [x for x in files.values() if x and Path(x).is_file()]
    hashes = {file: file_sha256(Path(file)) for file in _DRIVEN.value or ()}
    driven = {"driven_sha256": hashes} if hashes else {}
    body = {
        "cases": len(mine[0].ids),
        "suites": len(mine),
        "duration_s": None if _DRIVEN.value else _DURATION.value,
        "tallies": [
            {
                "name": found.name,
                "truth": found.truth,
                "verdicts": found.said[:, :, 0].size,
                "rates": {what: found.rate(what) for what in SAID},
                "decisions": found.decisions,
            }
            for found in tallies
        ],
        "every_pair": others,
        "config": config,
        "files": {**files, "driven": _DRIVEN.value},
        "made_by": {**provenance(known), **driven},
    }
    write_json(Path(_OUTPUT.value), body)
    print(f"written: {_OUTPUT.value}")


def _three(found: SuiteRuns) -> Three:
    runs = dict(found.rows)
    for name in (CANDIDATE, _INCUMBENT.value, WORSE):
        if name not in runs:
            raise InputError(f"{name}: expected a row of {', '.join(runs)}")

    def pair(candidate: str, other: str) -> Pair:
        return Pair(
            candidate=runs[candidate],
            incumbent=runs[other],
            families=found.groups,
            ids=found.ids,
            reference=np.asarray(found.way, np.float64),
            preventable=np.asarray(found.preventable, bool),
        )

    incumbent = _INCUMBENT.value
    return pair(CANDIDATE, incumbent), pair(incumbent, WORSE), pair(WORSE, incumbent)


def _read(file: str) -> Three:
    """A suite that was driven before."""
    return _three(read_runs(Path(file)))


def _all_driven() -> list[Three]:
    return [_driven(seed) for seed in range(_SEEDS.value)]


def _driven(seed: int) -> Three:
    """The rows on the cases of one seed of the catalogue."""
    job, _ = gate_job(
        str(_CANDIDATE.value),
        _INCUMBENT.value,
        suite=_SUITE.value,
        cases=_CASES.value,
        duration_s=_DURATION.value,
        catalogue_seed=seed,
        plan_every=1,
        rivals=("IDM", WORSE),
    )
    pool, cases, how = executor(), job.cases(), SuiteConfig()
    drive = spread(pool, job) if pool.workers > 1 else drive_here
    return _three(runs_of(run_suite(job.rows(), cases, how, drive)))


if __name__ == "__main__":
    run(main)
