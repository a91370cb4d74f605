"""Keys and values through tensorstore: a folder or any kvstore URL."""

import contextlib
import functools
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import tensorstore as ts

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.pipeline import LOCK, only_one

MANIFEST, MARK, SHARDS = "manifest.json", "shard.json", "shards/"
FACTS = "made_by.json"  # beside the manifest, whose bytes depend on the logs alone
# of each; the manifest of 10 million scenes takes some 10 MiB
JSON_BYTES = {MANIFEST: 2**30, MARK: 2**28, FACTS: 2**28}

_T = TypeVar("_T")


class Files:
    """Named values below one URL, by tensorstore's KvStore."""

    def __init__(self, url: str | os.PathLike[str]) -> None:
        text = os.fspath(url)
        self.name = text.rstrip("/")
        self.folder = None if "://" in text else os.path.abspath(text)
        where = {"driver": "file", "path": f"{self.folder}/"}
        try:
            self.kv = ts.KvStore.open(
                where if self.folder else f"{self.name}/", context=context()
            ).result()
        except ValueError as error:
            raise InputError(
                f"{text}: {_reason(error)}: expected a folder or a gs://, s3:// URL"
            ) from error

    def alone(self) -> contextlib.AbstractContextManager[None]:
        """Hold the folder for this process; remote places cannot be held.

        Raises:
          InputError: another process holds the folder.
        """
        if self.folder is None:
            return contextlib.nullcontext()
        return only_one(Path(self.folder), leave_nothing=True)

    def path(self, key: str) -> str:
        """Return how messages call a key."""
        return f"{self.name}/{key}"

    def wait(self, future: "ts.Future[_T]", key: str) -> _T:
        """Return a read's result; a failure names the key."""
        try:
            return future.result()
        except ValueError as error:
            raise InputError(
                f"{self.path(key)}: cannot be read: {_reason(error)}: "
                "expected a dataset's file"
            ) from error

    def list_keys(self) -> list[str]:
        """Return all keys below the dataset, but for the lock of who writes it.

        Raises:
          InputError: one is no text.
        """
        keys = self.wait(self.kv.list(), "")
        try:
            found = [key.decode() for key in keys]
        except UnicodeDecodeError as error:
            raise InputError(
                f"{self.name}: holds {error.object!r}: expected names in UTF-8"
            ) from error
        return [key for key in found if key != LOCK]

    def read(self, most: Mapping[str, int]) -> dict[str, bytes | None]:
        """Read values, all at once; None where there is none.

        Args:
          most: key -> bytes that it may have; a longer file of a folder is not read.

        Raises:
          InputError: one cannot be read, or is too large.
        """
        for key in most if self.folder is not None else ():
            try:
                found = os.stat(os.path.join(self.folder or "", key))
            except (FileNotFoundError, NotADirectoryError):
                continue
            except OSError as error:
                raise InputError(
                    f"{self.path(key)}: cannot be read: {error.strerror}: "
                    "expected a dataset's file"
                ) from error
            if not stat.S_ISREG(found.st_mode):  # of a pipe one would wait for bytes
                raise InputError(f"{self.path(key)}: expected a file")
            self._check_size(key, found.st_size, most[key])
        values = {}
        for key, future in {key: self.kv.read(key) for key in most}.items():
            result = self.wait(future, key)
            values[key] = result.value if result.state == "value" else None
            self._check_size(key, len(values[key] or b""), most[key])
        return values

    def _check_size(self, key: str, size: int, most: int) -> None:
        if size > most:
            raise InputError(f"{self.path(key)}: {size} bytes: expected {most} at most")

    def read_json(self, key: str) -> bytes | None:
        """Read one of the dataset's JSON files; arguments and errors as `read`."""
        return self.read({key: JSON_BYTES[key.rpartition("/")[2]]})[key]

    def write_many(self, values: Mapping[str, bytes]) -> None:
        """Write each value atomically; returns when all are on disk.

        Raises:
          OSError: one cannot be written.
        """
        futures = []
        try:
            for key, value in values.items():
                futures.append(put(self.kv, key, value))
            for future in futures:
                future.result()
        except ValueError as error:
            raise OSError(
                f"{self.name}: cannot be written: {_reason(error)}"
            ) from error
        finally:
            # a write still under way would land after an abort has cleaned up
            for future in futures:
                future.exception()

    def remove(self, start: str, end: str) -> None:
        """Delete the keys from `start` up to `end`.

        Raises:
          OSError: they cannot be deleted.
        """
        try:
            self.kv.delete_range(ts.KvStore.KeyRange(start, end)).result()
        except ValueError as error:
            raise OSError(
                f"{self.path(start)}: cannot be deleted: {_reason(error)}"
            ) from error


def _reason(error: ValueError) -> str:
    """Return tensorstore's message without the specification in brackets."""
    return str(error).split(" [")[0]


@functools.cache
def context() -> ts.Context:
    """Return one context for all, so that a memory:// URL means one thing."""
    return ts.Context()


def put(kv: ts.KvStore, key: str, value: bytes) -> ts.Future:
    """Start writing one value."""
    return kv.write(key, value)
