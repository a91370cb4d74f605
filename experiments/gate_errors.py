"""How often is the gate wrong? Verdicts over seeds of the catalogue, truth known.

    python -m experiments.gate_errors --output=out/gate_errors.json
    python -m experiments.gate_errors --candidate=FILE --output=out/gate_errors.json
    python -m experiments.gate_errors --driven=RUN/suite/metrics.npz --output=FILE

Every seed is a suite of its own cases. On each, drivers whose truth is known by
construction are compared with hand-set (`CONSTRUCTED` in `gate_pairs`). Hand-set with
other random candidates is equal. With a wanted speed lower by 5 or 20 % it is worse.
So it is with IDM's drives in a random 5 % of the cases, or wherever IDM is at fault.
Hand-set is better than the 5 % slower one, and than itself with IDM at fault. The table
says how often the gate ships, refuses and cannot judge. 230 cases are too few to show
that nothing got worse: with `--together=20` the gate also judges the cases of 20 seeds
as one suite.

With a candidate: it and the incumbent with their drives swapped by coins, and the
incumbent against itself on the cases of two seeds, are equal: what the gate detects
there is a false alarm. Against random weights, and random weights against the
incumbent, it should see the difference. `--driven` takes suites of `autotune` instead
of driving, and has no constructed drivers.

Left out, for nobody is compared with recordings here: human-likeness, which counts as
equal, and the checks against rewards that know nothing. Suites of any size may ship.
docs/gate.md says more.
"""

import dataclasses
from pathlib import Path

from absl import flags

from experiments import margins
from experiments.common import alone, provenance, run
from experiments.executor import executor
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.files import SuiteRuns, read_runs, runs_of
from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, drive_here, run_suite
from rcirl_jax.evaluation.gate.errors import (
    DECISIONS,
    SAID,
    Tally,
    as_driven,
    constructed,
    equal_pairs,
    every_pair,
    format_errors,
)
from rcirl_jax.evaluation.gate.pairs import pair_between
from rcirl_jax.evaluation.gate.runs import CANDIDATE, INCUMBENT
from rcirl_jax.evaluation.gate.types import GateConfig
from rcirl_jax.export.gate_job import ErrorsJob, gate_job
from rcirl_jax.export.spread import spread
from rcirl_jax.runtime.atomic_files import write_json
from rcirl_jax.runtime.pipeline import file_sha256

WORSE = "random weights"
CHUNK = 240  # cases in memory: ten of each family at once
_CANDIDATE = flags.DEFINE_string("candidate", None, "weights file")
_INCUMBENT = flags.DEFINE_string(
    "incumbent", "hand-set", "weights file, or a baseline; of the candidate"
)
_DRIVEN = flags.DEFINE_list("driven", None, "metrics.npz of suites, one per seed")
_OUTPUT = flags.DEFINE_string("output", None, "JSON to write", required=True)
_SEEDS = flags.DEFINE_integer("seeds", 40, "seeds of the catalogue", lower_bound=1)
_TOGETHER = flags.DEFINE_integer(
    "together", 1, "seeds whose cases are judged as one suite besides", lower_bound=1
)
_SWAPS = flags.DEFINE_integer("swaps", 25, "coins per seed", lower_bound=1)
_SUITE = flags.DEFINE_string("suite", "full", "full, or families with commas")
_CASES = flags.DEFINE_integer("cases", 10, "cases per family")
_DURATION = flags.DEFINE_float("duration", 30.0, "s per case")


def main() -> None:
    """Flags -> one table."""
    _check_flags()
    # nulls are for recordings
    config = dataclasses.replace(margins.gate_config(), nulls=())
    driven, tallies, others = _DRIVEN.value or [], [], []
    if driven:
        suites = [read_runs(Path(file)) for file in driven]
    else:
        suites = [_drive(seed) for seed in range(_SEEDS.value)]
        tallies += constructed(suites, config, _TOGETHER.value)
    if driven or _CANDIDATE.value:
        tallies += _of_candidate(suites, config)
    if driven:
        pair = pair_between(suites[0], CANDIDATE, _incumbent_row())
        others = every_pair(pair, suites[0].rows, config)
        shipped = sum(one["decision"] == "ship" for one in others)
        print(f"{driven[0]}: of {len(others)} pairs of its rows {shipped} ship")
    print(
        f"{len(suites)} suites of {len(suites[0].ids):,} cases; share of the verdicts"
    )
    print(format_errors(tallies))
    files = {"candidate": _CANDIDATE.value, "incumbent": _INCUMBENT.value}
    known = [x for x in files.values() if x and Path(x).is_file()]
    hashes = {file: file_sha256(Path(file)) for file in driven}
    body = {
        "cases": len(suites[0].ids),
        "suites": len(suites),
        "duration_s": None if driven else _DURATION.value,
        "tallies": [_facts(found) for found in tallies],
        "every_pair": others,
        "config": config,
        "files": {**files, "driven": _DRIVEN.value},
        "made_by": {
            **provenance(known),
            **({"driven_sha256": hashes} if hashes else {}),
        },
    }
    write_json(Path(_OUTPUT.value), body)
    print(f"written: {_OUTPUT.value}")


def _check_flags() -> None:
    if _DRIVEN.value:
        alone("driven", "candidate", "together")
    elif not _CANDIDATE.value and flags.FLAGS["incumbent"].present:
        raise InputError(
            f"--incumbent: {_INCUMBENT.value}: expected --candidate or --driven too"
        )
    if _INCUMBENT.value == WORSE:
        raise InputError(f"--incumbent: {WORSE}: expected one that is better")
    if _TOGETHER.value > _SEEDS.value:
        raise InputError(
            f"--together: {_TOGETHER.value}: expected at most {_SEEDS.value} seeds"
        )


def _incumbent_row() -> str:
    name = _INCUMBENT.value
    return INCUMBENT if Path(name).is_file() else name


def _of_candidate(suites: list[SuiteRuns], config: GateConfig) -> list[Tally]:
    """The kinds of pair that are made of a candidate, its incumbent and rivals."""
    incumbent = _incumbent_row()

    def pairs(candidate: str, other: str) -> list:
        return [pair_between(runs, candidate, other) for runs in suites]

    mine = pairs(CANDIDATE, incumbent)
    random, worse = pairs(incumbent, WORSE), pairs(WORSE, incumbent)
    return [
        *equal_pairs(mine, config, _SWAPS.value),
        as_driven(f"candidate, {incumbent}", "unknown", mine, config),
        as_driven(f"{incumbent}, {WORSE}", "better", random, config),
        as_driven(f"{WORSE}, {incumbent}", "worse", worse, config),
    ]


def _facts(found: Tally) -> dict:
    return {
        "name": found.name,
        "truth": found.truth,
        "cases": found.cases,
        "verdicts": found.of(SAID[0]).size,
        "rates": {what: found.rate(what) for what in (*SAID, *DECISIONS)},
        "decisions": found.decisions,
        "drives": found.drives,
    }


def _drive(seed: int) -> SuiteRuns:
    """The rows on the cases of one seed of the catalogue."""
    asked, _ = gate_job(
        _CANDIDATE.value,
        _INCUMBENT.value,
        suite=_SUITE.value,
        cases=_CASES.value,
        duration_s=_DURATION.value,
        catalogue_seed=seed,
        plan_every=1,
        rivals=("IDM", WORSE),
    )
    job = ErrorsJob(**vars(asked))
    pool, cases, how = executor(), job.cases(), SuiteConfig(chunk=CHUNK)
    drive = spread(pool, job) if pool.workers > 1 else drive_here
    return runs_of(run_suite(job.rows(), cases, how, drive))


if __name__ == "__main__":
    run(main)
