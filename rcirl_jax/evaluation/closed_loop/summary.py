"""The closed-loop table: rates with exact intervals, progress, score, differences.

Host numpy. `C` cases, in the order of the suite; every row drove the same ones.
A rate per case counts drives in which every sample holds; a rate per sample
counts samples, whose exact interval takes them for independent and is therefore
too short: it is printed because the paper does not say which it means. Below, the
report as terminal text, CSV and one hash.
"""

import csv
import dataclasses
import hashlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rcirl_jax.evaluation.statistics import (
    ClusterBootstrap,
    Difference,
    clopper_pearson,
    cluster_t,
    family_clusters,
    holm,
    mcnemar_exact,
)
from rcirl_jax.runtime.atomic_files import write_whole
from rcirl_jax.simulation.metrics import COLUMNS, CaseMetrics, nuplan_score

# %, the paper's Table II in the order of COLUMNS
PAPER = {
    "the paper, RC-IRL": (100.0, 100.0, 99.33, 99.97, 97.77, 82.77),
    "the paper, GAN": (100.0, 99.49, 86.80, 99.97, 71.20, 82.57),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rate:
    """k of n with its exact 95 % interval; bound: 3 / n where nothing failed."""

    k: int
    n: int
    rate: float
    low: float
    high: float
    bound: float | None


@dataclasses.dataclass(frozen=True, kw_only=True)
class RowSummary:
    """One row of the table."""

    per_case: Mapping[str, Rate]  # by COLUMNS
    per_sample: Mapping[str, Rate]
    filtered_case: Mapping[str, Rate]  # the jerk columns, filtered
    filtered_sample: Mapping[str, Rate]
    at_fault: int
    at_fault_preventable: int
    at_fault_vru: int
    collisions: int
    red_lights: int
    stop_signs: int
    off_road: int  # cases beyond nuPlan's 0.3 m
    progress_m: float  # mean
    progress_ratio: float  # to the reference row, sum over sum
    nuplan: float  # mean score
    nuplan_low: float
    nuplan_high: float
    parts: Mapping[str, float]  # nuPlan's parts, means
    physical: Mapping[str, float]  # further means and worst values
    families: Mapping[str, Mapping[str, float]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuiteComparison:
    """Row a minus row b on the same cases.

    McNemar's test takes cases for independent; cases of one family are not. What
    holds beyond these families is said by the differences over families (Student's,
    `statistics.cluster_t`; of a single family: over its cases).
    """

    a: str
    b: str
    # per column: cases only a passes, only b passes, McNemar p, Holm-adjusted p
    columns: Mapping[str, tuple[int, int, float, float]]
    over_families: Mapping[str, Difference]  # per column, share of cases passed
    progress_m: Difference
    nuplan: Difference


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuiteReport:
    """All rows, and differences of the first against the others."""

    cases: int
    families: tuple[str, ...]
    preventable: int
    trivial: int
    # the row whose distance is nuPlan's "expert route"
    reference: str
    rows: Mapping[str, RowSummary]
    comparisons: tuple[SuiteComparison, ...]


def rate(k: int, n: int) -> Rate:
    """K successes of n, exact (Clopper and Pearson 1934).

    Where nothing failed the bound is that of the rule of three: the exact one-sided
    bound of the failures is 1 - 0.05^(1/n) < -ln(0.05) / n < 3 / n.
    """
    low, high = clopper_pearson(k, n)
    bound = 1.0 - min(1.0, 3.0 / n) if k == n else None
    return Rate(k=k, n=n, rate=k / n, low=low, high=high, bound=bound)


def summarise(
    runs: Mapping[str, CaseMetrics],
    families: Sequence[str],
    preventable: np.ndarray,
    trivial: np.ndarray,
    reference_name: str,
    way: np.ndarray,
) -> SuiteReport:
    """The report of all rows.

    Args:
      runs: metrics [C] by row; the first is compared with the others.
      families: [C] family of every case.
      preventable: [C] bool, of `simulation.rows`.
      trivial: [C] bool.
      reference_name: the row that sets the distance.
      way: [C] m, how far it got.
    """
    names = np.asarray(families)
    scores = {
        row: np.asarray(nuplan_score(m, jnp.asarray(way))[0]) for row, m in runs.items()
    }
    cluster = family_clusters(names)
    rows = {
        row: _row(metrics, scores[row], names, cluster, preventable, way)
        for row, metrics in runs.items()
    }
    first = next(iter(runs))
    comparisons = tuple(
        _compare(first, other, runs, scores, cluster) for other in list(runs)[1:]
    )
    return SuiteReport(
        cases=len(names),
        families=tuple(dict.fromkeys(families)),
        preventable=int(preventable.sum()),
        trivial=int(trivial.sum()),
        reference=reference_name,
        rows=rows,
        comparisons=comparisons,
    )


def _rates(passes: ArrayLike, columns: Sequence[str]) -> dict[str, Rate]:
    holds = np.asarray(passes)
    return {
        name: rate(int(holds[:, i].sum()), holds.shape[0])
        for i, name in enumerate(columns)
    }


def _sample_rates(
    counts: ArrayLike, samples: ArrayLike, columns: Sequence[str]
) -> dict[str, Rate]:
    inside, total = np.asarray(counts), int(np.sum(samples))
    return {
        name: rate(int(inside[:, i].sum()), total) for i, name in enumerate(columns)
    }


def _interval(scores: np.ndarray, cluster: np.ndarray) -> tuple[float, float]:
    """95 % bootstrap interval of the mean over clusters."""
    if scores.size < 2:
        return float(scores.mean()), float(scores.mean())
    draws = ClusterBootstrap(cluster).means(scores)
    low, high = np.quantile(draws, [0.025, 0.975])
    return float(low), float(high)


def _finite_low(x: np.ndarray) -> float:
    """The 5 % quantile, in which "never" (inf) counts as large."""
    return float(np.quantile(np.minimum(x, 1e3), 0.05))


def _starts(seconds: np.ndarray) -> dict[str, float]:
    """Cases with a start on a free road, and the median of theirs, s; -1 if none."""
    found = seconds[seconds >= 0.0]
    median = float(np.median(found)) if found.size else -1.0
    return {"starts": float(found.size), "start_s_median": median}


def _row(
    m: CaseMetrics,
    scores: np.ndarray,
    names: np.ndarray,
    cluster: np.ndarray,
    preventable: np.ndarray,
    way: np.ndarray,
) -> RowSummary:
    low, high = _interval(scores, cluster)
    fault = np.asarray(m.at_fault) > 0
    jerks = COLUMNS[4:]
    parts = ("no_fault", "drivable", "direction", "ttc_bound", "speed_compliance")
    ratio = float(m.progress.sum() / max(float(way.sum()), 1e-9))
    return RowSummary(
        per_case=_rates(m.holds, COLUMNS),
        per_sample=_sample_rates(m.inside, m.samples, COLUMNS),
        filtered_case=_rates(m.holds_filtered, jerks),
        filtered_sample=_sample_rates(m.inside_filtered, m.samples, jerks),
        at_fault=int(fault.sum()),
        at_fault_preventable=int((fault & preventable).sum()),
        at_fault_vru=int((np.asarray(m.at_fault_vru) > 0).sum()),
        collisions=int((np.asarray(m.collisions) > 0).sum()),
        red_lights=int(m.red_lights.sum()),
        stop_signs=int(m.stop_signs.sum()),
        off_road=int((np.asarray(m.drivable) < 1.0).sum()),
        progress_m=float(m.progress.mean()),
        progress_ratio=ratio,
        nuplan=float(scores.mean()),
        nuplan_low=low,
        nuplan_high=high,
        parts={
            **{name: float(np.mean(getattr(m, name))) for name in parts},
            "comfort": float(np.mean(m.comfort)),
        },
        physical={
            "rms_a": float(np.mean(m.rms_a)),
            "rms_j": float(np.mean(m.rms_j)),
            "worst_a": float(np.min(m.min_a)),
            "worst_j": float(np.max(m.max_j)),
            "min_ttc_p5": _finite_low(np.asarray(m.min_ttc)),
            "min_headway_p5": _finite_low(np.asarray(m.min_headway)),
            "tet_s": float(np.mean(m.tet)),
            "induced_over_4": float(np.mean(np.asarray(m.induced_braking) > 4.0)),
            "brake_taps": float(np.mean(m.brake_taps)),
            "fallback_share": float(np.mean(m.fallback_share)),
            "standing_share": float(np.mean(m.standing_share)),
            "creeping_share": float(np.mean(m.creeping_share)),
            "sign_changes_per_s": float(np.mean(m.sign_changes)),
            **_starts(np.asarray(m.start_time)),
        },
        families=_by_family(m, scores, names, preventable, way),
    )


def _by_family(
    m: CaseMetrics,
    scores: np.ndarray,
    names: np.ndarray,
    preventable: np.ndarray,
    way: np.ndarray,
) -> dict[str, dict[str, float]]:
    found = {}
    for name in dict.fromkeys(names.tolist()):
        at = names == name
        fault = np.asarray(m.at_fault)[at] > 0
        samples = max(int(m.samples[at].sum()), 1)
        shares = m.inside[at].sum(axis=0) / samples
        passes = m.holds[at].mean(axis=0)
        reached = float(way[at].sum())
        found[name] = {
            "cases": float(at.sum()),
            "at_fault": float(fault.sum()),
            "at_fault_preventable": float((fault & preventable[at]).sum()),
            "progress_ratio": float(m.progress[at].sum() / max(reached, 1e-9)),
            "nuplan": float(scores[at].mean()),
            **{f"{c}_sample": float(x) for c, x in zip(COLUMNS, shares, strict=True)},
            **{f"{c}_case": float(x) for c, x in zip(COLUMNS, passes, strict=True)},
        }
    return found


def _compare(
    a: str,
    b: str,
    runs: Mapping[str, CaseMetrics],
    scores: Mapping[str, np.ndarray],
    cluster: np.ndarray,
) -> SuiteComparison:
    """McNemar per column with Holm over the columns; differences over families."""
    mine, theirs = runs[a].holds, runs[b].holds
    wins = (mine & ~theirs).sum(axis=0)
    losses = (~mine & theirs).sum(axis=0)
    raw = [mcnemar_exact(int(w), int(x)) for w, x in zip(wins, losses, strict=True)]
    adjusted = holm(np.array(raw))
    return SuiteComparison(
        a=a,
        b=b,
        columns={
            name: (int(wins[i]), int(losses[i]), raw[i], float(adjusted[i]))
            for i, name in enumerate(COLUMNS)
        },
        over_families={
            name: _apart(mine[:, i], theirs[:, i], cluster)
            for i, name in enumerate(COLUMNS)
        },
        progress_m=_apart(runs[a].progress, runs[b].progress, cluster),
        nuplan=_apart(scores[a], scores[b], cluster),
    )


def _apart(a: ArrayLike, b: ArrayLike, cluster: np.ndarray) -> Difference:
    """Mean of a - b [C] over clusters; of one case alone."""
    x, y = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if x.size < 2:
        mean = float(x[0] - y[0])
        return Difference(mean=mean, low=-np.inf, high=np.inf, se=np.inf, p=1.0)
    return cluster_t(x, y, cluster)


# ---------------------------------------------------------------- text

SHORT = {
    "collision_free": "no fault",
    "speed_limit": "V<limit",
    "a_station": "|a|<4",
    "a_lateral": "|a_lat|<4",
    "j_station": "|j|<6",
    "j_lateral": "|j_lat|<6",
}


def _rate_cell(found: Rate) -> str:
    """98.76 [98.1, 99.2], or 100 [>= 99.91] with the rule of three."""
    if found.bound is not None:
        return f"100 (>={100 * found.bound:.2f})"
    low, high = 100 * found.low, 100 * found.high
    return f"{100 * found.rate:.2f} [{low:.1f},{high:.1f}]"


def text_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table whose columns are as wide as they need; numbers to the right."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = []
    for row in [header, *rows]:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return lines


def format_suite(report: SuiteReport) -> str:
    """The paper's table per case and per sample, safety and progress, differences."""
    lines = [
        f"{report.cases:,} cases of {len(report.families)} groups; "
        f"{report.preventable:,} preventable by a careful driver, "
        f"{report.trivial:,} trivial.",
        "Cells: % [exact 95 % interval]; (>=): rule of three where nothing failed.",
        "",
        "Per case (every sample of a drive inside the bound, no at-fault collision)",
    ]
    header = ["", *(SHORT[c] for c in COLUMNS)]
    paper = [[name, *(f"{x:.2f}" for x in row)] for name, row in PAPER.items()]
    for kind in ("per_case", "per_sample"):
        if kind == "per_sample":
            lines += ["", "Per sample (10 Hz, samples before a crash)"]
        rows = [
            [name, *(_rate_cell(getattr(row, kind)[c]) for c in COLUMNS)]
            for name, row in report.rows.items()
        ]
        lines += text_table(header, [*rows, *paper])
    lines += [
        "",
        f"Jerk filtered as in nuPlan; safety; progress against {report.reference}",
        "start: from standstill to 80 % of the limit on a free road: median s "
        "(n starts)",
    ]
    lines += text_table(
        ["", "|j| case", "|j| sample", "faults", "prevent.", "VRU", "hits", "red",
         "stop", "off road", "creep", "start", "turns/s", "progress", "nuPlan [95 %]"],
        [_safety(name, row) for name, row in report.rows.items()],
    )  # fmt: skip
    lines += ["", *_differences(report)]
    return "\n".join(lines) + "\n"


def _safety(name: str, row: RowSummary) -> list[str]:
    return [
        name,
        f"{100 * row.filtered_case['j_station'].rate:.1f}",
        f"{100 * row.filtered_sample['j_station'].rate:.2f}",
        str(row.at_fault),
        str(row.at_fault_preventable),
        str(row.at_fault_vru),
        str(row.collisions),
        str(row.red_lights),
        str(row.stop_signs),
        str(row.off_road),
        f"{100 * row.physical['creeping_share']:.1f} %",
        _start(row),
        f"{row.physical['sign_changes_per_s']:.2f}",
        f"{100 * row.progress_ratio:.1f} %",
        f"{100 * row.nuplan:.1f} [{100 * row.nuplan_low:.1f},"
        f"{100 * row.nuplan_high:.1f}]",
    ]


def _start(row: RowSummary) -> str:
    """5.4 (120), or - (0) where no case has a start on a free road."""
    count, median = (row.physical[key] for key in ("starts", "start_s_median"))
    return f"{median:.1f} ({count:.0f})" if count else "- (0)"


def _differences(report: SuiteReport) -> list[str]:
    if not report.comparisons:
        return []
    first = report.comparisons[0].a
    lines = [
        f"{first} against each row on the same cases: drives only it passes - only "
        "the other passes (*: Holm-adjusted exact McNemar p < 0.05; **: and the "
        "interval over families is apart from 0); progress, nuPlan: over families"
    ]
    rows = []
    for item in report.comparisons:
        cells = [
            f"+{wins} -{losses}{'*' * (adjusted < 0.05) * (1 + over.is_apart)}"
            for (wins, losses, _, adjusted), over in zip(
                item.columns.values(), item.over_families.values(), strict=True
            )
        ]
        way, score = item.progress_m, item.nuplan
        cells.append(f"{way.mean:+.0f} [{way.low:+.0f},{way.high:+.0f}]")
        cells.append(f"{100 * score.mean:+.1f} +-{200 * score.se:.1f}")
        rows.append([item.b, *cells])
    header = ["", *(SHORT[c] for c in COLUMNS), "progress m", "nuPlan"]
    return lines + text_table(header, rows)


def format_families(report: SuiteReport, row: str) -> str:
    """The per-family table of one row."""
    header = ["family", "cases", "faults", "prevent.", *(SHORT[c] for c in COLUMNS[1:])]
    header += ["progress", "nuPlan"]
    rows = []
    for name, found in report.rows[row].families.items():
        cells = [name, *(f"{found[k]:.0f}" for k in ("cases", "at_fault"))]
        cells.append(f"{found['at_fault_preventable']:.0f}")
        cells += [f"{100 * found[f'{c}_sample']:.2f}" for c in COLUMNS[1:]]
        cells.append(f"{100 * found['progress_ratio']:.0f} %")
        cells.append(f"{100 * found['nuplan']:.1f}")
        rows.append(cells)
    title = f"{row}: per family (rates per sample, progress against {report.reference})"
    return "\n".join([title, *text_table(header, rows)]) + "\n"


def write_csv(
    path: Path,
    runs: Mapping[str, CaseMetrics],
    ids: Sequence[str],
    preventable: np.ndarray,
    parameters: Sequence[Mapping[str, float]],
) -> None:
    """One line per row and case: id, every metric, the case's parameters."""
    fields = dataclasses.fields(CaseMetrics)
    names = []
    for field in fields:
        value = np.asarray(getattr(next(iter(runs.values())), field.name))
        names += _column_names(field.name, value)
    keys = sorted({key for found in parameters for key in found})
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(["row", "case", "preventable", *names, *keys])
    for row, metrics in runs.items():
        columns = [np.asarray(getattr(metrics, f.name)) for f in fields]
        for i, case in enumerate(ids):
            cells = [x for column in columns for x in np.atleast_1d(column[i])]
            drawn = [parameters[i].get(key, "") for key in keys]
            flag = int(preventable[i])
            plain = [x.item() if hasattr(x, "item") else x for x in cells]
            writer.writerow([row, case, flag, *plain, *drawn])
    write_whole(path, text.getvalue())


def _column_names(name: str, value: np.ndarray) -> list[str]:
    if value.ndim == 1:
        return [name]
    labels = COLUMNS if value.shape[1] == len(COLUMNS) else COLUMNS[4:]
    return [f"{name}.{label}" for label in labels]


def result_hash(metrics: CaseMetrics) -> str:
    """sha256 over all metrics of all cases in order.

    Equal for two runs and for two batch sizes, or something is not
    reproducible.
    """
    total = hashlib.sha256()
    for field in dataclasses.fields(CaseMetrics):
        values = np.ascontiguousarray(getattr(metrics, field.name))
        total.update(f"{field.name} {values.dtype} {values.shape}".encode())
        total.update(values.tobytes())
    return total.hexdigest()
