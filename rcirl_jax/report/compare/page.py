"""The page that sets runs side by side: one HTML file that needs no other."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from rcirl_jax.evaluation.exact import CONFIDENCE
from rcirl_jax.report.charts import interval_axis, interval_cell
from rcirl_jax.report.compare.runs import ComparedRun
from rcirl_jax.report.pages import Table, facts_text, interval, write_page
from rcirl_jax.report.tuning.verdict_sections import DECISIONS

ALWAYS = ("recipe", "data, sha256", "commit")  # settings shown also where all agree


@dataclasses.dataclass(frozen=True, kw_only=True)
class Metric:
    """How a number is shown."""

    title: str
    unit: str
    scale: float = 1.0
    digits: int = 1
    signed: bool = False


METRICS = {
    "nuplan": Metric(
        title="nuPlan's score, more is better", unit="points", scale=100.0
    ),
    "jerk": Metric(
        title="Drives with raw |jerk| below 6 m/s³, more is better", unit="%",
        scale=100.0,
    ),
    "progress": Metric(
        title="Progress against the incumbent, more is better", unit="%",
        scale=100.0, signed=True,
    ),
    "at_fault": Metric(
        title="Cases with an at-fault collision, less is better", unit="%",
        scale=100.0, digits=2,
    ),
    "distance": Metric(
        title="Distance to the human on held-out drives, less is better", unit="m",
        digits=2,
    ),
    "top1": Metric(
        title="Top-1 distance on held-out scenes, less is better", unit="m", digits=2
    ),
}  # fmt: skip


def write_comparison(
    path: Path, runs: Sequence[ComparedRun], facts: Mapping[str, object]
) -> Path:
    """Write the page.

    Args:
      path: HTML file.
      runs: two or more, in the order in which they are shown.
      facts: provenance of the page.
    """
    return write_page(
        path,
        "compare.html",
        title=f"{len(runs)} tuning runs",
        runs=[
            {"run": run, "kind": DECISIONS.get(run.decision, "open")} for run in runs
        ],
        settings=settings_table(runs),
        metrics=[metric_table(name, runs) for name in METRICS],
        level=f"{100.0 * CONFIDENCE:g} %",
        facts=facts_text(facts),
        incumbents=len({run.incumbent for run in runs}),
    )


def settings_table(runs: Sequence[ComparedRun]) -> Table:
    """Settings that differ, and those of `ALWAYS`; the latter first."""
    names = dict.fromkeys(name for run in runs for name in run.settings)
    rows, marked = [], []
    for name in names:
        cells = [run.settings.get(name, "–") for run in runs]
        differs = len(set(cells)) > 1
        if differs or name in ALWAYS:
            rows.append((name, *cells))
        if differs and name in ALWAYS:
            marked.append(name)
    heads = ("", *(run.name for run in runs))
    return Table(
        caption="Recipe, data, commit, and settings that differ",
        heads=heads,
        rows=rows,
        kind="wrap",
        marked=marked,
    )


def metric_table(name: str, runs: Sequence[ComparedRun]) -> Table:
    """One number of all runs on one axis, with its intervals."""
    how = METRICS[name]
    found = {
        run.name: tuple(how.scale * x for x in run.numbers[name])
        for run in runs
        if name in run.numbers
    }
    ends = (
        min((x[1] for x in found.values()), default=0.0),
        max((x[2] for x in found.values()), default=1.0),
    )
    rows: list[Sequence[object]] = []
    if found:
        rows.append(("", interval_axis(ends, how.digits, how.unit), ""))
    for run in runs:
        if run.name not in found:
            rows.append((run.name, "", "not measured"))
            continue
        value, low, high = found[run.name]
        words = interval((value, low, high), how.digits, signed=how.signed)
        said = f"{run.name}: {words} {how.unit}"
        cell = interval_cell((value, low, high), ends, said)
        rows.append((run.name, cell, f"{words} {how.unit}"))
    return Table(caption=how.title, heads=("", "", ""), rows=rows, kind="forest")
