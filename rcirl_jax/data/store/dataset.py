"""The dataset on disk: shards of zarr3 arrays, each commit marked by a file.

    DATASET/manifest.json                  the dataset is complete; written last
    DATASET/shards/00000/shard.json        the shard is complete; written last
    DATASET/shards/00000/scene.ego.v/...   one zarr3 array [n, ...] per leaf

DATASET is a folder or any tensorstore URL (`gs://`, `s3://`, `memory://`).
Arrays: codec `sharding_indexed` around zstd and crc32c (zarr v3 specification),
so one file per leaf and shard, of which single blocks of rows can be read.

Checksums form a chain: manifest `hash` -> `sha256` of each shard.json -> sha256
of each file. Both JSON files carry the sha256 of their own canonical form (sorted
keys, no spaces, without that field). Nothing written depends on the time or the
machine: equal scenes give equal bytes.
"""

import abc
import functools
import json
import os
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import tensorstore as ts

from rcirl_jax.data.store.files import FACTS, MANIFEST, SHARDS, Files, context
from rcirl_jax.data.store.manifest import (
    BLOCK_ROWS,
    Manifest,
    layout,
    parse_manifest,
    shard_key,
    verify_shard,
)
from rcirl_jax.data.store.rows import leaf_specs, row_spec
from rcirl_jax.data.store.splits import check_disjoint
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import parse_json, plain
from rcirl_jax.types import Demonstration

OPEN_SHARDS = 256  # shards whose arrays are kept open, 60 kB each


class Demonstrations(abc.ABC):
    """Rows by number, in splits: a dataset, several joined, or one split anew."""

    @property
    @abc.abstractmethod
    def hash(self) -> str:
        """Identity of the whole contents."""

    @abc.abstractmethod
    def indices(self, split: str | None) -> np.ndarray:
        """Return row numbers [m] int64 of a split (None: of all), ascending."""

    @abc.abstractmethod
    def blocks(self, indices: np.ndarray) -> np.ndarray:
        """Return the number [m] of the block, unpacked together, of each row."""

    @abc.abstractmethod
    def read(self, indices: np.ndarray) -> Demonstration:
        """Read rows by number, numpy leaves [m, ...], in the order asked for."""

    def load(self, split: str | None) -> Demonstration:
        """Read all rows of a split (None: of all splits) into memory."""
        return self.read(self.indices(split))

    def weights(self, indices: np.ndarray) -> np.ndarray:
        """Return the weight [m] float32 of each scene in a training loss."""
        return np.ones(np.size(indices), np.float32)


class Dataset(Demonstrations):
    """A finished dataset, opened with `open_dataset`; rows are numbered 0 .. n-1.

    `dataset[row]` is one scene and what the human did in it; loops run over all rows.
    Of several at once `read` gives stacked arrays.

        >>> dataset = rcirl_jax.open_dataset("data")
        >>> held_out = dataset.indices("test")
        >>> one = dataset[held_out[0]]
        >>> one.human.v.shape, one.human.v.dtype
        ((18,), dtype('float32'))
    """

    def __init__(self, files: Files, manifest: Manifest) -> None:
        self.manifest = manifest
        self._files = files
        counts = [shard["count"] for shard in manifest.shards]
        self._starts = np.cumsum([0, *counts])
        self._open: dict[int, dict[str, ts.TensorStore]] = {}

    def __getitem__(self, row: int) -> Demonstration:
        """Return one row; numpy leaves without the row's axis.

        Raises:
          IndexError: no such row.
        """
        return jax.tree.map(lambda leaf: leaf[0], self.read(np.array([row])))

    @property
    def hash(self) -> str:
        """Identity of the whole contents: the manifest's hash."""
        return self.manifest.hash

    @property
    def count(self) -> int:
        """Number of rows."""
        return self.manifest.count

    def write_facts(self, body: Mapping[str, object]) -> None:
        """Write beside the manifest what made the dataset: commit, versions, flags.

        Raises:
          OSError: the place cannot be written.
        """
        text = json.dumps(plain(body), indent=2, allow_nan=False) + "\n"
        self._files.write_many({FACTS: text.encode()})

    def facts(self) -> dict[str, Any]:
        """Return what `write_facts` wrote; empty where nobody did.

        Raises:
          InputError: not a JSON object.
        """
        raw = self._files.read_json(FACTS)
        try:
            found = {} if raw is None else parse_json(raw)
        except ValueError as error:
            raise InputError(
                f"{self._files.path(FACTS)}: {error}: expected JSON"
            ) from error
        if not isinstance(found, dict):
            raise InputError(f"{self._files.path(FACTS)}: expected an object")
        return found

    def _arrays(self, shard: int) -> dict[str, ts.TensorStore]:
        """Return the shard's arrays, opened once, of the shapes and dtypes promised."""
        if shard in self._open:
            return self._open[shard]
        key, count = shard_key(shard), self.manifest.shards[shard]["count"]
        futures = {
            name: ts.open(
                {"driver": "zarr3"},
                kvstore=self._files.kv / f"{key}{name}/",
                open=True,
                context=context(),
            )
            for name in leaf_specs()
        }
        arrays = {}
        for name, leaf in leaf_specs().items():
            array = arrays[name] = self._files.wait(futures[name], key + name)
            where = f"{self._files.path(key + name)}: shard {shard}"
            found = (array.dtype.numpy_dtype, array.shape)
            expected = (leaf.dtype, (count, *leaf.shape))
            if found != expected:
                raise InputError(
                    f"{where}: {found[0]} {found[1]}: expected {expected[0]} "
                    f"{expected[1]}"
                )
            grid = array.chunk_layout
            chunks = (grid.read_chunk.shape, grid.write_chunk.shape)
            if chunks != layout(array.shape):  # a huge block would fill the memory
                raise InputError(
                    f"{where}: chunks {chunks}: expected {layout(array.shape)}"
                )
        if len(self._open) >= OPEN_SHARDS:
            self._open.pop(next(iter(self._open)))
        self._open[shard] = arrays
        return arrays

    def verify(self) -> None:
        """Check every byte.

        Raises:
          InputError: names the shard and the file at fault.
        """
        for number, shard in enumerate(self.manifest.shards):
            verify_shard(self._files, number, shard["sha256"])
            self._arrays(number)

    def check_tables(self) -> None:
        """Check numbers against name tables, and that splits share no vehicle."""
        names = {
            "group": self.manifest.groups,
            "vehicle": self.manifest.vehicles,
            "recording": self.manifest.recordings,
        }
        columns = self._read(np.arange(self.count), tuple(names))
        for column, table in names.items():
            low, high = columns[column].min(), columns[column].max()
            if low < 0 or high >= len(table):
                raise ValueError(f"{column}: {low} to {high}: {len(table)} names")
        split = self._split_groups()
        check_disjoint(columns["group"], columns["vehicle"], split)

    def _split_groups(self) -> dict[str, list[int]]:
        number = {name: i for i, name in enumerate(self.manifest.groups)}
        splits = self.manifest.splits.items()
        return {split: [number[name] for name in names] for split, names in splits}

    def indices(self, split: str | None) -> np.ndarray:
        """Return row numbers [m] int64 of a split (None: of all), ascending."""
        rows = np.arange(self.count)
        if split is None:
            return rows
        if split not in self.manifest.splits:
            known = ", ".join(self.manifest.splits)
            raise InputError(
                f"{self._files.path(MANIFEST)}: splits: {split}: expected {known}"
            )
        return rows[np.isin(self._groups, self._split_groups()[split])]

    @functools.cached_property
    def _groups(self) -> np.ndarray:
        return self.column("group")

    def blocks(self, indices: np.ndarray) -> np.ndarray:
        """Return the number [m] of the block, unpacked together, of each row."""
        shard = np.searchsorted(self._starts, indices, side="right") - 1
        counts = -(-np.diff(self._starts) // BLOCK_ROWS)
        before = np.cumsum([0, *counts])[shard]
        return before + (indices - self._starts[shard]) // BLOCK_ROWS

    def read(self, indices: np.ndarray) -> Demonstration:
        """Read rows by number, numpy leaves [m, ...], in the order asked for."""
        leaves = self._read(indices, tuple(leaf_specs()))
        return jax.tree.unflatten(jax.tree.structure(row_spec()), leaves.values())

    def column(self, name: str) -> np.ndarray:
        """Read one leaf of all rows, e.g. "scene.tags", numpy [n, ...]."""
        return self._read(np.arange(self.count), (name,))[name]

    def _read(
        self, indices: np.ndarray, names: tuple[str, ...]
    ) -> dict[str, np.ndarray]:
        rows = np.asarray(indices, np.int64)
        if rows.ndim != 1 or np.any((rows < 0) | (rows >= self.count)):
            raise IndexError(f"rows: expected a list of numbers below {self.count}")
        spec = {name: leaf_specs()[name] for name in names}
        out = {k: np.empty((rows.size, *v.shape), v.dtype) for k, v in spec.items()}
        owner = np.searchsorted(self._starts, rows, side="right") - 1
        for shard in np.unique(owner).tolist():
            places = np.flatnonzero(owner == shard)
            local = rows[places] - self._starts[shard]
            arrays = self._arrays(shard)
            reads = {name: arrays[name][local].read() for name in names}
            for name, future in reads.items():
                key = f"{shard_key(shard)}{name}"
                out[name][places] = self._files.wait(future, key)
        return out


def open_dataset(url: str | os.PathLike[str], verify: bool = True) -> Dataset:
    """Open a finished dataset.

    Args:
      url: dataset folder or tensorstore URL.
      verify: read every byte against its checksum first. Without it damage is
        found by crc32c when the damaged rows are read.

    Raises:
      InputError: no dataset, an interrupted import, another schema version, or
        damage; names the file.

    Examples:
        >>> dataset = rcirl_jax.open_dataset("data")
        >>> train, test = dataset.indices("train"), dataset.indices("test")
        >>> dataset.count == len(train) + len(test)
        True
    """
    files = Files(url)
    raw = files.read_json(MANIFEST)
    if raw is None:
        shards = any(key.startswith(SHARDS) for key in files.list_keys())
        reason = (
            "the import was interrupted: run import again to resume"
            if shards
            else "no dataset here: expected a folder made by `rcirl import`"
        )
        raise InputError(f"{files.path(MANIFEST)}: missing: {reason}")
    dataset = Dataset(files, parse_manifest(raw, files))
    if verify:
        dataset.verify()
    return dataset
