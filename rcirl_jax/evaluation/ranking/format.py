"""The ranking report as aligned plain text for a terminal, or as Markdown."""

import textwrap
from collections.abc import Sequence

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking.metrics import METRICS
from rcirl_jax.evaluation.ranking.table import (
    FEW_VEHICLES,
    MIN_WIDTH,
    RIVALS,
    SIGNIFICANT,
    RankingReport,
)
from rcirl_jax.evaluation.statistics import Estimate

_IN_MARKDOWN = (
    "top1_fde",
    "top1_fde_failure",
    "top3_fde",
    "top1_ade",
    "mrr",
    "nll",
    "percentile_rank",
    "crash_rate",
)


def format_table(
    report: RankingReport, width: int = 110, *, differences: bool = True
) -> str:
    """The report as aligned plain text for a terminal.

    Rows: learned scorers first, then the rivals; columns wrap into blocks that
    fit. A share of 0 or 100 % is printed with its exact bound. Below: learned
    rows minus each reference row (all rows, if none is learned).

    Args:
      report: from `build_report`.
      width: characters per line, at least `MIN_WIDTH`.
      differences: with the paired differences; many rows make thousands of lines.
    """
    if width < MIN_WIDTH:
        raise InputError(f"format_table: width: {width}: expected at least {MIN_WIDTH}")
    names = _order(report)
    learned = [name for name in names if name not in RIVALS]
    lines = [line for text in _heading(report) for line in textwrap.wrap(text, width)]
    labels = [_label(report, name) for name in names]
    first = max(len(label) for label in labels)
    columns = {name: _column(report, name, names) for name in METRICS}
    labels = ["", "", *(x for label in labels for x in (label, "  sd over runs"))]
    first = max(first, len("  sd over runs"))
    block: list[str] = []
    for name in METRICS:
        used = sum(len(columns[x][0]) + 2 for x in [*block, name])
        if block and first + used > width:
            lines += _block(labels, first, [columns[x] for x in block])
            block = []
        block.append(name)
    lines += _block(labels, first, [columns[x] for x in block])
    lines += _medians(report, names)
    lines += _differences(report, learned or names) if differences else []
    return "\n".join(lines) + "\n"


def markdown_table(report: RankingReport, against: str = "GAN") -> str:
    """The report's main columns as one Markdown table, a line per row.

    The last column is the paired difference in top-1 FDE to the row `against`, if
    there is one, with its p value by Holm's correction over the learned rows (the
    rivals apart) and all compared metrics.
    """
    titles = ["row", *(f"{METRICS[x].title}, {METRICS[x].unit}" for x in _IN_MARKDOWN)]
    apart = {
        c.row: f"{c.difference.mean:+.2f} [{c.difference.low:+.2f}, "
        f"{c.difference.high:+.2f}], p "
        + ("< 0.01" if c.p_holm < 0.01 else f"{c.p_holm:.2f}")
        for c in report.comparisons
        if c.reference == against and c.metric == "top1_fde"
    }
    titles += [f"top-1 minus {against}, m, Holm"] if apart else []
    lines = [titles, ["---"] * len(titles)]
    for name in _order(report):
        cells = [_label(report, name)]
        cells += [_cell(report.rows[name][x], METRICS[x].unit) for x in _IN_MARKDOWN]
        lines.append(cells + ([apart.get(name, "")] if apart else []))
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _order(report: RankingReport) -> list[str]:
    """Learned rows first, then the rivals in their order."""
    learned = [name for name in report.rows if name not in RIVALS]
    return [*learned, *(name for name in RIVALS if name in report.rows)]


def _heading(report: RankingReport) -> list[str]:
    counts = ", ".join(f"{n:,} {name}" for name, n in report.counts.items())
    mean, median = report.oracle_floor, report.oracle_floor_median
    level = f"{100.0 * report.confidence:g} %"
    heading = [
        f"Ranking at {report.horizon_s:g} s: {counts}.",
        "Oracle floor, FDE of the best candidate: "
        f"mean {mean.value:.2f} [{mean.low:.2f}, {mean.high:.2f}] m, "
        f"median {median.value:.2f} [{median.low:.2f}, {median.high:.2f}] m.",
        f"Cells: value [{level} interval over vehicles and runs]; (<= or >=): exact "
        f"{level} bound; high, low: which is better. +fail: a failure (crash of the "
        f"chosen, or nothing feasible) is charged at least {report.failure_m:g} m. "
        f"Miss: FDE above {report.miss_threshold_m:.2g} m.",
    ]
    if report.counts["vehicles"] < FEW_VEHICLES:
        heading.append(
            f"Fewer than {FEW_VEHICLES} vehicles: bootstrap intervals are too short."
        )
    return heading


def _label(report: RankingReport, name: str) -> str:
    runs = report.runs[name]
    return name if runs == 1 else f"{name} ({runs} runs)"


def _column(report: RankingReport, metric: str, names: Sequence[str]) -> list[str]:
    """Title, unit, then per row its cell and its spread; all of one width."""
    how = METRICS[metric]
    cells = [how.title, f"{how.unit}, {'high' if how.higher_is_better else 'low'}"]
    for name in names:
        found = report.rows[name][metric]
        cells.append(_cell(found, how.unit))
        spread = found.seed_sd
        cells.append("" if spread is None else _number(spread, how.unit))
    wide = max(len(cell) for cell in cells)
    return [cell.rjust(wide) for cell in cells]


def _block(labels: list[str], first: int, columns: list[list[str]]) -> list[str]:
    """Lines of one block of columns; spread lines of single runs are left out."""
    lines = [""]
    for i, label in enumerate(labels):
        cells = [column[i] for column in columns]
        if any(cell.strip() for cell in cells):
            lines.append("  ".join([label.ljust(first), *cells]).rstrip())
    rule = "-" * (first + sum(len(column[0]) + 2 for column in columns))
    return [*lines[:3], rule, *lines[3:]]


def _cell(found: Estimate, unit: str) -> str:
    if found.exact:
        bound = found.high if found.value == 0.0 else found.low
        sign = "<=" if found.value == 0.0 else ">="
        return f"{100.0 * found.value:.0f} ({sign} {_number(bound, unit)})"
    low, high = _number(found.low, unit), _number(found.high, unit)
    return f"{_number(found.value, unit)} [{low}, {high}]"


def _medians(report: RankingReport, names: Sequence[str]) -> list[str]:
    """One line per row: the median over scenes of the human's percentile rank."""
    lines = ["", "Median over scenes of the human's percentile rank"]
    wide = max(len(name) for name in names)
    for name in names:
        found = report.human_rank_median[name]
        low, high = 100.0 * found.low, 100.0 * found.high
        cell = f"{100.0 * found.value:5.1f} [{low:.1f}, {high:.1f}] %"
        lines.append(f"  {name:<{wide}}  {cell}")
    return lines


def _number(value: float, unit: str) -> str:
    """Fixed digits; a share that is not 0 or 100 % is never printed as if it were."""
    if unit != "%":
        return f"{value:.2f}" if unit == "m" else f"{value:.3f}"
    percent = 100.0 * value
    for digits in range(1, 6):
        text = f"{percent:.{digits}f}"
        if float(text) not in (0.0, 100.0):
            return text
    return f"{percent:.1f}"


def _differences(report: RankingReport, names: Sequence[str]) -> list[str]:
    shown = [c for c in report.comparisons if c.row in names]
    if not shown:
        return []
    lines = [
        "",
        "Paired differences on the same scenes; named where Holm's p is below "
        f"{SIGNIFICANT:g}",
    ]
    wide = max(len(METRICS[c.metric].title) for c in shown)
    last = ("", "")
    for c in shown:
        if (c.row, c.reference) != last:
            last = (c.row, c.reference)
            lines.append(f"{c.row} minus {c.reference}")
        d, unit = c.difference, METRICS[c.metric].unit
        scale, name = (100.0, "points") if unit == "%" else (1.0, unit)
        mean, low, high, se = (scale * x for x in (d.mean, d.low, d.high, d.se))
        interval = f"[{low:+.3f}, {high:+.3f}]"
        lines.append(
            f"  {METRICS[c.metric].title:<{wide}}  {mean:+8.3f} {interval:<18}"
            f" {name:<6}  s.e. {se:.3f}  p {d.p:.3f}, Holm {c.p_holm:.3f}  {c.verdict}"
        )
    return lines
