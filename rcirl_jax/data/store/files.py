"""Keys and values through tensorstore: a folder or any kvstore URL."""

import contextlib
import functools
import hashlib
import os
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path

import tensorstore as ts

from rcirl_jax.data.store.rows import _T
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.pipeline import LOCK, only_one

MANIFEST, MARK, SHARDS = "manifest.json", "shard.json", "shards/"
FACTS = "made_by.json"  # beside the manifest, whose bytes depend on the logs alone
# of each; the manifest of 10 million scenes takes some 10 MiB
JSON_BYTES = {MANIFEST: 2**30, MARK: 2**28, FACTS: 2**28}


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

    def read_json(self, key: str) -> bytes | None:
        """The bytes of one of the dataset's JSON files, or None.

        Raises:
          InputError: it cannot be read, or is too large (`JSON_BYTES`); in a folder
            that is seen before it is read.
        """
        self._check_size(key, self._size(key))
        value = self._value(self.kv.read(key), key)
        self._check_size(key, None if value is None else len(value))
        return value

    def digests(
        self, expected: Mapping[str, int]
    ) -> Iterator[tuple[str, int, str | None]]:
        """(key, bytes, sha256) of each value; (key, 0, None) where it is missing.

        Files of a folder are read piece by piece, remote ones all at once.

        Args:
          expected: key -> its bytes; a file of another number of bytes is not read, and
            its sha256 is None.

        Raises:
          InputError: one cannot be read.
        """
        futures = {} if self.folder else {key: self.kv.read(key) for key in expected}
        for key, future in futures.items():
            value = self._value(future, key)
            sha256 = None if value is None else hashlib.sha256(value).hexdigest()
            yield key, len(value or b""), sha256
        for key, wanted in expected.items() if self.folder else ():
            size, sha256 = self._size(key), None
            if size == wanted:
                with self._refusing(key), open(self._place(key), "rb") as file:
                    sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            yield key, size or 0, sha256

    def _value(self, future: "ts.Future", key: str) -> bytes | None:
        found = self.wait(future, key)
        return found.value if found.state == "value" else None

    def _place(self, key: str) -> str:
        return os.path.join(self.folder or "", key)

    def _size(self, key: str) -> int | None:
        """Bytes of a file in a folder; None where there is none, or no folder."""
        if self.folder is None:
            return None
        try:
            with self._refusing(key):
                found = os.stat(self._place(key))
        except (FileNotFoundError, NotADirectoryError):
            return None
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f"{self.path(key)}: expected a file")
        return found.st_size

    @contextlib.contextmanager
    def _refusing(self, key: str) -> Iterator[None]:
        """What the system says of a file that is there, as a refusal."""
        try:
            yield
        except (FileNotFoundError, NotADirectoryError):
            raise
        except OSError as error:
            raise InputError(
                f"{self.path(key)}: cannot be read: {error.strerror}: "
                "expected a dataset's file"
            ) from error

    def _check_size(self, key: str, size: int | None) -> None:
        most = JSON_BYTES[key.rpartition("/")[2]]
        if size is not None and size > most:
            raise InputError(f"{self.path(key)}: {size} bytes: expected {most} at most")

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
