"""May a candidate replace the incumbent? Tests on the same closed-loop cases.

Six kinds of check, none of them on a learned reward:

    safety      not more cases with a preventable at-fault collision, a
                collision with a pedestrian or cyclist, a red light or a stop sign run
                than the incumbent, up to a declared margin (`gate_safety`)
    no loss     rates and progress over all cases are not worse than the incumbent's
                by more than a margin: the lower end of the paired 95 % interval over
                cases lies above it
    families    in no family more clean drives or progress are lost than a margin. All
                families have to show it, so none is adjusted; a loss is detected
                (exact McNemar, t) only after Holm over families
    trivial baselines   nearer to the human than rewards that know nothing, and as
                safe
    likeness    not farther from the human than the incumbent (`gate_likeness`)
    gain        better in one primary metric or in human-likeness, at least: McNemar
                and families as clusters, Holm over them; and in no primary metric
                worse by the same tests and more than a margin

A check passes, fails, or is open: what was measured does not show it either way. Ship
needs every check passed, a gain and the full suite; one failed check refuses; else,
open checks, or a part of the suite only, make the gate unable to judge. A case with a
new fault that a person accepts no longer counts in the tests of safety. Host numpy,
float64. `C` cases.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate import likeness as gate_likeness
from rcirl_jax.evaluation.gate.checks import (
    families,
    gains,
    is_clean,
    no_loss,
    passes_of,
)
from rcirl_jax.evaluation.gate.safety import new_faults, safety, trivial_safety
from rcirl_jax.evaluation.gate.types import Check, Decision, GateConfig, Pair, Verdict
from rcirl_jax.evaluation.gate.words import family_of, sentence

WORST = 20  # cases named for a person to look at
MIN_CASES = 30  # below, no interval means anything


def judge(pair: Pair, config: GateConfig, part: str = "") -> Verdict:
    """All checks on one pair of rows.

    Args:
      pair: the drives.
      config: margins.
      part: what was left out of the suite, in words; then nothing ships.

    Raises:
      InputError: fewer than `MIN_CASES` cases, an accepted id that is no new fault,
        or no distances of a row that human-likeness is compared with.
    """
    count = len(pair.ids)
    if count < MIN_CASES:
        raise InputError(f"gate: {count} cases: expected at least {MIN_CASES}")
    faults = new_faults(pair, config.accept)
    checks = (
        *safety(pair, config),
        *no_loss(pair, config),
        *families(pair, config),
        *gate_likeness.against_trivial(pair, config),
        *trivial_safety(pair, config),
        *gate_likeness.against_incumbent(pair),
        *gains(pair, config),
    )
    decision, reasons = _decide(checks)
    if part and decision == "ship":
        decision = "could not judge"
        reasons = (f"{part}: nothing ships on a part of the suite", *reasons)
    verdict = Verdict(
        decision=decision,
        sentence="",
        reasons=reasons,
        checks=checks,
        cases=count,
        families=len(set(pair.families)),
        new_faults=faults,
        look_at=_look_at(pair, checks, [f.case for f in faults if not f.accepted]),
        part=part,
    )
    return dataclasses.replace(verdict, sentence=sentence(pair, verdict))


def _decide(checks: Sequence[Check]) -> tuple[Decision, tuple[str, ...]]:
    failed = [check for check in checks if check.outcome == "fail"]
    needed = [check for check in checks if check.kind != "gain"]
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
    if not check.measured:
        return f"{check.kind}: {check.title}: {check.note}"
    pairs = ""
    if check.lost is not None:
        pairs = f", better in {check.gained} cases, worse in {check.lost}"
    return (
        f"{check.kind}: {check.title}: {100 * check.difference:+.2f} "
        f"[{100 * check.low:+.2f}, {100 * check.high:+.2f}] %{pairs}"
        + (f"; {check.note}" if check.note else "")
    )


def _look_at(
    pair: Pair, checks: Sequence[Check], new: Sequence[str]
) -> tuple[str, ...]:
    """Cases that only one of them drives cleanly, or far apart; losses first.

    Before them new faults that nobody has accepted, if safety is not shown, and the
    worst of every family that failed.
    """
    mine, theirs = passes_of(pair.candidate), passes_of(pair.incumbent)
    faults = 8.0 * np.isin(pair.ids, new)
    lost = 4.0 * (~is_clean(pair.candidate) & is_clean(pair.incumbent))
    way = np.asarray(pair.candidate.progress) - np.asarray(pair.incumbent.progress)
    behind = np.clip(-way / np.maximum(pair.incumbent.progress, 1.0), 0.0, 1.0)
    comfort = 0.5 * (~mine["j_station"] & theirs["j_station"])
    key = faults + lost + behind + comfort
    order = [int(i) for i in np.argsort(-key, kind="stable") if key[i] > 0]
    failed = {family_of(c) for c in checks if c.outcome == "fail"}
    firsts: dict[str, int] = {}
    for i in order:
        if pair.families[i] in failed:
            firsts.setdefault(pair.families[i], i)
    unsafe = any(c.kind == "safety" and c.outcome != "pass" for c in checks)
    first = [i for i in order if unsafe and pair.ids[i] in new]
    found = dict.fromkeys([*first, *firsts.values(), *order])
    return tuple(pair.ids[i] for i in list(found)[:WORST])
