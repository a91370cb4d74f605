"""What files of either storage have in common: topics, decoders, errors."""

import contextlib
import dataclasses
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

from rcirl_jax.errors import InputError, extra_module

MAX_SCHEMA_BYTES = 2**20  # bytes of a message's definition; the longest have 50 kB
EXTRA = "ros2"

# what the library decodes: attributes named as the definition in the file names them
Message = SimpleNamespace
Decoder = Callable[[bytes], Message]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Topic:
    """A topic of one file, as the file describes it."""

    type: str  # pkg/msg/Name
    encoding: str  # of its messages
    schema_encoding: str  # of the definition, "" without one
    schema: bytes  # the definition
    count: int | None = None  # messages, where the file says it

    @property
    def is_described(self) -> bool:
        """Whether the file holds a definition of its messages."""
        return self.schema_encoding == "ros2msg"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sent:
    """A message as it is stored."""

    topic: str
    number: int  # of the topic's messages in this file, from 0
    logged: int  # ns, when it was recorded
    data: bytes


def decoder_of(path: Path, name: str, topic: Topic) -> Decoder:
    """What decodes a topic's messages, by the definition that the file holds.

    Raises:
      InputError: an encoding that is not ROS 2's, or no definition.
    """
    where = f"{path}: {name} ({topic.type})"
    if topic.encoding != "cdr":
        raise InputError(
            f"{where}: message_encoding: {topic.encoding!r}: expected cdr, which ROS 2 "
            "writes; convert the topic, or name another in [topics] of the source TOML"
        )
    if not topic.is_described:
        raise InputError(
            f"{where}: schema encoding: {topic.schema_encoding!r}: expected ros2msg, "
            "the definition inside the file; record it anew with `ros2 bag convert` "
            "where its package is installed"
        )
    if len(topic.schema) > MAX_SCHEMA_BYTES:
        raise InputError(
            f"{where}: schema: {len(topic.schema)} bytes: expected at most "
            f"{MAX_SCHEMA_BYTES}"
        )
    decoders = extra_module("mcap_ros2.decoder", EXTRA)
    schema = extra_module("mcap.records", EXTRA).Schema(
        id=1, name=topic.type, encoding="ros2msg", data=topic.schema
    )
    # the parser prints the line that it cannot read, which the error says as well
    quiet = contextlib.redirect_stderr(io.StringIO())
    with damaged(where, "a message definition of ROS 2"), quiet:
        return decoders.DecoderFactory().decoder_for("cdr", schema)


@contextlib.contextmanager
def damaged(where: str, expected: str) -> Iterator[None]:
    """Whatever the libraries raise on bytes that they cannot read, as one line.

    They have no common error: struct, zstandard, lz4, the parser and mcap have theirs.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        found = f"{type(error).__name__}: {str(error)[:200]}".removesuffix(": ")
        raise InputError(f"{where}: {found}: expected {expected}") from error
