"""The six kinds of check of a gate, none of them on a learned reward.

    safety      not more cases with a preventable at-fault collision, a collision with
                a pedestrian or cyclist, a red light or a stop sign run than the
                incumbent, up to a declared margin
    no loss     rates and progress over all cases are not worse than the incumbent's by
                more than a margin: the lower end of the paired 95 % interval over
                cases lies above it
    families    in no family more clean drives or progress are lost than a margin. All
                families have to show it, so none is adjusted; a loss is detected
                (exact McNemar, t) only after Holm over families
    trivial baselines   nearer to the human than rewards that know nothing, and as safe
    likeness    not farther from the human than the incumbent, on held-out recorded
                drives, paired by drive and clustered by vehicle
    gain        better in one primary metric or in human-likeness, at least: McNemar
                and families as clusters, Holm over them; and in no primary metric
                worse by the same tests and more than a margin

A check passes, fails, or is open: what was measured does not show it either way. A gain
is claimed for driving as such, so families count as draws from all kinds of scenes:
clusters. A loss is judged on the suite as it is, whose families are fixed and each
judged by itself besides: strata. Host numpy, float64. `C` cases, `D` recorded drives.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate.types import (
    CANDIDATE,
    Check,
    GateConfig,
    Kind,
    Likeness,
    NewFault,
    Outcome,
    Pair,
)
from rcirl_jax.evaluation.gate.words import TO_MEASURE, name_of, title_of
from rcirl_jax.evaluation.statistics import (
    ALPHA,
    CONFIDENCE,
    ClusterBootstrap,
    Difference,
    family_clusters,
    holm,
    mcnemar_exact,
    no_more_faults,
    over_clusters,
    paired_rates,
    within_strata,
)
from rcirl_jax.simulation.families import family_title
from rcirl_jax.simulation.metrics import COLUMNS, CaseMetrics, nuplan_score

MIN_CLUSTERS = 5  # families or vehicles below which no interval over them is made
MIN_FAMILY = 10  # cases of a family below which its interval means nothing
LEVEL = 1.0 - CONFIDENCE  # of two-sided tests
MATERIAL = 0.5  # share of a family's margin below which a loss of progress is small
NAMED = 10  # ids in an error
RATES = ("collision_free", "min_ttc", "speed_limit", "on_road")
# what a clean drive holds
CLEAN = (
    "collision_free",
    "red_light",
    "stop_sign",
    "min_ttc",
    "speed_limit",
    "on_road",
)


def check_of(
    kind: Kind,
    name: str,
    title: str,
    outcome: Outcome,
    found: Difference,
    margin: float | None = None,
    pairs: tuple[int, int] | None = None,
    p: float | None = None,
    note: str = "",
) -> Check:
    """Makes a check with the mean and interval of candidate minus the other.

    The arguments are fields of `Check`; `pairs` are (gained, lost) cases where those
    are counted, and the difference's own p is not the check's.
    """
    gained, lost = pairs or (None, None)
    return Check(
        kind=kind, name=name, title=title, outcome=outcome, difference=found.mean,
        low=found.low, high=found.high, margin=margin, gained=gained, lost=lost, p=p,
        note=note,
    )  # fmt: skip


def unmeasured(kind: Kind, name: str, title: str, note: str) -> Check:
    """Makes a check that nothing was measured for; `note` says what to do."""
    anything = Difference(mean=0.0, low=-1.0, high=1.0, se=np.nan, p=1.0)
    check = check_of(kind, name, title, "open", anything, note=note)
    return dataclasses.replace(check, measured=False)


# ---------------------------------------------------------------- what a drive is


def passes_of(metrics: CaseMetrics) -> dict[str, np.ndarray]:
    """Returns [C] bool per case, by the name of what has to hold."""
    holds = np.asarray(metrics.holds).astype(bool)
    return {
        **{name: holds[:, i] for i, name in enumerate(COLUMNS)},
        "collision_free": np.asarray(metrics.at_fault) == 0,
        "red_light": np.asarray(metrics.red_lights) == 0,
        "stop_sign": np.asarray(metrics.stop_signs) == 0,
        "min_ttc": np.asarray(metrics.ttc_bound) > 0,
        "on_road": np.asarray(metrics.drivable) > 0,
    }


def is_clean(metrics: CaseMetrics) -> np.ndarray:
    """Returns [C] bool: nothing of `CLEAN` is broken."""
    passes = passes_of(metrics)
    return np.all([passes[name] for name in CLEAN], axis=0)


def offences(metrics: CaseMetrics, preventable: np.ndarray) -> dict[str, np.ndarray]:
    """Returns [C], the number of every offence, by the name of its check.

    Collisions count where they are preventable; those with pedestrians and cyclists,
    red lights and stop signs count everywhere.

    Args:
      metrics: leaves [C].
      preventable: [C] bool.
    """
    return {
        "collision": np.where(preventable, np.asarray(metrics.at_fault), 0),
        "vulnerable": np.asarray(metrics.at_fault_vru),
        "red_light": np.asarray(metrics.red_lights),
        "stop_sign": np.asarray(metrics.stop_signs),
    }


def _discordant(mine: np.ndarray, theirs: np.ndarray) -> tuple[int, int]:
    """Returns (cases only mine passes, cases only theirs passes)."""
    return int(np.sum(mine & ~theirs)), int(np.sum(~mine & theirs))


def _progress(pair: Pair, at: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
    """Returns progress as a share of the incumbent's mean over the cases in `at`."""
    mine = np.asarray(pair.candidate.progress, np.float64)[at]
    theirs = np.asarray(pair.incumbent.progress, np.float64)[at]
    scale = max(float(theirs.mean()), 1.0)
    return mine / scale, theirs / scale


ALL = slice(None)


def clipped(found: Difference, high: float = 1.0) -> Difference:
    """Returns the same with an interval that stays where a difference can be.

    Args:
      found: with any ends.
      high: largest difference there can be; the smallest is -1. There is none of
        progress: nobody drives less than no way at all, but anybody farther.
    """
    return dataclasses.replace(
        found,
        low=min(max(found.low, -1.0), high),
        high=max(min(found.high, high), -1.0),
    )


# ---------------------------------------------------------------- safety


def new_faults(pair: Pair, accept: tuple[str, ...] = ()) -> tuple[NewFault, ...]:
    """Lists every case in which the candidate commits more of an offence.

    Collisions that no careful driver prevents are among them, and marked.

    Raises:
      InputError: an accepted id is no such case.
    """
    everywhere = np.ones(len(pair.ids), bool)
    mine = offences(pair.candidate, everywhere)
    theirs = offences(pair.incumbent, everywhere)
    more = {name: mine[name] > theirs[name] for name in mine}
    found = tuple(
        NewFault(
            case=pair.ids[i],
            faults=tuple(name for name in more if more[name][i]),
            preventable=bool(pair.preventable[i]),
            accepted=pair.ids[i] in accept,
        )
        for i in np.flatnonzero(np.any(list(more.values()), axis=0)).tolist()
    )
    cases = [fault.case for fault in found]
    for name in accept:
        if name not in cases:
            some = ", ".join(cases[:NAMED]) + (", ..." if len(cases) > NAMED else "")
            raise InputError(
                f"accept: {name}: no case with a new fault: expected "
                + (f"some of {some}" if cases else "none, for there is none")
            )
    return found


def _no_more(
    kind: Kind, pair: Pair, other: CaseMetrics, config: GateConfig, trivial: str = ""
) -> list[Check]:
    """Compares every offence of the candidate with another row's.

    A case in which the candidate commits more of one is lost, one in which it commits
    fewer is gained; a case that a person has accepted is neither. With c lost and b
    gained of n cases:

        pass    the exact paired test shows that (c - b) / n is below the margin
        fail    more lost than gained by McNemar's exact test, one-sided at 2.5 %
        open    neither: the cases at hand do not show it
    """
    mine = offences(pair.candidate, pair.preventable)
    theirs = offences(other, pair.preventable)
    counts, total = np.isin(pair.ids, config.accept, invert=True), len(pair.ids)
    checks = []
    for name in mine:
        pairs = (
            int(np.sum(counts & (mine[name] < theirs[name]))),
            int(np.sum(counts & (mine[name] > theirs[name]))),
        )
        margin, found = config.margins[name], paired_rates(pairs, total)
        p = no_more_faults(*pairs, total, margin)
        outcome: Outcome = "pass" if p <= ALPHA else "open"
        if found.mean < 0.0 and found.p < 2.0 * ALPHA:
            outcome = "fail"
        note, title = "", title_of(name)
        if outcome == "open" and no_more_faults(0, 0, total, margin) > ALPHA:
            note = f"{total} cases can never prove a margin of {100 * margin:g} %"
        if trivial:
            name, title = f"{name}, {trivial}", f"as safe as {trivial}: {title}"
        checks.append(
            check_of(kind, name, title, outcome, found, margin, pairs, p, note)
        )
    return checks


def safety(pair: Pair, config: GateConfig) -> list[Check]:
    """Compares every offence with the incumbent's."""
    return _no_more("safety", pair, pair.incumbent, config)


# ---------------------------------------------------------------- losses


def no_loss(pair: Pair, config: GateConfig) -> list[Check]:
    """Compares rates and progress of all cases, within their margins.

    The suite's families are fixed: rates by Tango's interval over cases, progress by
    Student's t within the families as strata.
    """
    mine, theirs = passes_of(pair.candidate), passes_of(pair.incumbent)
    count, found = len(pair.ids), []

    def add(
        name: str,
        loss: Difference,
        pairs: tuple[int, int] | None = None,
        note: str = "",
    ) -> None:
        margin, title = config.margins[name], title_of(name)
        outcome: Outcome = "fail" if loss.high < 0.0 else "open"
        outcome = "pass" if loss.low > -margin else outcome
        found.append(
            check_of("no loss", name, title, outcome, loss, margin, pairs, note=note)
        )

    for name in RATES:
        pairs, note = _discordant(mine[name], theirs[name]), ""
        margin = config.margins[name]
        if paired_rates((0, 0), count).low <= -margin:
            note = f"{count} cases can never prove a loss below {100 * margin:g} %"
        add(name, paired_rates(pairs, count), pairs, note=note)
    _, strata = np.unique(pair.families, return_inverse=True)
    add("progress", clipped(within_strata(*_progress(pair, ALL), strata), high=np.inf))
    return found


def families(pair: Pair, config: GateConfig) -> list[Check]:
    """Compares clean drives and progress of each family.

    A family passes if its own interval lies above the margin: that all have to pass
    needs no adjustment. It fails if a loss is detected after Holm over families; of
    progress, one of more than `MATERIAL` of the margin.
    """
    names = np.asarray(pair.families)
    order = [n for n in dict.fromkeys(pair.families) if np.sum(names == n) > 1]
    mine, theirs = is_clean(pair.candidate), is_clean(pair.incumbent)
    pairs, totals, rates, ways = [], [], [], []
    for name in order:
        at = names == name
        pairs.append(_discordant(mine[at], theirs[at]))
        totals.append(int(np.sum(at)))
        rates.append(paired_rates(pairs[-1], totals[-1]))
        way = within_strata(*_progress(pair, at), np.zeros(at.sum(), int))
        ways.append(clipped(way, high=np.inf))
    rate_p, way_p = (holm(np.array([x.p for x in found])) for found in (rates, ways))
    found = []
    for i, name in enumerate(order):
        words, few = family_title(name), totals[i] < MIN_FAMILY
        shown = rates[i].low > -config.family_clean
        detected = rates[i].mean < 0.0 and rate_p[i] < LEVEL
        outcome: Outcome = "fail" if detected else "pass" if shown else "open"
        found.append(
            check_of(
                "families", f"{name}, clean drives", f"{words}: clean drives", outcome,
                rates[i], config.family_clean, pairs[i], float(rate_p[i]),
            )
        )  # fmt: skip
        note = f"{totals[i]} cases: expected at least {MIN_FAMILY}" if few else ""
        shown = ways[i].low > -config.family_progress and not few
        small = -MATERIAL * config.family_progress
        detected = ways[i].mean < small and way_p[i] < LEVEL and not few
        outcome = "fail" if detected else "pass" if shown else "open"
        found.append(
            check_of(
                "families", f"{name}, progress", f"{words}: progress", outcome, ways[i],
                config.family_progress, p=float(way_p[i]), note=note,
            )
        )  # fmt: skip
    return found


# ---------------------------------------------------------------- human-likeness


def _few(known: Likeness) -> str:
    """Says why there is no interval; "" if there is one."""
    clusters = len(np.unique(known.clusters))
    if clusters >= MIN_CLUSTERS:
        return ""
    return (
        f"{clusters} vehicles are too few for an interval over them:"
        f" measure at least {MIN_CLUSTERS}"
    )


def _nearer(known: Likeness, other: str) -> Difference:
    """Returns the mean of (other's - candidate's distance) by the other's mean.

    Raises:
      InputError: no distances of one of the two.
    """
    for name in (CANDIDATE, other):
        if name not in known.distance:
            some = ", ".join(known.distance)
            raise InputError(f"likeness: {name}: expected a row of {some}")
    mine, theirs = (
        np.asarray(known.distance[name], np.float64) for name in (CANDIDATE, other)
    )
    scale = max(float(theirs.mean()), 1e-9)
    clusters = ClusterBootstrap(np.asarray(known.clusters))
    return over_clusters(theirs / scale, mine / scale, clusters)


def _distance(
    pair: Pair, kind: Kind, name: str, title: str, other: str, unclear: Outcome
) -> Check:
    """Compares the distance to the human with one row's; `unclear`: neither is."""
    if pair.likeness is None:
        return unmeasured(kind, name, title, TO_MEASURE)
    if few := _few(pair.likeness):
        return unmeasured(kind, name, title, few)
    found = _nearer(pair.likeness, other)
    outcome: Outcome = "pass" if found.low > 0.0 else unclear
    outcome = "fail" if found.high < 0.0 else outcome
    return check_of(kind, name, title, outcome, found, p=found.p)


def likeness(pair: Pair) -> list[Check]:
    """Fails where the candidate is farther from the human than the incumbent."""
    title = f"not farther from the human than {name_of(pair)}"
    return [_distance(pair, "likeness", "likeness", title, pair.name, "pass")]


def trivial_baselines(pair: Pair, config: GateConfig) -> list[Check]:
    """Compares with each trivial baseline: nearer to the human, and as safe."""
    kind, found = "trivial baselines", []
    for other in config.trivial_baselines:
        title = f"nearer to the human than {other}"
        found.append(_distance(pair, kind, f"likeness, {other}", title, other, "open"))
    for other in config.trivial_baselines:
        if other in pair.trivial_baselines:
            found += _no_more(kind, pair, pair.trivial_baselines[other], config, other)
        else:
            note = f"drive {other} on the same cases"
            title = f"as safe as {other}"
            found.append(unmeasured(kind, f"safety, {other}", title, note))
    return found


# ---------------------------------------------------------------- gains


def gains(pair: Pair, config: GateConfig) -> list[Check]:
    """Compares primary metrics and human-likeness; Holm over them.

    A gain has to be seen over families as clusters, and in rates by McNemar's test
    over cases too. A primary metric that is worse by the same tests and by more than
    `config.gain` fails: no gain elsewhere pays for it. Progress has its own margin
    (`no_loss`), human-likeness its own check (`likeness`).
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
        elif name == "progress":
            both = _progress(pair, ALL)
        else:  # nuPlan's score
            way = jnp.asarray(pair.reference)
            drives = (pair.candidate, pair.incumbent)
            a, b = (np.asarray(nuplan_score(m, way)[0], np.float64) for m in drives)
            both = a, b
        if few:
            found, p = within_strata(*both, index), 1.0
        else:
            found = over_clusters(*both, bootstrap)
            # both tests have to see it: cases, and families as clusters
            p = found.p if pairs is None else max(mcnemar_exact(*pairs), found.p)
        found = clipped(found, high=np.inf if name == "progress" else 1.0)
        rows.append((name, found, pairs, p))
    if pair.likeness is not None and not _few(pair.likeness):
        nearer = _nearer(pair.likeness, pair.name)
        rows.append(("likeness", nearer, None, nearer.p))
    checks = []
    adjusted = holm(np.array([row[3] for row in rows]))
    for (name, found, pairs, _), p in zip(rows, adjusted.tolist(), strict=True):
        outcome: Outcome = "pass" if found.mean > 0.0 and p < LEVEL else "open"
        judged = name not in ("progress", "likeness")
        if judged and found.mean < -config.gain and p < LEVEL:
            outcome = "fail"
        note = few if name != "likeness" else ""
        title = title_of(name)
        checks.append(
            check_of("gain", name, title, outcome, found, pairs=pairs, p=p, note=note)
        )
    return checks
