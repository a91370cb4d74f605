"""Messages of a bag as rows of numbers, about a minute at a time.

Which topics are read stands in the source TOML, by role; of which type they are says
the file.
"""

import array
import contextlib
from collections.abc import Iterator, Mapping
from itertools import accumulate
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.messages import check_held, topics_of
from rcirl_jax.data.formats.options import section
from rcirl_jax.data.formats.ros2.bag_file import Sent, Topic, decoder_of
from rcirl_jax.data.formats.ros2.mcap_file import McapFile
from rcirl_jax.data.formats.ros2.readings import COLUMNS, TYPES, Context, Row
from rcirl_jax.data.formats.ros2.sqlite_file import SqliteFile
from rcirl_jax.data.readers.reading import reading
from rcirl_jax.errors import InputError

MAX_MESSAGE_BYTES = 16 * 2**20  # bytes; decoded, a message takes many times its bytes
PIECE_S = 60.0  # s of recording after which rows are handed on
NEEDED = ("ego", "obstacles")


class Rows:
    """Rows of each role of a piece of a drive."""

    def __init__(self, names: dict[str, int]) -> None:
        self.names = names  # of obstacles, with their numbers
        self._values = {role: array.array("d") for role in COLUMNS}
        self.progress = 1.0  # share of the bag, or of its file, that is read with them
        self.notes: list[str] = []

    def add(self, role: str, row: Row) -> None:
        """One row, in the order of the role's columns."""
        self._values[role].extend(row)

    def table(self, role: str) -> np.ndarray:
        """[n, columns] of a role."""
        return np.array(self._values[role]).reshape(-1, len(COLUMNS[role]))

    def count(self, role: str) -> int:
        """Rows of a role."""
        return len(self._values[role]) // len(COLUMNS[role])


def open_file(path: Path) -> McapFile | SqliteFile:
    """A file of either storage, by its ending."""
    return SqliteFile(path) if path.suffix == ".db3" else McapFile(path)


def read_bag(files: list[Path], spec: dict) -> Iterator[Rows]:
    """All wanted messages of a bag, piece by piece in the order of recording."""
    (roles, notes), names = _roles(files, spec), {}
    sizes = [file.stat().st_size for file in files]
    done = 0.0  # bytes
    with reading(files[0], files) as show:
        for file, before, size in zip(
            files, accumulate(sizes, initial=0), sizes, strict=False
        ):
            for rows in _read_file(file, roles, spec, names):
                read = before + rows.progress * size
                show(int(read - done))
                done, rows.progress = read, min(read / max(sum(sizes), 1), 1.0)
                rows.notes, notes = notes, []
                yield rows


def _roles(files: list[Path], spec: dict) -> tuple[dict[str, str], list[str]]:
    """Topic -> role: of each role the first topic named that has messages.

    One that nobody can read is noted and passed over, unless it has to be there.

    Raises:
      InputError: a needed role has none, or its type is unknown.
    """
    known: dict[str, Topic] = {}
    for file in files:
        with open_file(file) as opened:
            for name, topic in opened.topics().items():
                if topic.count != 0:
                    known.setdefault(name, topic)
    roles, notes = {}, []
    # of each role the first topic that a bag has counts
    for role, names in topics_of(spec, COLUMNS, dict.fromkeys(COLUMNS, ())).items():
        met = [name for name in names if name in known]
        found = next((name for name in met if _is_read(role, known[name])), None)
        if found is not None:
            roles[found] = role
        elif met and role in NEEDED:
            _check_type(files[0], role, met[0], known[met[0]])
            roles[met[0]] = role  # says that it has no definition
        elif role in NEEDED and names:
            raise InputError(_missing(files[0], role, names, known))
        elif met:
            kind = known[met[0]].type
            notes.append(
                f"{met[0]} ({kind}): not read, of another type or without a definition"
                + ("; who drove is not known" if role == "driver" else "")
            )
    return roles, notes


def _is_read(role: str, topic: Topic) -> bool:
    return topic.type in TYPES[role] and topic.is_described


def _missing(
    path: Path, role: str, names: list[str], known: Mapping[str, Topic]
) -> str:
    """What is wrong with a bag without a needed topic, and which might be it."""
    fit = [name for name, topic in known.items() if topic.type in TYPES[role]]
    have = ", ".join(fit) or "none of a type that is read"
    return (
        f"{path}: {role}: no messages on {', '.join(names)}: expected one of them; "
        f"topics.{role} of the source TOML names it (in this bag: {have}), or [] for "
        "none"
    )


def _check_type(path: Path, role: str, name: str, topic: Topic) -> None:
    if topic.type not in TYPES[role]:
        raise InputError(
            f"{path}: {name}: type {topic.type!a:.80}: expected for topics.{role} one "
            f"of {', '.join(TYPES[role])}"
        )


def _read_file(
    path: Path, roles: dict[str, str], spec: dict, names: dict[str, int]
) -> Iterator[Rows]:
    """Rows of a file; names of obstacles get their numbers."""
    rows, began = Rows(names), None
    readings: dict[str, _Reading] = {}
    with open_file(path) as opened:
        own, span = opened.topics(), opened.span()
        for sent in opened.messages([name for name in roles if name in own]):
            began = sent.logged if began is None else began
            if abs(sent.logged - began) > PIECE_S * 1e9:
                rows.progress = _share(sent.logged, span)
                yield rows
                rows, began = Rows(names), sent.logged
            if sent.topic not in readings:
                readings[sent.topic] = _Reading(
                    path, sent.topic, own[sent.topic], roles[sent.topic], spec
                )
            readings[sent.topic].add(rows, sent)
    yield rows


def _share(logged: int, span: tuple[int, int] | None) -> float:
    """Share of a file's time that is over; none where its span is not known."""
    first, last = span or (logged, logged + 1)
    return min(max((logged - first) / max(last - first, 1), 0.0), 1.0)


class _Reading:
    """How messages of one topic of one file become rows."""

    def __init__(
        self, path: Path, name: str, topic: Topic, role: str, spec: dict
    ) -> None:
        _check_type(path, role, name, topic)
        self._where, self._role, self._type = f"{path}: {name}", role, topic.type
        self._decode = decoder_of(path, name, topic)
        self._read = TYPES[role][topic.type]
        self._frames, self._kinds = section(spec, "frames"), section(spec, "kinds")

    def add(self, rows: Rows, sent: Sent) -> None:
        """Append what a message says."""
        context = Context(
            where=f"{self._where}: message {sent.number}",
            map_frame=str(self._frames.get("map", "map")),
            base_frame=str(self._frames.get("base", "base_link")),
            kinds=self._kinds,
            names=rows.names,
        )
        with _readable(context.where, self._type):
            if len(sent.data) > MAX_MESSAGE_BYTES:
                size = len(sent.data)
                raise ValueError(f"{size} bytes of at most {MAX_MESSAGE_BYTES}")
            for row in self._read(self._decode(sent.data), context):
                rows.add(self._role, row)
        check_held(self._where, rows.count(self._role))


@contextlib.contextmanager
def _readable(where: str, kind: str) -> Iterator[None]:
    """Bytes that are cut short, and definitions that lack a field, are one line."""
    try:
        yield
    except InputError:
        raise
    except AttributeError as error:
        raise InputError(
            f"{where}: {error.name}: missing in the file's definition: expected a "
            f"{kind} with it"
        ) from error
    except Exception as error:
        raise InputError(
            f"{where}: {type(error).__name__}: {str(error)[:200]}: expected a {kind}"
        ) from error
