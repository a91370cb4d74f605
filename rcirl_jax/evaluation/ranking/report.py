"""The ranking report: every scorer beside its baselines, as JSON, text and Markdown.

Each row is a scorer with one dictionary of `scene_metrics` per training run;
baselines have one run. Intervals come from one shared bootstrap over vehicles (and
runs), so rows can be compared; the comparison itself is the paired difference.
"""

import dataclasses
import functools
import itertools
import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.summary import text_table
from rcirl_jax.evaluation.ranking.lanes import (
    IN_TIME_S,
    LANE_METRICS,
    LaneOutcomes,
    LaneReport,
    lane_report,
)
from rcirl_jax.evaluation.ranking.metrics import (
    METRICS,
    Outcomes,
    bounded,
    miss_threshold,
    oracle_fde,
)
from rcirl_jax.evaluation.statistics import (
    CONFIDENCE,
    NUM_RESAMPLES,
    ClusterBootstrap,
    Difference,
    Estimate,
    bootstrap_median,
    combine_seeds,
    difference_of,
    estimate_of,
    holm,
)
from rcirl_jax.planner.baselines import TUNED_IDM_ROW
from rcirl_jax.planner.mobil import MOBIL_ROW
from rcirl_jax.reward import LONG_ROW, SPEED_DP_ROW, TUNED_ROW
from rcirl_jax.runtime.checked import checked

SCHEMA = "rcirl-jax/ranking-report"
SCHEMA_VERSION = 1

UNTRAINED_ROW = "random weights"  # networks as they are before the first step

# Rows that are not learned, in the order printed below the learned ones.
BASELINE_ROWS = (
    *("random", UNTRAINED_ROW, "constant speed", "IDM", TUNED_IDM_ROW, MOBIL_ROW),
    *(SPEED_DP_ROW, "hand-set", TUNED_ROW, LONG_ROW, "oracle"),
)
# rows that the others are compared with
REFERENCES = (
    *("hand-set", TUNED_ROW, LONG_ROW, "IDM", TUNED_IDM_ROW, "random"),
    *("GAN", "GAN on curves", "GAN free", "GAN free on curves"),
    *("RC-IRL logistic", "logistic free", "MaxEnt monotone 32-16"),
)

SIGNIFICANT = 0.05  # Holm-adjusted p below which a difference has a name
MIN_WIDTH = 100  # characters; a line of the paired differences needs them
DIGITS = 9  # significant, of a stored number: a report of 40 rows stays below 1 MB
SMALLEST_P = 0.01  # that the resamples let a Holm-adjusted p value reach
FEW_VEHICLES = 20  # below, percentile intervals are noticeably too short


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparison:
    """One paired difference: row minus reference."""

    row: str
    reference: str
    metric: str
    difference: Difference
    p_holm: float  # adjusted over the rows of its kind with the same reference
    verdict: str  # "better", "worse" or "no difference", by SIGNIFICANT


@dataclasses.dataclass(frozen=True, kw_only=True)
class RankingReport:
    """All numbers of one evaluation. Shares and rates are in [0, 1]."""

    horizon_s: float
    miss_threshold_m: float
    failure_m: float  # least FDE charged for a failure
    counts: dict[str, int]  # scenes, vehicles, groups if known, candidates, feasible
    runs: dict[str, int]  # row -> training runs
    rows: dict[str, dict[str, Estimate]]  # row -> metric -> estimate
    comparisons: tuple[Comparison, ...]
    # row -> median over scenes of the percentile rank (mean over runs per scene)
    human_rank_median: dict[str, Estimate]
    oracle_floor: Estimate  # m, mean FDE of the best candidate per scene
    oracle_floor_median: Estimate  # m
    confidence: float
    num_resamples: int
    warnings: tuple[str, ...] = ()  # of `ranking_warnings`
    # the choice of lane; None along given paths, or where too few change lanes
    lanes: LaneReport | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ranked:
    """All rows on the same S held-out scenes; what a report is made of."""

    # row -> one `scene_metrics` per run, metric -> [S]
    table: Mapping[str, Sequence[Mapping[str, np.ndarray]]]
    outcomes: Outcomes
    group: np.ndarray | None = None  # [S] int, vehicle-disjoint group, to be counted
    lanes: LaneOutcomes | None = None  # where paths are planned


def build_report(
    ranked: Ranked,
    references: Sequence[str] | None = None,
    num_resamples: int | None = None,
) -> RankingReport:
    """Estimates every row's metrics with intervals, and paired differences.

    Args:
      ranked: the rows; the `cluster` of their outcomes is what is resampled.
      references: rows to compare with; by default those of `REFERENCES` present.
      num_resamples: bootstrap resamples; by default as many as it takes for the
        largest family of differences to reach an adjusted p of `SMALLEST_P`:
        m * 2 / (n + 1) <= `SMALLEST_P` for a family of m.
    """
    outcomes, scorers = ranked.outcomes, ranked.table
    if references is None:
        references = [name for name in REFERENCES if name in scorers]
    for name in references:
        if name not in scorers:
            raise InputError(
                f"report: references: {name}: expected one of {', '.join(scorers)}"
            )
    compared = [metric for metric, how in METRICS.items() if how.compared]
    # one Holm family each: learned rows, and baselines, against a reference
    families = [
        (reference, [n for n in scorers if n != reference and is_baseline(n) == kind])
        for reference in references
        for kind in (False, True)
    ]
    if num_resamples is None:
        largest = len(compared) * max((len(rows) for _, rows in families), default=0)
        num_resamples = max(NUM_RESAMPLES, math.ceil(2 * largest / SMALLEST_P) - 1)
    bootstrap = ClusterBootstrap(outcomes.cluster, num_resamples)
    stacked = {  # row -> metric -> [R, S]
        name: {metric: np.stack([run[metric] for run in runs]) for metric in runs[0]}
        for name, runs in scorers.items()
    }

    @functools.cache
    def resampled(row: str, metric: str, stream: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns means of the runs [R], replicates [n] with runs of a stream."""
        weight = METRICS[metric].weight
        inputs = stacked[row][metric], stacked[row][weight][0] if weight else None
        return bootstrap.mean(*inputs), bootstrap.means(*inputs, stream)

    def compare(reference: str, rows: Sequence[str]) -> list[Comparison]:
        """Compares a family of rows with one reference, in row then metric order."""
        found = []
        for row, metric in itertools.product(rows, compared):
            (a, drawn), (b, others) = (
                resampled(row, metric, 1),
                resampled(reference, metric, 2),
            )
            difference = difference_of(float(a.mean() - b.mean()), drawn - others)
            found.append((row, metric, difference))
        adjusted = holm([difference.p for _, _, difference in found])
        return [
            Comparison(
                row=row, reference=reference, metric=metric, difference=difference,
                p_holm=float(p),
                verdict=verdict(difference, p, METRICS[metric].higher_is_better),
            )
            for (row, metric, difference), p in zip(found, adjusted, strict=True)
        ]  # fmt: skip

    floor, vehicles = oracle_fde(outcomes), bootstrap.num_clusters
    counts = {"scenes": len(outcomes.cluster), "vehicles": vehicles}
    if ranked.group is not None:
        counts["groups"] = int(np.unique(ranked.group).size)
    counts["candidates"] = int(np.size(outcomes.feasible))
    counts["feasible"] = int(np.sum(outcomes.feasible))
    return RankingReport(
        horizon_s=float(outcomes.horizon_s),
        miss_threshold_m=miss_threshold(outcomes.horizon_s),
        failure_m=float(outcomes.failure_m),
        counts=counts,
        runs={name: len(runs) for name, runs in scorers.items()},
        rows={
            name: {
                metric: bounded(
                    estimate_of(*resampled(name, metric, 1)),
                    values[metric],
                    METRICS[metric].unit,
                    vehicles,
                )
                for metric in METRICS
            }
            for name, values in stacked.items()
        },
        comparisons=tuple(c for family in families for c in compare(*family)),
        human_rank_median={
            name: bootstrap_median(
                np.mean(values["percentile_rank"], axis=0), bootstrap
            )
            for name, values in stacked.items()
        },
        oracle_floor=combine_seeds(floor, bootstrap),
        oracle_floor_median=bootstrap_median(floor, bootstrap),
        confidence=CONFIDENCE,
        num_resamples=num_resamples,
        lanes=ranked.lanes and lane_report(scorers, ranked.lanes, outcomes.cluster),
    )


def ranking_warnings(
    report: RankingReport, rows: Sequence[str], references: Sequence[str]
) -> tuple[str, ...]:
    """Says which rows are not shown to rank better than one that should be easy.

    Args:
      report: with comparisons of top-1 FDE.
      rows: learned ones.
      references: random order and the planner's own cost, by name.
    """
    found = (
        not_ahead(
            row,
            {
                c.reference: c.difference
                for c in report.comparisons
                if c.metric == "top1_fde" and c.row == row and c.reference in references
            },
        )
        for row in rows
    )
    return tuple(filter(None, found))


def not_ahead(row: str, apart: Mapping[str, Difference]) -> str:
    """Says of which others a row's choice is not nearer to the human for certain.

    Args:
      row: who chose.
      apart: m, its top-1 FDE minus that of each other, with paired intervals.

    Returns:
      One sentence; "" if the row is ahead of all.
    """
    said = [
        ("worse than" if d.low > 0.0 else "not shown to be better than")
        + f" {other}, top-1 {d.mean:+.2f} [{d.low:+.2f}, {d.high:+.2f}] m"
        for other, d in apart.items()
        if d.high >= 0.0
    ]
    return f"ranking: {row} is {'; '.join(said)}" if said else ""


def is_baseline(row: str) -> bool:
    """Returns whether a row is not learned."""
    return row in BASELINE_ROWS


def verdict(difference: Difference, p_holm: float, higher_is_better: bool) -> str:
    """Names a difference "better" or "worse" if its adjusted p is small, else not."""
    if p_holm >= SIGNIFICANT:
        return "no difference"
    return "better" if (difference.mean > 0.0) == higher_is_better else "worse"


def to_json(report: RankingReport) -> dict:
    """Returns the report as plain JSON types.

    They are finite numbers, text, true, false and null. `seed_sd` and `seed_se` are
    null for a single run. Shares are in [0, 1]. Numbers have `DIGITS` significant
    digits.
    """
    content = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "metrics": {
            name: {
                "title": how.title,
                "unit": "1" if how.unit == "%" else how.unit,
                "higher_is_better": how.higher_is_better,
            }
            for name, how in METRICS.items()
        },
        **dataclasses.asdict(report),
    }
    return {name: _plain(node, name) for name, node in content.items()}


def from_json(body: Mapping[str, Any]) -> RankingReport:
    """Reads the report of `to_json`.

    Raises:
      InputError: another schema, or a field that is missing or of another kind.
    """
    version = (body.get("schema"), body.get("schema_version"))
    if version != (SCHEMA, SCHEMA_VERSION):
        raise InputError(
            f"report: schema: {version}: expected {(SCHEMA, SCHEMA_VERSION)}"
        )
    return checked(body, RankingReport, "report")


def _plain(node: object, where: str) -> "dict | list | str | float | int | bool | None":
    """Returns JSON types only; a number that is not finite is refused by its name."""
    if isinstance(node, Mapping):
        return {str(k): _plain(v, f"{where}.{k}") for k, v in node.items()}
    if isinstance(node, list | tuple):
        return [_plain(v, f"{where}[{i}]") for i, v in enumerate(node)]
    if node is None or isinstance(node, bool | str | int):
        return node
    number = float(node)  # type: ignore[arg-type]
    if not math.isfinite(number):
        raise InputError(f"report: {where}: {number}: expected a finite number")
    return float(f"{number:.{DIGITS}g}")


# ---------------------------------------------------------------- text

_IN_MARKDOWN = (
    *("top1_fde", "top1_fde_failure", "top3_fde", "top1_ade"),
    *("mrr", "nll", "percentile_rank", "crash_rate"),
)


def format_table(
    report: RankingReport, width: int = 110, *, differences: bool = True
) -> str:
    """Formats the report as aligned plain text for a terminal.

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
    learned = [name for name in names if not is_baseline(name)]
    lines = [line for text in _heading(report) for line in textwrap.wrap(text, width)]
    grid, block = _grid(report, names), [0]
    for column in range(1, len(grid[0])):
        wide = max(map(len, _columns(grid, [*block, column]))) > width
        if wide and len(block) > 1:
            lines += ["", *_columns(grid, block)]
            block = [0]
        block.append(column)
    lines += ["", *_columns(grid, block)]
    lines += _lanes(report.lanes, names, width) if report.lanes else []
    lines += _differences(report, learned or names) if differences else []
    return "\n".join(lines) + "\n"


def _lanes(found: LaneReport, names: Sequence[str], width: int) -> list[str]:
    """Formats the choice of lane as lines."""
    said = (
        f"Choice of lane: {found.changes:,} scenes of {found.vehicles:,} vehicles in "
        "which the human crosses a line and ends beyond it; the last column is of the "
        f"{found.stays:,} in which it crosses none. Who never crosses, or ends on "
        "another side, crosses at the horizon. IDM and constant speed keep their lane."
    )
    head = ["", *(how.title for how in LANE_METRICS.values())]
    rows = [
        [
            name,
            *(_cell(found.rows[name][x], how.unit) for x, how in LANE_METRICS.items()),
        ]
        for name in names
    ]
    head.append(f"within {IN_TIME_S:g} s minus MOBIL")
    for row in rows:
        d = found.minus_mobil.get(row[0])
        ends = d and [f"{100.0 * x:+.1f}" for x in (d.mean, d.low, d.high)]
        row.append("{} [{}, {}]".format(*ends) if ends else "")
    return ["", *textwrap.wrap(said, width), *text_table(head, rows)]


def _columns(grid: Sequence[Sequence[str]], which: Sequence[int]) -> list[str]:
    """Formats some columns of a table as lines."""
    head, *rows = [[row[i] for i in which] for row in grid]
    return text_table(head, rows)


def _grid(report: RankingReport, names: Sequence[str]) -> list[list[str]]:
    """Returns titles, units, each row's cells and, of several runs, their spread."""
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
    words = "Paired differences on the same scenes; named where Holm's p is below "
    lines = ["", f"{words}{SIGNIFICANT:g}"]
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
    """Formats the report's main columns as one Markdown table, a line per row.

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
    """Returns learned rows first, then the baselines in their order."""
    learned = [name for name in report.rows if not is_baseline(name)]
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
    heading += [f"warning: {said}" for said in report.warnings]
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
    """Formats fixed digits; only a share of 0 or 100 % is printed as one."""
    if unit != "%":
        return f"{value:.2f}" if unit == "m" else f"{value:.3f}"
    percent = 100.0 * value
    for digits in range(1, 6):
        text = f"{percent:.{digits}f}"
        if float(text) not in (0.0, 100.0):
            return text
    return f"{percent:.1f}"
