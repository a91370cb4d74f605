"""The ranking report: every scorer beside its rivals, as JSON and as a table.

Each row is a scorer with one dictionary of `scene_metrics` per training run;
rivals have one run. Intervals come from one shared bootstrap over vehicles (and
runs), so rows can be compared; the comparison itself is the paired difference.
"""

import dataclasses
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.ranking import METRICS, Outcomes, miss_threshold, oracle_fde
from rcirl_jax.evaluation.statistics import (
    CONFIDENCE,
    NUM_RESAMPLES,
    ClusterBootstrap,
    Difference,
    Estimate,
    bootstrap_median,
    clopper_pearson,
    combine_seeds,
    holm,
    paired_difference,
)

SCHEMA = "rcirl-jax/ranking-report"
SCHEMA_VERSION = 1

# Rows that are not learned, in the order printed below the learned ones.
RIVALS = ("random", "constant speed", "IDM", "hand-set", "oracle")
REFERENCES = ("hand-set", "random")  # rows that the others are compared with

SIGNIFICANT_SE = 2.0  # 1, standard errors beyond which a difference has a name
MIN_WIDTH = 100  # characters; a line of the paired differences needs them
FEW_VEHICLES = 20  # below, percentile intervals are noticeably too short


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparison:
    """One paired difference: row minus reference."""

    row: str
    reference: str
    metric: str
    difference: Difference
    p_holm: float  # adjusted over the rows of its kind with the same reference
    verdict: str  # "better", "worse" or "no difference", by SIGNIFICANT_SE


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
    confidence: float = CONFIDENCE,
    num_resamples: int = NUM_RESAMPLES,
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
      confidence: of all intervals.
      num_resamples: bootstrap resamples.
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
    bootstrap = ClusterBootstrap(outcomes.cluster, num_resamples)
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
            name: {
                metric: _estimate(values, metric, bootstrap, confidence)
                for metric in METRICS
            }
            for name, values in stacked.items()
        },
        comparisons=tuple(
            comparison
            for name in references
            for family in _families(scorers, name)
            for comparison in _compare(stacked, family, name, bootstrap, confidence)
        ),
        oracle_floor=combine_seeds(floor, bootstrap, confidence=confidence),
        oracle_floor_median=bootstrap_median(floor, bootstrap, confidence=confidence),
        confidence=confidence,
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


def _estimate(
    values: Mapping[str, np.ndarray],
    metric: str,
    bootstrap: ClusterBootstrap,
    confidence: float,
) -> Estimate:
    found = combine_seeds(
        values[metric],
        bootstrap,
        weight=_weight(values, metric),
        confidence=confidence,
    )
    if METRICS[metric].unit != "%":
        return found
    vehicles = bootstrap.num_clusters
    # the other end is certain, so all of the error probability goes to this one
    two_sided = 2.0 * confidence - 1.0
    if np.all(values[metric] == 0.0):
        high = clopper_pearson(0, vehicles, two_sided)[1]
        return dataclasses.replace(found, value=0.0, low=0.0, high=high, exact=True)
    if np.all(values[metric] == 1.0):
        low = clopper_pearson(vehicles, vehicles, two_sided)[0]
        return dataclasses.replace(found, value=1.0, low=low, high=1.0, exact=True)
    return found


def _families(names: Iterable[str], reference: str) -> list[list[str]]:
    """Learned rows, then rivals, without the reference: one Holm family each."""
    others = [name for name in names if name != reference]
    learned = [name for name in others if name not in RIVALS]
    return [learned, [name for name in others if name in RIVALS]]


def _compare(
    stacked: Mapping[str, Mapping[str, np.ndarray]],
    rows: Sequence[str],
    reference: str,
    bootstrap: ClusterBootstrap,
    confidence: float,
) -> list[Comparison]:
    """One family of rows against one reference, in row then metric order."""
    pairs = [(row, m) for row in rows for m, how in METRICS.items() if how.compared]
    found = [
        paired_difference(
            stacked[row][metric],
            stacked[reference][metric],
            bootstrap,
            weight=_weight(stacked[row], metric),
            confidence=confidence,
        )
        for row, metric in pairs
    ]
    adjusted = holm(np.array([difference.p for difference in found]))
    return [
        Comparison(
            row=row,
            reference=reference,
            metric=metric,
            difference=difference,
            p_holm=float(p),
            verdict=verdict(difference, METRICS[metric].higher_is_better),
        )
        for (row, metric), difference, p in zip(pairs, found, adjusted, strict=True)
    ]


def verdict(difference: Difference, higher_is_better: bool) -> str:
    """Name a difference "better" or "worse" if |mean| is above 2 s.e., else not."""
    if abs(difference.mean) <= SIGNIFICANT_SE * difference.se:
        return "no difference"
    return "better" if (difference.mean > 0.0) == higher_is_better else "worse"


def to_json(report: RankingReport) -> dict:
    """The report as plain JSON types: finite numbers, text, true/false and null.

    `seed_sd` and `seed_se` are null for a single run. Shares are in [0, 1].
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
    return number


def format_table(report: RankingReport, width: int = 110) -> str:
    """The report as aligned plain text for a terminal.

    Rows: learned scorers first, then the rivals; columns wrap into blocks that
    fit. A share of 0 or 100 % is printed with its exact bound. Below: learned
    rows minus each reference row (all rows, if none is learned).

    Args:
      report: from `build_report`.
      width: characters per line, at least `MIN_WIDTH`.
    """
    if width < MIN_WIDTH:
        raise InputError(f"format_table: width: {width}: expected at least {MIN_WIDTH}")
    learned = [name for name in report.rows if name not in RIVALS]
    rivals = [name for name in RIVALS if name in report.rows]
    lines = [line for text in _heading(report) for line in textwrap.wrap(text, width)]
    labels = [_label(report, name) for name in [*learned, *rivals]]
    first = max(len(label) for label in labels)
    columns = {name: _column(report, name, [*learned, *rivals]) for name in METRICS}
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
    return "\n".join([*lines, *_differences(report, learned or rivals)]) + "\n"


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
        "Paired differences on the same scenes; a difference has a name beyond "
        f"{SIGNIFICANT_SE:g} s.e.",
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
