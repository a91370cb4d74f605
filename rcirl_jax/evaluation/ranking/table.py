"""The ranking report: every scorer beside its baselines, as JSON and as a table.

Each row is a scorer with one dictionary of `scene_metrics` per training run;
baselines have one run. Intervals come from one shared bootstrap over vehicles (and
runs), so rows can be compared; the comparison itself is the paired difference.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rcirl_jax.errors import InputError
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
