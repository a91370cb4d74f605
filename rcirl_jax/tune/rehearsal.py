"""Rehearsal: a teacher drives what nobody recorded, and recovers from mistakes.

A reward tuned on some roads must not unlearn the others. So the catalogue (other seeds
than the suite's) is driven by a teacher, and in each further round by the reward
learned so far, which the teacher takes over from in turn: its way out of where the
learner's own mistakes lead becomes a demonstration too (Ross et al. 2011, "DAgger",
with takeovers). What is driven is a dataset like any other, with a weight of its own.

Drives of weight 0 are not learned from. They show what a reward with a prior cost
(`tune.prior_cost`) has to leave to the planner's own cost; in further rounds the
reward with a prior cost drives alone, and shows where it gets to by itself.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from rcirl_jax.data.store.dataset import Dataset, open_dataset
from rcirl_jax.errors import InputError
from rcirl_jax.export.closed_loop import incumbent_score, table_rows
from rcirl_jax.planner.rank import Params, Policy, RankConfig, rank_policy
from rcirl_jax.simulation.demonstrations import DriveConfig, drive_catalogue
from rcirl_jax.simulation.suite import suite_refs

TEACHERS = ("none", "driver model", "hand-set", "incumbent")
SUITE_SEED = 0  # of the catalogue that rewards are judged on


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rehearsal:
    """How the catalogue is rehearsed; [rehearsal] of a recipe."""

    # one of TEACHERS
    teacher: str = "none"
    # cases of each family that the teacher drives, and those of a further round
    cases: int = 12
    takeover_cases: int = 16
    # further rounds: the teacher takes over from the reward learned so far, or (weight
    # 0) that reward drives alone
    rounds: int = 1
    # seed of the cases; round r has this one plus r
    catalogue_seed: int = 1000
    # s of a drive, and between two scenes of the teacher's drives and of takeovers
    duration_s: float = 120.0
    stride_s: float = 3.0
    takeover_stride_s: float = 1.5
    # weight of the teacher's drives, and of each round, where a recorded source has 1;
    # 0: not learned from
    weight: float = 1.2
    takeover_weight: float = 0.8

    def __post_init__(self) -> None:
        """Reject what cannot be meant."""
        if self.teacher not in TEACHERS:
            raise InputError(
                f"rehearsal: teacher: {self.teacher}: expected one of "
                f"{', '.join(TEACHERS)}"
            )
        for name, low in (("cases", 1), ("takeover_cases", 1), ("rounds", 0)):
            if getattr(self, name) < low:
                raise InputError(
                    f"rehearsal: {name}: {getattr(self, name)}: expected at least {low}"
                )
        if self.catalogue_seed <= SUITE_SEED:
            raise InputError(
                f"rehearsal: catalogue_seed: {self.catalogue_seed}: expected above "
                f"{SUITE_SEED}, the suite's own"
            )
        if self.weight < 0.0:
            raise InputError(f"rehearsal: weight: {self.weight}: expected >= 0")
        if self.takeover_weight <= 0.0:
            raise InputError(
                f"rehearsal: takeover_weight: {self.takeover_weight}: expected > 0"
            )

    @property
    def datasets(self) -> int:
        """Number of datasets: the teacher's drives and one for each round."""
        return 0 if self.teacher == "none" else 1 + self.rounds

    @property
    def weights(self) -> tuple[float, ...]:
        """Weight of each dataset, in their order."""
        again = self.takeover_weight if self.weight else 0.0
        return (self.weight, *[again] * self.rounds)[: self.datasets]


def teacher_of(rehearsal: Rehearsal, incumbent: str) -> tuple[Policy, Params] | None:
    """The teacher as a policy and its weights; None: the driver models.

    Args:
      rehearsal: names the teacher.
      incumbent: weights file or "hand-set", of the teacher "incumbent".

    Raises:
      InputError: a file cannot be read.
    """
    if rehearsal.teacher == "driver model":
        return None
    name = "hand-set" if rehearsal.teacher == "hand-set" else incumbent
    score, weights = incumbent_score(name)
    return rank_policy(score, RankConfig()), weights


def rehearse(
    number: int,
    rehearsal: Rehearsal,
    output: Path,
    *,
    incumbent: str,
    learner: Path | None,
    before_commit: Callable[[Dataset], object],
) -> Dataset:
    """Drive the catalogue and keep what the teacher did.

    Args:
      number: 0: the teacher alone; else the round.
      rehearsal: how.
      output: dataset folder.
      incumbent: as `teacher_of`.
      learner: weights file of the reward learned so far; None in round 0.
      before_commit: as `DatasetWriter.finish`.
    """
    first = number == 0
    teacher, driven = teacher_of(rehearsal, incumbent), None
    if learner is not None:
        row = table_rows([str(learner)], ())[0]
        driven = row.policy, row.params
    if driven and not rehearsal.weight:
        teacher, driven = driven, None
    config = DriveConfig(
        duration_s=rehearsal.duration_s,
        stride_s=rehearsal.takeover_stride_s if driven else rehearsal.stride_s,
        test_fraction=0.0,
    )
    cases = rehearsal.cases if first else rehearsal.takeover_cases
    refs = suite_refs("full", cases, rehearsal.catalogue_seed + number)
    drive_catalogue(
        refs,
        output,
        config,
        teacher=teacher,
        learner=driven,
        overwrite=True,
        before_commit=before_commit,
    )
    return open_dataset(output)
