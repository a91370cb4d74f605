"""How the messages of a channel are read, by the descriptors in its record.

Fields are looked up by name, so that records of every release read alike. What is not
wanted is not parsed. Fields that a release lacks, and those that a message does not
set, are NaN, 0 or UNSET.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from google.protobuf import descriptor_pb2 as pb
from google.protobuf.message import DecodeError

from rcirl_jax.data.readers.protobuf import Field, Message, parser, table_of

ENUM = "enum"  # a field that is wanted as the number of an enum's value
UNSET = -1  # that number where the message does not set it
# field -> its default for a number, ENUM, a dict for a message, a list of one dict for
# repeated ones
Wanted = Mapping[str, Any]

MAX_TYPES = 100_000  # messages and enums of a channel's descriptors
# fields that every release has
NEEDED = (
    *("header", "timestamp_sec", "perception_obstacle", "prediction_obstacle"),
    *("id", "position", "velocity", "x", "y"),
)
LACKING = 2**29 - 1  # the highest number of a field, for one that a release lacks
NOTHING = ""  # type of such a field
NO_NUMBERS = ("string", "bytes", "message", "group", "enum")

PROTO_DESC = "ProtoDesc: desc 1 bytes, dependencies 2 ProtoDesc*"
_read_proto_desc = parser(table_of(PROTO_DESC))


class UndescribedError(DecodeError):
    """A channel that its record does not describe."""


class Reading(NamedTuple):
    """How a message type is read."""

    parse: Callable[[bytes], Message]
    names: dict[str, dict[int, str]]  # of an enum's values, by field


def reading_of(message: str, proto_desc: bytes, wanted: Wanted) -> Reading:
    """How to read the wanted fields of a message type.

    Args:
      message: full name, e.g. "apollo.localization.LocalizationEstimate".
      proto_desc: ProtoDesc of the file that defines it, with all those it imports.
      wanted: fields of the message.

    Raises:
      UndescribedError: there are no descriptors.
      DecodeError: damaged descriptors, an unknown message type, a field of another
        type than wanted, or none that is needed.
    """
    types, found = _Types(), [*dict.fromkeys(_contents(_read_proto_desc(proto_desc)))]
    if not any(found):
        raise UndescribedError(f"message type {message}: no descriptors")
    for content in found:
        file = pb.FileDescriptorProto.FromString(content)
        types.add(file.package, file.message_type, file.enum_type)
    types.want(message, wanted)
    try:
        return Reading(parser(types.tables), types.names)
    except TypeError as error:
        raise DecodeError(f"{message}: {error}") from error


def _contents(found: Message) -> Iterator[bytes]:
    """The FileDescriptorProto of a ProtoDesc and of those that it depends on."""
    yield found.desc
    yield from itertools.chain.from_iterable(map(_contents, found.dependencies))


class _Types:
    """Types by full name, and the tables of the messages that are wanted."""

    def __init__(self) -> None:
        self.tables: dict[str, dict[str, Field]] = {}
        self.names: dict[str, dict[int, str]] = {}
        self._known: dict[str, Any] = {NOTHING: pb.DescriptorProto()}

    def add(self, scope: str, messages: Iterable, enums: Iterable) -> None:
        """Types of a file or of a message, and those nested in them."""
        for found in (*enums, *messages):
            name = f"{scope}.{found.name}".lstrip(".")
            self._known[name] = found
            if isinstance(found, pb.DescriptorProto):
                self.add(name, found.nested_type, found.enum_type)
        if len(self._known) > MAX_TYPES:
            raise DecodeError(f"descriptors: more than {MAX_TYPES} types")

    def want(self, message: str, wanted: Wanted) -> str:
        """Make the table of a message type; its name in the tables."""
        found = self._known.get(message)
        if not isinstance(found, pb.DescriptorProto):
            raise DecodeError(f"message type {message}: not among the descriptors")
        own = f"Message{len(self.tables)}"
        table = self.tables[own] = {}
        known = {field.name: field for field in found.field}
        for place, (name, want) in enumerate(wanted.items()):
            if message != NOTHING and name in NEEDED and name not in known:
                raise DecodeError(f"field {name}: not among the descriptors")
            field = known.get(name) or _lacking(name, LACKING - place, want)
            table[name] = self._field(field, want, f"{message}.{name}")
        return own

    def _field(self, field: pb.FieldDescriptorProto, want: Any, where: str) -> Field:  # noqa: ANN401 - see Wanted
        kind = field.Type.Name(field.type).removeprefix("TYPE_").lower()
        repeated = field.label == field.LABEL_REPEATED
        if repeated != isinstance(want, list) or not _fits(want, kind):
            raise DecodeError(f"{where}: type {kind}: another is known")
        below = str(field.type_name).lstrip(".")
        if isinstance(want, dict | list):
            inner = want[0] if isinstance(want, list) else want
            return Field(self.want(below, inner), field.number, repeated)
        if want == ENUM:
            values = getattr(self._known.get(below), "value", ())
            self.names[str(field.name)] = {value.number: value.name for value in values}
            return Field("int32", field.number, default=str(UNSET))
        is_real = kind in ("double", "float")
        default = "nan" if is_real and math.isnan(want) else ""
        return Field(kind, field.number, default=default)


def _fits(want: Any, kind: str) -> bool:  # noqa: ANN401 - see Wanted
    if isinstance(want, dict | list):
        return kind == "message"
    return kind == ENUM if want == ENUM else kind not in NO_NUMBERS


def _lacking(name: str, number: int, want: Any) -> pb.FieldDescriptorProto:  # noqa: ANN401 - see Wanted
    """A field as wanted, with a number that no message has."""
    field = pb.FieldDescriptorProto(name=name, number=number, type_name=NOTHING)
    is_list = isinstance(want, list)
    field.label = field.LABEL_REPEATED if is_list else field.LABEL_OPTIONAL
    kinds = {dict: field.TYPE_MESSAGE, list: field.TYPE_MESSAGE, str: field.TYPE_ENUM}
    field.type = kinds.get(type(want), field.TYPE_DOUBLE)
    return field
