"""A suite from weights to report: classify the cases, drive every row, summarise."""

import dataclasses
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import tqdm

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.summary import (
    SuiteReport,
    SuiteRuns,
    format_families,
    format_suite,
    result_hash,
    summarise,
    write_csv,
)
from rcirl_jax.runtime.atomic_files import write_json, write_whole
from rcirl_jax.runtime.compiling import CompilesFirst
from rcirl_jax.runtime.executors import two_at_a_time
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.simulation.metrics import CaseMetrics
from rcirl_jax.simulation.rows import (
    RECORDED_HUMAN,
    Row,
    firsts_first,
    judges,
    preventable,
    trivial,
)
from rcirl_jax.simulation.suite import CaseSet, drive_row, rollout_config

# s of driving in all cases below which compiling takes longer than driving: then rows
# drive two at a time, so that one compiles while the other drives
SHORT_S = 2e4

# infinite where nobody was met; every other number of a drive is finite
NOBODY_MET = ("min_ttc", "min_headway", "min_clearance")

# what bars call the two drivers who say which collisions were preventable
BARS = {"CC": "a careful driver", "FSM": "another careful driver"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuiteConfig:
    """The settings by which a suite is driven."""

    # steps of 0.1 s between two plans
    plan_every: int = 1
    # cases driven together; bounds memory
    chunk: int = 180


DriveRow = Callable[[Row, CaseSet, SuiteConfig], CaseMetrics]


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuiteResult(SuiteRuns):
    """All results of a driven suite."""

    report: SuiteReport
    cases: CaseSet
    # by row: seconds, plans per second, steps between plans
    timings: Mapping[str, Mapping[str, float]]
    facts: Mapping[str, object]  # hashes, memory


def bar_of(row: Row, total: int) -> tqdm.tqdm:
    """A progress bar over the cases of a row."""
    who = BARS.get(row.name, row.name)
    return CompilesFirst(
        total=total, desc=f"drive the cases: {who}", unit="case", mininterval=0.5
    )


def drive_here(row: Row, cases: CaseSet, config: SuiteConfig) -> CaseMetrics:
    """All cases with one row, in this process."""
    rollout = rollout_config(row, cases.duration_s, config.plan_every)
    total = len(cases.ids)
    with bar_of(row, total) as bar:
        return drive_row(
            row,
            cases.build,
            total,
            rollout,
            chunk=config.chunk,
            progress=bar.update,
        )


def _check_numbers(row: Row, cases: CaseSet, metrics: CaseMetrics) -> None:
    """Raises InputError that names the first case with no number."""
    for field, values in vars(metrics).items():
        values = np.asarray(values).reshape(len(cases.ids), -1)
        none = field in NOBODY_MET
        bad = np.isnan(values) if none else ~np.isfinite(values)
        if bad.any():
            first = int(np.argmax(bad.any(axis=1)))
            found = values[first][bad[first]][0]
            raise InputError(
                f"simulate: {row.name}: case {cases.ids[first]}: {field}: {found}: "
                "expected a number"
            )


def run_suite(
    rows: Sequence[Row],
    cases: CaseSet,
    config: SuiteConfig,
    drive: DriveRow = drive_here,
) -> SuiteResult:
    """Drives every row over the cases and judge them; `drive` says where.

    The careful drivers and IDM drive too: they say which cases are
    preventable and how far one gets. Where the recorded human is a row, its
    distance is the reference instead of IDM's.
    """
    every = firsts_first([*{row.name: row for row in [*rows, *judges()]}.values()])

    def one(row: Row) -> tuple[CaseMetrics, float]:
        begin = time.perf_counter()
        found = drive(row, cases, config)
        _check_numbers(row, cases, found)
        return found, time.perf_counter() - begin

    # other places to drive in take one row after the other
    short = len(cases.ids) * cases.duration_s <= SHORT_S
    aside = short and drive is drive_here
    made = two_at_a_time(one, every) if aside else [one(row) for row in every]
    timed = dict(zip([row.name for row in every], made, strict=True))
    driven = {name: metrics for name, (metrics, _) in timed.items()}
    avoidable = preventable([driven["CC"], driven["FSM"]])
    calm = trivial([driven["IDM"], driven["constant speed"]])
    runs = {row.name: driven[row.name] for row in rows}
    hashes = {name: result_hash(found) for name, found in runs.items()}
    timings = {}
    for row in rows:
        seconds, steps = timed[row.name][1], config.plan_every
        plans = len(cases.ids) * round(cases.duration_s / STEP_S) / steps
        timings[row.name] = {
            "seconds": round(seconds, 2),
            "plans_per_s": round(plans / seconds, 1),
            "plan_every_steps": steps,
        }
    reference = RECORDED_HUMAN if RECORDED_HUMAN in runs else "IDM"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    driven_runs = SuiteRuns(
        rows=runs,
        ids=cases.ids,
        groups=cases.groups,
        preventable=avoidable,
        trivial=calm,
        reference=reference,
        way=np.asarray(driven[reference].progress),
    )
    return SuiteResult(
        **vars(driven_runs),
        report=summarise(driven_runs),
        cases=cases,
        timings=timings,
        facts={
            "duration_s": cases.duration_s,
            "chunk": config.chunk,
            "peak_memory_gib": round(peak, 2),
            "result_sha256": hashes,
        },
    )


def write_suite(
    result: SuiteResult, folder: Path, provenance: Mapping[str, object]
) -> str:
    """suite.json, cases.csv, table.txt in a folder; returns the table."""
    first = next(iter(result.rows))
    text = format_suite(result.report) + "\n" + format_families(result.report, first)
    write_whole(folder / "table.txt", text)
    facts = {**result.facts, "timings": result.timings, "made_by": provenance}
    write_json(folder / "suite.json", {**facts, "report": result.report})
    write_csv(folder / "cases.csv", result, result.cases.parameters)
    return text


def worst_cases(result: SuiteResult, row: str, count: int = 10) -> list[str]:
    """Ids of the cases of a row to look at first: faults, red lights, low progress."""
    metrics = result.rows[row]
    key = (
        1000.0 * (np.asarray(metrics.at_fault) > 0)
        + 100.0 * (np.asarray(metrics.red_lights) > 0)
        + 100.0 * (np.asarray(metrics.stop_signs) > 0)
        + np.asarray(metrics.max_j) / 100.0
    )
    order = np.argsort(-key, kind="stable")[:count]
    return [result.cases.ids[i] for i in order.tolist()]
