"""The ranking report: every scorer beside its baselines, as JSON, text and Markdown.

Each row is a scorer with one dictionary of `scene_metrics` per training run;
baselines have one run. Intervals come from one shared bootstrap over vehicles (and
runs), so rows can be compared; the comparison itself is the paired difference.
"""

import dataclasses
import itertools
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.summary import text_table
from rcirl_jax.evaluation.ranking.metrics import (
    METRICS,
    Outcomes,
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
    clopper_pearson,
    combine_seeds,
    difference_of,
    estimate_of,
    holm,
)
from rcirl_jax.planner.baselines import TUNED_IDM_ROW
from rcirl_jax.reward import LONG_ROW, SPEED_DP_ROW, TUNED_ROW
from rcirl_jax.runtime.checked import checked

SCHEMA = "rcirl-jax/ranking-report"
SCHEMA_VERSION = 1

UNTRAINED_ROW = "random weights"  # networks as they are before the first step

# Rows that are not learned, in the order printed below the learned ones.
BASELINE_ROWS = (
    *("random", UNTRAINED_ROW, "constant speed", "IDM", TUNED_IDM_ROW),
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


def build_report(
    scorers: Mapping[str, Sequence[Mapping[str, np.ndarray]]],
    outcomes: Outcomes,
    *,
    group: np.ndarray | None = None,
    references: Sequence[str] | None = None,
    num_resamples: int | None = None,
) -> RankingReport:
    """Estimates with intervals, and paired differences, of several scorers.

    A share that is 0 or 1 in every scene has no bootstrap spread. Its interval
    is then the exact one-sided bound for vehicles, about 3 / vehicles: where a
    share q of vehicles ever shows the event, at most about q of the scenes do.

    Args:
      scorers: row name -> one `scene_metrics` result per training run.
      outcomes: the scenes' outcomes; its `cluster` is what is resampled.
      group: [S] int, vehicle-disjoint group of each scene, to be counted.
      references: rows to compare with; by default those of `REFERENCES` present.
      num_resamples: bootstrap resamples; by default as many as it takes for the
        largest family of differences to reach an adjusted p of `SMALLEST_P`.
    """
    if not scorers:
        raise InputError("report: scorers: none: expected at least one row")
    if references is None:
        references = [name for name in REFERENCES if name in scorers]
    for name in references:
        if name not in scorers:
            raise InputError(
                f"report: references: {name}: expected one of {', '.join(scorers)}"
            )
    scenes = len(outcomes.cluster)
    stacked = {name: _stack(name, runs, scenes) for name, runs in scorers.items()}
    if num_resamples is None:
        num_resamples = _enough_resamples(scorers, references)
    bootstrap = ClusterBootstrap(outcomes.cluster, num_resamples)
    resampled = _Resampled(stacked, bootstrap)
    floor = oracle_fde(outcomes)
    counts = {"scenes": scenes, "vehicles": bootstrap.num_clusters}
    if group is not None:
        counts["groups"] = int(np.unique(group).size)
    counts["candidates"] = int(np.size(outcomes.feasible))
    counts["feasible"] = int(np.sum(outcomes.feasible))
    return RankingReport(
        horizon_s=float(outcomes.horizon_s),
        miss_threshold_m=miss_threshold(outcomes.horizon_s),
        failure_m=float(outcomes.failure_m),
        counts=counts,
        runs={name: len(runs) for name, runs in scorers.items()},
        rows={
            name: {metric: _estimate(resampled, name, metric) for metric in METRICS}
            for name in stacked
        },
        comparisons=tuple(
            comparison
            for name in references
            for family in _families(scorers, name)
            for comparison in _compare(resampled, family, name)
        ),
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
    )


def _stack(
    name: str, runs: Sequence[Mapping[str, np.ndarray]], scenes: int
) -> dict[str, np.ndarray]:
    """Metric -> [R, S]."""
    needed = [*METRICS, *{m.weight for m in METRICS.values() if m.weight}]
    if not runs:
        raise InputError(f"report: {name}: no runs: expected at least one")
    stacked = {}
    for metric in needed:
        columns = [np.asarray(run.get(metric), np.float64) for run in runs]
        if any(column.shape != (scenes,) for column in columns):
            raise InputError(
                f"report: {name}: {metric}: missing, or not of {scenes} scenes:"
                " expected a result of scene_metrics in every run"
            )
        stacked[metric] = np.stack(columns)
    return stacked


def _weight(values: Mapping[str, np.ndarray], metric: str) -> np.ndarray | None:
    weight = METRICS[metric].weight
    return None if weight is None else values[weight][0]


class _Resampled:
    """Means of rows over the resamples, made once for rows and differences."""

    def __init__(
        self,
        stacked: Mapping[str, Mapping[str, np.ndarray]],
        bootstrap: ClusterBootstrap,
    ) -> None:
        self.stacked, self.bootstrap = stacked, bootstrap
        self._means: dict[tuple[str, str, int], tuple[np.ndarray, np.ndarray]] = {}

    def means(
        self, row: str, metric: str, stream: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Means of the runs [R], and replicates [n] with runs drawn from `stream`."""
        key = (row, metric, stream)
        if key not in self._means:
            values = self.stacked[row]
            inputs = (values[metric], _weight(values, metric))
            means = self.bootstrap.mean(*inputs)
            self._means[key] = (means, self.bootstrap.means(*inputs, stream))
        return self._means[key]

    def difference(self, row: str, reference: str, metric: str) -> Difference:
        """`paired_difference` of two rows."""
        means, replicates = self.means(row, metric, 1)
        other, others = self.means(reference, metric, 2)
        mean = float(means.mean() - other.mean())
        return difference_of(mean, replicates - others)


def _estimate(resampled: _Resampled, row: str, metric: str) -> Estimate:
    found = estimate_of(*resampled.means(row, metric, 1))
    if METRICS[metric].unit != "%":
        return found
    values = resampled.stacked[row]
    vehicles = resampled.bootstrap.num_clusters
    # the other end is certain, so all of the error probability goes to this one
    two_sided = 2.0 * CONFIDENCE - 1.0
    if np.all(values[metric] == 0.0):
        high = clopper_pearson(0, vehicles, two_sided)[1]
        return dataclasses.replace(found, value=0.0, low=0.0, high=high, exact=True)
    if np.all(values[metric] == 1.0):
        low = clopper_pearson(vehicles, vehicles, two_sided)[0]
        return dataclasses.replace(found, value=1.0, low=low, high=1.0, exact=True)
    # stretched run weights can push an end of a share over 0 or 1
    low, high = max(found.low, 0.0), min(found.high, 1.0)
    return dataclasses.replace(found, low=low, high=high)


def _families(names: Iterable[str], reference: str) -> list[list[str]]:
    """Learned rows, then baselines, without the reference: one Holm family each."""
    others = [name for name in names if name != reference]
    learned = [name for name in others if name not in BASELINE_ROWS]
    return [learned, [name for name in others if name in BASELINE_ROWS]]


def _enough_resamples(names: Iterable[str], references: Sequence[str]) -> int:
    """Resamples n with m * 2 / (n + 1) <= `SMALLEST_P` for the largest family of m."""
    per_row = sum(how.compared for how in METRICS.values())
    families = [part for name in references for part in _families(names, name)]
    largest = per_row * max(map(len, families), default=0)
    return max(NUM_RESAMPLES, math.ceil(2 * largest / SMALLEST_P) - 1)


def _compare(
    resampled: _Resampled, rows: Sequence[str], reference: str
) -> list[Comparison]:
    """One family of rows against one reference, in row then metric order."""
    pairs = [(row, m) for row in rows for m, how in METRICS.items() if how.compared]
    found = [resampled.difference(row, reference, metric) for row, metric in pairs]
    adjusted = holm(np.array([difference.p for difference in found]))
    return [
        Comparison(
            row=row,
            reference=reference,
            metric=metric,
            difference=difference,
            p_holm=float(p),
            verdict=verdict(difference, p, METRICS[metric].higher_is_better),
        )
        for (row, metric), difference, p in zip(pairs, found, adjusted, strict=True)
    ]


def verdict(difference: Difference, p_holm: float, higher_is_better: bool) -> str:
    """Name a difference "better" or "worse" if its adjusted p is small, else not."""
    if p_holm >= SIGNIFICANT:
        return "no difference"
    return "better" if (difference.mean > 0.0) == higher_is_better else "worse"


def to_json(report: RankingReport) -> dict:
    """The report as plain JSON types: finite numbers, text, true/false and null.

    `seed_sd` and `seed_se` are null for a single run. Shares are in [0, 1]. Numbers
    have `DIGITS` significant digits.
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
    """The report of `to_json`.

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
    """JSON types only; a number that is not finite is an error that names itself."""
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
