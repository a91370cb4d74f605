"""How the messages of a channel are read, by the descriptors in its record.

Fields are looked up by name, so that records of every release read alike. What is not
wanted is not parsed. Fields that a release lacks, and those that a message does not
set, are NaN or 0.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from google.protobuf import descriptor_pb2 as pb
from google.protobuf.message import DecodeError

from rcirl_jax.data.readers.protobuf import Field, Message, parser

ENUM = "enum"  # a field that is wanted as the number of an enum's value
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

_read_proto_desc = parser(
    {
        "ProtoDesc": {
            "desc": Field("bytes", 1),
            "dependencies": Field("ProtoDesc", 2, repeated=True),
        }
    }
)


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
      DecodeError: damaged descriptors, an unknown message type, a field of another
        type than wanted, or none that is needed.
    """
    types = _Types()
    for content in dict.fromkeys(_contents(_read_proto_desc(proto_desc))):
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
    for other in found.dependencies:
        yield from _contents(other)


class _Types:
    """Message types by full name, and the tables of those that are wanted."""

    def __init__(self) -> None:
        self.tables: dict[str, dict[str, Field]] = {}
        self.names: dict[str, dict[int, str]] = {}
        self._messages = {NOTHING: pb.DescriptorProto()}
        self._enums = {NOTHING: pb.EnumDescriptorProto()}

    def add(
        self,
        scope: str,
        messages: Iterable[pb.DescriptorProto],
        enums: Iterable[pb.EnumDescriptorProto],
    ) -> None:
        """Types of a file or of a message, and those nested in them."""
        for enum in enums:
            self._enums[f"{scope}.{enum.name}".lstrip(".")] = enum
        for message in messages:
            name = f"{scope}.{message.name}".lstrip(".")
            self._messages[name] = message
            self.add(name, message.nested_type, message.enum_type)
        if len(self._messages) + len(self._enums) > MAX_TYPES:
            raise DecodeError(f"descriptors: more than {MAX_TYPES} types")

    def want(self, message: str, wanted: Wanted) -> str:
        """Make the table of a message type; its name in the tables."""
        if message not in self._messages:
            raise DecodeError(f"message type {message}: not among the descriptors")
        own = f"Message{len(self.tables)}"
        table = self.tables[own] = {}
        known = {field.name: field for field in self._messages[message].field}
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
            values = self._enums.get(below, self._enums[NOTHING]).value
            self.names[str(field.name)] = {value.number: value.name for value in values}
            return Field("int32", field.number)
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
    field.label = (
        field.LABEL_REPEATED if isinstance(want, list) else field.LABEL_OPTIONAL
    )
    if isinstance(want, dict | list):
        field.type = field.TYPE_MESSAGE
    else:
        field.type = field.TYPE_ENUM if want == ENUM else field.TYPE_DOUBLE
    return field
