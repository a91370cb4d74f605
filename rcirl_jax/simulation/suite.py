"""Suites: which cases are driven, and driving them row by row in bounded memory.

    full        every family of data_specs/scenarios, as many cases as it declares
    smoke       one case of every family, 20 s
    FAMILY[,F]  all cases of the named families
    recorded    held-out scenes of datasets; the others leave the log if need be

Cases are built, driven and reduced to metrics chunk by chunk, so memory does
not depend on how many there are; every chunk has the same shapes, so a row
compiles once.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import jax
import numpy as np

from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.planner.program import name_cases
from rcirl_jax.simulation.cases import STEP_S, Case, Record, Snapshot
from rcirl_jax.simulation.catalogue import (
    build_cases,
    case_id,
    case_number,
    family_names,
    load_family,
    parameters_of,
    parse_case_id,
)
from rcirl_jax.simulation.metrics import (
    CaseMetrics,
    MetricsConfig,
    case_metrics,
    without_lost,
)
from rcirl_jax.simulation.recorded import DATASET, HeldOut
from rcirl_jax.simulation.rollout import LANES, RolloutConfig, drive_cases
from rcirl_jax.simulation.rows import Row
from rcirl_jax.units import HORIZON_S

SMOKE_S = 20.0  # s of a smoke case
FULL_S = 120.0  # s of a case of the paper's suite

Progress = Callable[[int], object]  # called with the number of cases just driven


@dataclasses.dataclass(frozen=True, kw_only=True)
class CaseRef:
    """One case by name: the same on every machine."""

    family: str
    index: int
    seed: int = 0

    @property
    def id(self) -> str:
        """For example "cut_in/017@0"."""
        return case_id(self.family, self.index, self.seed)


def case_ref(text: str) -> CaseRef:
    """The case of an id.

    Raises:
      InputError: not an id, or no such family or index.
    """
    family, index, seed = parse_case_id(text)
    if family not in family_names():
        raise InputError(
            f"case: {text}: family: expected one of {', '.join(family_names())}"
        )
    return CaseRef(family=family, index=index, seed=seed)


def suite_refs(
    suite: str, per_family: int | None = None, seed: int = 0
) -> tuple[CaseRef, ...]:
    """The cases of a suite, family by family.

    Args:
      suite: "full", "smoke" or family names separated by commas.
      per_family: cases of each family; None: as its file declares (smoke: 1).
      seed: of the catalogue.

    Raises:
      InputError: an unknown suite or family, or a count below 1.
    """
    known = family_names()
    names = known if suite in ("full", "smoke") else tuple(suite.split(","))
    if len(set(names)) < len(names):
        raise InputError(f"suite: {suite}: a family twice: expected distinct ones")
    for name in names:
        if name not in known:
            raise InputError(
                f"suite: {name}: expected full, smoke or some of {', '.join(known)}"
                + did_you_mean(name, ("full", "smoke", *known))
            )
    if per_family is not None and per_family < 1:
        raise InputError(f"cases: {per_family}: expected at least 1")
    refs = []
    for name in names:
        declared = 1 if suite == "smoke" else load_family(name).cases
        count = per_family or declared
        refs += [CaseRef(family=name, index=i, seed=seed) for i in range(count)]
    return tuple(refs)


def case_duration(suite: str, given: float | None) -> float:
    """S of a case: as given, else those of the suite.

    Raises:
      InputError: none that a case can have.
    """
    usual = SMOKE_S if suite == "smoke" else FULL_S
    duration = usual if given is None else given
    if not 1.0 <= duration <= FULL_S:
        raise InputError(f"duration_s: {duration}: expected 1 to {FULL_S:g} s")
    return duration


def build(refs: Sequence[CaseRef], duration_s: float) -> Case:
    """The cases of refs, stacked [B, ...] in their order; numpy leaves."""
    places: dict[tuple[str, int], list[int]] = {}
    for place, ref in enumerate(refs):
        places.setdefault((ref.family, ref.seed), []).append(place)
    parts, order = [], []
    for (name, seed), members in places.items():
        indices = [refs[place].index for place in members]
        family = load_family(name)
        parts.append(build_cases(family, indices, seed, duration_s=duration_s))
        order += members
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    back = np.argsort(order)
    return jax.tree.map(lambda leaf: leaf[back], joined)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CaseSet:
    """The cases of a suite, by place 0 .. C - 1, built when they are needed."""

    ids: tuple[str, ...]
    # what belongs together: the family, or the recording
    groups: tuple[str, ...]
    # drawn parameters of each case, for the CSV
    parameters: tuple[Mapping[str, float], ...]
    # (first, last) -> cases of that range, stacked
    build: Callable[[int, int], Case]
    duration_s: float


def catalogue_set(refs: Sequence[CaseRef], duration_s: float) -> CaseSet:
    """Cases of the catalogue."""
    name_cases({case_number(ref.id): ref.id for ref in refs})
    drawn = [parameters_of(load_family(r.family), r.index, r.seed) for r in refs]
    return CaseSet(
        ids=tuple(ref.id for ref in refs),
        groups=tuple(ref.family for ref in refs),
        parameters=tuple(drawn),
        build=lambda first, last: build(refs[first:last], duration_s),
        duration_s=duration_s,
    )


def recorded_set(drives: HeldOut) -> CaseSet:
    """Held-out drives of datasets; grouped by recording, "DATASET:RECORDING"."""
    name_cases(drives.names)
    return CaseSet(
        ids=drives.ids,
        groups=tuple(
            f"{number // DATASET}:{number % DATASET}"
            for number in drives.recording.tolist()
        ),
        parameters=tuple({} for _ in drives.ids),
        build=lambda first, last: jax.tree.map(lambda x: x[first:last], drives.cases),
        duration_s=HORIZON_S,
    )


def rollout_config(row: Row, duration_s: float, plan_every: int) -> RolloutConfig:
    """Returns the rollout's settings for a row and cases of a duration."""
    steps = round(duration_s / STEP_S)
    return RolloutConfig(
        plan_every=plan_every,
        steps=-(-steps // plan_every) * plan_every,
        follow_log=row.follow_log,
        command_delay=row.command_delay,
        braking_jerk=row.braking_jerk,
    )


def _reduced(record: Record) -> CaseMetrics:
    """With the usual thresholds; one object, so that programs are reused."""
    return case_metrics(record, MetricsConfig())


def drive_with_logs(
    row: Row, cases: Case, config: RolloutConfig
) -> tuple[CaseMetrics, Record, Snapshot]:
    """Drive a few cases [n] as `drive_row` does, and keep what pictures need.

    On a CPU these are the suite's own drives, to the bit; elsewhere another batch is
    another program, which rounds the last digit differently, and traffic is chaotic.

    Returns:
      numpy leaves: metrics [n], record and snapshots [n, S].
    """
    count = cases.steps.shape[0]
    fill = np.minimum(np.arange(-(-count // LANES) * LANES), count - 1)
    full = jax.tree.map(lambda leaf: np.asarray(leaf)[fill], cases)
    made, (record, shots, _) = drive_cases(
        row.policy, row.params, full, config, _reduced, keep=True
    )
    logs = jax.tree.map(lambda leaf: np.asarray(leaf)[:count], (made, record, shots))
    if row.program is None:
        return logs
    made, *others = logs
    return without_lost(made), *jax.tree.map(np.nan_to_num, others)


def drive_row(
    row: Row,
    cases_of: Callable[[int, int], Case],
    total: int,
    config: RolloutConfig,
    *,
    chunk: int,
    progress: Progress | None = None,
) -> CaseMetrics:
    """Drive `total` cases with one row; metrics with numpy leaves [total].

    Args:
      row: who drives.
      cases_of: (first, last) -> cases of that range, stacked.
      total: number of cases.
      config: of the rollouts.
      chunk: cases in memory at a time, rounded up to whole groups of `LANES`;
        the metrics do not depend on it.
      progress: told how many cases have been driven since the last call.
    """
    size = -(-min(chunk, total) // LANES) * LANES
    parts = []
    for first in range(0, total, size):
        count = min(size, total - first)
        cases = cases_of(first, first + count)
        fill = np.minimum(np.arange(size), count - 1)
        full = jax.tree.map(lambda leaf, f=fill: np.asarray(leaf)[f], cases)
        found = drive_cases(row.policy, row.params, full, config, _reduced)
        if row.program is not None:
            found = without_lost(found)
        parts.append(jax.tree.map(lambda leaf, n=count: np.asarray(leaf)[:n], found))
        if progress is not None:
            progress(count)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
