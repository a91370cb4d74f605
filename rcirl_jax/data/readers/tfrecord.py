"""TFRecord files, read one record at a time without TensorFlow.

A record is `length` (uint64), `masked_crc32c(length)`, the data and
`masked_crc32c(data)` (uint32 each), all little-endian:

    masked_crc = rotate_right(crc32c, 15) + 0xa282ead8   (mod 2^32)
"""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from rcirl_jax.errors import InputError, extra_module

MAX_RECORD_BYTES = 256 * 1024**2  # bytes of a record
MASK_DELTA = 0xA282EAD8
HEADER = struct.Struct("<QI")
FOOTER = struct.Struct("<I")
FRAME_BYTES = HEADER.size + FOOTER.size  # around the data of a record
GZIP_MAGIC = b"\x1f\x8b"


def read_records(path: Path, limit: int = MAX_RECORD_BYTES) -> Iterator[bytes]:
    """Yields the data of each record of an uncompressed TFRecord file.

    Args:
      path: file.
      limit: bytes of the longest record that is read.

    Raises:
      InputError: damaged, truncated, compressed or empty file; a longer record.
    """
    crc32c = extra_module("google_crc32c").value
    try:
        left, count = path.stat().st_size, 0
        with path.open("rb") as handle:
            while left > 0:
                where = f"{path}: record {count}"
                length = _length(handle, where, left, limit, crc32c)
                data = handle.read(length)
                end = handle.read(FOOTER.size)
                if len(data) + len(end) < length + FOOTER.size:
                    raise InputError(f"{where}: data: cut off: expected {length} bytes")
                _check(where, "data", crc32c(data), *FOOTER.unpack(end))
                left -= FRAME_BYTES + length
                count += 1
                yield data
    except OSError as error:
        raise InputError(f"{path}: {error}: expected a readable file") from error
    if count == 0:
        raise InputError(f"{path}: records: none: expected at least one")


def mask(crc: int) -> int:
    """Returns the masked form in which TFRecord stores a CRC32C."""
    return ((crc >> 15 | crc << 17) + MASK_DELTA) & 0xFFFFFFFF


def _length(
    handle: BinaryIO,
    where: str,
    left: int,
    limit: int,
    crc32c: Callable[[bytes], int],
) -> int:
    """Length of the next record, checked before anything is allocated."""
    header = handle.read(HEADER.size)
    if header.startswith(GZIP_MAGIC):
        raise InputError(f"{where}: gzip data: expected an uncompressed TFRecord file")
    if len(header) < HEADER.size:
        raise InputError(
            f"{where}: header: {len(header)} bytes: expected {HEADER.size}; cut off?"
        )
    length, stored = HEADER.unpack(header)
    _check(where, "length", crc32c(header[:8]), stored)
    rest = left - FRAME_BYTES
    if length > min(rest, limit):
        raise InputError(
            f"{where}: length: {length} bytes: expected at most {limit}, and "
            f"{max(rest, 0)} are left in the file; cut off?"
        )
    return length


def _check(where: str, field: str, crc: int, stored: int) -> None:
    if mask(crc) != stored:
        raise InputError(
            f"{where}: {field} crc32c: {stored:#010x}: expected {mask(crc):#010x}; "
            "damaged, or no TFRecord file"
        )
