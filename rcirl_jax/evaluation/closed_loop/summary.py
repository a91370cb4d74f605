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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rcirl_jax.evaluation.statistics import (
    Difference,
    clopper_pearson,
    cluster_t,
    combine_seeds,
    family_clusters,
    holm,
    mcnemar_exact,
)
from rcirl_jax.runtime.atomic_files import write_whole
from rcirl_jax.simulation.cases import STEP_S
from rcirl_jax.simulation.metrics import (
    COLUMNS,
    CaseMetrics,
    not_driven,
    nuplan_score,
)

# %, the paper's Table II in the order of COLUMNS
PAPER = {
    "the paper, RC-IRL": (100.0, 100.0, 99.33, 99.97, 97.77, 82.77),
    "the paper, GAN": (100.0, 99.49, 86.80, 99.97, 71.20, 82.57),
}


# means and worst values of a row: name -> field of the metrics, how
PHYSICAL: dict[str, tuple[str, Callable[[np.ndarray], Any]]] = {
    "rms_a": ("rms_a", np.mean),
    "rms_j": ("rms_j", np.mean),
    "worst_a": ("min_a", np.min),
    "worst_j": ("max_j", np.max),
    # the 5 % quantile, in which "never" (inf) counts as large
    "min_ttc_p5": ("min_ttc", lambda x: np.quantile(np.minimum(x, 1e3), 0.05)),
    "min_headway_p5": ("min_headway", lambda x: np.quantile(np.minimum(x, 1e3), 0.05)),
    "tet_s": ("tet", np.mean),
    "induced_over_4": ("induced_braking", lambda x: np.mean(x > 4.0)),
    "brake_taps": ("brake_taps", np.mean),
    "fallback_share": ("fallback_share", np.mean),
    "standing_share": ("standing_share", np.mean),
    "creeping_share": ("creeping_share", np.mean),
    "sign_changes_per_s": ("sign_changes", np.mean),
    # cases with a start on a free road, and the median of theirs, s; -1 if none
    "starts": ("start_time", lambda x: np.sum(x >= 0.0)),
    "start_s_median": (
        "start_time",
        lambda x: np.median(x[x >= 0.0]) if np.any(x >= 0.0) else -1.0,
    ),
}
# of nuPlan's score
PARTS = (
    "no_fault",
    "drivable",
    "direction",
    "ttc_bound",
    "speed_compliance",
    "comfort",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuiteRuns:
    """Metrics of all rows on the same C cases."""

    rows: Mapping[str, CaseMetrics]  # leaves [C, ...]
    ids: tuple[str, ...]
    groups: tuple[str, ...]
    preventable: np.ndarray  # [C] bool, of `simulation.rows`
    trivial: np.ndarray  # [C] bool
    reference: str  # the row that sets the distance
    way: np.ndarray  # [C] m, how far it got


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
    not_driven: int = 0  # cases in which a program gave no plan


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
    """Returns the rate of k successes of n, exact (Clopper and Pearson 1934).

    Where nothing failed the bound is that of the rule of three: the exact one-sided
    bound of the failures is 1 - 0.05^(1/n) < -ln(0.05) / n < 3 / n.
    """
    low, high = clopper_pearson(k, n)
    bound = 1.0 - min(1.0, 3.0 / n) if k == n else None
    return Rate(k=k, n=n, rate=k / n, low=low, high=high, bound=bound)


def summarise(runs: SuiteRuns) -> SuiteReport:
    """Reports on all rows; the first is compared with the others."""
    names, rows = np.asarray(runs.groups), runs.rows
    way = jnp.asarray(runs.way)
    scores = {row: np.asarray(nuplan_score(m, way)[0]) for row, m in rows.items()}
    cluster = family_clusters(names)
    first, *others = rows
    return SuiteReport(
        cases=len(names),
        families=tuple(dict.fromkeys(runs.groups)),
        preventable=int(runs.preventable.sum()),
        trivial=int(runs.trivial.sum()),
        reference=runs.reference,
        rows={
            row: _row(metrics, scores[row], names, cluster, runs)
            for row, metrics in rows.items()
        },
        comparisons=tuple(_compare(first, b, rows, scores, cluster) for b in others),
    )


def _rates(holds: ArrayLike, total: int, columns: Sequence[str]) -> dict[str, Rate]:
    """Returns the rate of every column of `holds` [C, columns], summed over cases."""
    counts = np.asarray(holds).sum(axis=0).tolist()
    return {name: rate(int(k), total) for name, k in zip(columns, counts, strict=True)}


def _row(
    m: CaseMetrics,
    scores: np.ndarray,
    names: np.ndarray,
    cluster: np.ndarray,
    runs: SuiteRuns,
) -> RowSummary:
    mean = float(scores.mean())
    low, high = mean, mean
    if scores.size > 1:
        found = combine_seeds(scores, cluster)
        low, high = found.low, found.high
    fault, cases = np.asarray(m.at_fault) > 0, len(names)
    samples = max(int(m.samples.sum()), 1)
    jerks = COLUMNS[4:]
    return RowSummary(
        per_case=_rates(m.holds, cases, COLUMNS),
        per_sample=_rates(m.inside, samples, COLUMNS),
        filtered_case=_rates(m.holds_filtered, cases, jerks),
        filtered_sample=_rates(m.inside_filtered, samples, jerks),
        at_fault=int(fault.sum()),
        at_fault_preventable=int((fault & runs.preventable).sum()),
        at_fault_vru=int((np.asarray(m.at_fault_vru) > 0).sum()),
        collisions=int((np.asarray(m.collisions) > 0).sum()),
        red_lights=int(m.red_lights.sum()),
        stop_signs=int(m.stop_signs.sum()),
        off_road=int((np.asarray(m.drivable) < 1.0).sum()),
        progress_m=float(m.progress.mean()),
        progress_ratio=float(m.progress.sum() / max(float(runs.way.sum()), 1e-9)),
        nuplan=mean,
        nuplan_low=low,
        nuplan_high=high,
        parts={name: float(np.mean(getattr(m, name))) for name in PARTS},
        physical={
            name: float(how(np.asarray(getattr(m, field))))
            for name, (field, how) in PHYSICAL.items()
        },
        families={
            name: _family(m, scores, names == name, fault, runs)
            for name in dict.fromkeys(names.tolist())
        },
        not_driven=int(not_driven(m).sum()),
    )


def _family(
    m: CaseMetrics,
    scores: np.ndarray,
    at: np.ndarray,
    fault: np.ndarray,
    runs: SuiteRuns,
) -> dict[str, float]:
    """Returns the numbers of the cases `at` [C] of a family."""
    samples = max(int(m.samples[at].sum()), 1)
    shares = m.inside[at].sum(axis=0) / samples
    passes = m.holds[at].mean(axis=0)
    reached = float(runs.way[at].sum())
    return {
        "cases": float(at.sum()),
        "at_fault": float(fault[at].sum()),
        "at_fault_preventable": float((fault & runs.preventable)[at].sum()),
        "progress_ratio": float(m.progress[at].sum() / max(reached, 1e-9)),
        "nuplan": float(scores[at].mean()),
        **{f"{c}_sample": float(x) for c, x in zip(COLUMNS, shares, strict=True)},
        **{f"{c}_case": float(x) for c, x in zip(COLUMNS, passes, strict=True)},
    }


def _compare(
    a: str,
    b: str,
    rows: Mapping[str, CaseMetrics],
    scores: Mapping[str, np.ndarray],
    cluster: np.ndarray,
) -> SuiteComparison:
    """Makes McNemar per column with Holm over them, and differences over families."""
    mine, theirs = rows[a].holds, rows[b].holds
    wins = (mine & ~theirs).sum(axis=0).tolist()
    losses = (~mine & theirs).sum(axis=0).tolist()
    raw = [mcnemar_exact(w, x) for w, x in zip(wins, losses, strict=True)]
    columns = zip(wins, losses, raw, holm(raw).tolist(), strict=True)

    def apart(x: ArrayLike, y: ArrayLike) -> Difference:
        """Returns the mean of x - y [C] over clusters; of one case alone."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        if x.size < 2:
            mean = float(x[0] - y[0])
            return Difference(mean=mean, low=-np.inf, high=np.inf, se=np.inf, p=1.0)
        return cluster_t(x, y, cluster)

    return SuiteComparison(
        a=a,
        b=b,
        columns=dict(zip(COLUMNS, columns, strict=True)),
        over_families={
            name: apart(mine[:, i], theirs[:, i]) for i, name in enumerate(COLUMNS)
        },
        progress_m=apart(rows[a].progress, rows[b].progress),
        nuplan=apart(scores[a], scores[b]),
    )


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
    """Formats 98.76 [98.1, 99.2], or 100 [>= 99.91] with the rule of three."""
    if found.bound is not None:
        return f"100 (>={100 * found.bound:.2f})"
    low, high = 100 * found.low, 100 * found.high
    return f"{100 * found.rate:.2f} [{low:.1f},{high:.1f}]"


def text_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Formats a table as lines; columns as wide as they need, numbers to the right."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = []
    for row in [header, *rows]:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return lines


def format_suite(report: SuiteReport) -> str:
    """Formats the paper's table, safety and progress, and the differences."""
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
    lines += ["", COMFORT_TITLE]
    lines += text_table(
        ["", *COMFORT_HEADS],
        [[name, *comfort_cells(row)] for name, row in report.rows.items()],
    )
    lines += [
        "",
        f"Safety; progress against {report.reference}",
        "start: from standstill to 80 % of the limit on a free road: median s "
        "(n starts)",
    ]
    lines += text_table(
        ["", "faults", "prevent.", "VRU", "hits", "red",
         "stop", "off road", "creep", "start", "progress", "nuPlan [95 %]"],
        [_safety(name, row) for name, row in report.rows.items()],
    )  # fmt: skip
    for name, row in report.rows.items():
        if row.not_driven:
            lines.append(
                f"{name}: {row.not_driven:,} of {report.cases:,} cases not driven: "
                "they hold no bound, and make no progress"
            )
    lines += ["", *_differences(report)]
    return "\n".join(lines) + "\n"


# the first is what a passenger feels most: docs/closed_loop.md says why
COMFORT_HEADS = (
    *("RMS a, m/s²", "RMS jerk, m/s³", "brake taps/min", "turns of a/min"),
    *("raw |j|<6: drives %", "samples %", "filtered |j|<6: drives %", "samples %"),
)
COMFORT_TITLE = "Comfort; filtered: jerk as nuPlan smooths it, over 1.5 s"


def comfort_cells(row: RowSummary) -> list[str]:
    """Returns the cells of a row under `COMFORT_HEADS`."""
    drives, samples = row.per_case["j_station"].n, row.per_sample["j_station"].n
    minutes = samples * STEP_S / 60.0
    within = (row.per_case, row.per_sample, row.filtered_case, row.filtered_sample)
    return [
        f"{row.physical['rms_a']:.2f}",
        f"{row.physical['rms_j']:.2f}",
        f"{row.physical['brake_taps'] * drives / minutes:.2f}",
        f"{60.0 * row.physical['sign_changes_per_s']:.1f}",
        *(f"{100.0 * of['j_station'].rate:.2f}" for of in within),
    ]


def _safety(name: str, row: RowSummary) -> list[str]:
    starts, median = (row.physical[key] for key in ("starts", "start_s_median"))
    counts = ("at_fault", "at_fault_preventable", "at_fault_vru", "collisions")
    counts += ("red_lights", "stop_signs", "off_road")
    low, high = 100 * row.nuplan_low, 100 * row.nuplan_high
    return [
        name,
        *(str(getattr(row, key)) for key in counts),
        f"{100 * row.physical['creeping_share']:.1f} %",
        f"{median:.1f} ({starts:.0f})" if starts else "- (0)",
        f"{100 * row.progress_ratio:.1f} %",
        f"{100 * row.nuplan:.1f} [{low:.1f},{high:.1f}]",
    ]


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
    """Formats the per-family table of one row."""
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
    path: Path, runs: SuiteRuns, parameters: Sequence[Mapping[str, float]]
) -> None:
    """Writes one line per row and case: id, every metric, the case's parameters."""
    names = []
    for name, value in vars(next(iter(runs.rows.values()))).items():
        width = np.asarray(value).reshape(len(runs.ids), -1).shape[1]
        labels = COLUMNS if width == len(COLUMNS) else COLUMNS[4:]
        names += [f"{name}.{label}" for label in labels] if width > 1 else [name]
    keys = sorted({key for found in parameters for key in found})
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(["row", "case", "preventable", *names, *keys])
    for row, metrics in runs.rows.items():
        columns = [np.asarray(value) for value in vars(metrics).values()]
        for i, case in enumerate(runs.ids):
            cells = [x for column in columns for x in np.atleast_1d(column[i]).tolist()]
            drawn = [parameters[i].get(key, "") for key in keys]
            writer.writerow([row, case, int(runs.preventable[i]), *cells, *drawn])
    write_whole(path, text.getvalue())


def result_hash(metrics: CaseMetrics) -> str:
    """Returns the sha256 over all metrics of all cases in order.

    Equal for two runs and for two batch sizes, or something is not
    reproducible.
    """
    total = hashlib.sha256()
    for field in dataclasses.fields(CaseMetrics):
        values = np.ascontiguousarray(getattr(metrics, field.name))
        total.update(f"{field.name} {values.dtype} {values.shape}".encode())
        total.update(values.tobytes())
    return total.hexdigest()
