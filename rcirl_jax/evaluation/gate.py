"""May a candidate replace the incumbent? Tests on the same closed-loop cases.

Four kinds of check, none of them on a learned reward:

    safety      no case in which the candidate has more faults, hits more people, runs
                more red lights or stop signs than the incumbent: zero, not few
    no loss     rates and progress over all cases are not worse than the incumbent's
                by more than a declared margin: the lower end of the paired 97.5 %
                interval lies above it. Rates by Tango's score interval and by the
                clusters (families), both; progress by the latter
    families    in no family more clean drives or way are lost than a margin: by
                Tango's interval, and by Student's t over cases. All families have to
                show it, so none is adjusted; a loss is detected (exact McNemar, t) only
                after Holm over families
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

from collections.abc import Sequence

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate_checks import (
    families,
    family_of,
    gains,
    is_clean,
    no_loss,
    passes_of,
    safety,
)
from rcirl_jax.evaluation.gate_types import Check, Decision, GateConfig, Pair, Verdict

WORST = 20  # cases named for a person to look at
MIN_CASES = 30  # below, no interval means anything


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
        *safety(pair),
        *no_loss(pair, config),
        *families(pair, config),
        *gains(pair, config),
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
        look_at=_look_at(pair, checks),
        part=part,
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


def _look_at(pair: Pair, checks: Sequence[Check]) -> tuple[str, ...]:
    """Cases that only one of them drives cleanly, or far apart; losses first.

    Before them the worst of every family that failed.
    """
    mine, theirs = passes_of(pair.candidate), passes_of(pair.incumbent)
    faults = 8.0 * (~mine["collision_free"] & theirs["collision_free"])
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
    found = dict.fromkeys([*firsts.values(), *order])
    return tuple(pair.ids[i] for i in list(found)[:WORST])
