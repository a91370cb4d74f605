"""May a candidate replace the incumbent? Tests on the same closed-loop cases.

Ship needs every check of `checks` passed, a gain and the full suite; one failed check
refuses; else, open checks, or a part of the suite only, make the gate unable to judge.
A case with a new fault that a person accepts no longer counts in the tests of safety.
Host numpy, float64. `C` cases.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.runs import SuiteRuns
from rcirl_jax.evaluation.closed_loop.suite import SuiteConfig, SuiteResult
from rcirl_jax.evaluation.closed_loop.summary import result_hash
from rcirl_jax.evaluation.gate import checks as rules
from rcirl_jax.evaluation.gate.types import (
    CANDIDATE,
    INCUMBENT,
    Check,
    Decision,
    GateConfig,
    Likeness,
    Pair,
    Verdict,
)
from rcirl_jax.evaluation.gate.words import family_of, reason, sentence
from rcirl_jax.runtime.atomic_files import plain, write_json
from rcirl_jax.simulation.rollout import LANES
from rcirl_jax.simulation.rows import TRIVIAL_BASELINES, Row
from rcirl_jax.simulation.suite import drive_row, rollout_config

WORST = 20  # cases named for a person to look at
MIN_CASES = 30  # below, no interval means anything


def pair_of(
    runs: SuiteRuns,
    incumbent: str = INCUMBENT,
    trivial: Sequence[str] = TRIVIAL_BASELINES,
    likeness: Likeness | None = None,
    *,
    candidate: str = CANDIDATE,
) -> Pair:
    """Takes candidate, incumbent and trivial baselines from a driven suite.

    Args:
      runs: the drives.
      incumbent: name of its row.
      trivial: names of rows that the candidate has to be ahead of; those that the suite
        does not have are left out.
      likeness: distances to the human, where they were measured.
      candidate: name of its row.

    Raises:
      InputError: the suite has no such rows.
    """
    for name in (candidate, incumbent):
        if name not in runs.rows:
            raise InputError(f"gate: {name}: expected a row of {', '.join(runs.rows)}")
    return Pair(
        candidate=runs.rows[candidate],
        incumbent=runs.rows[incumbent],
        families=runs.groups,
        ids=runs.ids,
        reference=np.asarray(runs.way, np.float64),
        preventable=np.asarray(runs.preventable, bool),
        name=incumbent,
        trivial_baselines={n: runs.rows[n] for n in trivial if n in runs.rows},
        likeness=likeness,
    )


def repeats(row: Row, result: SuiteResult, config: SuiteConfig) -> None:
    """Drives the first cases once more; a verdict needs drives that repeat.

    Raises:
      InputError: another result than in the suite.
    """
    cases, count = result.cases, min(LANES, len(result.cases.ids))
    rollout = rollout_config(row, cases.duration_s, config.plan_every)
    again = drive_row(row, cases.build, count, rollout, chunk=LANES)
    before = jax.tree.map(lambda x: x[:count], result.runs[row.name])
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
      part: what was left out of the suite, in words; then nothing ships.

    Raises:
      InputError: fewer than `MIN_CASES` cases, an accepted id that is no new fault,
        or no distances of a row that human-likeness is compared with.
    """
    count = len(pair.ids)
    if count < MIN_CASES:
        raise InputError(f"gate: {count} cases: expected at least {MIN_CASES}")
    faults = rules.new_faults(pair, config.accept)
    checks = (
        *rules.safety(pair, config),
        *rules.no_loss(pair, config),
        *rules.families(pair, config),
        *rules.trivial_baselines(pair, config),
        *rules.likeness(pair),
        *rules.gains(pair, config),
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


def _look_at(
    pair: Pair, checks: Sequence[Check], new: Sequence[str]
) -> tuple[str, ...]:
    """Names cases that only one of them drives cleanly, or far apart; losses first.

    Before them new faults that nobody has accepted, if safety is not shown, and the
    worst of every family that failed.
    """
    mine, theirs = (rules.passes_of(x) for x in (pair.candidate, pair.incumbent))
    faults = 8.0 * np.isin(pair.ids, new)
    lost = 4.0 * (~rules.is_clean(pair.candidate) & rules.is_clean(pair.incumbent))
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


def write_verdict(
    path: Path, verdict: Verdict, config: GateConfig, facts: Mapping[str, object]
) -> None:
    """Writes verdict, margins and `facts` (files, hashes, provenance) as JSON."""
    first = {"sentence": verdict.sentence, "decision": verdict.decision}
    body = {**first, "exit_code": verdict.exit_code, **plain(verdict)}
    write_json(path, {**body, "config": plain(config), **facts})
