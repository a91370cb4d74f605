"""Records of Apollo's middleware Cyber RT: files, sections, channels, messages.

Layout: cyber/proto/record.proto and cyber/record/file in the Apollo sources. A
section has a head of 16 bytes (type int32, 4 bytes unused, size int64); that of the
header takes 2048 bytes, however short the header is. Sections are walked from the
start and not by the index, so records that were never closed can be read as well.
"""

import mmap
import re
import struct
from collections.abc import Callable, Container, Iterable, Iterator
from pathlib import Path
from typing import Any

from google.protobuf.message import DecodeError

from rcirl_jax.data.formats.files import files_below
from rcirl_jax.data.readers.protobuf import parsers
from rcirl_jax.errors import InputError

HEAD = struct.Struct("<i4xq")  # type and size of a section
HEADER_BYTES = 2048  # bytes that the header's section takes
HEADER, CHUNK_HEADER, CHUNK_BODY, INDEX, CHANNEL = range(5)
MAX_BYTES = 16 * 1024**2  # bytes of a message, or of what is said of a channel
VARINT, LENGTH = 0, 2  # wire types
SIZES = {1: 8, 5: 4}  # bytes of those of one size
# NAME.record, or a part .record.00000; some releases add when it began, .112907, and
# cyber_recorder what it did to a copy
NAME = re.compile(
    r"[^/]+?\.record(?:\.(?P<part>\d{1,9})(?:\.\d{1,20})?)?(?:\.(?:split|recover))?"
)

PARSERS = parsers(
    """
Header: compress 3 int64, is_complete 13 bool
Channel: name 1 string, message_type 2 string
"""
)


class Run:
    """A record and, if it is a part, those that follow: .00000, .00001, ..."""

    def __init__(self, first: Path) -> None:
        match = NAME.fullmatch(first.name)
        is_part = match is not None and match["part"] is not None
        drive, number = _drive_and_part(first)
        beside = first.parent.glob("*.record.*") if is_part else ()
        known = _drives(beside).get(drive, {})
        self.first, self.drive, self.files = first, drive.name, [first]
        while (following := known.get(number + len(self.files))) is not None:
            self.files.append(following)
        # its drive's, and its part behind a missing one
        is_first = number <= min(known, default=0)
        self.name = self.drive if is_first else f"{self.drive}-{number:05d}"
        # the drive has other parts, which do not follow
        self.is_cut = len(known) > len(self.files)


def first_parts(folder: Path, pattern: str) -> list[Path]:
    """Lists the first file of each run of parts at any depth of a folder, sorted."""
    drives = _drives(files_below(folder, pattern)).values()
    firsts = [f for parts in drives for n, f in parts.items() if n - 1 not in parts]
    if not firsts:
        raise InputError(f"{folder}: no file matches {pattern}: expected cyber records")
    return sorted(firsts)


def _drives(files: Iterable[Path]) -> dict[Path, dict[int, Path]]:
    """Parts by drive and number; of a file and its copies the shortest name counts."""
    drives: dict[Path, dict[int, Path]] = {}
    for file in filter(lambda one: NAME.fullmatch(one.name), sorted(files)):
        drive, number = _drive_and_part(file)
        drives.setdefault(drive, {}).setdefault(number, file)
    return drives


def _drive_and_part(file: Path) -> tuple[Path, int]:
    """Drive of a record, told from those of its name in other folders; its number."""
    match = NAME.fullmatch(file.name)
    number = int(match["part"] or 0) if match else 0
    return file.parent / file.name.split(".record")[0], number


class Record:
    """One record file; its messages are read once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.types: dict[str, str] = {}  # channel -> type of its messages
        self.is_complete = True

    def _error(self, field: str, found: object, expected: str) -> InputError:
        return InputError(f"{self.path}: {field}: {found}: expected {expected}")

    def messages(
        self, wanted: Container[str], show: Callable[[int], object] = lambda _: None
    ) -> Iterator[tuple[str, int, memoryview]]:
        """Yields (channel, time ns, content) of the messages on the wanted channels.

        Args:
          wanted: names of channels.
          show: called with the bytes of each section that has been read.
        """
        try:
            with self.path.open("rb") as handle:
                whole = mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise self._error("record", error, "a cyber record") from error
        try:
            for kind, section in self._sections(memoryview(whole)):
                if kind == CHANNEL:
                    check_size("channel", section)
                    channel = PARSERS["Channel"](bytes(section))
                    self.types[channel.name] = channel.message_type
                elif kind == CHUNK_BODY:
                    for number, value in _fields(section):
                        if number == 1 and (sent := _message(value))[0] in wanted:
                            yield sent
                show(len(section))
        except DecodeError as error:
            raise InputError(
                f"{self.path}: {error}: expected a cyber record"
            ) from error

    def _sections(self, data: memoryview) -> Iterator[tuple[int, memoryview]]:
        """(type, content) of the sections behind the header, up to the index."""
        at, end = HEAD.size + HEADER_BYTES, len(data)
        kind, size = HEAD.unpack_from(data) if end >= at else (-1, end)
        if kind != HEADER or not 0 <= size <= HEADER_BYTES:
            found = f"type {kind}, {size} bytes"
            raise self._error("header", found, "that of a cyber record")
        header = PARSERS["Header"](bytes(data[HEAD.size : HEAD.size + size]))
        if header.compress != 0:
            expected = "0, none (no Apollo release writes compressed chunks)"
            raise self._error("header: compress", header.compress, expected)
        self.is_complete = header.is_complete
        while (
            at < end and kind != INDEX
        ):  # the last; the rest is of a file written over
            size, where = HEAD.size, at
            if size <= end - at:
                kind, size = HEAD.unpack_from(data, at)
                at += HEAD.size
                if not HEADER < kind <= CHANNEL or size < 0:
                    found, expected = f"type {kind}, {size} bytes", "type 1 to 4"
                    raise self._error(f"section at byte {where}", found, expected)
            if size > end - at:
                found = f"{size} bytes of {end - at} left"
                expected = "a whole record; truncated?"
                raise self._error(f"section at byte {where}", found, expected)
            yield kind, data[at : at + size]
            at += size


def check_size(what: str, content: memoryview) -> None:
    """Refuses long content: parsed, a message takes many times its bytes."""
    if len(content) > MAX_BYTES:
        raise DecodeError(f"{what}: {len(content)} bytes of at most {MAX_BYTES}")


def _message(single: int | memoryview) -> tuple[str, int, memoryview]:
    """SingleMessage: channel_name 1, time 2, content 3."""
    found: dict[int, Any] = {1: b"", 2: 0, 3: memoryview(b""), **dict(_fields(single))}
    name, time, content = found[1], found[2], found[3]
    if isinstance(name, int) or not isinstance(time, int) or isinstance(content, int):
        raise DecodeError("message: a number for bytes")
    return bytes(name).decode(errors="replace"), time, content


def _fields(buffer: int | memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """(number, value) of a message's whole numbers and bytes; nothing is copied.

    By hand: the library copies all pictures and point clouds, in eight times the time.
    """
    if isinstance(buffer, int):
        raise DecodeError("message: number: expected bytes")
    at, end = 0, len(buffer)
    while at < end:
        key, at = _varint(buffer, at)
        number, wire = key >> 3, key & 7
        value, size = None, SIZES.get(wire, 0)
        if wire == VARINT:
            value, at = _varint(buffer, at)
        elif wire == LENGTH:
            size, at = _varint(buffer, at)
        elif not size:
            raise DecodeError(f"field {number}: wire type {wire}")
        if size > end - at:
            raise DecodeError(f"field {number}: {size} bytes of {end - at} left")
        if wire == LENGTH:
            value = buffer[at : at + size]
        at += size
        if value is not None:
            yield number, value


def _varint(buffer: memoryview, at: int) -> tuple[int, int]:
    """(value, place behind it) of a base-128 number of at most ten bytes."""
    if at < len(buffer) and buffer[at] < 0x80:  # most are short
        return buffer[at], at + 1
    value = 0
    for place, byte in enumerate(buffer[at : at + 10]):
        value |= (byte & 0x7F) << (7 * place)
        if byte < 0x80:
            return value, at + place + 1
    raise DecodeError("varint: no end within ten bytes")
