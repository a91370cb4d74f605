"""Messages read by the protobuf library, with short schemas instead of .proto files.

A schema names the fields that are read; the library skips all others. Parsed messages
take up to 60 times the bytes of a file made for it, so callers limit these first.
"""

import itertools
import operator
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

Message = Any  # a parsed message: it has the fields of its schema as attributes


def parsers(schema: str) -> dict[str, Callable[[bytes], Message]]:
    """Makes what parses each message of a schema; that raises `DecodeError`.

    Args:
      schema: lines "MESSAGE: FIELD NUMBER KIND, ...". A kind is a scalar type as in a
        .proto file or another message, with a star behind it if it is repeated, with
        "=5" if 5 is the default of a field that is not set, instead of zero.
    """
    lines = [line.partition(":") for line in schema.strip().splitlines()]
    file = descriptor_pb2.FileDescriptorProto(name="schema.proto", syntax="editions")
    # in which texts have to be UTF-8, and fields know whether they are set
    file.edition = descriptor_pb2.EDITION_2023
    names = [name for name, _, _ in lines]
    for name, _, fields in lines:
        message = file.message_type.add(name=name)
        for field, number, text in map(str.split, filter(str.strip, fields.split(","))):
            kind, _, default = text.partition("=")
            entry = message.field.add(name=field, number=int(number))
            is_list, kind = kind.endswith("*"), kind.rstrip("*")
            entry.label = entry.LABEL_REPEATED if is_list else entry.LABEL_OPTIONAL
            if kind in names:
                entry.type_name = kind
            else:
                entry.type = entry.Type.Value(f"TYPE_{kind.upper()}")
            if default:
                entry.default_value = default
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kinds = {name: pool.FindMessageTypeByName(name) for name in names}
    return {n: message_factory.GetMessageClass(k).FromString for n, k in kinds.items()}


def columns(
    messages: Iterable[Message], *fields: str, dtype: type = np.float64
) -> np.ndarray:
    """Numbers of many messages, [n, fields]; there are two fields or more."""
    rows = map(operator.attrgetter(*fields), messages)
    flat = np.fromiter(itertools.chain.from_iterable(rows), dtype)
    return flat.reshape(-1, len(fields))
