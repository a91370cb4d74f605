"""Types of the gate: margins, drives, checks and the verdict.

Axes: `C` cases of the suite, `D` held-out recorded drives.
"""

import dataclasses
from collections.abc import Mapping
from typing import Literal

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.summary import SuiteRuns
from rcirl_jax.simulation.metrics import COLUMNS, CaseMetrics
from rcirl_jax.simulation.rows import TRIVIAL_BASELINES

Kind = Literal[
    "safety",
    "recorded traffic",
    "no loss",
    "families",
    "trivial baselines",
    "likeness",
    "gain",
]
Outcome = Literal["pass", "fail", "open"]
Decision = Literal["ship", "do not ship", "no difference", "could not judge"]

# exit status of the command line
EXIT_CODES: dict[Decision, int] = {
    "ship": 0,
    "do not ship": 3,
    "no difference": 3,
    "could not judge": 2,
}
CANDIDATE, INCUMBENT = "candidate", "incumbent"  # names of rows
MAX_ACCEPTED = 3  # cases; more than a person looks at are no exceptions
IMPACT_MPS = 10.0  # m/s at which an at-fault impact counts as one
FELT = ("rms_a", "rms_j")  # fields of CaseMetrics: comfort, of which less is better
DRIVES = 4000  # held-out drives of a full run, or all there are


@dataclasses.dataclass(frozen=True, kw_only=True)
class GateConfig:
    """Margins and primary metrics, declared before looking at results.

    docs/gate.md says how each margin was chosen and what it can detect.
    """

    # more cases with a fault than the incumbent that count as none: shares of all
    # cases. 0.0025 of 4,140 are ten
    collision: float = 0.0025  # at fault, preventable
    vulnerable: float = 0.002  # at fault, with a pedestrian or cyclist
    red_light: float = 0.0025
    stop_sign: float = 0.0025
    # largest loss that counts as none: shares of all cases
    collision_free: float = 0.005  # at fault, preventable or not
    min_ttc: float = 0.01  # time to collision stays above 0.95 s
    # at-fault impacts, each counted by its speed over `IMPACT_MPS`: share of all cases
    impact: float = 0.0025
    speed_limit: float = 0.005
    on_road: float = 0.0025
    # clean drives, share of one family's cases; 180 cannot prove less than 0.021
    family_clean: float = 0.10
    # share of the incumbent's progress
    progress: float = 0.01
    family_progress: float = 0.10
    # share of the incumbent's distance to the human. 240 drives of 163 vehicles told
    # rewards apart by 11 to 13 % of it, all drives by less
    likeness: float = 0.10
    # among recorded traffic: vehicles in whose drives there is more of a fault, share
    # of all; and time with a short headway, as a share of time
    recorded: float = 0.025
    headway: float = 0.05
    # loss in one primary metric that a gain in another may cost; share of cases, of
    # the score, or of the incumbent's RMS
    gain: float = 0.02
    primary: tuple[str, ...] = ("rms_a", "rms_j", "a_station", "progress", "nuplan")
    # rows that the candidate has to be ahead of
    trivial_baselines: tuple[str, ...] = TRIVIAL_BASELINES
    # cases with a new fault that a person has looked at and accepts, `MAX_ACCEPTED`
    accept: tuple[str, ...] = ()

    @property
    def margins(self) -> dict[str, float]:
        """The margins by name."""
        return {k: v for k, v in vars(self).items() if isinstance(v, int | float)}

    def __post_init__(self) -> None:
        """Margins within (0, 1), known primary metrics, no name twice."""
        for name, margin in self.margins.items():
            if not 0.0 < margin < 1.0:
                raise InputError(f"{name}: {margin}: expected within (0, 1)")
        known = (*COLUMNS, *FELT, "progress", "nuplan")
        if not self.primary or not set(self.primary) <= set(known):
            bad = next((n for n in self.primary if n not in known), "none")
            raise InputError(f"primary: {bad}: expected some of {', '.join(known)}")
        if len(self.accept) > MAX_ACCEPTED:
            raise InputError(
                f"accept: {len(self.accept)} cases: expected at most {MAX_ACCEPTED}"
            )
        for flag in ("primary", "trivial_baselines", "accept"):
            names = getattr(self, flag)
            if len(set(names)) != len(names):
                twice = next(name for name in names if names.count(name) > 1)
                raise InputError(f"{flag}: {twice}: met twice: expected it once")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Likeness:
    """The distance of every row to the human, on D held-out recorded drives."""

    # row name -> [D] >= 0, distance to the human; lower is nearer
    distance: Mapping[str, np.ndarray]
    clusters: np.ndarray  # [D] int, the ego's vehicle in each drive
    available: int  # held-out drives that the recordings have
    # row name -> "collision", "ttc", "braking" and "headway" of `likeness.TRAFFIC`, [D]
    # each: 0 or 1, and a share of time
    traffic: Mapping[str, Mapping[str, np.ndarray]] = dataclasses.field(
        default_factory=dict
    )

    @property
    def left_out(self) -> str:
        """The drives that a full run has besides, in words; "" if none."""
        driven, usual = len(self.clusters), min(DRIVES, self.available)
        return f"{driven} held-out drives instead of {usual}" if driven < usual else ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pair:
    """A candidate and an incumbent that drove the same suite."""

    runs: SuiteRuns  # with the trivial baselines among its rows
    name: str = INCUMBENT  # of the incumbent's row
    mine: str = CANDIDATE  # of the candidate's row
    # rows `CANDIDATE`, `name` and the trivial baselines
    likeness: Likeness | None = None

    def __post_init__(self) -> None:
        """Rejects names that are no rows."""
        for name in (self.mine, self.name):
            if name not in self.runs.rows:
                known = ", ".join(self.runs.rows)
                raise InputError(f"gate: {name}: expected a row of {known}")

    @property
    def candidate(self) -> CaseMetrics:
        """The candidate's drives."""
        return self.runs.rows[self.mine]

    @property
    def incumbent(self) -> CaseMetrics:
        """The incumbent's drives."""
        return self.runs.rows[self.name]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """One test with its numbers."""

    kind: Kind
    name: str
    title: str  # in words
    outcome: Outcome
    # candidate minus the other, positive is better; rates as shares, progress and
    # likeness as shares of the other's mean
    difference: float
    low: float
    high: float
    margin: float | None  # below which a loss is one; None: any
    gained: int | None  # cases that only the candidate passes
    lost: int | None  # cases that only the other passes
    # safety and trivial baselines: one-sided, of a loss as large as the margin;
    # families and gain: two-sided, of no difference, Holm-adjusted within the kind
    p: float | None
    note: str = ""
    measured: bool = True  # else the numbers say nothing: from -1 to 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewFault:
    """A case in which the candidate commits more of an offence than the incumbent."""

    case: str
    faults: tuple[str, ...]  # names of the safety checks
    preventable: bool  # a careful driver has no collision there
    accepted: bool  # a person has looked at it


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """The gate's decision with its checks and reasons."""

    decision: Decision
    sentence: str  # the decision in plain words
    reasons: tuple[str, ...]
    checks: tuple[Check, ...]
    cases: int
    families: int
    new_faults: tuple[NewFault, ...]
    look_at: tuple[str, ...]  # ids of cases that differ, the worst first
    part: str  # what of the suite was left out, in words; "" if nothing
    against: tuple[str, ...] = ()  # the best arguments against it (`gate.against`)

    @property
    def exit_code(self) -> int:
        """0 only to ship."""
        return EXIT_CODES[self.decision]
