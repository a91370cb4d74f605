"""The checks of a gate on rates, progress, families and gains; see `gate`."""

import jax.numpy as jnp
import numpy as np

from rcirl_jax.evaluation.exact import CONFIDENCE, holm, mcnemar_exact, tango
from rcirl_jax.evaluation.gate import likeness as gate_likeness
from rcirl_jax.evaluation.gate.stats import (
    MIN_CLUSTERS,
    clipped,
    counted,
    over_clusters,
    within_strata,
)
from rcirl_jax.evaluation.gate.types import Check, GateConfig, Outcome, Pair, check_of
from rcirl_jax.evaluation.gate.words import title_of
from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    Difference,
    family_clusters,
)
from rcirl_jax.simulation.catalogue.families import family_title
from rcirl_jax.simulation.metrics import COLUMNS, CaseMetrics, nuplan_score

MIN_FAMILY = 10  # cases of a family below which its interval means nothing
LEVEL = 1.0 - CONFIDENCE  # of two-sided tests
MATERIAL = 0.5  # share of a family's margin below which a loss of progress is small
RATES = ("collision_free", "min_ttc", "speed_limit", "on_road")


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


def is_clean(metrics: CaseMetrics) -> np.ndarray:
    """[C] bool: nothing of `CLEAN` is broken."""
    passes = passes_of(metrics)
    return np.all([passes[name] for name in CLEAN], axis=0)


def _discordant(mine: np.ndarray, theirs: np.ndarray) -> tuple[int, int]:
    """(cases only mine passes, cases only theirs passes)."""
    return int(np.sum(mine & ~theirs)), int(np.sum(~mine & theirs))


def _proved(low: float, high: float, margin: float) -> Outcome:
    """No loss beyond the margin, a loss for certain, or neither."""
    if low > -margin:
        return "pass"
    return "fail" if high < 0.0 else "open"


def no_loss(pair: Pair, config: GateConfig) -> list[Check]:
    """Rates and progress of all cases, within their margins.

    The suite's families are fixed: rates by Tango's interval over cases, progress by
    Student's t within the families as strata.
    """
    mine, theirs = passes_of(pair.candidate), passes_of(pair.incumbent)
    count, found = len(pair.ids), []
    for name in RATES:
        margin = config.margins[name]
        pairs = _discordant(mine[name], theirs[name])
        rate = counted(pairs, count)
        note = ""
        if tango(0, 0, count, CONFIDENCE)[0] <= -margin:
            note = f"{count} cases can never prove a loss below {100 * margin:g} %"
        outcome = _proved(rate.low, rate.high, margin)
        title = title_of(name)
        check = check_of(
            "no loss", name, title, outcome, rate, margin, pairs, note=note
        )
        found.append(check)
    _, strata = np.unique(pair.families, return_inverse=True)
    # nobody drives less than no way at all
    way = clipped(within_strata(*_ways(pair), strata), high=np.inf)
    margin, title = config.progress, title_of("progress")
    outcome = _proved(way.low, way.high, margin)
    found.append(check_of("no loss", "progress", title, outcome, way, margin))
    return found


def _ways(pair: Pair, at: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Progress as a share of the incumbent's mean, over all cases or those in `at`."""
    some = slice(None) if at is None else at
    mine = np.asarray(pair.candidate.progress, np.float64)[some]
    theirs = np.asarray(pair.incumbent.progress, np.float64)[some]
    scale = max(float(theirs.mean()), 1.0)
    return mine / scale, theirs / scale


def families(pair: Pair, config: GateConfig) -> list[Check]:
    """Per family: clean drives and progress, no worse than the margins.

    A family passes if its own interval lies above the margin: that all have to pass
    needs no adjustment. It fails if a loss is detected after Holm over families; of
    progress, one of more than `MATERIAL` of the margin.
    """
    names = np.asarray(pair.families)
    order = [n for n in dict.fromkeys(pair.families) if np.sum(names == n) > 1]
    mine, theirs = is_clean(pair.candidate), is_clean(pair.incumbent)
    pairs = [_discordant(mine[names == n], theirs[names == n]) for n in order]
    totals = [int(np.sum(names == n)) for n in order]
    rates = [counted(*each) for each in zip(pairs, totals, strict=True)]
    ways = []
    for name in order:
        at = names == name
        one = within_strata(*_ways(pair, at), np.zeros(at.sum(), int))
        ways.append(clipped(one, high=np.inf))
    rate_p, way_p = (holm(np.array([x.p for x in found])) for found in (rates, ways))
    found = []
    for i, name in enumerate(order):
        few, words = totals[i] < MIN_FAMILY, family_title(name)
        note = f"{totals[i]} cases: expected at least {MIN_FAMILY}" if few else ""
        detected = rates[i].mean < 0.0 and rate_p[i] < LEVEL
        shown = rates[i].low > -config.family_clean
        clean: Outcome = "fail" if detected else "pass" if shown else "open"
        found.append(
            check_of(
                "families", f"{name}, clean drives", f"{words}: clean drives", clean,
                rates[i], config.family_clean, pairs[i], float(rate_p[i]),
            )
        )  # fmt: skip
        small = -MATERIAL * config.family_progress
        detected = ways[i].mean < small and way_p[i] < LEVEL and not few
        shown = ways[i].low > -config.family_progress and not few
        way: Outcome = "fail" if detected else "pass" if shown else "open"
        found.append(
            check_of(
                "families", f"{name}, progress", f"{words}: progress", way, ways[i],
                config.family_progress, p=float(way_p[i]), note=note,
            )
        )  # fmt: skip
    return found


def gains(pair: Pair, config: GateConfig) -> list[Check]:
    """Primary metrics and human-likeness that are better; Holm over them.

    A gain has to be seen over families as clusters, and in rates by McNemar's test
    over cases too. A primary metric that is worse by the same tests and by more than
    `config.gain` fails: no gain elsewhere pays for it. Progress has its own margin
    (`no_loss`), human-likeness its own check (`gate_likeness`).
    """
    _, index = np.unique(pair.families, return_inverse=True)
    groups = int(index.max()) + 1
    bootstrap = ClusterBootstrap(family_clusters(pair.families))
    few = ""
    if groups < MIN_CLUSTERS:
        few = (
            f"{groups} families: too few for an interval over families"
            f" (at least {MIN_CLUSTERS}); this one is over cases"
        )
    mine, theirs = passes_of(pair.candidate), passes_of(pair.incumbent)
    rows: list[tuple[str, Difference, tuple[int, int] | None, float]] = []
    for name in config.primary:
        pairs = None
        if name in COLUMNS:
            both = mine[name].astype(float), theirs[name].astype(float)
            pairs = _discordant(mine[name], theirs[name])
        else:
            both = _ways(pair) if name == "progress" else _scores(pair)
        if few:
            found = within_strata(*both, index)
            p = 1.0
        else:
            found = over_clusters(*both, bootstrap)
            # both tests have to see it: cases, and families as clusters
            p = found.p if pairs is None else max(mcnemar_exact(*pairs), found.p)
        found = clipped(found, high=np.inf if name == "progress" else 1.0)
        rows.append((name, found, pairs, p))
    if nearer := gate_likeness.gain(pair):
        rows.append(("likeness", nearer, None, nearer.p))
    adjusted = holm(np.array([row[3] for row in rows]))
    return [
        _gain(*row[:3], float(p), few, config)
        for row, p in zip(rows, adjusted, strict=True)
    ]


def _gain(
    name: str,
    found: Difference,
    pairs: tuple[int, int] | None,
    p: float,
    few: str,
    config: GateConfig,
) -> Check:
    outcome: Outcome = "open"
    if found.mean > 0.0 and p < LEVEL:
        outcome = "pass"
    judged = name not in ("progress", "likeness")
    if judged and found.mean < -config.gain and p < LEVEL:
        outcome = "fail"
    note = few if name != "likeness" else ""
    title = title_of(name)
    return check_of("gain", name, title, outcome, found, pairs=pairs, p=p, note=note)


def _scores(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """NuPlan's score of both."""
    reference = jnp.asarray(pair.reference)
    mine, theirs = (
        np.asarray(nuplan_score(metrics, reference)[0], np.float64)
        for metrics in (pair.candidate, pair.incumbent)
    )
    return mine, theirs
