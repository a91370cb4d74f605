"""A driven suite on disk: every metric of every case, for tables and gates later.

One npz without pickled objects: `row<i>.<metric>` arrays [C, ...], the rows' names,
ids and groups of the cases, and what the summary needs besides.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rcirl_jax.evaluation.closed_loop.npz_files import (
    check_array,
    names_of_rows,
    read_npz,
    write_npz,
)
from rcirl_jax.evaluation.closed_loop.suite import SuiteResult
from rcirl_jax.evaluation.closed_loop.summary import SuiteReport, summarise
from rcirl_jax.simulation.metrics import CaseMetrics

COLUMNS = {  # metrics of several numbers a case
    **dict.fromkeys(("inside", "holds"), (6,)),
    **dict.fromkeys(("inside_filtered", "holds_filtered"), (2,)),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuiteRuns:
    """Metrics of all rows on the same C cases."""

    rows: Mapping[str, CaseMetrics]  # leaves [C, ...]
    ids: tuple[str, ...]
    groups: tuple[str, ...]
    preventable: np.ndarray  # [C] bool
    trivial: np.ndarray  # [C] bool
    reference: str  # who sets the distance
    way: np.ndarray  # [C] m, how far it got

    def report(self) -> SuiteReport:
        """The table."""
        return summarise(
            self.rows,
            self.groups,
            self.preventable,
            self.trivial,
            self.reference,
            self.way,
        )


def runs_of(result: SuiteResult) -> SuiteRuns:
    """The part of a driven suite that is stored."""
    return SuiteRuns(
        rows=result.runs,
        ids=result.cases.ids,
        groups=result.cases.groups,
        preventable=result.preventable,
        trivial=result.trivial,
        reference=result.reference,
        way=result.way,
    )


def write_runs(path: Path, runs: SuiteRuns) -> None:
    """Write the file, atomically."""
    arrays = {
        "names": np.array(list(runs.rows)),
        "ids": np.array(runs.ids),
        "groups": np.array(runs.groups),
        "preventable": np.asarray(runs.preventable, bool),
        "trivial": np.asarray(runs.trivial, bool),
        "reference": np.array(runs.reference),
        "way": np.asarray(runs.way),
    }
    for number, metrics in enumerate(runs.rows.values()):
        for field in dataclasses.fields(CaseMetrics):
            value = np.asarray(getattr(metrics, field.name))
            arrays[f"row{number}.{field.name}"] = value
    write_npz(path, arrays)


def _check_arrays(arrays: Mapping[str, np.ndarray], rows: int) -> None:
    """Check shapes and kinds: numbers [C, ...] as `CaseMetrics` says, texts [C].

    Raises:
      ValueError, KeyError: another one (names the array).
    """
    numbers, texts, flags = "biuf", "U", "b"
    wanted = {
        "reference": (texts, ()),
        **dict.fromkeys(("ids", "groups"), (texts, (len(arrays["ids"]),))),
        **dict.fromkeys(("preventable", "trivial"), (flags, (len(arrays["ids"]),))),
        "way": (numbers, (len(arrays["ids"]),)),
    }
    for number in range(rows):
        for field in dataclasses.fields(CaseMetrics):
            shape = (len(arrays["ids"]), *COLUMNS.get(field.name, ()))
            wanted[f"row{number}.{field.name}"] = numbers, shape
    for name, (kinds, shape) in wanted.items():
        check_array(arrays, name, kinds, shape)


def read_runs(path: Path) -> SuiteRuns:
    """The suite of a file.

    Raises:
      InputError: missing, damaged, or not such a file.
    """
    with read_npz(path, "the metrics of a suite") as arrays:
        names = names_of_rows(arrays["names"])
        rows = {
            name: CaseMetrics(
                **{
                    field.name: arrays[f"row{number}.{field.name}"]
                    for field in dataclasses.fields(CaseMetrics)
                }
            )
            for number, name in enumerate(names)
        }
        _check_arrays(arrays, len(names))
        return SuiteRuns(
            rows=rows,
            ids=tuple(arrays["ids"].tolist()),
            groups=tuple(arrays["groups"].tolist()),
            preventable=arrays["preventable"],
            trivial=arrays["trivial"],
            reference=str(arrays["reference"]),
            way=arrays["way"],
        )
