"""The closed-loop report as terminal text, JSON, CSV and one hash."""

import csv
import dataclasses
import hashlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.evaluation.closed_loop.summary import (
    PAPER,
    Rate,
    RowSummary,
    SuiteReport,
)
from rcirl_jax.runtime.atomic_files import write_whole
from rcirl_jax.simulation.metrics import COLUMNS, CaseMetrics

SHORT = {
    "collision_free": "no fault",
    "speed_limit": "V<limit",
    "a_station": "|a|<4",
    "a_lateral": "|a_lat|<4",
    "j_station": "|j|<6",
    "j_lateral": "|j_lat|<6",
}


def _percent(found: Rate) -> str:
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
            [name, *(_percent(getattr(row, kind)[c]) for c in COLUMNS)]
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
