"""Atomic writes, locks, and JSON of a bounded size."""

import codecs
import contextlib
import dataclasses
import errno
import fcntl
import json
import math
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np

from rcirl_jax.errors import InputError

MAX_JSON_BYTES = 16 * 1024**2  # of a JSON file that is read
MAX_DEPTH = 100  # levels of it
HALVES = re.compile("[\ud800-\udfff]")  # of surrogate pairs

# of file systems without locks, where two writers are not kept apart
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP)


def write_whole(path: Path, content: str | bytes) -> None:
    """Writes a file atomically: temporary file, fsync, rename; its folder is made.

    A killed write leaves a file that ends in ".tmp".

    Raises:
      OSError: it cannot be written (the disk is full); names the file.
    """
    part = path.with_name(path.name + ".tmp")
    try:
        with locked(part) as file:
            file.truncate(0)
            try:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
                os.replace(part, path)
            except OSError:
                part.unlink(missing_ok=True)
                raise
        # the new name lives in the folder; it is on disk once the folder is
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise named(error, path) from error


@contextlib.contextmanager
def locked(path: Path, *, wait: bool = True) -> Iterator[IO[bytes]]:
    """Opens a file for appending, held by this process alone; made if missing.

    Where the file system has no locks, nobody is kept out. By hand, because filelock
    holds a file of its own, which would stay beside every file written.

    Args:
      path: of the file.
      wait: for whoever holds it.

    Raises:
      BlockingIOError: somebody holds it, and this does not wait.
      OSError: it cannot be made or written.
    """
    how = fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") as file:
            try:
                fcntl.flock(file, how)
            except OSError as error:
                if error.errno not in NO_LOCKS:
                    raise
            # who held it before may have renamed or removed it after it was opened
            try:
                there = path.stat()
            except FileNotFoundError:
                continue
            if os.path.samestat(os.fstat(file.fileno()), there):
                yield file
                return


def named(error: OSError, path: Path) -> OSError:
    """Adds a file's name to an error; one of writing to an open file has none."""
    return OSError(error.errno, error.strerror or str(error), str(path))


def plain(node: Any) -> Any:  # noqa: ANN401
    """Makes JSON-ready: dataclasses to dicts, numpy to Python, NaN, inf to None."""
    if dataclasses.is_dataclass(node) and not isinstance(node, type):
        return {f.name: plain(getattr(node, f.name)) for f in dataclasses.fields(node)}
    if isinstance(node, Mapping):
        return {str(key): plain(value) for key, value in node.items()}
    if isinstance(node, list | tuple):
        return [plain(value) for value in node]
    if isinstance(node, np.generic):
        node = node.item()
    if isinstance(node, float) and not math.isfinite(node):
        return None
    return node


def write_json(
    path: Path, body: Mapping[str, object] | Sequence[object], indent: int = 2
) -> None:
    """Writes the body as JSON (see `plain`), atomically."""
    write_whole(path, json.dumps(plain(body), indent=indent, allow_nan=False) + "\n")


def _levels(body: object) -> int:
    """Levels of a JSON body, as far as MAX_DEPTH + 1."""
    level, depth = [body], 0
    while level and depth <= MAX_DEPTH:
        inner = [list(x.values()) if isinstance(x, dict) else x for x in level]
        level = [one for x in inner if isinstance(x, list) for one in x]
        depth += 1
    return depth


def parse_json(text: bytes | str) -> Any:  # noqa: ANN401
    """Parses JSON from outside, strictly; the body can be written again.

    Args:
      text: where it is bytes, UTF-8, with or without a byte order mark.

    Raises:
      ValueError: no JSON (NaN and infinities are none), no UTF-8, half of a surrogate
        pair, or nested deeper than MAX_DEPTH.
    """
    if isinstance(text, bytes):
        text = text.removeprefix(codecs.BOM_UTF8)
    try:
        body = msgspec.json.decode(text)
    except msgspec.MsgspecError as error:
        raise ValueError(str(error)) from error
    except RecursionError as error:
        raise ValueError("nested too deep") from error
    if _levels(body) > MAX_DEPTH:
        raise ValueError("nested too deep")
    return body


def is_text(texts: str | np.ndarray) -> bool:
    """True if it can be printed and stored: half a surrogate pair is no character.

    Python makes them of bytes that are no UTF-8, as in names of files; numpy holds
    any 32 bits as a character.
    """
    if isinstance(texts, str):
        return HALVES.search(texts) is None
    points = np.frombuffer(texts.tobytes(), texts.dtype.byteorder + "u4")
    half = (points >= 0xD800) & (points <= 0xDFFF)
    return not np.any(half | (points > sys.maxunicode))


def read_json(path: Path, expected: str, most: int = MAX_JSON_BYTES) -> Any:  # noqa: ANN401
    """Reads the body of a JSON file.

    Args:
      path: of the file.
      expected: what it should be, the end of every refusal.
      most: bytes of a file that is read.

    Raises:
      InputError: unreadable, too large, no JSON, no text, or nested too deep.
    """
    try:
        with Path(path).open("rb") as file:
            content = file.read(most + 1)
        if len(content) > most:
            raise InputError(
                f"{path}: size: above {most >> 20} MiB: expected {expected}"
            )
        return parse_json(content)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}: expected {expected}") from error
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: {error}: expected {expected}") from error
