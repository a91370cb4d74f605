"""Messages read by the protobuf library, with tables instead of .proto files.

A table names the fields that are read; the library skips all others, and those of
another wire type. Parsed messages take up to 60 times the bytes of a file made for
it, so callers limit these first. The library itself refuses 100 nested messages.
"""

import itertools
import operator
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

Message = Any  # a parsed message: it has the fields of its table as attributes


class Field(NamedTuple):
    """A field of a message; one that is not set reads as its default."""

    kind: str  # as in a .proto file: a scalar type, or another message of the table
    number: int
    repeated: bool = False
    default: str = ""  # of a scalar; "": zero


Types = Mapping[str, Mapping[str, Field]]  # message -> field -> what it is


def table_of(schema: str) -> Types:
    """Makes a table of lines "MESSAGE: FIELD NUMBER KIND, ...", the first one's first.

    A star behind the kind says that it is repeated, "=5" that 5 is its default.
    """
    table: dict[str, dict[str, Field]] = {}
    for line in schema.strip().splitlines():
        message, _, fields = line.partition(":")
        table[message] = {}
        for name, number, text in map(str.split, filter(str.strip, fields.split(","))):
            kind, _, default = text.partition("=")
            is_list = kind.endswith("*")
            found = Field(kind.rstrip("*"), int(number), is_list, default)
            table[message][name] = found
    return table


def parser(types: Types) -> Callable[[bytes], Message]:
    """Makes what parses the first message of a table; that raises `DecodeError`.

    Raises:
      TypeError: a number that no field may have, or one of two fields.
    """
    file = descriptor_pb2.FileDescriptorProto(name="table.proto", syntax="editions")
    # in which texts have to be UTF-8, and fields know whether they are set
    file.edition = descriptor_pb2.EDITION_2023
    for name, fields in types.items():
        message = file.message_type.add(name=name)
        for field, (kind, number, repeated, default) in fields.items():
            entry = message.field.add(name=field, number=number)
            entry.label = entry.LABEL_REPEATED if repeated else entry.LABEL_OPTIONAL
            if kind in types:
                entry.type_name = kind
            else:
                entry.type = entry.Type.Value(f"TYPE_{kind.upper()}")
            if default:
                entry.default_value = default
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    first = pool.FindMessageTypeByName(next(iter(types)))
    return message_factory.GetMessageClass(first).FromString


def columns(
    messages: Iterable[Message], *fields: str, dtype: type = np.float64
) -> np.ndarray:
    """Numbers of many messages, [n, fields]; there are two fields or more."""
    rows = map(operator.attrgetter(*fields), messages)
    flat = np.fromiter(itertools.chain.from_iterable(rows), dtype)
    return flat.reshape(-1, len(fields))
