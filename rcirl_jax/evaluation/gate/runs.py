"""From a driven suite to the rows that the gate compares."""

from collections.abc import Sequence

import jax
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.files import SuiteRuns
from rcirl_jax.evaluation.closed_loop.output import result_hash
from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, SuiteResult
from rcirl_jax.evaluation.gate.types import (
    CANDIDATE,
    INCUMBENT,
    Likeness,
    Pair,
)
from rcirl_jax.simulation.rollout import LANES
from rcirl_jax.simulation.rows import TRIVIAL_BASELINES, Row
from rcirl_jax.simulation.suite import drive_row, rollout_config


def pair_of(
    runs: SuiteRuns,
    incumbent: str = INCUMBENT,
    trivial: Sequence[str] = TRIVIAL_BASELINES,
    likeness: Likeness | None = None,
    *,
    candidate: str = CANDIDATE,
) -> Pair:
    """Candidate, incumbent and trivial baselines of a driven suite.

    Args:
      runs: the drives.
      incumbent: name of its row.
      trivial: names of rows that the candidate has to be ahead of; those that the suite
        does not have are left out.
      likeness: distances to the human, where they were measured.
      candidate: name of its row.

    Raises:
      InputError: the suite has no such rows.
    """
    for name in (candidate, incumbent):
        if name not in runs.rows:
            raise InputError(f"gate: {name}: expected a row of {', '.join(runs.rows)}")
    return Pair(
        candidate=runs.rows[candidate],
        incumbent=runs.rows[incumbent],
        families=runs.groups,
        ids=runs.ids,
        reference=np.asarray(runs.way, np.float64),
        preventable=np.asarray(runs.preventable, bool),
        name=incumbent,
        trivial_baselines={
            name: runs.rows[name] for name in trivial if name in runs.rows
        },
        likeness=likeness,
    )


def repeats(row: Row, result: SuiteResult, config: SuiteConfig) -> None:
    """Drive the first cases once more; a verdict needs drives that repeat.

    Raises:
      InputError: another result than in the suite.
    """
    cases, count = result.cases, min(LANES, len(result.cases.ids))
    rollout = rollout_config(row, cases.duration_s, config.plan_every)
    again = drive_row(row, cases.build, count, rollout, chunk=LANES)
    before = jax.tree.map(lambda x: x[:count], result.runs[row.name])
    if result_hash(again) != result_hash(before):
        raise InputError(
            f"gate: {row.name}: the first {count} cases, driven twice, differ:"
            " expected one result"
        )
