"""The gate's verdict as terminal text and JSON."""

import textwrap
from collections.abc import Mapping
from pathlib import Path

from rcirl_jax.evaluation.closed_loop.output import text_table
from rcirl_jax.evaluation.gate.types import Check, GateConfig, Verdict
from rcirl_jax.evaluation.gate.words import WIDTH, fault_words
from rcirl_jax.runtime.atomic_files import plain, write_json

RANKS = {"fail": 0, "open": 1, "pass": 2}  # the order in which they are shown
OUTCOMES = {"pass": "ok", "fail": "FAIL", "open": "open"}
FIRST = ("sentence", "decision")  # of the JSON


def _percent(share: float) -> str:
    return f"{100.0 * share:+.2f}"


def _cells(check: Check) -> list[str]:
    pairs = "" if check.lost is None else f"+{check.gained} -{check.lost}"
    outcome = OUTCOMES[check.outcome] if check.kind != "gain" else _gain(check)
    if not check.measured:
        return [check.title, outcome, *["", "not measured"], *["", "", ""]]
    return [
        check.title,
        outcome,
        _percent(check.difference),
        f"[{_percent(check.low)}, {_percent(check.high)}]",
        "" if check.margin is None else f"-{100.0 * check.margin:g}",
        pairs,
        "" if check.p is None else f"{check.p:.3f}",
    ]


def _gain(check: Check) -> str:
    return {"pass": "better", "fail": "FAIL", "open": "-"}[check.outcome]


TITLES = {
    "safety": "Not more cases with a fault (p: of as many more as the margin)",
    "no loss": "No loss beyond the margin, over all cases",
    "families": "No loss beyond the margin in any family (p: Holm; the ten worst)",
    "trivial baselines": "Ahead of rewards that know nothing",
    "likeness": "Not farther from the human",
    "gain": "Better somewhere, worse nowhere (Holm over the primary metrics)",
}
WORST_FAMILIES = 10  # rows of the terminal table; the JSON has all


def _shown(kind: str, checks: list[Check]) -> list[Check]:
    """All, or of the families those that failed or lost most."""
    if kind != "families":
        return checks
    ranked = sorted(checks, key=lambda c: (RANKS[c.outcome], c.difference))
    return ranked[:WORST_FAMILIES]


def format_verdict(verdict: Verdict) -> str:
    """The sentence and decision first, then every kind of check as a table."""
    lines = textwrap.wrap(verdict.sentence, WIDTH)
    lines += ["", f"verdict: {verdict.decision.upper()}"]
    lines += [line for reason in verdict.reasons for line in _item(reason)]
    lines += ["", f"{verdict.cases:,} cases of {verdict.families} families; % of cases"]
    if verdict.part:
        lines += textwrap.wrap(f"a part of the suite: {verdict.part}", WIDTH)
    header = ["", "", "difference", "95 %", "margin", "cases", "p"]
    for kind, title in TITLES.items():
        checks = [check for check in verdict.checks if check.kind == kind]
        rows = [_cells(check) for check in _shown(kind, checks)]
        if rows:
            lines += ["", title, *text_table(header, rows)]
    if verdict.new_faults:
        lines += ["", "Cases with a new fault; --accept=ID,... of those that may stay"]
        for fault in verdict.new_faults:
            lines += _item(fault_words(fault))
    if verdict.look_at:
        named = ", ".join(verdict.look_at)
        lines += ["", *textwrap.wrap(f"look first at: {named}", WIDTH)]
    return "\n".join(lines) + "\n"


def _item(said: str) -> list[str]:
    return textwrap.wrap(said, WIDTH, initial_indent="  - ", subsequent_indent="    ")


def write_verdict(
    path: Path, verdict: Verdict, config: GateConfig, facts: Mapping[str, object]
) -> None:
    """Verdict, margins and `facts` (files, hashes, provenance) as JSON."""
    body = {
        "sentence": verdict.sentence,
        "decision": verdict.decision,
        "exit_code": verdict.exit_code,
        **{k: v for k, v in plain(verdict).items() if k not in FIRST},
        "config": plain(config),
        **facts,
    }
    write_json(path, body)
