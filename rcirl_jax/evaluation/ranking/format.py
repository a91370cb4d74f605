"""The ranking report as aligned plain text for a terminal, or as Markdown."""

import itertools
import textwrap
from collections.abc import Sequence

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.output import text_table
from rcirl_jax.evaluation.ranking.metrics import METRICS
from rcirl_jax.evaluation.ranking.table import (
    BASELINE_ROWS,
    FEW_VEHICLES,
    MIN_WIDTH,
    SIGNIFICANT,
    Comparison,
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

    Rows: learned scorers first, then the baselines; columns wrap into blocks that
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
    learned = [name for name in names if name not in BASELINE_ROWS]
    lines = [line for text in _heading(report) for line in textwrap.wrap(text, width)]
    grid, block = _grid(report, names), [0]
    for column in range(1, len(grid[0])):
        wide = max(map(len, _columns(grid, [*block, column]))) > width
        if wide and len(block) > 1:
            lines += ["", *_columns(grid, block)]
            block = [0]
        block.append(column)
    lines += ["", *_columns(grid, block)]
    lines += _differences(report, learned or names) if differences else []
    return "\n".join(lines) + "\n"


def _columns(grid: Sequence[Sequence[str]], which: Sequence[int]) -> list[str]:
    """Lines of some columns of a table."""
    head, *rows = [[row[i] for i in which] for row in grid]
    return text_table(head, rows)


def _grid(report: RankingReport, names: Sequence[str]) -> list[list[str]]:
    """Titles, units, then a row's cells and, of several runs, their spread."""
    kinds = [*METRICS.values(), METRICS["percentile_rank"]]
    titles = [how.title for how in kinds]
    titles[-1] = f"{titles[-1]}, median"
    ways = ["high" if how.higher_is_better else "low" for how in kinds]
    units = [f"{how.unit}, {way}" for how, way in zip(kinds, ways, strict=True)]
    grid = [["", *titles], ["", *units]]
    for name in names:
        found = [report.rows[name][x] for x in METRICS]
        cells = [*found, report.human_rank_median[name]]
        pairs = list(zip(cells, kinds, strict=True))
        grid.append([_label(report, name), *(_cell(x, how.unit) for x, how in pairs)])
        if report.runs[name] > 1:
            spread = [(x.seed_sd, how.unit) for x, how in pairs]
            sds = ["" if sd is None else _number(sd, unit) for sd, unit in spread]
            grid.append(["  sd over runs", *sds])
    return grid


def _differences(report: RankingReport, names: Sequence[str]) -> list[str]:
    shown = [c for c in report.comparisons if c.row in names]
    if not shown:
        return []
    lines = [
        "",
        "Paired differences on the same scenes; named where Holm's p is below "
        f"{SIGNIFICANT:g}",
    ]
    for pair, group in itertools.groupby(shown, lambda c: (c.row, c.reference)):
        first, *others = [_difference(c) for c in group]
        lines += [" minus ".join(pair), *text_table(first, others)]
    return lines


def _difference(found: Comparison) -> list[str]:
    d, how = found.difference, METRICS[found.metric]
    scale, unit = (100.0, "points") if how.unit == "%" else (1.0, how.unit)
    mean, low, high, se = (scale * x for x in (d.mean, d.low, d.high, d.se))
    return [
        f"  {how.title}",
        f"{mean:+.3f} [{low:+.3f}, {high:+.3f}] {unit:6}",
        f"s.e. {se:.3f}",
        f"p {d.p:.3f}, Holm {found.p_holm:.3f}",
        found.verdict,
    ]


def markdown_table(report: RankingReport, against: str = "GAN") -> str:
    """The report's main columns as one Markdown table, a line per row.

    The last column is the paired difference in top-1 FDE to the row `against`, if
    there is one, with its p value by Holm's correction over the learned rows (the
    baselines apart) and all compared metrics.
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
    """Learned rows first, then the baselines in their order."""
    learned = [name for name in report.rows if name not in BASELINE_ROWS]
    return [*learned, *(name for name in BASELINE_ROWS if name in report.rows)]


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


def _cell(found: Estimate, unit: str) -> str:
    if found.exact:
        bound = found.high if found.value == 0.0 else found.low
        sign = "<=" if found.value == 0.0 else ">="
        return f"{100.0 * found.value:.0f} ({sign} {_number(bound, unit)})"
    low, high = _number(found.low, unit), _number(found.high, unit)
    return f"{_number(found.value, unit)} [{low}, {high}]"


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
