"""TFRecord files, read one record at a time without TensorFlow.

A record is `length` (uint64), `masked_crc32c(length)`, the data and
`masked_crc32c(data)` (uint32 each), all little-endian:

    masked_crc = rotate_right(crc32c, 15) + 0xa282ead8   (mod 2^32)
"""

import struct
from collections.abc import Iterator
from pathlib import Path

from rcirl_jax.errors import InputError, extra_module

MAX_RECORD_BYTES = 256 * 1024**2  # bytes of a record
MASK_DELTA = 0xA282EAD8
HEADER = struct.Struct("<QI")
FOOTER = struct.Struct("<I")
FRAME_BYTES = HEADER.size + FOOTER.size  # around the data of a record
GZIP_MAGIC = b"\x1f\x8b"


def read_records(path: Path, limit: int = MAX_RECORD_BYTES) -> Iterator[bytes]:
    """Yields the data of each record, of `limit` bytes at most, uncompressed.

    Raises:
      InputError: damaged, truncated, compressed or empty file; a longer record.
    """
    crc32c = extra_module("google_crc32c").value

    def check(where: str, field: str, content: bytes, stored: int) -> None:
        if (crc := mask(crc32c(content))) != stored:
            raise InputError(
                f"{where}: {field} crc32c: {stored:#010x}: expected {crc:#010x}; "
                "damaged, or no TFRecord file"
            )

    left, count = path.stat().st_size, 0
    with path.open("rb") as handle:
        while left > 0:
            where, header = f"{path}: record {count}", handle.read(HEADER.size)
            if header.startswith(GZIP_MAGIC):
                expected = "expected an uncompressed TFRecord file"
                raise InputError(f"{where}: gzip data: {expected}")
            if len(header) < HEADER.size:
                found = f"{len(header)} bytes: expected {HEADER.size}; cut off?"
                raise InputError(f"{where}: header: {found}")
            length, stored = HEADER.unpack(header)
            check(where, "length", header[:8], stored)
            rest = left - FRAME_BYTES
            if not 0 <= length <= min(rest, limit):  # before anything is allocated
                raise InputError(
                    f"{where}: length: {length} bytes: expected at most {limit}, "
                    f"and {max(rest, 0)} are left in the file; cut off?"
                )
            data = handle.read(length)
            check(where, "data", data, *FOOTER.unpack(handle.read(FOOTER.size)))
            left -= FRAME_BYTES + length
            count += 1
            yield data
    if count == 0:
        raise InputError(f"{path}: records: none: expected at least one")


def mask(crc: int) -> int:
    """Returns the masked form in which TFRecord stores a CRC32C."""
    return ((crc >> 15 | crc << 17) + MASK_DELTA) & 0xFFFFFFFF
