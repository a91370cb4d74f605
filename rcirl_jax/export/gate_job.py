"""Which rows and cases a gate drives, by names and files."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.suite import (
    SuiteConfig,
    SuiteResult,
    run_suite,
)
from rcirl_jax.evaluation.gate.runs import CANDIDATE, INCUMBENT, repeats
from rcirl_jax.export.spread import SuiteJob, drive_by
from rcirl_jax.planner.baselines import Idm
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.simulation.rows import BASELINES
from rcirl_jax.simulation.suite import FULL_S, CaseRef, case_duration, suite_refs


def gate_job(
    candidate: str,
    incumbent: str,
    *,
    suite: str,
    cases: int | None,
    duration_s: float | None,
    catalogue_seed: int,
    plan_every: int,
    rivals: Sequence[str] = ("IDM",),
    tuned_idm: Idm | None = None,
    track: str = "full",
) -> tuple[SuiteJob, str]:
    """The suite that both drive, and the name of the incumbent's row.

    Args:
      candidate: weights file.
      incumbent: weights file, or the name of a baseline.
      suite: full, smoke, or families with commas.
      cases: per family; None: as declared.
      duration_s: of a case; None: 120 s, smoke 20 s.
      catalogue_seed: of the cases.
      plan_every: steps of 0.1 s between two plans.
      rivals: further baselines.
      tuned_idm: of a further row.
      track: of the safety filter, `SafetyConfig.track`.

    Raises:
      InputError: a duration, suite or count that cannot be.
    """
    learned = incumbent not in BASELINES
    duration = case_duration(suite, duration_s)
    if learned and not Path(incumbent).is_file():
        raise InputError(
            f"--incumbent: {incumbent}: expected a weights file or one of "
            + ", ".join(BASELINES)
        )
    names = [*rivals] if learned else [incumbent, *rivals]
    files = {CANDIDATE: candidate, **({INCUMBENT: incumbent} if learned else {})}
    job = SuiteJob(
        weights=tuple(files.values()),
        names=tuple(files),
        baselines=tuple(dict.fromkeys(names)),
        refs=suite_refs(suite, cases, catalogue_seed),
        duration_s=duration,
        plan_every=plan_every,
        tuned_idm=tuned_idm,
        track=track,
    )
    return job, INCUMBENT if learned else incumbent


def drive_job(job: SuiteJob, executor: Executor) -> SuiteResult:
    """Drive the suite wherever the executor runs it, and the first cases twice.

    Raises:
      InputError: the candidate's drives do not repeat.
    """
    rows, config = job.rows(), SuiteConfig(plan_every=job.plan_every)
    result = run_suite(rows, job.cases(), config, drive_by(executor, job))
    repeats(rows[0], result, config)
    return result


def left_out(job: SuiteJob) -> str:
    """What of the full suite a job leaves out, in words; "" if nothing."""
    full = suite_refs("full")
    missing = len({ref.id for ref in full} - {_first(ref).id for ref in job.refs})
    said = []
    if missing:
        said.append(
            f"{len(job.refs):,} cases, {missing:,} of the full suite's left out"
        )
    if job.duration_s < FULL_S:
        said.append(f"cases of {job.duration_s:g} s instead of {FULL_S:g} s")
    if job.plan_every > 1:
        said.append(f"a plan every {job.plan_every * STEP_S:g} s instead of {STEP_S:g}")
    if job.track != "full":
        said.append("a safety filter that only forbids collisions")
    return "; ".join(said)


def _first(ref: CaseRef) -> CaseRef:
    """The same case of the catalogue's seed 0."""
    return dataclasses.replace(ref, seed=0)
