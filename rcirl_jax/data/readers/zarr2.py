"""One-dimensional structured arrays of zarr version 2, read a piece at a time.

Specification: zarr-specs.readthedocs.io/en/latest/v2. The metadata is checked
before anything is decompressed: no object arrays, no filters, no compressor but
blosc, bounded chunks. tensorstore decompresses; it knows no text fields ("<U16"),
so it is told that a record is plain bytes, and numpy gives them their meaning.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import is_text, parse_json

MAX_METADATA_BYTES = 1024**2  # bytes of a .zarray
MAX_RECORD_BYTES = 64 * 1024  # bytes of one record
MAX_CHUNK_BYTES = 256 * 1024**2  # bytes of one chunk, decompressed
MAX_READ_BYTES = 2 * 1024**3  # bytes read at once
MAX_RECORDS = 10**11  # records of an array; the largest public set has 4 * 10^9
CACHE_BYTES = 64 * 1024**2  # bytes of decompressed chunks kept
BLOSC_HEADER = 16  # bytes; uint32 at 4: size decompressed, at 12: compressed
TYPE = re.compile(r"[<|]?(?:([fiu][1248])|(U)([1-9][0-9]{0,3}))")


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
        meta = read_json(file, MAX_METADATA_BYTES)
        self.size = _extent(file, meta, "shape", MAX_RECORDS)
        self.chunk = _extent(file, meta, "chunks", MAX_RECORDS)
        self.dtype = _dtype(file, meta.get("dtype"))
        _check_fields(file, self.dtype, fields)
        self._texts = [name for name in fields if self.dtype[name].base.kind == "U"]
        if self.chunk < 1 or self.chunk * self.dtype.itemsize > MAX_CHUNK_BYTES:
            raise InputError(
                f"{file}: chunks: {self.chunk} records: expected 1 to "
                f"{MAX_CHUNK_BYTES // self.dtype.itemsize}"
            )
        self._compressor = _compressor(file, meta)
        self._store = None
        self._checked: set[int] = set()

    def read(self, start: int, stop: int) -> np.ndarray:
        """Records start .. stop - 1."""
        if start >= stop:
            return np.zeros(0, self.dtype)
        if (stop - start) * self.dtype.itemsize > MAX_READ_BYTES:
            raise InputError(
                f"{self.path}: records {start} to {stop}: "
                f"{(stop - start) * self.dtype.itemsize} bytes: "
                f"expected at most {MAX_READ_BYTES}"
            )
        for number in range(start // self.chunk, (stop - 1) // self.chunk + 1):
            if number not in self._checked:
                self._check_chunk(number)
        try:
            raw = self._open()[start:stop].read().result()
        except ValueError as error:
            raise InputError(
                f"{self.path}: records {start} to {stop}: {_brief(error)}: "
                "expected whole chunks"
            ) from error
        records = np.ascontiguousarray(raw).reshape(-1).view(self.dtype)
        for name in self._texts:
            if not is_text(records[name]):
                raise InputError(
                    f"{self.path}: records {start} to {stop}: {name}: characters that "
                    "are none: expected text"
                )
        return records

    def _open(self) -> Any:  # noqa: ANN401 - tensorstore is imported when needed
        if self._store is None:
            import tensorstore

            self._store = tensorstore.open(
                {
                    "driver": "zarr",
                    "kvstore": {"driver": "file", "path": str(self.path.resolve())},
                    "metadata": {
                        "zarr_format": 2,
                        "shape": [self.size],
                        "chunks": [self.chunk],
                        "dtype": [["record", "|u1", [self.dtype.itemsize]]],
                        "compressor": self._compressor,
                        "filters": None,
                        "fill_value": None,
                        "order": "C",
                    },
                    "context": {"cache_pool": {"total_bytes_limit": CACHE_BYTES}},
                },
                open=True,
                assume_metadata=True,
            ).result()
        return self._store

    def _check_chunk(self, number: int) -> None:
        """The file is there and decompresses to a chunk; a missing one reads as 0."""
        file = self.path / str(number)
        expected = self.chunk * self.dtype.itemsize
        try:
            size = file.stat().st_size
            with file.open("rb") as handle:
                head = handle.read(BLOSC_HEADER)
        except OSError as error:
            raise InputError(
                f"{file}: chunk: {error.strerror}: expected a file"
            ) from error
        if self._compressor is not None:
            if len(head) < BLOSC_HEADER:
                raise InputError(f"{file}: chunk: {size} bytes: expected blosc data")
            found = int.from_bytes(head[4:8], "little")
            if found != expected:
                raise InputError(
                    f"{file}: chunk: {found} bytes decompressed: expected {expected}"
                )
            expected = int.from_bytes(head[12:16], "little")
        if size != expected:
            raise InputError(f"{file}: chunk: {size} bytes: expected {expected}")
        self._checked.add(number)


def read_json(file: Path, max_bytes: int) -> dict:
    """A small JSON object."""
    try:
        size = file.stat().st_size
        content = file.read_bytes() if size <= max_bytes else b""
    except OSError as error:
        raise InputError(f"{file}: {error.strerror}: expected a file") from error
    if size > max_bytes:
        raise InputError(f"{file}: size: {size} bytes: expected at most {max_bytes}")
    try:
        found = parse_json(content)
    except ValueError as error:
        raise InputError(f"{file}: json: {_brief(error)}: expected JSON") from error
    if not isinstance(found, dict):
        raise InputError(f"{file}: json: {type(found).__name__}: expected an object")
    return found


def _brief(error: Exception) -> str:
    """First line of a message, short."""
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def _extent(file: Path, meta: dict, key: str, limit: int) -> int:
    """The only number of a list such as [20802]."""
    if meta.get("zarr_format") != 2:
        raise InputError(f"{file}: zarr_format: {meta.get('zarr_format')}: expected 2")
    value = meta.get(key)
    if (
        not isinstance(value, list)
        or len(value) != 1
        or type(value[0]) is not int
        or not 0 <= value[0] <= limit
    ):
        raise InputError(f"{file}: {key}: {str(value)[:40]}: expected one size")
    return value[0]


def _dtype(file: Path, fields: object) -> np.dtype:
    """Numbers and short texts only; object arrays would be pickles."""
    if not isinstance(fields, list) or not 0 < len(fields) <= 64:
        raise InputError(
            f"{file}: dtype: {str(fields)[:40]}: expected a list of fields"
        )
    parts = []
    for field in fields:
        whole = isinstance(field, list) and len(field) >= 2
        name, kind, *shape = field if whole else ("", "")
        match = TYPE.fullmatch(kind) if isinstance(kind, str) else None
        shape = shape[0] if len(shape) == 1 else shape
        sizes = isinstance(shape, list) and all(
            type(size) is int and 0 < size <= 1024 for size in shape
        )
        if not (isinstance(name, str) and name and match and sizes and len(shape) <= 3):
            raise InputError(
                f"{file}: dtype: {str(field)[:60]}: "
                "expected [name, little-endian number or text, shape]"
            )
        parts.append((name, "<" + kind.lstrip("<|"), tuple(shape)))
    try:
        dtype = np.dtype(parts)
    except ValueError as error:
        raise InputError(
            f"{file}: dtype: {_brief(error)}: expected different names"
        ) from error
    if not 0 < dtype.itemsize <= MAX_RECORD_BYTES:
        raise InputError(
            f"{file}: dtype: {dtype.itemsize} bytes: expected 1 to {MAX_RECORD_BYTES}"
        )
    return dtype


def _check_fields(
    file: Path, dtype: np.dtype, fields: Mapping[str, tuple[str, tuple]]
) -> None:
    for name, (kinds, shape) in fields.items():
        if name not in (dtype.names or ()):
            raise InputError(
                f"{file}: dtype: {name}: missing: expected it among {dtype.names}"
            )
        found = dtype[name]
        if found.base.kind not in kinds or found.shape != shape:
            raise InputError(
                f"{file}: dtype: {name}: {found}: expected shape {shape}, "
                f"kind {' or '.join(kinds)}"
            )


def _compressor(file: Path, meta: dict) -> dict | None:
    if meta.get("filters"):
        raise InputError(f"{file}: filters: {str(meta['filters'])[:40]}: expected none")
    found = meta.get("compressor")
    if found is None:
        return None
    if not isinstance(found, dict) or found.get("id") != "blosc":
        raise InputError(
            f"{file}: compressor: {str(found)[:60]}: expected blosc or none"
        )
    # what decompresses is written in each chunk; these only have to be valid
    return {"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 1, "blocksize": 0}
