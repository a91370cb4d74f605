"""Which rows and cases a gate drives, by names and files, and what comes of it."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.likeness import (
    DRIVES,
    LikenessReport,
    held_out_likeness,
)
from rcirl_jax.evaluation.closed_loop.runs import runs_of
from rcirl_jax.evaluation.closed_loop.suite import (
    SuiteConfig,
    SuiteResult,
)
from rcirl_jax.evaluation.gate.types import CANDIDATE, INCUMBENT, GateConfig, Verdict
from rcirl_jax.evaluation.gate.verdict import judge, pair_of, repeats
from rcirl_jax.export.closed_loop import SuiteJob, run_job
from rcirl_jax.planner.baselines import Idm
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.simulation.recorded import held_out
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
    baselines: Sequence[str] = ("IDM",),
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
      baselines: further baselines.
      tuned_idm: of a further row.
      track: of the safety filter, `SafetyConfig.track`.

    Raises:
      InputError: a duration, suite or count that cannot be.
    """
    learned = incumbent not in BASELINES
    duration = case_duration(suite, duration_s)
    if learned and not Path(incumbent).is_file():
        raise InputError(
            f"incumbent: {incumbent}: expected a weights file or one of "
            + ", ".join(BASELINES)
        )
    names = [*baselines] if learned else [incumbent, *baselines]
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
    result = run_job(job, executor)
    repeats(job.rows()[0], result, SuiteConfig(plan_every=job.plan_every))
    return result


@dataclasses.dataclass(frozen=True, kw_only=True)
class Judged:
    """A verdict and what it rests on."""

    verdict: Verdict
    likeness: LikenessReport | None  # of the held-out drives, if there are any
    facts: Mapping[str, object]  # of the suite: hashes, memory


def judged(
    job: SuiteJob,
    incumbent: str,
    config: GateConfig,
    executor: Executor,
    sources: Sequence[Dataset] = (),
    drives: int = DRIVES,
) -> Judged:
    """Drive a gate's job and judge it.

    Args:
      job: of `gate_job`.
      incumbent: name of its row.
      config: margins.
      executor: where cases are driven.
      sources: datasets whose held-out drives measure human-likeness.
      drives: of them, in all.

    Raises:
      InputError: drives that do not repeat, or too few cases.
    """
    result, report = drive_job(job, executor), None
    if sources:
        recorded = held_out(sources, drives)
        report = held_out_likeness(recorded, job.rows(), job.plan_every)
    known = None if report is None else report.likeness
    pair = pair_of(runs_of(result), incumbent, config.trivial_baselines, known)
    verdict = judge(pair, config, left_out(job))
    return Judged(verdict=verdict, likeness=report, facts=result.facts)


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
