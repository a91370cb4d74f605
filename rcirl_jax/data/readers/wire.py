"""Protocol buffers read by field number or by name, without generated classes.

Encoding: protobuf.dev/programming-guides/encoding. A log's own descriptors
(FileDescriptorProto, embedded in cyber records) give the names, so that records
of every release read alike and no protobuf version is asked for. Nothing is
allocated for a field before its length is known to lie inside the buffer.
"""

import struct
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

VARINT, FIXED64, LENGTH, FIXED32 = 0, 1, 2, 5  # wire types
MAX_MESSAGES = 100_000  # message types of a set of descriptors
MAX_DEPTH = 64  # nested messages, and descriptors that import each other
# descriptor's type number -> struct format of a fixed field, or its reading
FIXED = {1: "<d", 2: "<f", 6: "<Q", 7: "<I", 15: "<i", 16: "<q"}
SIGNED = (3, 5)  # int64, int32: negative numbers take ten bytes
ZIGZAG = (17, 18)  # sint32, sint64
TEXT, MESSAGE, BYTES, ENUM = 9, 11, 12, 14
REPEATED = 3  # descriptor's label number
ENUM_NAME = "enum"  # marks a field that is wanted as the name of an enum's value

Value = int | memoryview
Plan = dict[int, tuple[str, int, bool, Any]]


class WireError(ValueError):
    """Bytes that are no protocol buffer; importers add the file's name."""


def fields(buffer: memoryview) -> Iterator[tuple[int, int, Value]]:
    """(number, wire type, value) of each field of a message.

    Raises:
      WireError: a length beyond the buffer, an unknown wire type, a bad varint.
    """
    at, end = 0, len(buffer)
    while at < end:
        key = buffer[at]
        at += 1
        if key & 0x80:
            key, at = _varint(buffer, at - 1)
        wire = key & 7
        if wire == LENGTH:
            size, at = _varint(buffer, at)
            if size > end - at:
                raise WireError(f"field {key >> 3}: {size} bytes of {end - at} left")
            yield key >> 3, wire, buffer[at : at + size]
            at += size
        elif wire == VARINT:
            value, at = _varint(buffer, at)
            yield key >> 3, wire, value
        elif wire in (FIXED64, FIXED32):
            size = 8 if wire == FIXED64 else 4
            if size > end - at:
                raise WireError(f"field {key >> 3}: {size} bytes of {end - at} left")
            yield key >> 3, wire, buffer[at : at + size]
            at += size
        else:
            raise WireError(f"field {key >> 3}: wire type {wire}")


def _varint(buffer: memoryview, at: int) -> tuple[int, int]:
    """(value, place behind it) of a base-128 number of at most ten bytes."""
    if at < len(buffer) and buffer[at] < 0x80:  # most are short
        return buffer[at], at + 1
    value = shift = 0
    for byte in buffer[at : at + 10]:
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, at
        shift += 7
    raise WireError("varint: no end within ten bytes")


def packed_sint32(buffer: memoryview) -> np.ndarray:
    """A packed list of zigzag-coded numbers as int64 [n].

    Every byte below 128 ends a number; its bytes hold 7 bits each.
    """
    raw = np.frombuffer(buffer, np.uint8)
    if raw.size == 0:
        return np.zeros(0, np.int64)
    ends = np.flatnonzero(raw < 0x80)
    starts = np.concatenate([[0], ends[:-1] + 1]) if ends.size else ends
    if ends.size == 0 or ends[-1] != raw.size - 1 or np.max(ends - starts) > 9:
        raise WireError("packed numbers: no end within ten bytes")
    owner = np.repeat(np.arange(ends.size), ends - starts + 1)
    shift = (7 * (np.arange(raw.size) - starts[owner])).astype(np.uint64)
    parts = (raw & np.uint8(0x7F)).astype(np.uint64) << shift
    coded = np.bitwise_or.reduceat(parts, starts)
    low = (coded & np.uint64(0xFFFFFFFF)).astype(np.int64)
    return (low >> 1) ^ -(low & 1)


def text(buffer: Value) -> str:
    """UTF-8 text of a length-delimited field."""
    if not isinstance(buffer, memoryview):
        raise WireError("text: number: expected bytes")
    try:
        return bytes(buffer).decode("utf-8")
    except UnicodeDecodeError as error:
        raise WireError(f"text: {error.reason}") from error


def nested(buffer: Value) -> memoryview:
    """The bytes of a nested message."""
    if not isinstance(buffer, memoryview):
        raise WireError("message: number: expected bytes")
    return buffer


class Schema:
    """Message types by full name, gathered from serialised descriptors."""

    def __init__(self) -> None:
        self._messages: dict[str, dict[int, tuple[str, int, bool, str]]] = {}
        self._enums: dict[str, dict[int, str]] = {}

    def add(self, descriptor: memoryview) -> None:
        """All types of a FileDescriptorProto: package 2, messages 4, enums 5."""
        parts = list(fields(descriptor))
        package = next((text(v) for n, _, v in parts if n == 2), "")
        for number, _, value in parts:
            if number == 4:
                self._add_message(package, nested(value), 0)
            elif number == 5:
                self._add_enum(package, nested(value))

    def _add_message(self, scope: str, buffer: memoryview, depth: int) -> None:
        """DescriptorProto: name 1, fields 2, nested messages 3, enums 4."""
        if depth > MAX_DEPTH or len(self._messages) >= MAX_MESSAGES:
            raise WireError(f"descriptor: beyond {MAX_MESSAGES} nested types")
        parts = list(fields(buffer))
        name = next((text(v) for n, _, v in parts if n == 1), "")
        full = f"{scope}.{name}".lstrip(".")
        self._messages[full] = dict(
            _field(nested(value)) for number, _, value in parts if number == 2
        )
        for number, _, value in parts:
            if number == 3:
                self._add_message(full, nested(value), depth + 1)
            elif number == 4:
                self._add_enum(full, nested(value))

    def _add_enum(self, scope: str, buffer: memoryview) -> None:
        """EnumDescriptorProto: name 1, values 2 of name 1 and number 2."""
        name, values = "", {}
        for number, _, value in fields(buffer):
            if number == 1:
                name = text(value)
            elif number == 2:
                entry = {n: v for n, _, v in fields(nested(value))}
                key = entry.get(2, 0)
                label = text(entry.get(1, memoryview(b"")))
                values[key if isinstance(key, int) else 0] = label
        self._enums[f"{scope}.{name}".lstrip(".")] = values

    def plan(self, message: str, wanted: Mapping[str, Any]) -> Plan:
        """How to read the wanted fields of a message type.

        Args:
          message: full name, e.g. "apollo.localization.LocalizationEstimate".
          wanted: field name -> what it has to be: None for a number, ENUM_NAME,
            a dict for a nested message, a list of one dict for repeated ones.
            Fields that this release of the type lacks are left out.

        Raises:
          WireError: an unknown message type, or a field of another type.
        """
        if message not in self._messages:
            raise WireError(f"message type {message}: not among the descriptors")
        plan: Plan = {}
        for number, entry in self._messages[message].items():
            name, kind, repeated, type_name = entry
            if name not in wanted:
                continue
            want = wanted[name]
            if not _fits(want, kind, repeated):
                raise WireError(f"{message}.{name}: type {kind}: another is known")
            below: Any = None
            if kind == MESSAGE:
                inner = want[0] if repeated else want
                below = self.plan(type_name, inner)
            elif kind == ENUM:
                below = self._enums.get(type_name, {})
            plan[number] = (name, kind, repeated, below)
        return plan


def _fits(want: Any, kind: int, repeated: bool) -> bool:  # noqa: ANN401 - see Schema.plan
    if isinstance(want, dict | list):
        return kind == MESSAGE and repeated == isinstance(want, list)
    if want == ENUM_NAME:
        return kind == ENUM and not repeated
    return kind not in (TEXT, MESSAGE, BYTES, ENUM) and not repeated


def _field(buffer: memoryview) -> tuple[int, tuple[str, int, bool, str]]:
    """FieldDescriptorProto: name 1, number 3, label 4, type 5, type_name 6."""
    entry = {number: value for number, _, value in fields(buffer)}
    number, label, kind = (entry.get(key, 0) for key in (3, 4, 5))
    if not (
        isinstance(number, int) and isinstance(label, int) and isinstance(kind, int)
    ):
        raise WireError("descriptor: field: expected numbers")
    name, type_name = (
        text(entry.get(1, memoryview(b""))),
        text(entry.get(6, memoryview(b""))),
    )
    return number, (name, kind, label == REPEATED, type_name.lstrip("."))


def decode(plan: Plan, buffer: memoryview) -> dict[str, Any]:
    """The planned fields of one message: numbers, names of enums, dicts, lists.

    A field that is not set is absent; a repeated one is a list of messages.
    """
    found: dict[str, Any] = {}
    for number, wire, value in fields(buffer):
        entry = plan.get(number)
        if entry is None:
            continue
        name, kind, repeated, below = entry
        read = _value(name, kind, wire, value, below)
        if repeated:
            found.setdefault(name, []).append(read)
        else:
            found[name] = read
    return found


def _value(name: str, kind: int, wire: int, value: Value, below: Any) -> Any:  # noqa: ANN401 - as the field's type says
    """One field's value; the wire type has to be the one its type asks for."""
    if isinstance(value, int):
        if kind not in FIXED and kind not in (TEXT, MESSAGE, BYTES):
            return _whole(kind, value, below)
    elif wire == LENGTH:
        if kind == MESSAGE:
            return decode(below, value)
        if kind in (TEXT, BYTES):
            return text(value) if kind == TEXT else bytes(value)
    elif kind in FIXED and struct.calcsize(FIXED[kind]) == len(value):
        return struct.unpack(FIXED[kind], value)[0]
    raise WireError(f"field {name}: wire type {wire}: not of type {kind}")


def _whole(kind: int, value: int, names: Any) -> int | str:  # noqa: ANN401 - None or a dict
    """An integer of its type's sign, or the name of an enum's value."""
    if kind == ENUM:
        return names.get(value, str(value))
    if kind in ZIGZAG:
        return (value >> 1) ^ -(value & 1)
    return value - (1 << 64) if kind in SIGNED and value >> 63 else value
