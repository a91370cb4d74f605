"""Files of a dataset, by tensorstore: a folder or any kvstore URL; and their digests.

Checksums form a chain: manifest `hash` -> `sha256` of each shard.json -> sha256
of each file. Both JSON files carry the sha256 of their own canonical form (sorted
keys, no spaces, without that field). Nothing written depends on the time or the
machine: equal scenes give equal bytes.
"""

import contextlib
import functools
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, TypedDict, TypeVar

import msgspec
import tensorstore as ts

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import parse_json
from rcirl_jax.runtime.pipeline import LOCK, digest, only_one

MANIFEST, MARK, SHARDS = "manifest.json", "shard.json", "shards/"
PLANS = "plans.json"  # of the sites of the first recordings
FACTS = "made_by.json"  # beside the manifest, whose bytes depend on the logs alone
# of each; the manifest of 10 million scenes takes some 10 MiB
JSON_BYTES = {MANIFEST: 2**30, MARK: 2**28, FACTS: 2**28, PLANS: 2**28}
SCHEMA_VERSION = 2  # of manifest.json and shard.json

_T = TypeVar("_T")


class FileEntry(TypedDict):
    """Size and digest of a file."""

    bytes: Annotated[int, msgspec.Meta(ge=0)]
    sha256: Annotated[str, msgspec.Meta(pattern=r"\A[0-9a-f]{64}\Z")]


class Files:
    """Named values below one URL."""

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
        """Holds the folder for this process; remote places cannot be held.

        Raises:
          InputError: another process holds the folder.
        """
        if self.folder is None:
            return contextlib.nullcontext()
        return only_one(Path(self.folder))

    def path(self, key: str) -> str:
        """Returns how messages call a key."""
        return f"{self.name}/{key}"

    def wait(self, future: "ts.Future[_T]", key: str) -> _T:
        """Returns a read's result; a failure names the key."""
        try:
            return future.result()
        except ValueError as error:
            raise InputError(
                f"{self.path(key)}: cannot be read: {_reason(error)}: "
                "expected a dataset's file"
            ) from error

    def list_keys(self) -> list[str]:
        """Returns all keys below the dataset, but for the lock of who writes it.

        Raises:
          InputError: one is no text.
        """
        try:
            found = [key.decode() for key in self.wait(self.kv.list(), "")]
        except UnicodeDecodeError as error:
            raise InputError(
                f"{self.name}: holds {error.object!r}: expected names in UTF-8"
            ) from error
        return [key for key in found if key != LOCK]

    def read(self, most: Mapping[str, int]) -> dict[str, bytes | None]:
        """Reads values, all at once; None where there is none.

        Args:
          most: key -> bytes that it may have; a longer file of a folder is not read.

        Raises:
          InputError: one cannot be read, or is too large.
        """

        def check(key: str, size: int) -> None:
            if size > most[key]:
                raise InputError(
                    f"{self.path(key)}: {size} bytes: expected {most[key]} at most"
                )

        for key in most if self.folder is not None else ():
            path = os.path.join(self.folder or "", key)
            if os.path.exists(path):
                if not os.path.isfile(path):  # of a pipe one would wait for bytes
                    raise InputError(f"{self.path(key)}: expected a file")
                check(key, os.path.getsize(path))
        values = {}
        for key, future in {key: self.kv.read(key) for key in most}.items():
            result = self.wait(future, key)
            values[key] = result.value if result.state == "value" else None
            check(key, len(values[key] or b""))
        return values

    def read_json(self, key: str) -> bytes | None:
        """Reads one of the dataset's JSON files; errors as of `read`."""
        return self.read({key: JSON_BYTES[key.rpartition("/")[2]]})[key]

    def write_many(self, values: Mapping[str, bytes]) -> None:
        """Writes each value atomically; returns when all are on disk.

        Raises:
          OSError: one cannot be written.
        """
        futures = []
        try:
            with self._writing():
                for key, value in values.items():
                    futures.append(put(self.kv, key, value))
                for future in futures:
                    future.result()
        finally:
            # a write still under way would land after an abort has cleaned up
            for future in futures:
                future.exception()

    def remove(self, start: str, end: str) -> None:
        """Deletes the keys from `start` up to `end`; OSError if they cannot be."""
        with self._writing():
            self.kv.delete_range(ts.KvStore.KeyRange(start, end)).result()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except ValueError as error:
            raise OSError(
                f"{self.name}: cannot be written: {_reason(error)}"
            ) from error


def _reason(error: ValueError) -> str:
    """Returns tensorstore's message without the specification in brackets."""
    return str(error).split(" [")[0]


@functools.cache
def context() -> ts.Context:
    """Returns one context for all, so that a memory:// URL means one thing."""
    return ts.Context()


def put(kv: ts.KvStore, key: str, value: bytes) -> ts.Future:
    """Starts writing one value."""
    return kv.write(key, value)


# -------------------------------------------------------------------- checksums


def describe(data: bytes) -> FileEntry:
    """Returns size and sha256 of a file."""
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def seal(payload: Mapping, field: str) -> bytes:
    """Returns JSON bytes of the payload with its own digest as one more field."""
    whole = {**payload, field: digest(payload)}
    return (json.dumps(whole, sort_keys=True, indent=1) + "\n").encode()


def unseal(raw: bytes, field: str, name: str) -> dict[str, Any]:
    """Parses `seal`'s bytes; InputError when they are not as written."""
    try:
        payload = parse_json(raw)
    except ValueError as error:
        raise InputError(
            f"{name}: not JSON ({error}): expected the file as written; truncated?"
        ) from error
    found = payload.get("schema_version") if isinstance(payload, dict) else None
    if found != SCHEMA_VERSION:
        raise InputError(
            f"{name}: schema_version: {found}: expected {SCHEMA_VERSION}; "
            "import the logs again with this version"
        )
    sha = digest({k: v for k, v in payload.items() if k != field})
    if sha != payload.get(field):
        raise InputError(
            f"{name}: {field}: contents {sha}: expected {payload.get(field)}; damaged"
        )
    return payload
