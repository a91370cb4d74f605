"""What a gate is given and what it says: margins, drives, checks, a verdict."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.simulation.metrics import COLUMNS, CaseMetrics

Kind = Literal["safety", "no loss", "families", "gain"]
Outcome = Literal["pass", "fail", "open"]
Decision = Literal["ship", "do not ship", "no difference", "could not judge"]

# exit status of the command line
EXIT_CODES: dict[Decision, int] = {
    "ship": 0,
    "do not ship": 3,
    "no difference": 3,
    "could not judge": 2,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class GateConfig:
    """Margins and primary metrics; what a team declares before it looks."""

    # largest loss that counts as none: shares of all cases
    collision_free: float = 0.001
    min_ttc: float = 0.003  # time to collision stays above 0.95 s
    speed_limit: float = 0.002
    on_road: float = 0.002
    # clean drives, share of one family's cases; 180 cannot prove less than 0.021
    family_clean: float = 0.05
    # share of the incumbent's way
    progress: float = 0.01
    family_progress: float = 0.05
    primary: tuple[str, ...] = ("a_station", "j_station", "progress", "nuplan")

    def __post_init__(self) -> None:
        """Margins within (0, 1) and known primary metrics."""
        for field in dataclasses.fields(self):
            margin = getattr(self, field.name)
            if field.name != "primary" and not 0.0 < margin < 1.0:
                raise InputError(
                    f"--{field.name}_margin: {margin}: expected within (0, 1)"
                )
        known = (*COLUMNS, "progress", "nuplan")
        for name in self.primary:
            if name not in known:
                raise InputError(
                    f"--primary: {name}: expected some of {', '.join(known)}"
                )
        if not self.primary:
            raise InputError("--primary: none: expected at least one metric")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """One test with its numbers."""

    kind: Kind
    name: str
    outcome: Outcome
    # candidate minus incumbent; rates as shares, progress as share of its way
    difference: float
    low: float
    high: float
    margin: float | None  # below which a loss is one; None: any
    gained: int | None  # cases only the candidate passes
    lost: int | None  # cases only the incumbent passes
    p: float | None  # two-sided, Holm-adjusted within its kind
    note: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """What the gate says, and why."""

    decision: Decision
    reasons: tuple[str, ...]
    checks: tuple[Check, ...]
    cases: int
    families: int
    look_at: tuple[str, ...]  # ids of cases that differ, the worst first
    part: str  # what of the suite was left out, in words; "" if nothing

    @property
    def exit_code(self) -> int:
        """0 only to ship."""
        return EXIT_CODES[self.decision]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pair:
    """Candidate and incumbent on the same C cases; numpy leaves [C]."""

    candidate: CaseMetrics
    incumbent: CaseMetrics
    families: Sequence[str]
    ids: Sequence[str]
    reference: np.ndarray  # [C] m, way of the driver that nuPlan's score compares to

    def __post_init__(self) -> None:
        """Same cases, all finite where a drive has a number."""
        count = len(self.ids)
        for name in ("candidate", "incumbent"):
            metrics = getattr(self, name)
            for field in ("progress", "at_fault", "holds", "max_j", "rms_a"):
                values = np.asarray(getattr(metrics, field), np.float64)
                if len(values) != count:
                    raise InputError(
                        f"gate: {name}: {len(values)} cases: expected {count}"
                    )
                if not np.isfinite(values).all():
                    bad = self.ids[int(np.argwhere(~np.isfinite(values))[0, 0])]
                    raise InputError(
                        f"gate: {name}: {bad}: {field}: not a finite number"
                    )
        if len(set(self.ids)) != count:
            twice = next(name for name in self.ids if self.ids.count(name) > 1)
            raise InputError(f"gate: {twice}: met twice: expected distinct cases")
        if len(self.families) != count or len(self.reference) != count:
            raise InputError(f"gate: families, reference: expected {count} each")
