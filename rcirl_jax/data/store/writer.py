"""Writing a dataset, shard by shard; the form on disk is `dataset`'s."""

import json
import os
import re
from collections.abc import Callable, Mapping
from typing import Any

from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.data.store.files import JSON_BYTES, MANIFEST, MARK, SHARDS, Files
from rcirl_jax.data.store.manifest import (
    SCHEMA_VERSION,
    Manifest,
    ShardInfo,
    array_table,
    parse_manifest,
    seal,
    shard_entry,
)
from rcirl_jax.data.store.rows import checked_leaves
from rcirl_jax.data.store.shards import (
    describe,
    encode,
    shard_info,
    shard_key,
    verify_shard,
)
from rcirl_jax.errors import InputError, LostWorkError
from rcirl_jax.types import Demonstration
from rcirl_jax.units import TIMES_S

SHARDS_END = "shards0"  # first key after all that begin with "shards/"
# what the import hands to `DatasetWriter.finish`; the writer knows the rest
IMPORT_FIELDS = (
    "rate_hz",
    "sources",
    "recordings",
    "groups",
    "vehicles",
    "splits",
    "quality",
    "import",
)


class DatasetWriter:
    """Writes a dataset shard by shard; can be interrupted anywhere.

    Nothing is touched before the first shard is written: with `overwrite`, bad
    input found before that leaves the old dataset as it was.
    """

    def __init__(self, url: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Look at what is there.

        Args:
          url: dataset folder, need not exist, or tensorstore URL.
          overwrite: start over, replacing whatever import is there.

        Raises:
          InputError: a finished dataset without `overwrite`; other files.
        """
        self._files = Files(url)
        self._missing_folders = _missing_folders(self._files.folder)
        keys = self._files.list_keys()
        shards = any(re.match(SHARDS + r"\d{5}/", key) for key in keys)
        if keys and not shards and MANIFEST not in keys:
            raise InputError(
                f"{self._files.name}: holds {keys[0]}, not a dataset: "
                "expected an empty or new folder"
            )
        if MANIFEST in keys and not overwrite:
            raise InputError(
                f"{self._files.name}: holds a finished dataset: "
                "expected a new folder, or overwrite to replace it"
            )
        # one `shard_entry` a shard: lineages of a long log would fill the memory
        self._shards = [] if overwrite or not shards else self._find_committed()
        self._first_written: int | None = None
        self._finished = False

    def _find_committed(self) -> list[dict]:
        found = []
        while True:
            try:
                found.append(shard_entry(verify_shard(self._files, len(found))))
            except InputError:
                return found

    def committed(self) -> list[ShardInfo]:
        """The shards already there and whole, from number 0 on without a gap.

        Read from disk; the writer itself remembers digests only.
        """
        return [
            shard_info(self._files, index, shard["sha256"])
            for index, shard in enumerate(self._shards)
        ]

    def write_shard(
        self, index: int, demonstrations: Demonstration, lineage: list[dict]
    ) -> ShardInfo:
        """Write and commit the next shard; removes remains of an earlier attempt.

        Args:
          index: number of the shard, the number of shards before it.
          demonstrations: numpy rows [n, ...], n >= 1.
          lineage: one JSON-ready dict per recording in the shard, with its "name"
            and, if known, the "sha256" of what it was made of.

        Raises:
          InputError: the place cannot be written at all.
          OSError: it can no longer be written, e.g. the disk is full. Shards
            before this one stay, to resume from.
        """
        if index != len(self._shards):
            raise ValueError(f"shard {index}: expected {len(self._shards)} next")
        leaves = checked_leaves(demonstrations)
        values = encode(leaves)
        payload = {
            "schema_version": SCHEMA_VERSION,
            "index": index,
            "count": int(leaves["vehicle"].size),
            "lineage": lineage,
            "files": {key: describe(value) for key, value in values.items()},
        }
        key = shard_key(index)
        mark = self._readable(seal(payload, "sha256"), key + MARK)
        if self._first_written is None:
            self._first_written = index
        self._remove_from(index)
        try:
            self._files.write_many({key + file: v for file, v in values.items()})
            self._files.write_many({key + MARK: mark})
        except OSError as error:
            if index > 0:
                raise
            raise InputError(f"{error}: expected a place to write to") from error
        info = ShardInfo(**json.loads(mark))
        self._shards.append(shard_entry(info))
        return info

    def _readable(self, raw: bytes, key: str) -> bytes:
        """Refuse to write what would not be read again; what is finished stays."""
        most = JSON_BYTES[key.rpartition("/")[2]]
        if len(raw) > most:
            raise LostWorkError(
                f"{self._files.path(key)}: {len(raw)} bytes of names: expected {most} "
                "at most; import into several datasets"
            )
        return raw

    def _remove_from(self, index: int) -> None:
        # shards before the manifest: what an interrupt here leaves cannot pass for
        # an import to resume
        start = SHARDS if index == 0 else shard_key(index).rstrip("/")
        self._files.remove(start, SHARDS_END)
        self._files.remove(MANIFEST, MANIFEST + "\0")

    def finish(
        self,
        manifest_fields: Mapping[str, Any],
        before_commit: Callable[[Dataset], object] = lambda dataset: None,
    ) -> Manifest:
        """Commit the dataset: check the tables, write manifest.json.

        Args:
          manifest_fields: exactly `IMPORT_FIELDS`, JSON-ready.
          before_commit: what else belongs to a finished import; a run that is killed
            in it is resumed, and its bad input is raised after the commit.

        Raises:
          InputError: a vehicle has rows in two splits.
          LostWorkError: more names than a manifest holds; the shards are sound.
        """
        if set(manifest_fields) != set(IMPORT_FIELDS):
            different = sorted(set(manifest_fields) ^ set(IMPORT_FIELDS))
            raise ValueError(f"manifest: {different}: expected {IMPORT_FIELDS}")
        if not self._shards:
            raise ValueError("dataset: 0 shards: expected at least one")
        payload = {
            **manifest_fields,
            "schema_version": SCHEMA_VERSION,
            "count": sum(shard["count"] for shard in self._shards),
            "arrays": array_table(),
            "time_grid_s": TIMES_S.tolist(),
            "shards": self._shards,
        }
        raw = self._readable(seal(payload, "hash"), MANIFEST)
        dataset = Dataset(self._files, parse_manifest(raw, self._files))
        dataset.check_tables()
        self._remove_from(len(self._shards))
        failed = None
        try:
            before_commit(dataset)
        except InputError as error:
            failed = error
        self._files.write_many({MANIFEST: raw})
        self._finished = True
        if failed is not None:
            raise failed
        return dataset.manifest

    def abort(self) -> None:
        """Remove what this writer wrote; shards resumed from stay as they were."""
        if self._finished or self._first_written is None:
            return
        self._remove_from(self._first_written)
        inner = [os.path.join(self._files.folder, SHARDS)] if self._files.folder else []
        for folder in inner + self._missing_folders:
            if os.path.isdir(folder) and not os.listdir(folder):
                os.rmdir(folder)


def _missing_folders(folder: str | None) -> list[str]:
    """Folders that writing into `folder` will create, innermost first."""
    missing = []
    while folder is not None and not os.path.lexists(folder):
        missing.append(folder)
        folder = os.path.dirname(folder)
    return missing
