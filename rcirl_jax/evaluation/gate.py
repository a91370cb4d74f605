"""May a candidate replace the incumbent? Tests on the same closed-loop cases.

Four kinds of check, none of them on a learned reward:

    safety      no case in which the candidate has more faults, hits more people, runs
                more red lights or stop signs than the incumbent: zero, not few
    no loss     rates and progress over all cases are not worse than the incumbent's
                by more than a declared margin: the lower end of the paired 97.5 %
                interval lies above it. Rates by Tango's score interval and by the
                clusters (families), both; progress by the latter
    families    in no family a loss of drives (exact McNemar) or of way (Student's t
                over cases) is detected, Holm over families
    gain        better in one primary metric, at least: McNemar and clusters, or
                clusters alone, Holm over the primary metrics

Over clusters means the paired bootstrap and Student's t with families - 1 degrees of
freedom, of both the wider interval and the larger p: with few families the bootstrap
alone takes chance for certainty.

A check passes, fails, or is open: too few cases to prove it either way. Ship needs
every check passed, a gain and the full suite; one failed check refuses; else, open
checks, or a part of the suite only, make the gate unable to judge. Host numpy,
float64. `C` cases.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.statistics import (
    CONFIDENCE,
    ClusterBootstrap,
    Difference,
    cluster_t,
    holm,
    mcnemar_exact,
    paired_difference,
    tango,
)
from rcirl_jax.simulation.metrics import COLUMNS, CaseMetrics, nuplan_score

Outcome = Literal["pass", "fail", "open"]
Decision = Literal["ship", "do not ship", "no difference", "could not judge"]

# exit status of the command line
EXIT_CODES: dict[Decision, int] = {
    "ship": 0,
    "do not ship": 3,
    "no difference": 3,
    "could not judge": 2,
}
WORST = 20  # cases named for a person to look at
MIN_CASES = 30  # below, no interval means anything
MIN_FAMILY = 10  # cases of a family below which its bootstrap means nothing


@dataclasses.dataclass(frozen=True, kw_only=True)
class GateConfig:
    """Margins and primary metrics; what a team declares before it looks."""

    # largest loss that counts as none: shares of all cases
    collision_free: float = 0.001
    min_ttc: float = 0.003  # time to collision stays above 0.95 s
    speed_limit: float = 0.002
    on_road: float = 0.002
    # share of the incumbent's way
    progress: float = 0.01
    family_progress: float = 0.05
    primary: tuple[str, ...] = ("a_station", "j_station", "progress", "nuplan")

    def __post_init__(self) -> None:
        """Margins within (0, 1) and known primary metrics."""
        for field in dataclasses.fields(self):
            margin = getattr(self, field.name)
            if field.name != "primary" and not 0.0 < margin < 1.0:
                raise InputError(f"--{field.name}: {margin}: expected within (0, 1)")
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

    kind: Literal["safety", "no loss", "families", "gain"]
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


def judge(pair: Pair, config: GateConfig, part: str = "") -> Verdict:
    """All checks on one pair of rows.

    Args:
      pair: the drives.
      config: margins.
      part: what was left out of the suite, in words; then nothing ships.

    Raises:
      InputError: fewer than `MIN_CASES` cases.
    """
    count = len(pair.ids)
    if count < MIN_CASES:
        raise InputError(f"gate: {count} cases: expected at least {MIN_CASES}")
    checks = (
        *_safety(pair),
        *_no_loss(pair, config),
        *_families(pair, config),
        *_gains(pair, config),
    )
    decision, reasons = _decide(checks)
    if part and decision == "ship":
        decision = "could not judge"
        reasons = (f"{part}: nothing ships on a part of the suite", *reasons)
    return Verdict(
        decision=decision,
        reasons=reasons,
        checks=checks,
        cases=count,
        families=len(set(pair.families)),
        look_at=_look_at(pair),
    )


def _decide(checks: Sequence[Check]) -> tuple[Decision, tuple[str, ...]]:
    needed = [check for check in checks if check.kind != "gain"]
    failed = [check for check in needed if check.outcome == "fail"]
    unclear = [check for check in needed if check.outcome == "open"]
    gained = [c for c in checks if c.kind == "gain" and c.outcome == "pass"]
    if failed:
        return "do not ship", tuple(_reason(check) for check in failed)
    if unclear:
        return "could not judge", tuple(_reason(check) for check in unclear)
    if gained:
        return "ship", tuple(_reason(check) for check in gained)
    return "no difference", ("no primary metric is better",)


def _reason(check: Check) -> str:
    pairs = "" if check.lost is None else f", +{check.gained} -{check.lost} cases"
    return (
        f"{check.kind}: {check.name}: {100 * check.difference:+.2f} "
        f"[{100 * check.low:+.2f}, {100 * check.high:+.2f}] %{pairs}"
        + (f"; {check.note}" if check.note else "")
    )


# ------------------------------------------------------------------- what passes


def _passes(metrics: CaseMetrics) -> dict[str, np.ndarray]:
    """Per case [C] bool, by the name of what has to hold."""
    at = lambda name: np.asarray(getattr(metrics, name))  # noqa: E731
    holds = at("holds").astype(bool)
    return {
        **{name: holds[:, i] for i, name in enumerate(COLUMNS)},
        "collision_free": at("at_fault") == 0,
        "red_light": at("red_lights") == 0,
        "stop_sign": at("stop_signs") == 0,
        "min_ttc": at("ttc_bound") > 0,
        "on_road": at("drivable") > 0,
    }


CLEAN = ("collision_free", "red_light", "stop_sign", "min_ttc", "speed_limit")


OFFENCES = {
    "collision_free": "at_fault",
    "vulnerable": "at_fault_vru",  # pedestrians and cyclists
    "red_light": "red_lights",
    "stop_sign": "stop_signs",
}


def _clean(passes: Mapping[str, np.ndarray]) -> np.ndarray:
    """[C] bool: nothing of `CLEAN` is broken, and the car stays on the road."""
    return np.all([passes[name] for name in (*CLEAN, "on_road")], axis=0)


def _discordant(mine: np.ndarray, theirs: np.ndarray) -> tuple[int, int]:
    """(cases only mine passes, cases only theirs passes)."""
    return int(np.sum(mine & ~theirs)), int(np.sum(~mine & theirs))


def _clusters(pair: Pair) -> np.ndarray:
    """[C] family of a case; single cases where there is one family."""
    _, index = np.unique(np.asarray(pair.families), return_inverse=True)
    return index if index.max() > 0 else np.arange(index.size)


# ------------------------------------------------------------------------ checks


def _over_clusters(
    a: np.ndarray, b: np.ndarray, clusters: ClusterBootstrap
) -> Difference:
    """Mean of a - b over families: the wider interval and larger p of two methods."""
    drawn = paired_difference(a, b, clusters)
    student = cluster_t(a, b, clusters.cluster)
    return Difference(
        mean=drawn.mean,
        low=min(drawn.low, student.low),
        high=max(drawn.high, student.high),
        se=max(drawn.se, student.se),
        p=max(drawn.p, student.p),
    )


def _safety(pair: Pair) -> list[Check]:
    found = []
    for name, field in OFFENCES.items():
        mine, theirs = (
            np.asarray(getattr(metrics, field))
            for metrics in (pair.candidate, pair.incumbent)
        )
        gained, lost = int(np.sum(mine < theirs)), int(np.sum(mine > theirs))
        low, high = tango(gained, lost, len(pair.ids), CONFIDENCE)
        new = np.flatnonzero(mine > theirs)
        named = ", ".join(pair.ids[int(i)] for i in new[:3])
        found.append(
            Check(
                kind="safety",
                name=name,
                outcome="fail" if lost else "pass",
                difference=(gained - lost) / len(pair.ids),
                low=low,
                high=high,
                margin=None,
                gained=gained,
                lost=lost,
                p=mcnemar_exact(gained, lost),
                note=f"new: {named}{', ...' if new.size > 3 else ''}" if lost else "",
            )
        )
    return found


def _proved(low: float, high: float, margin: float) -> Outcome:
    """No loss beyond the margin, a loss for certain, or neither."""
    if low > -margin:
        return "pass"
    return "fail" if high < 0.0 else "open"


def _no_loss(pair: Pair, config: GateConfig) -> list[Check]:
    mine, theirs = _passes(pair.candidate), _passes(pair.incumbent)
    count, found = len(pair.ids), []
    bootstrap = ClusterBootstrap(_clusters(pair))
    for name in ("collision_free", "min_ttc", "speed_limit", "on_road"):
        margin = getattr(config, name)
        gained, lost = _discordant(mine[name], theirs[name])
        score = tango(gained, lost, count, CONFIDENCE)
        drawn = _over_clusters(
            mine[name].astype(float), theirs[name].astype(float), bootstrap
        )
        low, high = min(score[0], drawn.low), max(score[1], drawn.high)
        outcome = _proved(low, high, margin)
        enough = tango(0, 0, count, CONFIDENCE)[0] > -margin
        found.append(
            Check(
                kind="no loss",
                name=name,
                outcome=outcome,
                difference=(gained - lost) / count,
                low=low,
                high=high,
                margin=margin,
                gained=gained,
                lost=lost,
                p=None,
                note=""
                if enough
                else f"{count} cases can never prove a loss below {100 * margin:g} %",
            )
        )
    way = _over_clusters(*_ways(pair, np.ones(count, bool)), bootstrap)
    outcome = _proved(way.low, way.high, config.progress)
    found.append(_continuous("no loss", "progress", way, outcome, config.progress))
    return found


def _ways(pair: Pair, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Progress as a share of the incumbent's mean, over the cases in `at`."""
    mine = np.asarray(pair.candidate.progress, np.float64)[at]
    theirs = np.asarray(pair.incumbent.progress, np.float64)[at]
    scale = max(float(theirs.mean()), 1.0)
    return mine / scale, theirs / scale


def _continuous(
    kind: Literal["no loss", "families", "gain"],
    name: str,
    found: Difference,
    outcome: Outcome,
    margin: float | None,
    p: float | None = None,
) -> Check:
    return Check(
        kind=kind,
        name=name,
        outcome=outcome,
        difference=found.mean,
        low=found.low,
        high=found.high,
        margin=margin,
        gained=None,
        lost=None,
        p=p,
    )


def _families(pair: Pair, config: GateConfig) -> list[Check]:
    """Per family: clean drives lost, and way lost; each Holm over families."""
    mine, theirs = _clean(_passes(pair.candidate)), _clean(_passes(pair.incumbent))
    names = np.asarray(pair.families)
    order = [n for n in dict.fromkeys(pair.families) if np.sum(names == n) > 1]
    counts = [_discordant(mine[names == n], theirs[names == n]) for n in order]
    clean_p = holm(np.array([mcnemar_exact(*pairs) for pairs in counts]))
    ways = [
        cluster_t(*_ways(pair, names == n), np.arange(np.sum(names == n)))
        for n in order
    ]
    way_p = holm(np.array([way.p for way in ways]))
    found, level = [], 1.0 - CONFIDENCE
    for i, name in enumerate(order):
        (gained, lost), way = counts[i], ways[i]
        total = int(np.sum(names == name))
        low, high = tango(gained, lost, total, CONFIDENCE)
        worse = lost > gained and clean_p[i] < level
        seen = len(order) * mcnemar_exact(0, total) < level  # if all were lost
        found.append(
            Check(
                kind="families",
                name=f"{name}, clean drives",
                outcome="fail" if worse else "pass" if seen else "open",
                difference=(gained - lost) / total,
                low=low,
                high=high,
                margin=None,
                gained=gained,
                lost=lost,
                p=float(clean_p[i]),
            )
        )
        short = way.mean < -config.family_progress and way_p[i] < level
        outcome: Outcome = "fail" if short else "pass"
        check = _continuous(
            "families",
            f"{name}, progress",
            way,
            outcome if total >= MIN_FAMILY else "open",
            config.family_progress,
            float(way_p[i]),
        )
        if total < MIN_FAMILY:
            note = f"{total} cases: expected at least {MIN_FAMILY}"
            check = dataclasses.replace(check, note=note)
        found.append(check)
    return found


def _gains(pair: Pair, config: GateConfig) -> list[Check]:
    mine, theirs = _passes(pair.candidate), _passes(pair.incumbent)
    bootstrap = ClusterBootstrap(_clusters(pair))
    rows: list[tuple[str, Difference, tuple[int, int] | None, float]] = []
    for name in config.primary:
        if name in COLUMNS:
            a, b = mine[name].astype(float), theirs[name].astype(float)
            pairs = _discordant(mine[name], theirs[name])
            found = _over_clusters(a, b, bootstrap)
            # both tests have to see it: cases, and families as clusters
            p = max(mcnemar_exact(*pairs), found.p)
        else:
            pairs = None
            both = _scores(pair)
            if name == "progress":
                both = _ways(pair, np.ones(len(pair.ids), bool))
            found = _over_clusters(*both, bootstrap)
            p = found.p
        rows.append((name, found, pairs, p))
    adjusted = holm(np.array([row[3] for row in rows]))
    checks = []
    for (name, found, pairs, _), p in zip(rows, adjusted, strict=True):
        better = found.mean > 0.0 and p < 1.0 - CONFIDENCE
        outcome: Outcome = "pass" if better else "open"
        check = _continuous("gain", name, found, outcome, None, float(p))
        if pairs is not None:
            check = dataclasses.replace(check, gained=pairs[0], lost=pairs[1])
        checks.append(check)
    return checks


def _scores(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """NuPlan's score of both."""
    reference = jnp.asarray(pair.reference)
    mine, theirs = (
        np.asarray(nuplan_score(metrics, reference)[0], np.float64)
        for metrics in (pair.candidate, pair.incumbent)
    )
    return mine, theirs


def _look_at(pair: Pair) -> tuple[str, ...]:
    """Cases that only one of them drives cleanly, or far apart; losses first."""
    mine, theirs = _passes(pair.candidate), _passes(pair.incumbent)
    faults = 8.0 * (~mine["collision_free"] & theirs["collision_free"])
    lost = 4.0 * (~_clean(mine) & _clean(theirs))
    way = np.asarray(pair.candidate.progress) - np.asarray(pair.incumbent.progress)
    behind = np.clip(-way / np.maximum(pair.incumbent.progress, 1.0), 0.0, 1.0)
    comfort = 0.5 * (~mine["j_station"] & theirs["j_station"])
    key = faults + lost + behind + comfort
    order = [i for i in np.argsort(-key, kind="stable")[:WORST].tolist() if key[i] > 0]
    return tuple(pair.ids[int(i)] for i in order)
