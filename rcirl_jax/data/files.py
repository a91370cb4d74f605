"""Keys and values through tensorstore: a folder or any kvstore URL."""

import contextlib
import functools
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import tensorstore as ts

from rcirl_jax.data.rows import _T
from rcirl_jax.errors import InputError
from rcirl_jax.stages import LOCK, only_one

MANIFEST, MARK, SHARDS = "manifest.json", "shard.json", "shards/"
FACTS = "made_by.json"  # beside the manifest, whose bytes depend on the logs alone


class Files:
    """Named values below one URL: a thin skin over tensorstore's KvStore."""

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
        """Held by this process; remote places cannot be.

        Raises:
          InputError: another process holds the folder.
        """
        if self.folder is None:
            return contextlib.nullcontext()
        return only_one(Path(self.folder), leave_nothing=True)

    def path(self, key: str) -> str:
        """How messages call a key."""
        return f"{self.name}/{key}"

    def wait(self, future: "ts.Future[_T]", key: str) -> _T:
        """A read's result; a failure names the key."""
        try:
            return future.result()
        except ValueError as error:
            raise InputError(
                f"{self.path(key)}: cannot be read: {_reason(error)}: "
                "expected a dataset's file"
            ) from error

    def list_keys(self) -> list[str]:
        """All keys below the dataset, but for the lock of who writes it.

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

    def read_many(self, keys: Iterable[str]) -> Iterable[tuple[str, bytes | None]]:
        """Each key with its value, None where it is missing; all read at once."""
        futures = {key: self.kv.read(key) for key in keys}
        for key, future in futures.items():
            found = self.wait(future, key)
            yield key, found.value if found.state == "value" else None

    def read(self, key: str) -> bytes | None:
        """One value, or None."""
        return dict(self.read_many([key]))[key]

    def write_many(self, values: Mapping[str, bytes]) -> None:
        """Each value atomically; returns when all are on disk."""
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
    """A message of tensorstore without the specification it appends in brackets."""
    return str(error).split(" [")[0]


@functools.cache
def context() -> ts.Context:
    """One context for all, so that a memory:// URL means one thing."""
    return ts.Context()


def put(kv: ts.KvStore, key: str, value: bytes) -> ts.Future:
    """Start writing one value."""
    return kv.write(key, value)
