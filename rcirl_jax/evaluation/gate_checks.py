"""The checks of a gate; what they mean: `gate`."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from rcirl_jax.evaluation.exact import CONFIDENCE, holm, mcnemar_exact, tango
from rcirl_jax.evaluation.gate_types import Check, GateConfig, Kind, Outcome, Pair
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    Difference,
    cluster_t,
    family_clusters,
    paired_difference,
)
from rcirl_jax.simulation.metrics import COLUMNS, CaseMetrics, nuplan_score

MIN_FAMILY = 10  # cases of a family below which its interval means nothing


def passes_of(metrics: CaseMetrics) -> dict[str, np.ndarray]:
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


# what a clean drive holds
CLEAN = (
    *("collision_free", "red_light", "stop_sign"),
    *("min_ttc", "speed_limit", "on_road"),
)


# what no case may have more of -> its count in CaseMetrics
OFFENCES = {
    "collision_free": "at_fault",
    "vulnerable": "at_fault_vru",  # pedestrians and cyclists
    "red_light": "red_lights",
    "stop_sign": "stop_signs",
}


def is_clean(metrics: CaseMetrics) -> np.ndarray:
    """[C] bool: nothing of `CLEAN` is broken."""
    passes = passes_of(metrics)
    return np.all([passes[name] for name in CLEAN], axis=0)


def _discordant(mine: np.ndarray, theirs: np.ndarray) -> tuple[int, int]:
    """(cases only mine passes, cases only theirs passes)."""
    return int(np.sum(mine & ~theirs)), int(np.sum(~mine & theirs))


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


def _counted(
    kind: Kind,
    name: str,
    outcome: Outcome,
    pairs: tuple[int, int],
    total: int,
    **more: Any,  # noqa: ANN401
) -> Check:
    """A check of (gained, lost) of `total` cases, with Tango's interval."""
    gained, lost = pairs
    low, high = tango(gained, lost, total, CONFIDENCE)
    made = Check(
        kind=kind,
        name=name,
        outcome=outcome,
        difference=(gained - lost) / total,
        low=low,
        high=high,
        margin=None,
        gained=gained,
        lost=lost,
        p=None,
    )
    return dataclasses.replace(made, **more)


def safety(pair: Pair) -> list[Check]:
    """No case with more of an offence than the incumbent commits."""
    found = []
    for name, field in OFFENCES.items():
        mine, theirs = (
            np.asarray(getattr(metrics, field))
            for metrics in (pair.candidate, pair.incumbent)
        )
        pairs = int(np.sum(mine < theirs)), int(np.sum(mine > theirs))
        new = [pair.ids[int(i)] for i in np.flatnonzero(mine > theirs)]
        more = ", ..." if len(new) > 3 else ""
        check = _counted(
            "safety",
            name,
            "fail" if new else "pass",
            pairs,
            len(pair.ids),
            p=mcnemar_exact(*pairs),
            note=f"new: {', '.join(new[:3])}{more}" if new else "",
        )
        found.append(check)
    return found


def _proved(low: float, high: float, margin: float) -> Outcome:
    """No loss beyond the margin, a loss for certain, or neither."""
    if low > -margin:
        return "pass"
    return "fail" if high < 0.0 else "open"


def no_loss(pair: Pair, config: GateConfig) -> list[Check]:
    """Rates and progress of all cases, within their margins."""
    mine, theirs = passes_of(pair.candidate), passes_of(pair.incumbent)
    count, found = len(pair.ids), []
    bootstrap = ClusterBootstrap(family_clusters(pair.families))
    for name in ("collision_free", "min_ttc", "speed_limit", "on_road"):
        margin = getattr(config, name)
        pairs = _discordant(mine[name], theirs[name])
        score = tango(*pairs, count, CONFIDENCE)
        drawn = _over_clusters(
            mine[name].astype(float), theirs[name].astype(float), bootstrap
        )
        low, high = min(score[0], drawn.low), max(score[1], drawn.high)
        note = ""
        if tango(0, 0, count, CONFIDENCE)[0] <= -margin:
            note = f"{count} cases can never prove a loss below {100 * margin:g} %"
        outcome = _proved(low, high, margin)
        wide = {"low": low, "high": high, "margin": margin, "note": note}
        found.append(_counted("no loss", name, outcome, pairs, count, **wide))
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
    kind: Kind,
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


def family_of(check: Check) -> str:
    """The family that a check is about; "" if it is about all cases."""
    return check.name.rpartition(", ")[0] if check.kind == "families" else ""


def families(pair: Pair, config: GateConfig) -> list[Check]:
    """Per family: clean drives and way, no worse than the margins.

    A family passes if its own interval says so: that all have to pass needs no
    adjustment. It fails if a loss is detected after Holm over families.
    """
    mine, theirs = is_clean(pair.candidate), is_clean(pair.incumbent)
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
        margin = config.family_clean
        shown = tango(gained, lost, total, CONFIDENCE)[0] > -margin
        worse = lost > gained and clean_p[i] < level
        clean: Outcome = "fail" if worse else "pass" if shown else "open"
        title, p = f"{name}, clean drives", float(clean_p[i])
        found.append(
            _counted("families", title, clean, counts[i], total, margin=margin, p=p)
        )
        short = way.mean < -config.family_progress and way_p[i] < level
        shown = way.low > -config.family_progress and total >= MIN_FAMILY
        check = _continuous(
            "families",
            f"{name}, progress",
            way,
            "fail" if short and total >= MIN_FAMILY else "pass" if shown else "open",
            config.family_progress,
            float(way_p[i]),
        )
        if total < MIN_FAMILY:
            note = f"{total} cases: expected at least {MIN_FAMILY}"
            check = dataclasses.replace(check, note=note)
        found.append(check)
    return found


def gains(pair: Pair, config: GateConfig) -> list[Check]:
    """Primary metrics that are better; Holm over them."""
    mine, theirs = passes_of(pair.candidate), passes_of(pair.incumbent)
    bootstrap = ClusterBootstrap(family_clusters(pair.families))
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
