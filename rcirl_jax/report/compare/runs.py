"""What a comparison takes from the folder of a tuning run: settings and numbers."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import msgspec

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.exact import clopper_pearson
from rcirl_jax.evaluation.gate.types import CANDIDATE
from rcirl_jax.runtime.atomic_files import read_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.runtime.pipeline import Stages
from rcirl_jax.runtime.settings import leaves

Interval = tuple[float, float, float]  # value, low, high
RUN = "a folder of `rcirl autotune`, finished up to its verdict"
HEX = 12  # digits of a hash that are shown
# flags that say where a run was made, not what it is
PLACES = ("output", "workdir", "run", "executor", "workers", "ray_address", "trackers")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComparedRun:
    """One run."""

    name: str  # its folder
    decision: str
    sentence: str
    incumbent: str
    settings: Mapping[str, str]  # all that is noted of how it was made
    numbers: Mapping[str, Interval]  # by the names of `page.METRICS`, those measured


class _Check(msgspec.Struct):
    kind: str
    name: str
    difference: float
    low: float
    high: float
    measured: bool = True


class _Verdict(msgspec.Struct):
    """verdict.json, what is used of it."""

    sentence: str
    decision: str
    cases: int
    checks: list[_Check]
    config: dict = {}


class _Rate(msgspec.Struct):
    rate: float
    low: float
    high: float


class _Row(msgspec.Struct):
    """A row of suite.json."""

    per_case: dict[str, _Rate]
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
    """The run in a folder.

    Raises:
      InputError: it is no run, or has no verdict yet.
    """
    stages = Stages(folder=folder).read()
    path = folder / "verdict.json"
    if "gate" not in stages or not path.is_file():
        raise InputError(f"{folder}: no verdict in it: expected {RUN}")
    verdict = checked(read_json(path, "a verdict"), _Verdict, path)
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


def _settings(stages: Mapping[str, dict], verdict: _Verdict) -> dict[str, str]:
    """Recipe, data and commit first; then training, rehearsal, gate and other flags.

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
        "prior_cost": str(inputs.get("prior_cost", ""))[:HEX],
    }
    found |= _flat(inputs.get("config"), "training")
    rehearsal = (stages.get("rehearse 0", {}).get("inputs") or {}).get("rehearsal")
    found |= _flat(rehearsal, "rehearsal") | _flat(verdict.config, "gate")
    said = {name.rpartition(": ")[2].rpartition(".")[2] for name in found}
    of_gate = {f"{name}_margin" for name in verdict.config}
    found |= {
        f"--{name}": value
        for name, value in given.items()
        if name not in said | of_gate
    }
    found |= _flat(made.get("versions"), "version")
    return {name: _said(value) for name, value in found.items()}


def _flat(tree: object, name: str) -> dict[str, object]:
    """Leaves of nested settings, by "name: field.field"; {} where there are none."""
    found = leaves(tree) if isinstance(tree, Mapping) else {}
    return {f"{name}: {n}": x for n, x in found.items() if x is not None}


def _said(value: object) -> str:
    """A setting as text; "–" where it is none."""
    if isinstance(value, list | tuple):
        value = ", ".join(map(str, value))
    return "–" if value is None or value == "" else str(value)


def _of_verdict(verdict: _Verdict) -> dict[str, Interval]:
    """Progress against the incumbent, as the report's card has it."""
    for kind in ("gain", "no loss"):
        for one in verdict.checks:
            if (one.kind, one.name) == (kind, "progress") and one.measured:
                return {"progress": (one.difference, one.low, one.high)}
    return {}


def _of_suite(path: Path, cases: int) -> dict[str, Interval]:
    """Closed-loop numbers of the candidate."""
    if (found := _candidate(path, "report")) is None:
        return {}
    row = checked(found, _Row, f"{path}: {CANDIDATE}")
    numbers = {
        "nuplan": (row.nuplan, row.nuplan_low, row.nuplan_high),
        "at_fault": (row.at_fault / cases, *clopper_pearson(row.at_fault, cases)),
    }
    if jerk := row.per_case.get("j_station"):
        numbers["jerk"] = (jerk.rate, jerk.low, jerk.high)
    return numbers


def _of_row(path: Path, field: str, name: str) -> dict[str, Interval]:
    """One number of the candidate's row."""
    found = _candidate(path)
    if found is None or field not in found:
        return {}
    one = checked(found[field], _Estimate, f"{path}: {CANDIDATE}: {field}")
    middle = one.value if one.mean is None else one.mean
    return {} if middle is None else {name: (middle, one.low, one.high)}


def _candidate(path: Path, *inside: str) -> dict | None:
    """The candidate's row of a table in a file; None where nothing was measured."""
    if not path.is_file():
        return None
    found = read_json(path, "a table of a run")
    for key in (*inside, "rows", CANDIDATE):
        found = found.get(key) if isinstance(found, dict) else None
    return found if isinstance(found, dict) else None
