"""What the gate and the suite say, as tables and cards of the report."""

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
from rcirl_jax.report.charts import forest_axis, forest_cell
from rcirl_jax.report.pages import Table, interval, number, part
from rcirl_jax.simulation.metrics import COLUMNS

SIGNIFICANT = 1.0 - CONFIDENCE
LEVEL = f"{100.0 * CONFIDENCE:g} %"
DECISIONS = {  # classes of the decisions
    "ship": "ship",
    "do not ship": "refused",
    "no difference": "refused",
    "could not judge": "open",
}
SAFETY = {"fail": "refused", "open": "open"}  # of the card, by the worst outcome
# families have a section of their own
KINDS = ("safety", "no loss", "trivial baselines", "likeness", "gain")


def verdict_view(verdict: Verdict) -> dict:
    """The decision and why, for the template."""
    return {
        "kind": DECISIONS[verdict.decision],
        "sentence": verdict.sentence,
        "reasons": verdict.reasons,
        "cases": verdict.cases,
        "families": verdict.families,
        "part": verdict.part,
    }


def checks_tables(verdict: Verdict) -> list[Table]:
    """Checks over all cases, a forest plot for each kind."""
    tables = []
    for kind in KINDS:
        checks = [check for check in verdict.checks if check.kind == kind]
        if checks:
            tables.append(forest(TITLES[kind], checks, [c.title for c in checks]))
    return tables


def margins_table(gate: GateConfig) -> Table:
    """What counts as no loss."""
    margins = [
        (name.replace("_", " "), f"{100.0 * value:g} %")
        for name, value in gate.margins.items()
    ]
    rows = [*margins, ("primary metrics", ", ".join(gate.primary))]
    return Table(caption="Margins, declared before", heads=("", ""), rows=rows)


def forest(title: str, checks: Sequence[Check], names: Sequence[str]) -> Table:
    """Checks as rows of a forest plot on one axis, with their numbers."""
    measured = [check for check in checks if check.measured]
    limit = max(
        [
            0.1,
            *(100.0 * max(abs(c.low), abs(c.high), c.margin or 0.0) for c in measured),
        ]
    )
    rows: list[Sequence[object]] = [("", forest_axis(limit, "%"), "", "", "")]
    failing = []
    for name, check in zip(names, checks, strict=True):
        word, kind = outcome_of(check)
        said = part("outcome", kind, word, check.note if check.measured else "")
        if not check.measured:
            rows.append((name, "", "not measured", check.note, said))
            continue
        found = 100.0 * check.difference, 100.0 * check.low, 100.0 * check.high
        numbers = interval(found, 2, signed=True) + " %"
        if kind == "fail":
            failing.append(name)
        cell = forest_cell(
            found,
            limit=limit,
            margin=None if check.margin is None else 100.0 * check.margin,
            failed=kind == "fail",
            words=f"{name}: {numbers}, {word}",
        )
        rows.append((name, cell, numbers, _evidence(check), said))
    heads = ("", "", f"difference [{LEVEL}]", "margin, cases, p", "")
    return Table(caption=title, heads=heads, rows=rows, kind="forest", marked=failing)


def outcome_of(check: Check) -> tuple[str, str]:
    """Word and class; a gain that is missing is no failure of the gate."""
    if check.kind != "gain" or check.outcome == "fail":
        return OUTCOMES[check.outcome], check.outcome
    if check.outcome == "pass":
        return "better", "pass"
    worse = check.difference < 0.0 and (check.p or 0.0) < SIGNIFICANT
    return ("worse", "open") if worse else ("no difference", "open")


def _evidence(check: Check) -> str:
    """Margin, cases that only one of them passes, and the p value."""
    margin = "" if check.margin is None else f"−{100.0 * check.margin:g} %"
    pairs = "" if check.lost is None else f"+{check.gained} −{check.lost}"
    p = "" if check.p is None else _p(check.p)
    return ", ".join(filter(None, (margin, pairs, p)))


def _p(p: float) -> str:
    return f"p {p:.3f}" if p >= 0.001 else "p < 0.001"


def families_tables(verdict: Verdict) -> list[Table]:
    """Two forest plots: clean drives and progress per family, the worst first."""
    tables = []
    for kind in ("clean drives", "progress"):
        checks = [
            check
            for check in verdict.checks
            if check.kind == "families" and check.name.endswith(f", {kind}")
        ]
        checks.sort(key=lambda c: (RANKS[c.outcome], c.difference))
        if checks:
            names = [check.title.removesuffix(f": {kind}") for check in checks]
            tables.append(forest(kind.capitalize(), checks, names))
    return tables


def suite_view(suite: SuiteReport, marked: Sequence[str]) -> dict:
    """The paper's table per case and per sample, safety and progress, differences."""
    lead = (
        f"{suite.cases:,} cases of {len(suite.families)} groups; {suite.preventable:,} "
        f"preventable by a careful driver, {suite.trivial:,} trivial."
    )
    heads = ("", *(SHORT[name] for name in COLUMNS))
    paper = [(name, *(f"{x:.2f}" for x in row)) for name, row in PAPER.items()]
    tables = []
    for field, title in (
        ("per_case", "Per case: every sample inside the bound, no at-fault collision"),
        ("per_sample", "Per sample: 10 Hz; intervals take samples for independent"),
    ):
        rows = [
            (name, *(_rate(getattr(row, field)[c]) for c in COLUMNS))
            for name, row in suite.rows.items()
        ]
        found = Table(caption=title, heads=heads, rows=[*rows, *paper], marked=marked)
        tables.append(found)
    tables.append(_safety(suite.rows, suite.reference, marked))
    if suite.comparisons:
        tables.append(_comparisons(suite.comparisons))
    return {"lead": lead, "tables": tables}


def _rate(rate: Rate) -> str:
    if rate.bound is not None:
        digits = 2 if rate.bound < 0.9999 else 4
        return f"100 (≥ {100.0 * rate.bound:.{digits}f})"
    low, high = 100.0 * rate.low, 100.0 * rate.high
    return f"{100.0 * rate.rate:.2f} [{low:.1f}, {high:.1f}]"


def _safety(
    rows: Mapping[str, RowSummary], reference: str, marked: Sequence[str]
) -> Table:
    heads = (
        "", "at-fault collisions", "preventable", "with pedestrians, cyclists",
        "collisions", "red lights", "stop signs", "off road", "progress",
        f"nuPlan [{LEVEL}]",
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
    title = f"Safety (counts) and progress, % of {reference}'s"
    return Table(caption=title, heads=heads, rows=body, marked=marked)


def _comparisons(comparisons: Sequence[Comparison]) -> Table:
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
    return Table(caption=title, heads=heads, rows=rows, kind="wrap")


def cards(
    verdict: Verdict, suite: SuiteReport, incumbent: str
) -> list[dict[str, object]]:
    """Five cards: cases, nearer to the human, safety, comfort, progress."""
    new = len(verdict.new_faults)
    return [
        {
            "title": "Cases driven",
            "value": f"{verdict.cases:,}",
            "words": f"of {verdict.families} families, {new} with a new fault",
            "kind": DECISIONS[verdict.decision],
        },
        _amount(verdict, "Nearer to the human", ("likeness",), "on held-out drives"),
        _safety_card(verdict, suite, incumbent),
        _amount(
            verdict,
            "Comfort",
            ("a_station", "j_station"),
            "points of all drives: within 4 m/s² / 6 m/s³",
        ),
        _amount(verdict, "Progress", ("progress",), f"of {incumbent}'s"),
    ]


def _amount(
    verdict: Verdict, title: str, names: Sequence[str], words: str
) -> dict[str, object]:
    """A card on checks that measure an amount; the worst outcome colours it."""
    ranked = ("gain", "likeness", "no loss", "trivial baselines")
    known = {
        name: [c for c in verdict.checks if c.name == name and c.measured]
        for name in names
    }
    found = [
        min(checks, key=lambda c: ranked.index(c.kind))
        for checks in known.values()
        if checks
    ]
    if not found:
        return {"title": title, "value": "–", "words": "not measured", "kind": "open"}
    values = " / ".join(number(100.0 * c.difference, 1, signed=True) for c in found)
    ends = "; ".join(
        f"[{number(100.0 * c.low, 1)}, {number(100.0 * c.high, 1)}]" for c in found
    )
    every = [c for checks in known.values() for c in checks]
    kind = "refused" if any(c.outcome == "fail" for c in every) else "open"
    if kind == "open" and all(c.low > 0.0 for c in found):
        kind = "ship"
    unit = "" if words.startswith("points") else " %"
    return {
        "title": title,
        "value": values + unit,
        "words": f"{words} {ends}",
        "kind": kind,
    }


def _safety_card(
    verdict: Verdict, suite: SuiteReport, incumbent: str
) -> dict[str, object]:
    mine = next(iter(suite.rows.values()))
    theirs = suite.rows[incumbent]
    outcomes = {c.outcome for c in verdict.checks if c.kind == "safety"}
    more = mine.at_fault > theirs.at_fault and outcomes == {"pass"}
    return {
        "title": "Safety",
        "value": f"{mine.at_fault} / {theirs.at_fault}",
        "words": "at-fault collisions, candidate / incumbent; red lights "
        f"{mine.red_lights} / {theirs.red_lights}, stop signs {mine.stop_signs} / "
        f"{theirs.stop_signs}{'; no more than the margin allows' if more else ''}",
        "kind": next((SAFETY[x] for x in ("fail", "open") if x in outcomes), "ship"),
    }
