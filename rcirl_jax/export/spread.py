"""A closed-loop suite in pieces: each a range of cases with one row.

Rows hold compiled functions and cases come from files, so neither is sent to
other processes: a piece names them, and whoever drives it builds them again.
"""

import dataclasses
import functools
from collections.abc import Iterator

import jax
import numpy as np

from rcirl_jax.evaluation.closed_loop.suite import (
    Drive,
    SuiteConfig,
    bar_of,
    drive_here,
)
from rcirl_jax.export.closed_loop import table_rows
from rcirl_jax.planner.baselines import Idm
from rcirl_jax.runtime.executors import Executor
from rcirl_jax.simulation.metrics import CaseMetrics
from rcirl_jax.simulation.rollout import LANES
from rcirl_jax.simulation.rows import Row
from rcirl_jax.simulation.suite import (
    CaseRef,
    CaseSet,
    catalogue_set,
    drive_row,
    rollout_config,
)
from rcirl_jax.simulation.world.careful import judges


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuiteJob:
    """The rows and cases of a suite by name; hashable and small."""

    weights: tuple[str, ...]
    baselines: tuple[str, ...]
    refs: tuple[CaseRef, ...]
    duration_s: float
    plan_every: int = 1
    dp: bool = False
    names: tuple[str, ...] = ()  # of the learned rows; else after loss and shape
    tuned_idm: Idm | None = None  # of a further row
    track: str = "full"  # of the safety filter

    def rows(self) -> list[Row]:
        """Learned rows, then the baselines."""
        return table_rows(
            self.weights,
            self.baselines,
            self.plan_every,
            dp=self.dp,
            names=self.names,
            track=self.track,
            tuned_idm=self.tuned_idm,
        )

    def cases(self) -> CaseSet:
        """The cases of the catalogue."""
        return catalogue_set(self.refs, self.duration_s)


@functools.lru_cache(maxsize=2)
def _made(job: SuiteJob) -> tuple[dict[str, Row], CaseSet]:
    rows = {row.name: row for row in [*judges(), *job.rows()]}
    return rows, job.cases()


def drive_piece(
    piece: tuple[str, int, int], job: SuiteJob, config: SuiteConfig
) -> Iterator[CaseMetrics]:
    """Metrics of the cases first .. last - 1 with the row of a name."""
    name, first, last = piece
    rows, cases = _made(job)
    row = rows[name]
    yield drive_row(
        row,
        lambda a, b: cases.build(first + a, first + b),
        last - first,
        rollout_config(row, cases.duration_s, config.plan_every),
        chunk=config.chunk,
    )


def spread(executor: Executor, job: SuiteJob) -> Drive:
    """A `Drive` that sends ranges of cases to an executor; same result as here."""

    def drive(row: Row, cases: CaseSet, config: SuiteConfig) -> CaseMetrics:
        total, size = len(cases.ids), -(-config.chunk // LANES) * LANES
        # a rest that is shorter would be another shape for the compiler
        pieces = [
            (row.name, first, min(first + size, total))
            for first in range(0, total, size)
        ]
        piece = functools.partial(drive_piece, job=job, config=config)
        parts = []
        with bar_of(row, total) as bar:
            for made in executor.stream(piece, pieces):
                parts.append(made)
                bar.update(len(np.asarray(jax.tree.leaves(made)[0])))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)

    return drive


def drive_by(executor: Executor, job: SuiteJob) -> Drive:
    """`spread` where there are other processes, else this one drives."""
    return spread(executor, job) if executor.workers > 1 else drive_here
