"""Bags: which files are one, what topics they have, and their messages as bytes.

A bag is a folder with metadata.yaml, or a file of its own. Of metadata.yaml only the
list of files is read, line by line: rosbag2 writes one entry a line, and so no YAML
library is needed. Files are MCAP (https://mcap.dev/spec, read by the library `mcap`;
one that was never closed has no magic at its end and is refused, because nobody knows
how much is missing) or rosbag2's SQLite storage. The definitions of messages are in the
file; SQLite files from before ROS 2 Iron lack them.
"""

import contextlib
import io
import itertools
import re
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import BinaryIO, NamedTuple

from rcirl_jax.data.formats.files import is_input
from rcirl_jax.data.formats.options import patterns
from rcirl_jax.data.readers.sqlite import Database
from rcirl_jax.errors import InputError, extra_module

EXTRA = "ros2"
METADATA = "metadata.yaml"
PACKED = (".zstd", ".lz4")  # endings of files that rosbag2 compressed as a whole
MAGIC = b"\x89MCAP0\r\n"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MAX_METADATA_BYTES = 64 * 2**20  # bytes; rosbag2 repeats the profiles of each topic
MAX_MESSAGE_BYTES = 16 * 2**20  # bytes; decoded, a message takes many times its bytes
MAX_CHUNK_BYTES = 2**30  # bytes of one chunk of MCAP, unpacked or not
MAX_TOPICS = 100_000
MAX_MESSAGES = 100_000_000
TOPICS = ("name", "type", "serialization_format")
MESSAGES = ("topic_id", "timestamp", "data")
DEFINITIONS = ("topic_type", "encoding", "encoded_message_definition")

# what the library decodes: attributes named as the definition in the file names them
Message = SimpleNamespace
Sent = tuple[str, int, bytes]  # topic, ns when it was recorded, content


class Topic(NamedTuple):
    """A topic of one file, as the file describes it."""

    type: str  # pkg/msg/Name
    encoding: str  # of its messages
    schema_encoding: str  # of the definition, "" without one
    schema: bytes  # the definition
    is_silent: bool  # it has no messages

    @property
    def is_described(self) -> bool:
        """True if the file holds a definition of its messages."""
        return self.schema_encoding == "ros2msg"


# ------------------------------------------------------------------- folders


def bags_of(path: Path, spec: dict) -> list[Path]:
    """Lists the bags of an input: folders with metadata.yaml, files outside of them."""
    if path.is_file() or (path / METADATA).is_file():
        return [path]
    wanted = patterns(spec)
    found = [file for pattern in (*wanted, METADATA) for file in path.rglob(pattern)]
    files = {file for file in found if is_input(path, file)}
    folders = {file.parent for file in files if file.name == METADATA}
    bags = folders | {file for file in files if file.parent not in folders}
    if not bags:
        raise InputError(
            f"{path}: no file matches {', '.join(wanted)}, nor {METADATA}: "
            "expected ROS 2 bags"
        )
    return sorted(bags)


def files_in(bag: Path) -> list[Path]:
    """Lists the files of a bag, in the order of time.

    Raises:
      InputError: packed as a whole by rosbag2, no files, or one that is missing.
    """
    files, metadata = [bag], bag / METADATA
    if metadata.is_file():
        where = f"{metadata}: relative_file_paths"
        if (size := metadata.stat().st_size) > MAX_METADATA_BYTES:
            raise InputError(
                f"{metadata}: {size} bytes: expected at most {MAX_METADATA_BYTES}"
            )
        text = metadata.read_text(errors="replace")
        listed = re.search(r"^ *relative_file_paths: *\n((?: *- .*\n?)*)", text, re.M)
        lines = listed[1].splitlines() if listed else []
        # bags of Foxy name their folder as well; no file outside the bag is read
        names = [Path(line.strip()[2:].strip().strip("\"'")).name for line in lines]
        if not names:
            raise InputError(
                f"{where}: none: expected the files of the bag; write it anew with "
                "`ros2 bag reindex`"
            )
        files = [bag / name for name in names]
        for file in files:
            if not file.is_file():
                raise InputError(
                    f"{where}: {file.name[:200]}: missing: expected this file in the "
                    "bag; `ros2 bag reindex` lists those that are there"
                )
    for file in files:
        if file.suffix in PACKED:
            raise InputError(
                f"{file}: compressed as a whole: expected .mcap or .db3; unpack it, "
                "for example with `zstd -d`, and name the files so in metadata.yaml"
            )
    return files


# ------------------------------------------------------------------- storages


class BagFile(NamedTuple):
    """A file of either storage, nothing decoded."""

    topics: dict[str, Topic]  # by name
    # ns, when the first and the last message were recorded; None: not known
    span: tuple[int, int] | None
    # messages of the wanted topics in the order of recording
    messages: Callable[[Collection[str]], Iterator[Sent]]


@contextlib.contextmanager
def open_file(path: Path) -> Iterator[BagFile]:
    """Opens a file of either storage, by its ending."""
    if path.suffix == ".db3":
        with Database(path) as database:
            yield _of_sqlite(database)
    else:
        with path.open("rb") as stream:
            yield _of_mcap(path, stream)


def _of_mcap(path: Path, stream: BinaryIO) -> BagFile:
    head, size = stream.read(len(MAGIC)), stream.seek(0, io.SEEK_END)
    if head != MAGIC:
        raise InputError(
            f"{path}: begins with {head!r}: expected an MCAP file ({MAGIC!r})"
        )
    stream.seek(max(size - len(MAGIC), 0))
    if size < 2 * len(MAGIC) or stream.read() != MAGIC:
        raise InputError(
            f"{path}: no end after {size} bytes: expected a whole MCAP file; "
            "truncated, or never closed? `mcap recover FILE -o NEW` keeps what is sound"
        )
    stream.seek(0)
    where, sound = str(path), "a sound MCAP file; `mcap doctor FILE` says what is wrong"
    with damaged(where, sound):
        reader = extra_module("mcap.reader", EXTRA).SeekingReader(
            stream, validate_crcs=True, record_size_limit=MAX_CHUNK_BYTES
        )
        summary = reader.get_summary()
    if summary is None or not summary.channels:
        raise InputError(
            f"{path}: summary: no channels: expected a file with a summary section; "
            "`mcap recover FILE -o NEW` writes one"
        )
    for chunk in summary.chunk_indexes:
        size = max(chunk.uncompressed_size, chunk.compressed_size)
        if size > MAX_CHUNK_BYTES:
            raise InputError(
                f"{path}: chunk at byte {chunk.chunk_start_offset}: {size} bytes: "
                f"expected at most {MAX_CHUNK_BYTES}"
            )
    known, topics = summary.statistics, {}
    counts = known.channel_message_counts if known else {}
    for key, channel in summary.channels.items():
        schema = summary.schemas.get(channel.schema_id)
        encoding = channel.message_encoding
        about = (schema.encoding, schema.data) if schema else ("", b"")
        is_silent = bool(counts) and not counts.get(key, 0)
        # several publishers are several channels, of which some may be silent
        if not is_silent or channel.topic not in topics:
            kind = schema.name if schema else ""
            topics[channel.topic] = Topic(kind, encoding, *about, is_silent)

    def messages(wanted: Collection[str]) -> Iterator[Sent]:
        found = reader.iter_messages(topics=list(wanted))
        while True:
            with damaged(where, sound):
                item = next(found, None)
            if item is None:
                return
            yield item[1].topic, item[2].log_time, item[2].data

    span = (known.message_start_time, known.message_end_time) if known else None
    return BagFile(topics, span, messages)


def _of_sqlite(database: Database) -> BagFile:
    database.need("messages", MESSAGES)

    def rows(sql: str, most: int = MAX_TOPICS, values: tuple = ()) -> Iterator[tuple]:
        chunks = database.chunks(sql, ("messages",), most, values)
        return itertools.chain.from_iterable(chunks)

    def texts(table: str, columns: tuple[str, ...]) -> list[tuple]:
        """Rows of a table: its id, and texts."""
        database.need(table, ("id", *columns))
        cast = ", ".join(f"CAST({name} AS TEXT)" for name in columns)
        found = rows(f"SELECT id, {cast} FROM {table}")
        return [(key, *(cell or "" for cell in cells)) for key, *cells in found]

    named = texts("topics", TOPICS)
    has_definitions = database.columns("message_definitions")
    known = texts("message_definitions", DEFINITIONS) if has_definitions else ()
    definitions = {kind: (encoding, text.encode()) for _, kind, encoding, text in known}
    used = {key for (key,) in rows("SELECT DISTINCT topic_id FROM messages")}
    topics = {
        name: Topic(kind, encoding, *definitions.get(kind, ("", b"")), key not in used)
        for key, name, kind, encoding in named
    }
    by_time = "SELECT timestamp FROM messages ORDER BY timestamp"
    ends = f"CAST(({by_time} LIMIT 1) AS INT), CAST(({by_time} DESC LIMIT 1) AS INT)"

    def messages(wanted: Collection[str]) -> Iterator[Sent]:
        names = {key: name for key, name, *_ in named if name in wanted}
        sql = (
            "SELECT topic_id, CAST(timestamp AS INT), CAST(data AS BLOB) FROM messages "
            f"WHERE topic_id IN ({', '.join('?' * len(names))}) ORDER BY timestamp"
        )
        for key, logged, data in rows(sql, MAX_MESSAGES, tuple(names)):
            yield names[key], logged or 0, data or b""

    ((first, last),) = rows(f"SELECT {ends}")
    return BagFile(topics, None if first is None else (first, last), messages)


# ------------------------------------------------------------------- decoding


def as_sent(data: bytes) -> bytes:
    """Returns a message, unpacked if rosbag2 compressed it by itself.

    Raises:
      ValueError: it is longer than MAX_MESSAGE_BYTES.
    """
    size = len(data)
    if data.startswith(ZSTD_MAGIC):  # no CDR begins so
        zstandard = extra_module("zstandard", EXTRA)
        size = zstandard.frame_content_size(data)
        if size <= MAX_MESSAGE_BYTES:
            most = MAX_MESSAGE_BYTES
            data = zstandard.ZstdDecompressor().decompress(data, max_output_size=most)
    if size > MAX_MESSAGE_BYTES:
        raise ValueError(f"{size} bytes of at most {MAX_MESSAGE_BYTES}")
    return data


def decoder_of(path: Path, name: str, topic: Topic) -> Callable[[bytes], Message]:
    """Makes what decodes a topic's messages, by the definition that the file holds.

    Raises:
      InputError: an encoding that is not ROS 2's, or no definition.
    """
    where, wrong = f"{path}: {name} ({topic.type})", ""
    if topic.encoding != "cdr":
        wrong = (
            f"message_encoding: {topic.encoding!r}: expected cdr, which ROS 2 writes; "
            "convert the topic, or name another in [topics] of the source TOML"
        )
    elif not topic.is_described:
        wrong = (
            f"schema encoding: {topic.schema_encoding!r}: expected ros2msg, the "
            "definition inside the file; record it anew with `ros2 bag convert` where "
            "its package is installed"
        )
    if wrong:
        raise InputError(f"{where}: {wrong}")
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
    """Turns what libraries raise on bytes that they cannot read into one line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        found = f"{type(error).__name__}: {str(error)[:200]}".removesuffix(": ")
        raise InputError(f"{where}: {found}: expected {expected}") from error
