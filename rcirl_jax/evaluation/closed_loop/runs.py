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
from rcirl_jax.evaluation.closed_loop.summary import SuiteRuns
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
    """Writes arrays by name as a packed file, whole or not at all."""
    packed = io.BytesIO()
    np.savez_compressed(packed, allow_pickle=False, **arrays)
    write_whole(path, packed.getvalue())


@contextlib.contextmanager
def read_npz(path: Path, expected: str) -> Iterator[dict[str, Any]]:
    """Reads the arrays of a file by name; checks what the block makes of them too.

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
    """Returns texts [rows], checked: a file may claim 2**40 empty ones in no bytes.

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
    """Reads the arrays of the archive; what it would unpack to is checked first."""
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


def write_runs(path: Path, runs: SuiteRuns) -> None:
    """Writes the file, atomically."""
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
        for name, value in vars(metrics).items():
            arrays[f"row{number}.{name}"] = np.asarray(value)
    write_npz(path, arrays)


def read_runs(path: Path) -> SuiteRuns:
    """Reads the suite of a file.

    Raises:
      InputError: missing, damaged, or not such a file.
    """
    numbers, texts, flags = "biuf", "U", "b"
    with read_npz(path, "the metrics of a suite") as arrays:
        names, count = names_of_rows(arrays["names"]), len(arrays["ids"])
        fields = [field.name for field in dataclasses.fields(CaseMetrics)]
        check_array(arrays, "reference", texts, ())
        check_array(arrays, "way", numbers, (count,))
        for name in ("ids", "groups"):
            check_array(arrays, name, texts, (count,))
        for name in ("preventable", "trivial"):
            check_array(arrays, name, flags, (count,))
        rows = {}
        for number, name in enumerate(names):
            for field in fields:
                shape = (count, *COLUMNS.get(field, ()))
                check_array(arrays, f"row{number}.{field}", numbers, shape)
            values = {field: arrays[f"row{number}.{field}"] for field in fields}
            rows[name] = CaseMetrics(**values)
        return SuiteRuns(
            rows=rows,
            ids=tuple(arrays["ids"].tolist()),
            groups=tuple(arrays["groups"].tolist()),
            preventable=arrays["preventable"],
            trivial=arrays["trivial"],
            reference=str(arrays["reference"]),
            way=arrays["way"],
        )
