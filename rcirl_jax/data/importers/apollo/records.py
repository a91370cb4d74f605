"""Records of Apollo's middleware Cyber RT: sections, channels, messages.

Layout: cyber/proto/record.proto and cyber/record/file in the Apollo sources. A
file is a row of sections, each with a head of 16 bytes (type int32, 4 bytes
unused, size int64). The header's section takes 2048 bytes, however short the
header is. Channels bring the descriptors of their messages. Chunk bodies hold
the messages. The index at the end is not needed: sections are walked from the
start, so records that were never closed can be read as well.
"""

import contextlib
import mmap
import re
import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rcirl_jax.data.importers.files import files_below
from rcirl_jax.data.readers.wire import (
    MAX_DEPTH,
    Schema,
    WireError,
    fields,
    nested,
    text,
)
from rcirl_jax.errors import InputError

HEAD = struct.Struct("<i4xq")  # type and size of a section
HEADER_BYTES = 2048  # bytes that the header's section takes
HEADER, CHUNK_HEADER, CHUNK_BODY, INDEX, CHANNEL = range(5)
COMPRESSION = {1: "BZ2", 2: "LZ4"}
MAX_DESCRIPTOR_BYTES = 64 * 1024**2  # bytes of one channel's descriptors
# NAME.record, or a part .record.00000; some releases add when it began, .112907, and
# cyber_recorder what it did to a copy
NAME = re.compile(
    r"[^/]+?\.record(?:\.(?P<part>\d{1,9})(?:\.\d{1,20})?)?(?:\.(?:split|recover))?"
)


def drive_name(file: Path) -> str:
    """The part of a name before .record."""
    return file.name.split(".record")[0]


def run_name(first: Path) -> str:
    """Name of a run of parts: its drive's, and its part behind a missing one."""
    name, number = drive_name(first), _part(first)
    is_first = number <= min(_parts_of(first), default=0)
    return name if is_first else f"{name}-{number:05d}"


def is_cut(first: Path) -> bool:
    """Whether the drive of a run has other parts, which do not follow."""
    return len(_parts_of(first)) > len(parts_from(first))


def first_parts(folder: Path, pattern: str) -> list[Path]:
    """The first file of each run of parts at any depth of a folder, sorted."""
    drives = _drives(files_below(folder, pattern))
    if not drives:
        raise InputError(f"{folder}: no file matches {pattern}: expected cyber records")
    return sorted(
        file
        for parts in drives.values()
        for number, file in parts.items()
        if number - 1 not in parts
    )


def parts_from(file: Path) -> list[Path]:
    """A record and, if it is a part, those that follow: .00000, .00001, ..."""
    found, number, chain = _parts_of(file), _part(file), [file]
    while number + len(chain) in found:
        chain.append(found[number + len(chain)])
    return chain


def _parts_of(file: Path) -> dict[int, Path]:
    """Parts of a record's drive by their numbers; none if it is no part."""
    match = NAME.fullmatch(file.name)
    if match is None or match["part"] is None:
        return {}
    drives = _drives(file.parent.glob("*.record.*"))
    return drives.get(_drive(file), {})


def _drive(file: Path) -> Path:
    """The drive of a record, told from those of its name in other folders."""
    return file.parent / drive_name(file)


def _drives(files: Iterable[Path]) -> dict[Path, dict[int, Path]]:
    """Parts by drive and number; of a file and its copies the shortest name counts."""
    drives: dict[Path, dict[int, Path]] = {}
    for file in sorted(files):
        if NAME.fullmatch(file.name):
            drives.setdefault(_drive(file), {}).setdefault(_part(file), file)
    return drives


def _part(file: Path) -> int:
    match = NAME.fullmatch(file.name)
    return int(match["part"] or 0) if match else 0


class Record:
    """One record file, mapped into memory; use as a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # channel -> (message type, its descriptors)
        self.channels: dict[str, tuple[str, Schema]] = {}
        self.is_complete = True

    def __enter__(self) -> "Record":
        try:
            with self.path.open("rb") as handle:
                self._map = mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise InputError(
                f"{self.path}: record: {error}: expected a cyber record"
            ) from error
        self._data = memoryview(self._map)
        return self

    def __exit__(self, *_: object) -> None:
        self._data.release()
        # an error's traceback may still hold a piece
        with contextlib.suppress(BufferError):
            self._map.close()

    def messages(
        self,
        wanted: Callable[[str], bool],
        show: Callable[[int], object] = lambda _: None,
    ) -> Iterator[tuple[str, int, memoryview]]:
        """(channel, time ns, content) of the messages on the wanted channels.

        Args:
          wanted: whether a channel is.
          show: called with the bytes of each section that has been read.
        """
        try:
            for kind, section in self._sections():
                if kind == CHANNEL:
                    self._add_channel(section)
                elif kind == CHUNK_BODY:
                    for number, _, value in fields(section):
                        if number == 1:
                            found = _message(nested(value), wanted)
                            if found is not None:
                                yield found
                show(len(section))
        except WireError as error:
            raise InputError(
                f"{self.path}: {error}: expected a cyber record"
            ) from error

    def _sections(self) -> Iterator[tuple[int, memoryview]]:
        at, end = 0, len(self._data)
        while at < end:
            if end - at < HEAD.size:
                raise self._truncated(at)
            kind, size = HEAD.unpack_from(self._data, at)
            if at == 0:
                self._read_header(kind, size)
                at = HEAD.size + HEADER_BYTES
                continue
            at += HEAD.size
            if not HEADER < kind <= CHANNEL or size < 0:
                raise InputError(
                    f"{self.path}: section at byte {at - HEAD.size}: type {kind}, "
                    f"{size} bytes: expected type 1 to 4"
                )
            if size > end - at:
                raise self._truncated(at)
            yield kind, self._data[at : at + size]
            at += size
            if kind == INDEX:  # the last; the rest is of a file written over
                return

    def _truncated(self, at: int) -> InputError:
        return InputError(
            f"{self.path}: section at byte {at}: beyond the end at "
            f"{len(self._data)}: expected a whole record; truncated?"
        )

    def _read_header(self, kind: int, size: int) -> None:
        """Compress 3, is_complete 13."""
        whole = HEAD.size + HEADER_BYTES <= len(self._data)
        if kind != HEADER or not 0 <= size <= HEADER_BYTES or not whole:
            raise InputError(
                f"{self.path}: header: type {kind}, {size} bytes: "
                "expected that of a cyber record"
            )
        header = dict.fromkeys((3, 13), 0)
        for number, _, value in fields(self._data[HEAD.size : HEAD.size + size]):
            if number in header and isinstance(value, int):
                header[number] = value
        if header[3] != 0:
            name = COMPRESSION.get(header[3], str(header[3]))
            raise InputError(
                f"{self.path}: header: compress: {name}: expected none "
                "(no Apollo release writes compressed chunks)"
            )
        self.is_complete = header[13] != 0

    def _add_channel(self, section: memoryview) -> None:
        """Channel: name 1, message_type 2, proto_desc 3."""
        name, message, schema = "", "", Schema()
        for number, _, value in fields(section):
            if number == 1:
                name = text(value)
            elif number == 2:
                message = text(value)
            elif number == 3:
                if len(nested(value)) > MAX_DESCRIPTOR_BYTES:
                    raise WireError(f"channel {name}: descriptors too large")
                _add_descriptors(schema, nested(value), set(), 0)
        self.channels[name] = (message, schema)


def _add_descriptors(
    schema: Schema, buffer: memoryview, seen: set[bytes], depth: int
) -> None:
    """ProtoDesc: desc 1, dependencies 2, each a ProtoDesc."""
    if depth > MAX_DEPTH:
        raise WireError(f"descriptors: nested deeper than {MAX_DEPTH}")
    for number, _, value in fields(buffer):
        if number == 1 and bytes(nested(value)) not in seen:
            seen.add(bytes(nested(value)))
            schema.add(nested(value))
        elif number == 2:
            _add_descriptors(schema, nested(value), seen, depth + 1)


def _message(
    buffer: memoryview, wanted: Callable[[str], bool]
) -> tuple[str, int, memoryview] | None:
    """SingleMessage: channel_name 1, time 2, content 3; None if not wanted."""
    name, time, content = "", 0, memoryview(b"")
    for number, _, value in fields(buffer):
        if number == 1:
            name = text(value)
        elif number == 2 and isinstance(value, int):
            time = value
        elif number == 3:
            content = nested(value)
    return (name, time, content) if wanted(name) else None
