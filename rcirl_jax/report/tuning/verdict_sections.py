"""What the gate and the suite say, as HTML: verdict, table of the paper, families."""

from collections.abc import Mapping, Sequence

from rcirl_jax.evaluation.closed_loop.output import SHORT
from rcirl_jax.evaluation.closed_loop.summary import (
    PAPER,
    Comparison,
    Rate,
    RowSummary,
    SuiteReport,
)
from rcirl_jax.evaluation.exact import CONFIDENCE
from rcirl_jax.evaluation.gate.output import OUTCOMES, RANKS, TITLES
from rcirl_jax.evaluation.gate.types import Check, GateConfig, Verdict
from rcirl_jax.report.charts import interval_axis, interval_cell
from rcirl_jax.report.markup import Markup, folded, interval, table, text
from rcirl_jax.simulation.metrics import COLUMNS

SIGNIFICANT = 1.0 - CONFIDENCE
LEVEL = f"{100.0 * CONFIDENCE:g} %"
DECISIONS = {  # class, what it means
    "ship": ("ship", "Ship: the candidate may replace the incumbent."),
    "do not ship": (
        "refused",
        "Do not ship: the candidate is worse where it must not be.",
    ),
    "no difference": (
        "refused",
        "No difference: keep the incumbent. Nothing is worse beyond the margins, and "
        "nothing is better.",
    ),
    "could not judge": (
        "open",
        "Could not judge: too few cases to prove that nothing is lost. Keep the "
        "incumbent, or drive more cases.",
    ),
}
# families have a section of their own
KINDS = ("safety", "no loss", "nulls", "likeness", "gain")


def verdict_section(
    verdict: Verdict, gate: GateConfig, incumbent: str, played: Sequence[str]
) -> str:
    """Decision in words, reasons, checks over all cases, what to look at.

    Args:
      verdict: of `evaluation.gate.decision.judge`.
      gate: its margins.
      incumbent: name of the row that was compared with.
      played: ids of the cases in the player, in its order.
    """
    kind, words = DECISIONS[verdict.decision]
    reasons = "".join(f"<li>{text(reason)}</li>" for reason in verdict.reasons)
    parts = [
        f'<div class="decision {kind}"><strong>{text(words)}</strong>'
        f"<p>{text(verdict.sentence)}</p><ul>{reasons}</ul></div>",
        f"<p>Candidate against {text(incumbent)} on the same {verdict.cases:,} cases "
        f"of {verdict.families} families; differences are candidate minus incumbent, "
        f"in % of cases or of the incumbent's way, with {LEVEL} intervals."
        + (f" A part of the suite: {text(verdict.part)}." if verdict.part else "")
        + "</p>",
        _look_at(verdict, played),
    ]
    for name in KINDS:
        checks = [check for check in verdict.checks if check.kind == name]
        if checks:
            names = [check.name.replace("_", " ") for check in checks]
            parts.append(forest(TITLES[name], checks, names))
    rows = [(name.replace("_", " "), value) for name, value in _margins(gate)]
    parts.append(folded("Margins, declared before", table("", ("", ""), rows)))
    return "\n".join(parts)


def _margins(gate: GateConfig) -> list[tuple[str, str]]:
    found = {k: v for k, v in vars(gate).items() if isinstance(v, float)}
    margins = [(name, f"{100.0 * value:g} %") for name, value in found.items()]
    return [*margins, ("primary metrics", ", ".join(gate.primary))]


def _look_at(verdict: Verdict, played: Sequence[str]) -> str:
    """Cases that differ most, those in the player as links to it."""
    if not verdict.look_at:
        return "<p>No case is driven worse by the candidate.</p>"
    items = []
    for case in verdict.look_at:
        name = text(case)
        if case in played:
            place = list(played).index(case)
            name = f'<a href="#player" data-case="{place}">{name}</a>'
        items.append(name)
    return (
        f"<p>Look first at: {', '.join(items)}. Links play here; any case is driven "
        "and drawn again by <code>python -m experiments.replay --weights=FILE "
        "--case=ID --output=DIR</code>.</p>"
    )


def forest(title: str, checks: Sequence[Check], names: Sequence[str]) -> str:
    """Checks as rows of a forest plot on one axis, with their numbers."""
    limit = max(100.0 * max(abs(c.low), abs(c.high), c.margin or 0.0) for c in checks)
    limit = max(limit, 0.1)
    rows: list[Sequence[object]] = [("", interval_axis(limit, "%"), "", "", "")]
    failing = []
    for name, check in zip(names, checks, strict=True):
        value, low, high = (
            100.0 * x for x in (check.difference, check.low, check.high)
        )
        numbers = interval((value, low, high), 2, signed=True) + " %"
        word, kind = outcome_of(check)
        if kind == "fail":
            failing.append(name)
        cell = interval_cell(
            value,
            low,
            high,
            limit=limit,
            margin=None if check.margin is None else 100.0 * check.margin,
            failed=kind == "fail",
            words=f"{name}: {numbers}, {word}",
        )
        said = Markup(f'<span class="outcome {kind}">{word}</span>')
        rows.append((name, cell, numbers, _evidence(check), said))
    heads = ("", "", f"difference [{LEVEL}]", "cases, p", "")
    return table(title, heads, rows, kind="forest", marked=failing)


def outcome_of(check: Check) -> tuple[str, str]:
    """Word and class; a gain that is missing is no failure of the gate."""
    if check.kind != "gain" or check.outcome == "fail":
        return OUTCOMES[check.outcome], check.outcome
    if check.outcome == "pass":
        return "better", "pass"
    worse = check.difference < 0.0 and (check.p or 0.0) < SIGNIFICANT
    return ("worse", "open") if worse else ("no difference", "open")


def _evidence(check: Check) -> str:
    """Cases that only one of them passes, and the p value."""
    pairs = "" if check.lost is None else f"+{check.gained} −{check.lost}"
    return ", ".join(filter(None, (pairs, "" if check.p is None else _p(check.p))))


def _p(p: float) -> str:
    return f"p {p:.3f}" if p >= 0.001 else "p < 0.001"


def families_section(verdict: Verdict) -> str:
    """Two forest plots: clean drives and progress per family, the worst first."""
    plots = []
    for kind in ("clean drives", "progress"):
        checks = [
            check
            for check in verdict.checks
            if check.kind == "families" and check.name.endswith(f", {kind}")
        ]
        checks.sort(key=lambda c: (RANKS[c.outcome], c.difference))
        if checks:
            names = [check.name.removesuffix(f", {kind}") for check in checks]
            plots.append(forest(kind.capitalize(), checks, names))
    if not plots:
        return "<p>No family has two cases or more.</p>"
    lead = (
        "<p>Candidate minus incumbent per family, the worst first. A family passes if "
        "its interval lies above the dashed margin, and fails (square) if a loss is "
        "detected with p &lt; 0.05 after Holm over the families; else it is open: too "
        "few cases. Intervals are per family and not adjusted. Cases: only the "
        "candidate clean, only the incumbent.</p>"
    )
    return "\n".join([lead, *plots])


def suite_section(suite: SuiteReport, marked: Sequence[str]) -> str:
    """The paper's table per case and per sample, safety and progress, differences."""
    parts = [
        f"<p>{suite.cases:,} cases of {len(suite.families)} groups; "
        f"{suite.preventable:,} preventable by a careful driver, {suite.trivial:,} "
        f"trivial. Cells: % with the exact {LEVEL} interval; (≥): rule of three where "
        "nothing failed.</p>"
    ]
    heads = ("", *(SHORT[name] for name in COLUMNS))
    paper = [(name, *(f"{x:.2f}" for x in row)) for name, row in PAPER.items()]
    for field, title in (
        (
            "per_case",
            "Per case: every sample of a drive inside the bound, no own fault",
        ),
        ("per_sample", "Per sample: 10 Hz; intervals take samples for independent"),
    ):
        rows = [
            (name, *(_rate(getattr(row, field)[c]) for c in COLUMNS))
            for name, row in suite.rows.items()
        ]
        parts.append(table(title, heads, [*rows, *paper], marked=marked))
    parts.append(_safety(suite.rows, suite.reference, marked))
    if suite.comparisons:
        parts.append(_comparisons(suite.comparisons))
    return "\n".join(parts)


def _rate(rate: Rate) -> str:
    if rate.bound is not None:
        digits = 2 if rate.bound < 0.9999 else 4
        return f"100 (≥ {100.0 * rate.bound:.{digits}f})"
    low, high = 100.0 * rate.low, 100.0 * rate.high
    return f"{100.0 * rate.rate:.2f} [{low:.1f}, {high:.1f}]"


def _safety(
    rows: Mapping[str, RowSummary], reference: str, marked: Sequence[str]
) -> str:
    heads = (
        "", "own faults", "preventable", "to pedestrians, cyclists", "collisions",
        "red lights", "stop signs", "off road", "progress", f"nuPlan [{LEVEL}]",
    )  # fmt: skip
    body = [
        (
            name,
            row.at_fault,
            row.at_fault_preventable,
            row.at_fault_vru,
            row.collisions,
            row.red_lights,
            row.stop_signs,
            row.off_road,
            f"{100.0 * row.progress_ratio:.1f} %",
            interval((row.nuplan, row.nuplan_low, row.nuplan_high), 1, scale=100.0),
        )
        for name, row in rows.items()
    ]  # fmt: skip
    title = f"Safety (counts) and progress, % of {reference}'s way"
    return table(title, heads, body, marked=marked)


def _comparisons(comparisons: Sequence[Comparison]) -> str:
    """First row minus every other; what is not significant is said to be none."""
    first = comparisons[0].a
    heads = ("", *(SHORT[name] for name in COLUMNS), "progress, m", "nuPlan")
    rows = []
    for one in comparisons:
        cells: list[object] = [one.b]
        for name in COLUMNS:
            wins, losses, _, p = one.columns[name]
            is_known = p < SIGNIFICANT and one.over_families[name].is_apart
            said = "" if is_known else " no difference"
            cells.append(f"+{wins} −{losses}, {_p(p)}{said}")
        for found, scale in ((one.progress_m, 1.0), (one.nuplan, 100.0)):
            values = (found.mean, found.low, found.high)
            none = "" if found.is_apart else " no difference"
            cells.append(interval(values, 1, scale=scale, signed=True) + none)
        rows.append(cells)
    title = (
        f"{first} against each row on the same cases: drives only it passes, only the "
        "other passes (exact McNemar, Holm over the columns); no difference also where "
        "the interval over families contains 0"
    )
    return table(title, heads, rows, kind="wrap")
