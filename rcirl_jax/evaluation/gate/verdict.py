"""May a candidate replace the incumbent? Tests on the same closed-loop cases.

Six kinds of check, none of them on a learned reward:

    safety      not more cases with a preventable at-fault collision, a collision with
                a pedestrian or cyclist, a red light or a stop sign run than the
                incumbent, up to a declared margin
    recorded traffic    on held-out recorded drives among replayed traffic that reacts:
                not more vehicles with an at-fault collision, with too little time to a
                collision, or with somebody made to brake hard, and no more time with a
                short headway, up to margins
    no loss     rates, impact speeds and progress over all cases are not worse than the
                incumbent's by more than a margin: the lower end of the paired 95 %
                interval over cases lies above it
    families    in no family more clean drives or progress are lost than a margin. All
                families have to show it, so none is adjusted; a loss is detected
                (exact McNemar, t) only after Holm over families
    trivial baselines   nearer to the human than rewards that know nothing, and as safe
    likeness    not farther from the human than the incumbent by a margin, on held-out
                recorded drives, paired by drive and clustered by vehicle. Farther for
                certain fails also within the margin: what passes was measured less than
                half of the margin farther
    gain        better in one primary metric or in human-likeness, at least: McNemar
                and families as clusters, Holm over them; and in no primary metric
                worse by the same tests and more than a margin

A check passes, fails, or is open: what was measured does not show it either way. Ship
needs every check passed, a gain, the full suite and the usual held-out drives; one
failed check refuses; else, open checks, or a part only of what is to be driven, make
the gate unable to judge. A case with a
new fault that a person accepts no longer counts in the tests of safety.

A gain is claimed for driving as such, so families count as draws from all kinds of
scenes: clusters. A loss is judged on the suite as it is, whose families are fixed and
each judged by itself besides: strata. Host numpy, float64. `C` cases, `D` recorded
drives.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, SuiteResult
from rcirl_jax.evaluation.closed_loop.summary import result_hash
from rcirl_jax.evaluation.gate.against import against
from rcirl_jax.evaluation.gate.types import (
    CANDIDATE,
    FELT,
    IMPACT_MPS,
    Check,
    Decision,
    GateConfig,
    Kind,
    NewFault,
    Pair,
    Verdict,
)
from rcirl_jax.evaluation.gate.words import WORDS, family_of, name_of, reason, sentence
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
from rcirl_jax.runtime.atomic_files import plain, write_json
from rcirl_jax.simulation.families import family_title
from rcirl_jax.simulation.metrics import (
    COLUMNS,
    CaseMetrics,
    not_driven,
    nuplan_score,
)
from rcirl_jax.simulation.rollout import LANES
from rcirl_jax.simulation.rows import Row
from rcirl_jax.simulation.suite import drive_row, rollout_config

WORST = 20  # cases named for a person to look at
MIN_CASES = 30  # below, no interval means anything
MIN_CLUSTERS = 5  # families or vehicles below which no interval over them is made
MIN_IMPACTS = 6  # unlike ones that can show a loss: 2^-6 < 2.5 %, the test's level
MIN_FAMILY = 10  # cases of a family below which its interval means nothing
LEVEL = 1.0 - CONFIDENCE  # of two-sided tests
MATERIAL = 0.5  # share of a family's margin below which a loss of progress is small
NAMED = 10  # ids in an error
RATES = ("collision_free", "min_ttc", "speed_limit", "on_road")
CLEAN = (*RATES, "red_light", "stop_sign")  # what a clean drive holds
# what to do where human-likeness was not measured
TO_MEASURE = "measure human-likeness on held-out recordings (docs/gate.md)"


def repeats(row: Row, result: SuiteResult, config: SuiteConfig) -> None:
    """Drives the first cases once more; a verdict needs drives that repeat.

    Raises:
      InputError: another result than in the suite.
    """
    cases, count = result.cases, min(LANES, len(result.cases.ids))
    rollout = rollout_config(row, cases.duration_s, config.plan_every)
    again = drive_row(row, cases.build, count, rollout, chunk=LANES)
    before = jax.tree.map(lambda x: x[:count], result.rows[row.name])
    both = ~(not_driven(again) | not_driven(before))
    again, before = jax.tree.map(lambda x: x[both], (again, before))
    if result_hash(again) != result_hash(before):
        raise InputError(
            f"gate: {row.name}: the first {count} cases, driven twice, differ:"
            " expected one result"
        )


def judge(pair: Pair, config: GateConfig, part: str = "") -> Verdict:
    """Runs all checks on one pair of rows and decides.

    Args:
      pair: the drives.
      config: margins.
      part: what was left out of the suite, in words; then nothing ships, nor where
        held-out drives were left out.

    Raises:
      InputError: fewer than `MIN_CASES` cases, an accepted id that is no new fault,
        or no distances of a row that human-likeness is compared with.
    """
    count = len(pair.runs.ids)
    if count < MIN_CASES:
        raise InputError(f"gate: {count} cases: expected at least {MIN_CASES}")
    drives = pair.likeness.left_out if pair.likeness else ""
    part = "; ".join(filter(None, (part, drives)))
    faults = new_faults(pair, config.accept)
    checks = (
        *_not_driven(pair),
        *_no_more("safety", pair, pair.incumbent, config),
        *_recorded(pair, config),
        *_no_loss(pair, config),
        *_families(pair, config),
        *_trivial_baselines(pair, config),
        _likeness(pair, config),
        *_gains(pair, config),
    )
    failed = [c for c in checks if c.outcome == "fail"]
    unclear = [c for c in checks if c.kind != "gain" and c.outcome == "open"]
    gained = [c for c in checks if c.kind == "gain" and c.outcome == "pass"]
    decision: Decision = "no difference"
    if failed:
        decision = "do not ship"
    elif unclear:
        decision = "could not judge"
    elif gained:
        decision = "ship"
    reasons = tuple(reason(check) for check in failed or unclear or gained)
    reasons = reasons or ("no primary metric is better",)
    if part and decision == "ship":
        decision = "could not judge"
        reasons = (f"{part}: nothing ships on a part", *reasons)
    verdict = Verdict(
        decision=decision,
        sentence="",
        reasons=reasons,
        checks=checks,
        cases=count,
        families=len(set(pair.runs.groups)),
        new_faults=faults,
        look_at=_look_at(pair, checks, [f.case for f in faults if not f.accepted]),
        part=part,
        against=against(pair, checks),
    )
    return dataclasses.replace(verdict, sentence=sentence(pair, verdict))


def _look_at(
    pair: Pair, checks: Sequence[Check], new: Sequence[str]
) -> tuple[str, ...]:
    """Names cases that only one of them drives cleanly, or far apart; losses first.

    Before them new faults that nobody has accepted, if safety is not shown, and the
    worst of every family that failed.
    """
    mine, theirs = passes_of(pair.candidate), passes_of(pair.incumbent)
    way = np.asarray(pair.candidate.progress) - np.asarray(pair.incumbent.progress)
    key = (
        8.0 * np.isin(pair.runs.ids, new)
        + 4.0 * (~mine["clean"] & theirs["clean"])
        + np.clip(-way / np.maximum(pair.incumbent.progress, 1.0), 0.0, 1.0)
        + 0.5 * (~mine["j_station"] & theirs["j_station"])
    )
    order = [int(i) for i in np.argsort(-key, kind="stable") if key[i] > 0]
    failed = {family_of(c) for c in checks if c.outcome == "fail"}
    firsts: dict[str, int] = {}
    for i in order:
        if pair.runs.groups[i] in failed:
            firsts.setdefault(pair.runs.groups[i], i)
    unsafe = any(c.kind == "safety" and c.outcome != "pass" for c in checks)
    first = [i for i in order if unsafe and pair.runs.ids[i] in new]
    found = dict.fromkeys([*first, *firsts.values(), *order])
    return tuple(pair.runs.ids[i] for i in list(found)[:WORST])


def write_verdict(
    path: Path, verdict: Verdict, config: GateConfig, facts: Mapping[str, object]
) -> None:
    """Writes verdict, margins and `facts` (files, hashes, provenance) as JSON."""
    first = {"sentence": verdict.sentence, "decision": verdict.decision}
    body = {**first, "exit_code": verdict.exit_code, **plain(verdict)}
    write_json(path, {**body, "config": plain(config), **facts})


# ---------------------------------------------------------------- what a drive is


def passes_of(metrics: CaseMetrics) -> dict[str, np.ndarray]:
    """Returns [C] bool by the name of what has to hold; "clean" is all of `CLEAN`."""
    holds = np.asarray(metrics.holds).astype(bool)
    passes = {
        **{name: holds[:, i] for i, name in enumerate(COLUMNS)},
        "collision_free": np.asarray(metrics.at_fault) == 0,
        "red_light": np.asarray(metrics.red_lights) == 0,
        "stop_sign": np.asarray(metrics.stop_signs) == 0,
        "min_ttc": np.asarray(metrics.ttc_bound) > 0,
        "on_road": np.asarray(metrics.drivable) > 0,
    }
    return {**passes, "clean": np.all([passes[name] for name in CLEAN], axis=0)}


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


def new_faults(pair: Pair, accept: tuple[str, ...] = ()) -> tuple[NewFault, ...]:
    """Lists every case in which the candidate commits more of an offence.

    Collisions that no careful driver prevents are among them, and marked.

    Raises:
      InputError: an accepted id is no such case.
    """
    everywhere = np.ones(len(pair.runs.ids), bool)
    mine = offences(pair.candidate, everywhere)
    theirs = offences(pair.incumbent, everywhere)
    more = {name: mine[name] > theirs[name] for name in mine}
    found = tuple(
        NewFault(
            case=pair.runs.ids[i],
            faults=tuple(name for name in more if more[name][i]),
            preventable=bool(pair.runs.preventable[i]),
            accepted=pair.runs.ids[i] in accept,
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


# ---------------------------------------------------------------- checks


def _check(
    kind: Kind,
    name: str,
    title: str,
    found: Difference,
    fails: bool,
    passes: bool,
    *,
    margin: float | None = None,
    pairs: tuple[int, int] | None = None,
    p: float | None = None,
    note: str = "",
) -> Check:
    """Makes a check of candidate minus the other; `fails` goes before `passes`.

    `pairs` are (gained, lost) cases where those are counted; the difference's own p is
    not the check's.
    """
    gained, lost = pairs or (None, None)
    return Check(
        kind=kind, name=name, title=title,
        outcome="fail" if fails else "pass" if passes else "open",
        difference=found.mean, low=found.low, high=found.high, margin=margin,
        gained=gained, lost=lost, p=p, note=note,
    )  # fmt: skip


def _unmeasured(kind: Kind, name: str, title: str, note: str) -> Check:
    """Makes a check that nothing was measured for; `note` says what to do."""
    anything = Difference(mean=0.0, low=-1.0, high=1.0, se=np.nan, p=1.0)
    check = _check(kind, name, title, anything, False, False, note=note)
    return dataclasses.replace(check, measured=False)


def _not_driven(pair: Pair) -> Iterator[Check]:
    """Makes an open check of each row that has not driven all cases."""
    rows = {"candidate": pair.candidate, name_of(pair): pair.incumbent}
    for name, metrics in rows.items():
        if lost := int(not_driven(metrics).sum()):
            note = f"{name} did not drive {lost:,} of {len(pair.runs.ids):,} cases"
            title = f"all cases driven by {name}"
            yield _unmeasured("safety", f"driven, {name}", title, note)


def _discordant(mine: np.ndarray, theirs: np.ndarray) -> tuple[int, int]:
    """Returns (cases only mine passes, cases only theirs passes)."""
    return int(np.sum(mine & ~theirs)), int(np.sum(~mine & theirs))


def _progress(
    pair: Pair, at: np.ndarray | slice = slice(None)
) -> tuple[np.ndarray, np.ndarray]:
    """Returns progress as a share of the incumbent's mean over the cases in `at`."""
    mine = np.asarray(pair.candidate.progress, np.float64)[at]
    theirs = np.asarray(pair.incumbent.progress, np.float64)[at]
    scale = max(float(theirs.mean()), 1.0)
    return mine / scale, theirs / scale


def _impacts(pair: Pair, config: GateConfig) -> tuple[np.ndarray, np.ndarray]:
    """Returns [C], impact speeds of at-fault collisions over `IMPACT_MPS`, of both.

    An accepted case counts 0.
    """
    counts = np.isin(pair.runs.ids, config.accept, invert=True)
    mine, theirs = (
        np.where(counts & (np.asarray(x.at_fault) > 0), np.asarray(x.impact_speed), 0.0)
        for x in (pair.candidate, pair.incumbent)
    )
    return mine / IMPACT_MPS, theirs / IMPACT_MPS


def _clipped(found: Difference, high: float = np.inf) -> Difference:
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


def _no_more(
    kind: Kind, pair: Pair, other: CaseMetrics, config: GateConfig, trivial: str = ""
) -> Iterator[Check]:
    """Compares every offence of the candidate with another row's.

    A case in which the candidate commits more of one is lost, one in which it commits
    fewer is gained; a case that a person has accepted is neither. With c lost and b
    gained of n cases:

        pass    the exact paired test shows that (c - b) / n is below the margin
        fail    more lost than gained by McNemar's exact test, one-sided at 2.5 %
        open    neither: the cases at hand do not show it
    """
    mine = offences(pair.candidate, pair.runs.preventable)
    theirs = offences(other, pair.runs.preventable)
    counts, total = (
        np.isin(pair.runs.ids, config.accept, invert=True),
        len(pair.runs.ids),
    )
    for name in mine:
        gained = int(np.sum(counts & (mine[name] < theirs[name])))
        lost = int(np.sum(counts & (mine[name] > theirs[name])))
        pairs, margin = (gained, lost), config.margins[name]
        found, p = paired_rates(pairs, total), no_more_faults(*pairs, total, margin)
        fails, passes = found.mean < 0.0 and found.p < 2.0 * ALPHA, p <= ALPHA
        note, title = "", WORDS[name].title
        if not (fails or passes) and no_more_faults(0, 0, total, margin) > ALPHA:
            note = f"{total} cases can never prove a margin of {100 * margin:g} %"
        if trivial:
            name, title = f"{name}, {trivial}", f"as safe as {trivial}: {title}"
        numbers = {"margin": margin, "pairs": pairs, "p": p, "note": note}
        yield _check(kind, name, title, found, fails, passes, **numbers)


def _no_loss(pair: Pair, config: GateConfig) -> Iterator[Check]:
    """Compares rates, impact speeds and progress of all cases, within their margins.

    The suite's families are fixed: rates by Tango's interval over cases, the others by
    Student's t within the families as strata.
    """
    mine, theirs = passes_of(pair.candidate), passes_of(pair.incumbent)
    count = len(pair.runs.ids)
    strata = np.unique(pair.runs.groups, return_inverse=True)[1]
    for name in (*RATES, "impact", "progress"):
        margin, pairs, note, enough = config.margins[name], None, "", True
        if name == "progress":
            found = _clipped(within_strata(*_progress(pair), strata))
        elif name == "impact":
            ours, others = _impacts(pair, config)
            found = _clipped(within_strata(others, ours, strata))
            enough = np.count_nonzero(ours != others) >= MIN_IMPACTS
        else:
            pairs = _discordant(mine[name], theirs[name])
            found = paired_rates(pairs, count)
            if paired_rates((0, 0), count).low <= -margin:
                note = f"{count} cases can never prove a loss below {100 * margin:g} %"
        passes = found.low > -margin
        fails = bool(found.high < 0.0 and not passes and enough)
        title = WORDS[name].title
        numbers = {"margin": margin, "pairs": pairs, "note": note}
        yield _check("no loss", name, title, found, fails, passes, **numbers)


def _recorded(pair: Pair, config: GateConfig) -> Iterator[Check]:
    """Compares safety on held-out drives; vehicles are what is independent.

    A vehicle is lost if the candidate has more of a fault in its drives than the
    incumbent has. Collisions are judged as those of the suite (`_no_more`), the others
    as what must not be lost (`_no_loss`).
    """
    known, kind = pair.likeness, "recorded traffic"
    if known is None or not {CANDIDATE, pair.name} <= known.traffic.keys():
        return
    vehicles, index = np.unique(known.clusters, return_inverse=True)
    if (total := vehicles.size) < MIN_CLUSTERS:
        return  # as the check of likeness says
    mine, theirs = known.traffic[CANDIDATE], known.traffic[pair.name]
    margin = config.recorded
    for name in ("collision", "ttc", "braking"):
        more = np.bincount(index, mine[name] - theirs[name], total)
        pairs, note = (int(np.sum(more < 0.0)), int(np.sum(more > 0.0))), ""
        found, p = paired_rates(pairs, total), no_more_faults(*pairs, total, margin)
        fails, passes = found.mean < 0.0 and found.p < 2.0 * ALPHA, p <= ALPHA
        never = no_more_faults(0, 0, total, margin) > ALPHA
        if name != "collision":
            passes = found.low > -margin
            fails = bool(found.high < 0.0 and not passes)
            never = paired_rates((0, 0), total).low <= -margin
        if not (fails or passes) and never:
            note = f"{total} vehicles can never prove a margin of {100 * margin:g} %"
        name = f"recorded {name}"
        numbers = {"margin": margin, "pairs": pairs, "p": p, "note": note}
        yield _check(kind, name, WORDS[name].title, found, fails, passes, **numbers)
    name, margin = "recorded headway", config.headway
    clusters = ClusterBootstrap(index)
    found = over_clusters(theirs["headway"], mine["headway"], clusters)
    passes = found.low > -margin
    fails = bool(found.high < 0.0 and not passes)
    yield _check(kind, name, WORDS[name].title, found, fails, passes, margin=margin)


def _families(pair: Pair, config: GateConfig) -> Iterator[Check]:
    """Compares clean drives and progress of each family.

    A family passes if its own interval lies above the margin: that all have to pass
    needs no adjustment. It fails if a loss is detected after Holm over families; of
    progress, one of more than `MATERIAL` of the margin.
    """
    names = np.asarray(pair.runs.groups)
    cases = {name: names == name for name in dict.fromkeys(pair.runs.groups)}
    cases = {name: at for name, at in cases.items() if at.sum() > 1}
    mine, theirs = (passes_of(x)["clean"] for x in (pair.candidate, pair.incumbent))
    amounts: dict[str, list[tuple[Difference, tuple[int, int] | None]]] = {
        "clean drives": [],
        "progress": [],
    }
    for at in cases.values():
        pairs, count = _discordant(mine[at], theirs[at]), int(at.sum())
        amounts["clean drives"].append((paired_rates(pairs, count), pairs))
        way = within_strata(*_progress(pair, at), np.zeros(count, int))
        amounts["progress"].append((_clipped(way), None))
    adjusted = {n: holm([x.p for x, _ in found]) for n, found in amounts.items()}
    margins = {"clean drives": config.family_clean, "progress": config.family_progress}
    for i, (name, at) in enumerate(cases.items()):
        for amount, margin in margins.items():
            (found, pairs), p = amounts[amount][i], float(adjusted[amount][i])
            small, enough, note = 0.0, True, ""
            if amount == "progress":
                small, enough = MATERIAL * margin, at.sum() >= MIN_FAMILY
                if not enough:
                    note = f"{at.sum()} cases: expected at least {MIN_FAMILY}"
            yield _check(
                "families",
                f"{name}, {amount}",
                f"{family_title(name)}: {amount}",
                found,
                bool(enough and found.mean < -small and p < LEVEL),
                bool(enough and found.low > -margin),
                margin=margin,
                pairs=pairs,
                p=p,
                note=note,
            )


def _nearer(pair: Pair, other: str) -> Difference | str:
    """Returns the mean of (other's - candidate's distance) by the other's mean.

    Where there is none, says why.

    Raises:
      InputError: no distances of one of the two.
    """
    known = pair.likeness
    if known is None:
        return TO_MEASURE
    vehicles = len(np.unique(known.clusters))
    if vehicles < MIN_CLUSTERS:
        return (
            f"{vehicles} vehicles are too few for an interval over them:"
            f" measure at least {MIN_CLUSTERS}"
        )
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
    pair: Pair, kind: Kind, name: str, title: str, other: str, margin: float | None
) -> Check:
    """Compares the distance to the human with one row's.

    Args:
      pair: the drives.
      kind: of the check.
      name: of the check.
      title: of the check.
      other: name of the row.
      margin: share of that row's distance that the candidate may be farther; None:
        it has to be nearer.
    """
    found = _nearer(pair, other)
    if isinstance(found, str):
        return _unmeasured(kind, name, title, found)
    fails, passes = found.high < 0.0, found.low > -(margin or 0.0)
    numbers = {"margin": margin, "p": found.p}
    return _check(kind, name, title, found, fails, passes, **numbers)


def _likeness(pair: Pair, config: GateConfig) -> Check:
    """Compares the distance to the human with the incumbent's, within its margin."""
    title = f"not farther from the human than {name_of(pair)}"
    return _distance(pair, "likeness", "likeness", title, pair.name, config.likeness)


def _trivial_baselines(pair: Pair, config: GateConfig) -> Iterator[Check]:
    """Compares with each trivial baseline: nearer to the human, and as safe."""
    kind = "trivial baselines"
    for other in config.trivial_baselines:
        title = f"nearer to the human than {other}"
        yield _distance(pair, kind, f"likeness, {other}", title, other, None)
    for other in config.trivial_baselines:
        if other in pair.runs.rows:
            yield from _no_more(kind, pair, pair.runs.rows[other], config, other)
        else:
            note = f"drive {other} on the same cases"
            title = f"as safe as {other}"
            yield _unmeasured(kind, f"safety, {other}", title, note)


def _gains(pair: Pair, config: GateConfig) -> Iterator[Check]:
    """Compares primary metrics and human-likeness; Holm over them.

    A gain has to be seen over families as clusters, and in rates by McNemar's test
    over cases too. A primary metric that is worse by the same tests and by more than
    `config.gain` fails: no gain elsewhere pays for it. Progress has its own margin
    (`_no_loss`), human-likeness its own check (`_likeness`).
    """
    families, index = np.unique(pair.runs.groups, return_inverse=True)
    bootstrap, few = ClusterBootstrap(family_clusters(pair.runs.groups)), ""
    if families.size < MIN_CLUSTERS:
        few = (
            f"{families.size} families: too few for an interval over families"
            f" (at least {MIN_CLUSTERS}); this one is over cases"
        )
    drives = (pair.candidate, pair.incumbent)
    mine, theirs = (passes_of(metrics) for metrics in drives)
    rows: list[tuple[str, Difference, tuple[int, int] | None, float]] = []
    for name in config.primary:
        pairs = None
        if name in COLUMNS:
            both = mine[name].astype(float), theirs[name].astype(float)
            pairs = _discordant(mine[name], theirs[name])
        elif name == "progress":
            both = _progress(pair)
        elif name in FELT:
            a, b = (np.asarray(getattr(m, name), np.float64) for m in drives)
            scale = max(float(b.mean()), 1e-9)
            both = -a / scale, -b / scale
        else:  # nuPlan's score
            way = jnp.asarray(pair.runs.way)
            a, b = (np.asarray(nuplan_score(m, way)[0], np.float64) for m in drives)
            both = a, b
        if few:
            found, p = within_strata(*both, index), 1.0
        else:
            found = over_clusters(*both, bootstrap)
            # both tests have to see it: cases, and families as clusters
            p = found.p if pairs is None else max(mcnemar_exact(*pairs), found.p)
        if name not in FELT:  # which may be any number of times the incumbent's
            found = _clipped(found, high=np.inf if name == "progress" else 1.0)
        rows.append((name, found, pairs, p))
    nearer = _nearer(pair, pair.name)
    if not isinstance(nearer, str):
        rows.append(("likeness", nearer, None, nearer.p))
    adjusted = holm([row[3] for row in rows]).tolist()
    for (name, found, pairs, _), p in zip(rows, adjusted, strict=True):
        judged = name not in ("progress", "likeness")
        yield _check(
            "gain",
            name,
            WORDS[name].title,
            found,
            judged and found.mean < -config.gain and p < LEVEL,
            found.mean > 0.0 and p < LEVEL,
            pairs=pairs,
            p=p,
            note="" if name == "likeness" else few,
        )
