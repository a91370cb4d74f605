"""One-dimensional structured arrays of zarr version 2, read a piece at a time.

Specification: zarr-specs.readthedocs.io/en/latest/v2. The metadata is checked
before anything is decompressed: no object arrays, no filters, no compressor but
blosc, bounded chunks. tensorstore decompresses; it knows no text fields ("<U16"),
so it is told that a record is plain bytes, and numpy gives them their meaning.
"""

import functools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from rcirl_jax.data.readers.tables.streams import first_bytes
from rcirl_jax.errors import InputError, as_input_error
from rcirl_jax.runtime.atomic_files import is_text, read_json
from rcirl_jax.runtime.checked import checked

MAX_METADATA_BYTES = 1024**2  # bytes of a .zarray
MAX_RECORD_BYTES = 64 * 1024  # bytes of one record
MAX_CHUNK_BYTES = 256 * 1024**2  # bytes of one chunk, decompressed
MAX_READ_BYTES = 2 * 1024**3  # bytes read at once
MAX_RECORDS = 10**11  # records of an array; the largest public set has 4 * 10^9
CACHE_BYTES = 64 * 1024**2  # bytes of decompressed chunks kept
BLOSC_HEADER = 16  # bytes; uint32 at 4: size decompressed, at 12: compressed
# little-endian numbers and short texts only; object arrays would be pickles
TYPE = re.compile(r"[<|]?([fiu][1248]|U[1-9][0-9]{0,3})")

_Extent = tuple[Annotated[int, msgspec.Meta(ge=0, le=MAX_RECORDS)]]
_Shape = Annotated[
    list[Annotated[int, msgspec.Meta(ge=1, le=1024)]], msgspec.Meta(max_length=3)
]
_Field = Annotated[list[str | _Shape], msgspec.Meta(min_length=2, max_length=3)]


class _Blosc(msgspec.Struct):
    id: Literal["blosc"]


class _Metadata(msgspec.Struct):
    """The fields of a .zarray that are read."""

    zarr_format: Literal[2]
    shape: _Extent
    chunks: _Extent
    dtype: Annotated[list[_Field], msgspec.Meta(min_length=1, max_length=64)]
    compressor: _Blosc | None = None
    filters: Annotated[list, msgspec.Meta(max_length=0)] | None = None


class StructuredArray:
    """A folder with a .zarray and chunks "0", "1", ... of records."""

    def __init__(self, folder: Path, fields: Mapping[str, tuple[str, tuple]]) -> None:
        """Reads and checks the metadata only.

        Args:
          folder: of the array.
          fields: name -> (numpy kinds allowed, shape) of the fields needed.
        """
        self.path = folder
        file = folder / ".zarray"
        body = read_json(file, "the metadata of an array", MAX_METADATA_BYTES)
        meta = checked(body, _Metadata, file)
        (self.size,), (self.chunk,) = meta.shape, meta.chunks
        self.dtype = _dtype(file, meta.dtype)
        known: Any = self.dtype.fields or {}
        for name, (kinds, shape) in fields.items():
            found = known[name][0] if name in known else None
            if found is None or found.base.kind not in kinds or found.shape != shape:
                raise InputError(
                    f"{file}: dtype: {name}: {found or 'missing'}: expected shape "
                    f"{shape}, kind {' or '.join(kinds)}, among {', '.join(known)}"
                )
        self._texts = [name for name in fields if known[name][0].base.kind == "U"]
        most = MAX_CHUNK_BYTES // self.dtype.itemsize
        if not 1 <= self.chunk <= most:
            raise InputError(f"{file}: chunks: {self.chunk}: expected 1 to {most}")
        self._is_packed = meta.compressor is not None
        self._checked: set[int] = set()

    def read(self, start: int, stop: int) -> np.ndarray:
        """Returns records start .. stop - 1."""
        if start >= stop:
            return np.zeros(0, self.dtype)
        where, size = f"records {start} to {stop}", (stop - start) * self.dtype.itemsize
        if size > MAX_READ_BYTES:
            raise InputError(
                f"{self.path}: {where}: {size} bytes: expected at most {MAX_READ_BYTES}"
            )
        for number in range(start // self.chunk, (stop - 1) // self.chunk + 1):
            if number not in self._checked:
                self._check_chunk(number)
        with as_input_error(f"{self.path}: {where}", "whole chunks"):
            raw = self._store[start:stop].read().result()
        records = np.ascontiguousarray(raw).reshape(-1).view(self.dtype)
        for name in self._texts:
            if not is_text(records[name]):
                raise InputError(
                    f"{self.path}: {where}: {name}: characters that are none: "
                    "expected text"
                )
        return records

    @functools.cached_property
    def _store(self) -> Any:  # noqa: ANN401 - tensorstore is imported when needed
        import tensorstore

        spec = {
            "driver": "zarr",
            "kvstore": {"driver": "file", "path": str(self.path.resolve())},
            "metadata": {
                "shape": [self.size],
                "chunks": [self.chunk],
                "dtype": [["record", "|u1", [self.dtype.itemsize]]],
                # what decompresses is written in each chunk
                "compressor": {"id": "blosc"} if self._is_packed else None,
            },
            "context": {"cache_pool": {"total_bytes_limit": CACHE_BYTES}},
        }
        return tensorstore.open(spec, open=True, assume_metadata=True).result()

    def _check_chunk(self, number: int) -> None:
        """Checks that a chunk is there (a missing one reads as 0) and its two sizes."""
        file = self.path / str(number)
        if not file.is_file():
            raise InputError(f"{file}: chunk: missing: expected a file")
        sizes, expected = [file.stat().st_size], [self.chunk * self.dtype.itemsize]
        if self._is_packed:  # the head says both: decompressed, and as it is
            head = first_bytes(file, BLOSC_HEADER)
            unpacked, packed = (int.from_bytes(head[k:][:4], "little") for k in (4, 12))
            sizes, expected = [*sizes, unpacked], [packed, *expected]
        if sizes != expected:
            raise InputError(f"{file}: chunk: {sizes} bytes: expected {expected}")
        self._checked.add(number)


def _dtype(file: Path, fields: list[list]) -> np.dtype:
    """The type of a record, by its fields [name, type] or [name, type, shape]."""
    parts = []
    for name, kind, *shape in fields:
        match = TYPE.fullmatch(str(kind))
        if not (isinstance(name, str) and match and {*map(type, shape)} <= {list}):
            raise InputError(
                f"{file}: dtype: {str([name, kind, *shape])[:60]}: "
                "expected [name, little-endian number or text, shape]"
            )
        parts.append((name, f"<{match[1]}", *map(tuple, shape)))
    with as_input_error(str(file), "fields of different names"):
        dtype = np.dtype(parts)
    if not 0 < dtype.itemsize <= MAX_RECORD_BYTES:
        most = f"expected 1 to {MAX_RECORD_BYTES}"
        raise InputError(f"{file}: dtype: {dtype.itemsize} bytes: {most}")
    return dtype
