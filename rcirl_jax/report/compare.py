"""Several tuning runs on one page: settings that differ, numbers side by side."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate.types import CANDIDATE
from rcirl_jax.evaluation.statistics import CONFIDENCE, clopper_pearson
from rcirl_jax.report.charts import Interval, interval_axis, interval_cell
from rcirl_jax.report.pages import Table, facts_text, interval, write_page
from rcirl_jax.report.tuning_page import DECISIONS
from rcirl_jax.runtime.atomic_files import read_json
from rcirl_jax.runtime.checked import checked, leaves
from rcirl_jax.runtime.pipeline import Stages

RUN = "a folder of `rcirl autotune`, finished up to its verdict"
READ = ("verdict.json", "suite/suite.json", "likeness.json", "ranking.json")
HEX = 12  # digits of a hash that are shown
# flags that say where a run was made, not what it is
PLACES = ("output", "run", "executor", "workers", "ray_address", "trackers")
ALWAYS = ("recipe", "data, sha256", "commit")  # settings shown also where all agree


@dataclasses.dataclass(frozen=True, kw_only=True)
class Metric:
    """The form in which a number is shown."""

    title: str
    unit: str
    scale: float = 1.0
    digits: int = 1
    signed: bool = False


METRICS = {
    "nuplan": Metric(
        title="nuPlan's score, more is better", unit="points", scale=100.0
    ),
    "rms_a": Metric(
        title="RMS acceleration saved against the incumbent, more is better", unit="%",
        scale=100.0, signed=True,
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComparedRun:
    """One run."""

    name: str  # its folder
    decision: str
    sentence: str
    incumbent: str
    settings: Mapping[str, str]  # all that is noted of how it was made
    numbers: Mapping[str, Interval]  # by the names of `page.METRICS`, those measured


class _CheckFile(msgspec.Struct):
    kind: str
    name: str
    difference: float
    low: float
    high: float
    measured: bool = True


class _VerdictFile(msgspec.Struct):
    """verdict.json, what is used of it."""

    sentence: str
    decision: str
    cases: int
    checks: list[_CheckFile]
    config: dict = {}


class _Row(msgspec.Struct):
    """A row of suite.json."""

    at_fault: int
    nuplan: float
    nuplan_low: float
    nuplan_high: float


class _Estimate(msgspec.Struct):
    """A number of likeness.json (`mean`) or ranking.json (`value`)."""

    low: float
    high: float
    mean: float | None = None
    value: float | None = None


def read_run(folder: Path) -> ComparedRun:
    """Read the run in a folder.

    Raises:
      InputError: it is no run, has no verdict yet, or a file was changed since.
    """
    kept = Stages(folder=folder)
    stages, path = kept.read(), folder / "verdict.json"
    if "gate" not in stages or not path.is_file():
        raise InputError(f"{folder}: no verdict in it: expected {RUN}")
    for name in READ:
        kept.check_kept(folder / name)
    verdict = checked(read_json(path, "a verdict"), _VerdictFile, path)
    settings = _settings(stages, verdict)
    return ComparedRun(
        name=str(folder),
        decision=verdict.decision,
        sentence=verdict.sentence,
        incumbent=settings.get("incumbent", ""),
        settings=settings,
        numbers={
            **_of_verdict(verdict),
            **_of_suite(folder / "suite" / "suite.json", verdict.cases),
            **_of_row(folder / "likeness.json", "distance_m", "distance"),
            **_of_row(folder / "ranking.json", "top1_fde", "top1"),
        },
    )


def _settings(stages: Mapping[str, dict], verdict: _VerdictFile) -> dict[str, str]:
    """Return recipe, data, commit; then training, simulated demonstrations, gate.

    A flag that says what the training's settings say too is left out.
    """
    gate, train = stages["gate"], stages.get("train 0", {})
    made, inputs = gate.get("made_by") or {}, train.get("inputs") or {}
    given = {
        name: value
        for name, value in (made.get("flags") or {}).items()
        if name not in PLACES
    }
    found = {
        "recipe": given.pop("recipe", None),
        "data, sha256": str(inputs.get("dataset", ""))[:HEX],
        "commit": str(made.get("git_commit") or "")[:HEX],
        "incumbent": (gate.get("inputs") or {}).get("incumbent"),
        "cases": verdict.cases,
        "training runs": sum(name.startswith("train ") for name in stages),
        "prior cost": str(inputs.get("prior_cost", ""))[:HEX],
    }
    found |= _flat(inputs.get("config"), "training")
    driven = stages.get("demonstrate 0", {}).get("inputs") or {}
    plan = driven.get("simulated_demonstrations")
    found |= _flat(plan, "simulated demonstrations") | _flat(verdict.config, "gate")
    said = {name.rpartition(": ")[2].rpartition(".")[2] for name in found}
    of_gate = {f"{name}_margin" for name in verdict.config}
    found |= {
        f"--{name}": value
        for name, value in given.items()
        if name not in said | of_gate
    }
    found |= _flat(made.get("versions"), "version")
    said_of = {}
    for name, value in found.items():
        text = ", ".join(map(str, value)) if isinstance(value, list | tuple) else value
        said_of[name] = "–" if text is None or text == "" else str(text)
    return said_of


def _flat(tree: object, name: str) -> dict[str, object]:
    """Return leaves of nested settings, by "name: field.field"."""
    found = leaves(tree) if isinstance(tree, Mapping) else {}
    return {f"{name}: {n}": x for n, x in found.items() if x is not None}


def _of_verdict(verdict: _VerdictFile) -> dict[str, Interval]:
    """Return numbers against the incumbent, as the report's cards have them."""
    found = {}
    for kind in ("no loss", "gain"):
        for one in verdict.checks:
            if one.kind == kind and one.name in ("progress", "rms_a") and one.measured:
                found[one.name] = one.difference, one.low, one.high
    return found


def _of_suite(path: Path, cases: int) -> dict[str, Interval]:
    """Return closed-loop numbers of the candidate."""
    if (found := _candidate(path, "report")) is None:
        return {}
    row = checked(found, _Row, f"{path}: {CANDIDATE}")
    return {
        "nuplan": (row.nuplan, row.nuplan_low, row.nuplan_high),
        "at_fault": (row.at_fault / cases, *clopper_pearson(row.at_fault, cases)),
    }


def _of_row(path: Path, field: str, name: str) -> dict[str, Interval]:
    """Return one number of the candidate's row."""
    found = _candidate(path)
    if found is None or field not in found:
        return {}
    one = checked(found[field], _Estimate, f"{path}: {CANDIDATE}: {field}")
    middle = one.value if one.mean is None else one.mean
    return {} if middle is None else {name: (middle, one.low, one.high)}


def _candidate(path: Path, *inside: str) -> dict | None:
    """Return the candidate's row of a table in a file; None if nothing was measured."""
    if not path.is_file():
        return None
    found = read_json(path, "a table of a run")
    for key in (*inside, "rows", CANDIDATE):
        found = found.get(key) if isinstance(found, dict) else None
    return found if isinstance(found, dict) else None


def write_comparison(
    path: Path, runs: Sequence[ComparedRun], facts: Mapping[str, object]
) -> Path:
    """Write the page.

    Args:
      path: HTML file.
      runs: two or more, in the order in which they are shown.
      facts: provenance of the page.
    """
    # settings that differ, and those of `ALWAYS`
    rows, marked = [], []
    for name in dict.fromkeys(name for run in runs for name in run.settings):
        cells = [run.settings.get(name, "–") for run in runs]
        differs = len(set(cells)) > 1
        if differs or name in ALWAYS:
            rows.append((name, *cells))
        if differs and name in ALWAYS:
            marked.append(name)
    settings = Table(
        caption="Recipe, data, commit, and settings that differ",
        heads=("", *(run.name for run in runs)),
        rows=rows,
        kind="wrap",
        marked=marked,
    )
    return write_page(
        path,
        "compare.html",
        title=f"{len(runs)} tuning runs",
        runs=[
            {"run": run, "kind": DECISIONS.get(run.decision, "open")} for run in runs
        ],
        settings=settings,
        metrics=[metric_table(name, runs) for name in METRICS],
        level=f"{100.0 * CONFIDENCE:g} %",
        facts=facts_text(facts),
        incumbents=len({run.incumbent for run in runs}),
    )


def metric_table(name: str, runs: Sequence[ComparedRun]) -> Table:
    """Return one number of all runs on one axis, with its intervals."""
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
