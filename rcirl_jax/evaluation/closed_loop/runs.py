"""A driven suite on disk: every metric of every case, for tables and gates later.

One npz without pickled objects, checked before it is unpacked: `row<i>.<metric>` arrays
[C, ...], the rows' names, ids and groups of the cases, and what the summary needs.
"""

import contextlib
import dataclasses
import io
import math
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.closed_loop.suite import SuiteResult
from rcirl_jax.evaluation.closed_loop.summary import SuiteReport, summarise
from rcirl_jax.runtime.atomic_files import is_text, write_whole
from rcirl_jax.simulation.metrics import CaseMetrics

MAX_BYTES = 2**30  # bytes of a file, unpacked
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
DAMAGED = (
    # of files and arrays; of zip: damaged, packed or locked in ways not known
    *(OSError, ArithmeticError, LookupError, ValueError, TypeError),
    *(EOFError, MemoryError, RuntimeError, SyntaxError),  # of a kind "(,)f8"
    *(zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Arrays by name as a packed file, whole or not at all."""
    packed = io.BytesIO()
    np.savez_compressed(packed, allow_pickle=False, **arrays)
    write_whole(path, packed.getvalue())


@contextlib.contextmanager
def read_npz(path: Path, expected: str) -> Iterator[dict[str, Any]]:
    """The arrays of a file by name; what the block makes of them is checked as well.

    Args:
      path: the file.
      expected: of the file, last in the line.

    Raises:
      InputError: the file is missing or damaged, or one of `DAMAGED` in the block.
    """
    try:
        yield _arrays(path)
    except DAMAGED as error:
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: {why}: expected {expected}") from error


def check_array(
    arrays: Mapping[str, np.ndarray], name: str, kinds: str, shape: tuple[int, ...]
) -> None:
    """Check one array's kind, of numpy's letters ("U" is text), and its shape.

    Raises:
      ValueError, KeyError: another one (names the array).
    """
    found = arrays[name]
    if found.dtype.kind not in kinds or found.shape != shape:
        raise ValueError(f"{name}: {found.dtype} {found.shape}, not {shape}")


def names_of_rows(found: np.ndarray) -> list[str]:
    """Texts [rows], checked first: a file may claim 2**40 empty ones in no bytes.

    Raises:
      ValueError: another array, or a name that is there twice.
    """
    if found.dtype.kind != "U" or found.ndim != 1:
        raise ValueError(f"names: {found.dtype} {found.shape}, not texts (rows,)")
    names = found.tolist()
    if len(set(names)) != len(names):
        raise ValueError("names: one twice")
    return names


def _arrays(path: Path) -> dict[str, Any]:
    """The arrays of the archive; what it would unpack to is checked first."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if any(member.compress_type not in PACKINGS for member in members):
            raise ValueError("packed in a way that numpy does not write")
        size = sum(member.file_size for member in members)
        if size > MAX_BYTES:
            raise ValueError(f"{size} bytes unpacked, more than {MAX_BYTES}")
        for member in members:
            _check_claim(archive, member)
    with np.load(path, allow_pickle=False) as found:
        arrays = {name: found[name] for name in found.files}
    for name, value in arrays.items():
        if value.size > max(value.nbytes, 1):  # texts of no length, any number of them
            raise ValueError(f"{name}: {value.size} values in {value.nbytes} bytes")
        if value.dtype.kind == "U" and not is_text(value):
            raise ValueError(f"{name}: characters that are none")
    return arrays


def _check_claim(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    """Check that an array's head claims the bytes that are there, before any is made.

    Raises:
      ValueError: it does not, or the member is no array.
    """
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        if version != (1, 0):
            raise ValueError(f"{member.filename}: version {version} of its head")
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        held = member.file_size - file.tell()
    if math.prod(shape) * dtype.itemsize != held:
        raise ValueError(f"{member.filename}: {shape} of {dtype} in {held} bytes")


# ---------------------------------------------------------------- suites

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
