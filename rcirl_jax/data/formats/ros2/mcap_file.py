"""MCAP files by the library `mcap`: topics and messages, nothing decoded.

Format: https://mcap.dev/spec. A file that was never closed has no index and no magic
at its end; it is refused, because nobody knows how much is missing.
"""

import io
from collections.abc import Collection, Iterator
from pathlib import Path
from types import SimpleNamespace

from rcirl_jax.data.formats.ros2.bag_file import EXTRA, Sent, Topic, damaged
from rcirl_jax.errors import InputError, extra_module

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 2**30  # bytes of one chunk, unpacked or not
SOUND = "a sound MCAP file; `mcap doctor FILE` says what is damaged"


class McapFile:
    """One file; use as a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> "McapFile":
        self._stream = self.path.open("rb")
        try:
            self._check_ends()
            with damaged(str(self.path), SOUND):
                self._reader = extra_module("mcap.reader", EXTRA).SeekingReader(
                    self._stream,
                    validate_crcs=True,
                    record_size_limit=MAX_CHUNK_BYTES,
                )
                self._summary = self._reader.get_summary()
            self._check_chunks()
        except BaseException:
            self._stream.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def _check_ends(self) -> None:
        """The magic at both ends; the last one is written when a file is closed."""
        head = self._stream.read(len(MAGIC))
        if head != MAGIC:
            raise InputError(
                f"{self.path}: begins with {head!r}: expected an MCAP file ({MAGIC!r})"
            )
        size = self._stream.seek(0, io.SEEK_END)
        self._stream.seek(max(size - len(MAGIC), 0))
        if size < 2 * len(MAGIC) or self._stream.read() != MAGIC:
            raise InputError(
                f"{self.path}: no end after {size} bytes: expected a whole MCAP file; "
                "truncated, or never closed? `mcap recover FILE -o NEW` keeps what is "
                "sound"
            )
        self._stream.seek(0)

    def _check_chunks(self) -> None:
        for chunk in self._summary.chunk_indexes if self._summary else ():
            size = max(chunk.uncompressed_size, chunk.compressed_size)
            if size > MAX_CHUNK_BYTES:
                raise InputError(
                    f"{self.path}: chunk at byte {chunk.chunk_start_offset}: {size} "
                    f"bytes: expected at most {MAX_CHUNK_BYTES}"
                )

    def topics(self) -> dict[str, Topic]:
        """Topics by name.

        Raises:
          InputError: the file has no summary of them.
        """
        summary = self._summary
        if summary is None or not summary.channels:
            raise InputError(
                f"{self.path}: summary: no channels: expected a file with a summary "
                "section; `mcap recover FILE -o NEW` writes one"
            )
        counts = summary.statistics and summary.statistics.channel_message_counts
        found: dict[str, Topic] = {}
        for key, channel in summary.channels.items():
            schema = summary.schemas.get(channel.schema_id)
            topic = _topic(channel, schema, counts.get(key, 0) if counts else None)
            # several publishers are several channels, of which some may be silent
            if topic.count != 0 or channel.topic not in found:
                found[channel.topic] = topic
        return found

    def span(self) -> tuple[int, int] | None:
        """When the first and the last message were recorded, ns; None: not known."""
        counted = self._summary and self._summary.statistics
        return counted and (counted.message_start_time, counted.message_end_time)

    def messages(self, wanted: Collection[str]) -> Iterator[Sent]:
        """Messages on the wanted topics, in the order of recording."""
        numbers = dict.fromkeys(wanted, 0)
        found = self._reader.iter_messages(topics=list(wanted))
        while True:
            with damaged(str(self.path), SOUND):
                item = next(found, None)
            if item is None:
                return
            _, channel, message = item
            name = channel.topic
            number, numbers[name] = numbers[name], numbers[name] + 1
            data, logged = message.data, message.log_time
            yield Sent(topic=name, number=number, logged=logged, data=data)


def _topic(
    channel: SimpleNamespace, schema: SimpleNamespace | None, count: int | None
) -> Topic:
    """A topic by its channel and schema records; 0 is no schema."""
    return Topic(
        type=schema.name if schema else "",
        encoding=channel.message_encoding,
        schema_encoding=schema.encoding if schema else "",
        schema=schema.data if schema else b"",
        count=count,
    )
