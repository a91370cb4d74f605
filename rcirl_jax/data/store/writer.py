"""Writing a dataset, shard by shard; the form on disk is `dataset.py`'s."""

import contextlib
import os
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import tensorstore as ts

from rcirl_jax.data.store.dataset import (
    Dataset,
    Manifest,
    ShardEntry,
    ShardInfo,
    array_table,
    layout,
    parse_manifest,
    shard_info,
    shard_key,
    verify_shard,
)
from rcirl_jax.data.store.files import (
    JSON_BYTES,
    MANIFEST,
    MARK,
    SCHEMA_VERSION,
    SHARDS,
    Files,
    describe,
    seal,
    unseal,
)
from rcirl_jax.data.store.rows import leaf_specs, named_leaves
from rcirl_jax.data.store.splits import check_disjoint
from rcirl_jax.errors import InputError, LostWorkError
from rcirl_jax.types import Demonstration
from rcirl_jax.units import TIMES_S

SHARDS_END = "shards0"  # first key after all that begin with "shards/"
ZSTD_LEVEL = 3  # zstd's own default


class DatasetWriter:
    """Writes a dataset shard by shard; can be interrupted anywhere.

    Nothing is touched before the first shard is written: with `overwrite`, bad
    input found before that leaves the old dataset as it was.
    """

    def __init__(self, url: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Looks at what is there.

        Args:
          url: dataset folder, need not exist, or tensorstore URL.
          overwrite: start over, replacing whatever import is there.

        Raises:
          InputError: a finished dataset without `overwrite`; other files.
        """
        self._files = Files(url)
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
        # no `ShardInfo`: lineages of a long log would fill the memory
        self._shards: list[ShardEntry] = []
        with contextlib.suppress(InputError):  # of the first shard that is not whole
            while shards and not overwrite:
                info = verify_shard(self._files, len(self._shards))
                self._add(info.count, info.sha256, info.lineage)
        self._first_written: int | None = None
        self._finished = False

    def committed(self) -> list[ShardInfo]:
        """Reads the shards already there and whole, from number 0 on without a gap."""
        return [
            shard_info(self._files, index, shard["sha256"])
            for index, shard in enumerate(self._shards)
        ]

    def write_shard(
        self, index: int, demonstrations: Demonstration, lineage: list[dict]
    ) -> None:
        """Writes and commits the next shard; removes remains of an earlier attempt.

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
        leaves = {
            name: np.ascontiguousarray(leaf)
            for name, leaf in named_leaves(demonstrations).items()
        }
        count = int(leaves["vehicle"].size)
        for name, spec in leaf_specs().items():
            found, expected = leaves[name], (count, *spec.shape)
            if (found.shape, found.dtype) != (expected, spec.dtype) or count == 0:
                raise ValueError(
                    f"{name}: {found.dtype} {found.shape}: expected {spec.dtype} "
                    f"{expected}, at least one row"
                )
        key = shard_key(index)
        values = {key + file: value for file, value in _encode(leaves).items()}
        payload = {
            "schema_version": SCHEMA_VERSION,
            "index": index,
            "count": count,
            "lineage": lineage,
            "files": {k.removeprefix(key): describe(v) for k, v in values.items()},
        }
        mark, sha256 = self._sealed(payload, "sha256", key + MARK)
        if self._first_written is None:
            self._first_written = index
        self._remove_from(index)
        try:
            self._files.write_many(values)
            self._files.write_many({key + MARK: mark})
        except OSError as error:
            if index > 0:
                raise
            raise InputError(f"{error}: expected a place to write to") from error
        self._add(count, sha256, lineage)

    def _add(self, count: int, sha256: str, lineage: list[dict]) -> None:
        made_of = {entry["name"]: entry.get("sha256") for entry in lineage}
        entry: ShardEntry = {"count": count, "sha256": sha256, "recordings": made_of}
        self._shards.append(entry)

    def _sealed(self, payload: Mapping, field: str, key: str) -> tuple[bytes, str]:
        """Returns the bytes and digest of a file; refuses what could not be read."""
        raw, most = seal(payload, field), JSON_BYTES[key.rpartition("/")[2]]
        if len(raw) > most:  # what is finished stays
            raise LostWorkError(
                f"{self._files.path(key)}: {len(raw)} bytes of names: expected {most} "
                "at most; import into several datasets"
            )
        return raw, unseal(raw, field, key)[field]

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
        """Commits the dataset: checks the tables, writes manifest.json.

        Args:
          manifest_fields: the fields of `Manifest` from `rate_hz` on but `shards` and
            `hash`, JSON-ready.
          before_commit: what else belongs to a finished import; a run that is killed
            in it is resumed, and its bad input is raised after the commit.

        Raises:
          InputError: a vehicle has rows in two splits.
          LostWorkError: more names than a manifest holds; the shards are sound.
        """
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
        raw, _ = self._sealed(payload, "hash", MANIFEST)
        dataset = Dataset(self._files, parse_manifest(raw, self._files))
        _check_tables(dataset)
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
        """Removes what this writer wrote; shards resumed from stay as they were.

        Folders made for the dataset go with `Files.alone`.
        """
        if self._finished or self._first_written is None:
            return
        self._remove_from(self._first_written)
        if self._files.folder is not None:
            with contextlib.suppress(OSError):  # shards before are in it
                os.rmdir(os.path.join(self._files.folder, SHARDS))


def _check_tables(dataset: Dataset) -> None:
    """Checks numbers against name tables, and that splits share no vehicle."""
    manifest = dataset.manifest
    names = {"group": manifest.groups, "vehicle": manifest.vehicles}
    names |= {"recording": manifest.recordings}
    columns = dataset.columns(tuple(names), np.arange(dataset.count))
    for column, table in names.items():
        low, high = columns[column].min(), columns[column].max()
        if low < 0 or high >= len(table):
            raise ValueError(f"{column}: {low} to {high}: {len(table)} names")
    check_disjoint(columns["group"], columns["vehicle"], dataset.split_groups())


def _metadata(shape: tuple[int, ...], dtype: np.dtype) -> dict:
    """Returns zarr3 metadata: one storage chunk per array, cut into blocks of rows."""
    block, chunk = map(list, layout(shape))
    plain = {"name": "bytes", "configuration": {"endian": "little"}}
    zstd = {"level": ZSTD_LEVEL, "checksum": False}  # crc32c checks already
    sharding = {
        "chunk_shape": block,
        "codecs": [
            plain if dtype.itemsize > 1 else {"name": "bytes"},
            {"name": "zstd", "configuration": zstd},
            {"name": "crc32c"},
        ],
        "index_codecs": [plain, {"name": "crc32c"}],
    }
    return {
        "shape": list(shape),
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
        "codecs": [{"name": "sharding_indexed", "configuration": sharding}],
    }


def _encode(leaves: Mapping[str, np.ndarray]) -> dict[str, bytes]:
    """Returns a shard's zarr3 files by key, made in memory and hashed as written."""
    context = ts.Context()
    opened = {
        name: ts.open(
            {
                "driver": "zarr3",
                "kvstore": {"driver": "memory", "path": f"{name}/"},
                "metadata": _metadata(leaf.shape, leaf.dtype),
                "store_data_equal_to_fill_value": True,
                "create": True,
            },
            context=context,
        )
        for name, leaf in leaves.items()
    }
    writes = [opened[name].result().write(leaf) for name, leaf in leaves.items()]
    for write in writes:
        write.result()
    memory = ts.KvStore.open("memory://", context=context).result()
    futures = {key: memory.read(key) for key in sorted(memory.list().result())}
    return {key.decode(): future.result().value for key, future in futures.items()}
