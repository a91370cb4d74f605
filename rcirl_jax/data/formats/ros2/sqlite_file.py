"""Bags in rosbag2's SQLite storage (.db3): topics and messages, nothing decoded.

The definitions of messages stand in a table of their own since ROS 2 Iron; files of
before do not hold them, and cannot be read without the packages that they came from.
"""

from collections.abc import Collection, Iterator
from pathlib import Path

from rcirl_jax.data.formats.ros2.bag_file import Sent, Topic
from rcirl_jax.data.readers.sqlite import Database
from rcirl_jax.errors import InputError

MAX_TOPICS = 100_000
MAX_MESSAGES = 100_000_000
TOPICS = ("id", "name", "type", "serialization_format")
MESSAGES = ("topic_id", "timestamp", "data")
DEFINITIONS = ("topic_type", "encoding", "encoded_message_definition")


class SqliteFile:
    """One file; use as a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._database = Database(path)

    def __enter__(self) -> "SqliteFile":
        self._database.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._database.__exit__(*error)

    def topics(self) -> dict[str, Topic]:
        """Topics by name."""
        self._database.need("topics", TOPICS)
        self._database.need("messages", MESSAGES)
        definitions = self._definitions()
        sql = "SELECT DISTINCT topic_id FROM messages"
        met = self._database.chunks(sql, ("messages.topic_id",), MAX_TOPICS)
        used = {row[0] for rows in met for row in rows}
        found = {}
        for key, name, kind, encoding in self._texts("topics", TOPICS):
            how, text = definitions.get(kind, ("", ""))
            found[name] = Topic(
                type=kind,
                encoding=encoding,
                schema_encoding=how,
                schema=text.encode(),
                count=None if key in used else 0,
            )
        return found

    def _definitions(self) -> dict[str, tuple[str, str]]:
        """Type -> (encoding, text) of its definition; none before ROS 2 Iron."""
        if not self._database.columns("message_definitions"):
            return {}
        self._database.need("message_definitions", DEFINITIONS)
        rows = self._texts("message_definitions", DEFINITIONS)
        return {kind: (encoding, text) for kind, encoding, text in rows}

    def _texts(self, table: str, columns: tuple[str, ...]) -> Iterator[tuple]:
        sql = f"SELECT {', '.join(columns)} FROM {table}"
        for rows in self._database.chunks(sql, columns, MAX_TOPICS):
            for row in rows:
                for name, cell in zip(columns, row, strict=True):
                    if name != "id" and not isinstance(cell, str):
                        where = f"{table}.{name}"
                        raise self._database.error(where, repr(cell)[:40], "a text")
                yield row

    def span(self) -> tuple[int, int] | None:
        """When the first and the last message were recorded, ns; None: not known."""
        self._database.need("messages", MESSAGES)
        ends = []
        for way in ("ASC", "DESC"):
            sql = f"SELECT timestamp FROM messages ORDER BY timestamp {way} LIMIT 1"
            found = self._database.chunks(sql, ("messages.timestamp",), 1)
            ends += [row[0] for rows in found for row in rows]
        if len(ends) != 2 or not all(isinstance(end, int) for end in ends):
            return None
        return ends[0], ends[1]

    def messages(self, wanted: Collection[str]) -> Iterator[Sent]:
        """Messages on the wanted topics, in the order of recording."""
        self._database.need("messages", MESSAGES)
        names = {row[0]: row[1] for row in self._texts("topics", TOPICS)}
        keys = [key for key, name in names.items() if name in wanted]
        numbers = dict.fromkeys(wanted, 0)
        marks = ", ".join("?" * len(keys))
        sql = (
            "SELECT topic_id, timestamp, data FROM messages "
            f"WHERE topic_id IN ({marks}) ORDER BY timestamp"
        )
        for rows in self._database.chunks(sql, MESSAGES, MAX_MESSAGES, tuple(keys)):
            for key, logged, data in rows:
                name = names[key]
                number, numbers[name] = numbers[name], numbers[name] + 1
                if not isinstance(logged, int) or not isinstance(data, bytes):
                    raise InputError(
                        f"{self.path}: messages: message {number} of {name}: "
                        f"{type(logged).__name__}, {type(data).__name__}: expected "
                        "a time in ns and bytes"
                    )
                yield Sent(topic=name, number=number, logged=logged, data=data)
