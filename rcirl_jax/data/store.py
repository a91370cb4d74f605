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

import dataclasses
import functools
import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar, cast

import jax
import numpy as np
import tensorstore as ts

from rcirl_jax.data.splits import check_disjoint
from rcirl_jax.errors import InputError
from rcirl_jax.types import (
    NUM_TAGS,
    Demonstration,
    Ego,
    Obstacles,
    Path,
    Scene,
    Trajectory,
)
from rcirl_jax.units import NUM_OBSTACLES, NUM_STATIONS, NUM_TIMES, TIMES_S

SCHEMA_VERSION = 1  # of manifest.json and shard.json
BLOCK_ROWS = 256  # rows of a separately compressed block: ~2.5 MB of scenes, unpacked
ZSTD_LEVEL = 3  # zstd's own default
MANIFEST, MARK, SHARDS = "manifest.json", "shard.json", "shards/"
_T = TypeVar("_T")
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


def _node(
    kind: type[_T], shape: tuple, dtype: type = np.float32, /, **other: tuple
) -> _T:
    """A pytree node whose leaves have one shape and dtype, but for `other`."""
    leaves = {}
    for field in dataclasses.fields(cast(Any, kind)):
        size, of = other.get(field.name, (shape, dtype))
        leaves[field.name] = _leaf(size, of)
    return kind(**leaves)


def _leaf(shape: tuple, dtype: type) -> jax.Array:
    # a description in an array's place, as jax.eval_shape has it
    return cast(jax.Array, jax.ShapeDtypeStruct(shape, dtype))


def row_spec() -> Demonstration:
    """Shape and dtype of every leaf of one stored row."""
    slots, motion = (NUM_OBSTACLES,), (NUM_OBSTACLES, NUM_TIMES)
    scene = Scene(
        ego=_node(Ego, ()),
        path=_node(Path, (NUM_STATIONS,)),
        obstacles=_node(
            Obstacles,
            motion,
            valid=(motion, np.bool_),
            kind=(slots, np.int32),
            is_recorded=(slots, np.bool_),
        ),
        time_valid=_leaf((NUM_TIMES,), np.bool_),
        tags=_leaf((NUM_TAGS,), np.bool_),
    )
    return Demonstration(
        scene=scene,
        human=_node(Trajectory, (NUM_TIMES,)),
        decisions=_leaf(slots, np.int32),
        **{name: _leaf((), np.float32) for name in ("future_s", "s_at_5s")},
        **{
            name: _leaf((), np.int32)
            for name in ("vehicle", "recording", "group", "frame")
        },
    )


def named_leaves(rows: Demonstration) -> dict[str, Any]:
    """Leaves by path, e.g. "scene.path.kappa", in the order of the tree."""
    flat, _ = jax.tree_util.tree_flatten_with_path(rows)
    return {".".join(key.name for key in path): leaf for path, leaf in flat}


@functools.cache
def _leaves() -> dict[str, jax.ShapeDtypeStruct]:
    return named_leaves(row_spec())


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShardInfo:
    """A committed shard, as its shard.json says."""

    schema_version: int
    index: int
    count: int  # rows
    lineage: list[dict]  # recordings in it, as the import described them
    files: dict[str, dict]  # key below the shard -> {"bytes", "sha256"}
    sha256: str  # over the fields above


@dataclasses.dataclass(frozen=True, kw_only=True)
class Manifest:
    """What manifest.json says; "import" is called `import_flags` here."""

    schema_version: int
    count: int  # rows of all shards
    arrays: dict[str, dict]  # leaf -> {"shape", "dtype"} of one row
    time_grid_s: list[float]  # s, `TIMES_S`
    rate_hz: list[float]  # Hz, sampling rates of the recordings
    sources: list[dict]  # {"source", "licence"} of the data
    recordings: list[str]  # names by number, as are the next two
    groups: list[str]
    vehicles: list[str]
    splits: dict[str, list[str]]  # group names per split
    shards: list[dict]  # {"count", "sha256"} by shard number
    quality: dict  # data-quality report
    import_flags: dict
    hash: str  # sha256 over the canonical manifest without this field


_MANIFEST_KEYS = tuple(
    "import" if field.name == "import_flags" else field.name
    for field in dataclasses.fields(Manifest)
)


# ----------------------------------------------------------------------- keys


def _canonical(payload: Mapping) -> str:
    return hashlib.sha256(
        json.dumps(
            payload, sort_keys=True, separators=(",", ":"), allow_nan=False
        ).encode()
    ).hexdigest()


def _seal(payload: Mapping, field: str) -> bytes:
    """JSON bytes of the payload with its own digest as one more field."""
    whole = {**payload, field: _canonical(payload)}
    return (json.dumps(whole, sort_keys=True, indent=1) + "\n").encode()


def _refuse_constant(text: str) -> None:
    raise ValueError(f"{text} is no JSON number")


def _unseal(raw: bytes, field: str, name: str) -> dict:
    """Parse `_seal`'s bytes; InputError when they are not as written."""
    try:
        payload = json.loads(raw, parse_constant=_refuse_constant)
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
    stated = payload.get(field)
    sha = _canonical({k: v for k, v in payload.items() if k != field})
    if sha != stated:
        raise InputError(f"{name}: {field}: contents {sha}: expected {stated}; damaged")
    return payload


class _Files:
    """Named values below one URL: a thin skin over tensorstore's KvStore."""

    def __init__(self, url: str | os.PathLike[str]) -> None:
        text = os.fspath(url)
        self.name = text.rstrip("/")
        self.folder = None if "://" in text else os.path.abspath(text)
        where = {"driver": "file", "path": f"{self.folder}/"}
        try:
            self.kv = ts.KvStore.open(
                where if self.folder else f"{self.name}/", context=_context()
            ).result()
        except ValueError as error:
            raise InputError(
                f"{text}: {_reason(error)}: expected a folder or a gs://, s3:// URL"
            ) from error

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
        return [key.decode() for key in self.wait(self.kv.list(), "")]

    def read_many(self, keys: Iterable[str]) -> Iterable[tuple[str, bytes | None]]:
        """Each key with its value, None where it is missing; all read at once."""
        futures = {key: self.kv.read(key) for key in keys}
        for key, future in futures.items():
            found = self.wait(future, key)
            yield key, found.value if found.state == "value" else None

    def read(self, key: str) -> bytes | None:
        return dict(self.read_many([key]))[key]

    def write_many(self, values: Mapping[str, bytes]) -> None:
        """Each value atomically; returns when all are on disk."""
        futures = []
        try:
            for key, value in values.items():
                futures.append(_put(self.kv, key, value))
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
        """Delete the keys from `start` up to `end`."""
        self.kv.delete_range(ts.KvStore.KeyRange(start, end)).result()


def _reason(error: ValueError) -> str:
    """A message of tensorstore without the specification it appends in brackets."""
    return str(error).split(" [")[0]


@functools.cache
def _context() -> ts.Context:
    return ts.Context()  # one for all, so that a memory:// URL means one thing


def _put(kv: ts.KvStore, key: str, value: bytes) -> ts.Future:
    return kv.write(key, value)


def _shard_key(index: int) -> str:
    return f"{SHARDS}{index:05d}/"


# --------------------------------------------------------------------- arrays


def _metadata(shape: tuple[int, ...], dtype: np.dtype) -> dict:
    """zarr3 metadata: one storage chunk per array, cut into blocks of rows."""
    rows, rest = min(shape[0], BLOCK_ROWS), list(shape[1:])
    plain = {"name": "bytes", "configuration": {"endian": "little"}}
    zstd = {"level": ZSTD_LEVEL, "checksum": False}  # crc32c checks already
    sharding = {
        "chunk_shape": [rows, *rest],
        "codecs": [
            plain if dtype.itemsize > 1 else {"name": "bytes"},
            {"name": "zstd", "configuration": zstd},
            {"name": "crc32c"},
        ],
        "index_codecs": [plain, {"name": "crc32c"}],
    }
    chunk = [-(-shape[0] // rows) * rows, *rest]
    return {
        "shape": list(shape),
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
        "codecs": [{"name": "sharding_indexed", "configuration": sharding}],
    }


def _encode(leaves: Mapping[str, np.ndarray]) -> dict[str, bytes]:
    """zarr3 files of a shard in memory, so that they can be hashed as written."""
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


def _checked_leaves(rows: Demonstration) -> dict[str, np.ndarray]:
    """Leaves as contiguous arrays; ValueError where one is not `[n, *spec]`."""
    leaves = {k: np.ascontiguousarray(v) for k, v in named_leaves(rows).items()}
    count = leaves["vehicle"].size
    for name, spec in _leaves().items():
        shape, dtype = (count, *spec.shape), spec.dtype
        if leaves[name].shape != shape or leaves[name].dtype != dtype:
            raise ValueError(
                f"{name}: {leaves[name].dtype} {leaves[name].shape}: "
                f"expected {dtype} {shape}"
            )
    if count == 0:
        raise ValueError("shard: 0 rows: expected at least one")
    return leaves


def _describe(data: bytes | None) -> dict:
    if data is None:
        return {"bytes": 0, "sha256": "missing"}
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def _verify_shard(files: _Files, index: int, sha256: str | None = None) -> ShardInfo:
    """Read all of a shard against its checksums; InputError names what is wrong."""
    key = _shard_key(index)
    name = files.path(key + MARK)
    mark = files.read(key + MARK)
    if mark is None:
        raise InputError(f"{name}: shard {index}: missing: expected sha256 {sha256}")
    info = ShardInfo(**_unseal(mark, "sha256", name))
    if sha256 is not None and info.sha256 != sha256:
        raise InputError(
            f"{name}: shard {index}: sha256 {info.sha256}: expected {sha256}"
        )
    for path, data in files.read_many(key + file for file in info.files):
        found, expected = _describe(data), info.files[path.removeprefix(key)]
        if found != expected:
            raise InputError(
                f"{files.path(path)}: shard {index}: {found['bytes']} bytes, sha256 "
                f"{found['sha256']}: expected {expected['bytes']} bytes, sha256 "
                f"{expected['sha256']}; import the logs again"
            )
    return info


# --------------------------------------------------------------------- writer


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
        self._files = _Files(url)
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
                "expected a new folder, or --overwrite to replace it"
            )
        self._committed = [] if overwrite or not shards else self._find_committed()
        self._first_written: int | None = None
        self._finished = False

    def _find_committed(self) -> list[ShardInfo]:
        found = []
        while True:
            try:
                found.append(_verify_shard(self._files, len(found)))
            except InputError:
                return found

    def committed(self) -> list[ShardInfo]:
        """The shards already there and whole, from number 0 on without a gap."""
        return list(self._committed)

    def write_shard(
        self, index: int, demonstrations: Demonstration, lineage: list[dict]
    ) -> ShardInfo:
        """Write and commit the next shard; removes remains of an earlier attempt.

        Args:
          index: number of the shard, the number of shards before it.
          demonstrations: numpy rows [n, ...], n >= 1.
          lineage: one JSON-ready dict per recording in the shard.

        Raises:
          InputError: the place cannot be written at all.
          OSError: it can no longer be written, e.g. the disk is full. Shards
            before this one stay, to resume from.
        """
        if index != len(self._committed):
            raise ValueError(f"shard {index}: expected {len(self._committed)} next")
        leaves = _checked_leaves(demonstrations)
        values = _encode(leaves)
        payload = {
            "schema_version": SCHEMA_VERSION,
            "index": index,
            "count": int(leaves["vehicle"].size),
            "lineage": lineage,
            "files": {key: _describe(value) for key, value in values.items()},
        }
        mark, key = _seal(payload, "sha256"), _shard_key(index)
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
        self._committed.append(ShardInfo(**json.loads(mark)))
        return self._committed[-1]

    def _remove_from(self, index: int) -> None:
        # shards before the manifest: what an interrupt here leaves cannot pass for
        # an import to resume
        start = SHARDS if index == 0 else _shard_key(index).rstrip("/")
        self._files.remove(start, SHARDS_END)
        self._files.remove(MANIFEST, MANIFEST + "\0")

    def finish(self, manifest_fields: Mapping[str, Any]) -> Manifest:
        """Commit the dataset: check the tables, write manifest.json.

        Args:
          manifest_fields: exactly `IMPORT_FIELDS`, JSON-ready.

        Raises:
          InputError: a vehicle has rows in two splits.
        """
        if set(manifest_fields) != set(IMPORT_FIELDS):
            different = sorted(set(manifest_fields) ^ set(IMPORT_FIELDS))
            raise ValueError(f"manifest: {different}: expected {IMPORT_FIELDS}")
        if not self._committed:
            raise ValueError("dataset: 0 shards: expected at least one")
        payload = {
            **manifest_fields,
            "schema_version": SCHEMA_VERSION,
            "count": sum(info.count for info in self._committed),
            "arrays": _array_table(),
            "time_grid_s": TIMES_S.tolist(),
            "shards": [
                {"count": info.count, "sha256": info.sha256} for info in self._committed
            ],
        }
        raw = _seal(payload, "hash")
        dataset = Dataset(self._files, _parse_manifest(raw, self._files))
        dataset.check_tables()
        self._remove_from(len(self._committed))
        self._files.write_many({MANIFEST: raw})
        self._finished = True
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


# --------------------------------------------------------------------- reader


def _array_table() -> dict[str, dict]:
    return {
        name: {"shape": list(leaf.shape), "dtype": np.dtype(leaf.dtype).name}
        for name, leaf in _leaves().items()
    }


def _parse_manifest(raw: bytes, files: _Files) -> Manifest:
    name = files.path(MANIFEST)
    payload = _unseal(raw, "hash", name)
    if set(payload) != set(_MANIFEST_KEYS):
        different = sorted(set(payload) ^ set(_MANIFEST_KEYS))
        raise InputError(f"{name}: {different[0]}: expected {_MANIFEST_KEYS}")
    ours = _array_table()
    for leaf in sorted(ours.keys() | payload["arrays"].keys()):
        found, expected = payload["arrays"].get(leaf), ours.get(leaf)
        if found != expected:
            raise InputError(f"{name}: arrays: {leaf}: {found}: expected {expected}")
    if payload["time_grid_s"] != TIMES_S.tolist():
        raise InputError(
            f"{name}: time_grid_s: {payload['time_grid_s']}: expected {NUM_TIMES} "
            f"times from 0 to {TIMES_S[-1]} s"
        )
    payload["import_flags"] = payload.pop("import")
    return Manifest(**payload)


class Dataset:
    """A finished dataset, opened with `open_dataset`; rows are numbered 0 .. n-1."""

    def __init__(self, files: _Files, manifest: Manifest) -> None:
        self.manifest = manifest
        self._files = files
        counts = [shard["count"] for shard in manifest.shards]
        self._starts = np.cumsum([0, *counts])
        self._open: dict[int, dict[str, ts.TensorStore]] = {}

    @property
    def hash(self) -> str:
        """Identity of the whole contents: the manifest's hash."""
        return self.manifest.hash

    @property
    def count(self) -> int:
        """Number of rows."""
        return self.manifest.count

    def _arrays(self, shard: int) -> dict[str, ts.TensorStore]:
        """The shard's arrays, opened once, of the shapes and dtypes promised."""
        if shard in self._open:
            return self._open[shard]
        key, count = _shard_key(shard), self.manifest.shards[shard]["count"]
        specs = {
            name: {
                "driver": "zarr3",
                "kvstore": (self._files.kv / f"{key}{name}/").spec().to_json(),
            }
            for name in _leaves()
        }
        futures = {
            name: ts.open(spec, open=True, context=_context())
            for name, spec in specs.items()
        }
        arrays = {}
        for name, leaf in _leaves().items():
            array = self._files.wait(futures[name], key + name)
            found = (array.dtype.numpy_dtype, array.shape)
            expected = (leaf.dtype, (count, *leaf.shape))
            if found != expected:
                raise InputError(
                    f"{self._files.path(key + name)}: shard {shard}: {found[0]} "
                    f"{found[1]}: expected {expected[0]} {expected[1]}"
                )
            arrays[name] = array
        self._open[shard] = arrays
        return arrays

    def verify(self) -> None:
        """Check every byte; InputError names the shard and the file at fault."""
        for number, shard in enumerate(self.manifest.shards):
            _verify_shard(self._files, number, shard["sha256"])
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
        splits = self.manifest.splits
        members = sorted(name for names in splits.values() for name in names)
        if members != sorted(self.manifest.groups):
            raise ValueError(f"splits: {splits}: expected every group exactly once")
        split = self._split_groups()
        check_disjoint(columns["group"], columns["vehicle"], split)

    def _split_groups(self) -> dict[str, list[int]]:
        number = {name: i for i, name in enumerate(self.manifest.groups)}
        splits = self.manifest.splits.items()
        return {split: [number[name] for name in names] for split, names in splits}

    def indices(self, split: str | None) -> np.ndarray:
        """[m] int64 row numbers of a split in ascending order; of all for None."""
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
        return self._read(np.arange(self.count), ("group",))["group"]

    def load(self, split: str | None) -> Demonstration:
        """All rows of a split (None: of all splits) in memory."""
        return self.read(self.indices(split))

    def read(self, indices: np.ndarray) -> Demonstration:
        """Rows by number, numpy leaves [m, ...], in the order asked for."""
        leaves = self._read(indices, tuple(_leaves()))
        return jax.tree.unflatten(jax.tree.structure(row_spec()), leaves.values())

    def _read(
        self, indices: np.ndarray, names: tuple[str, ...]
    ) -> dict[str, np.ndarray]:
        rows = np.asarray(indices, np.int64)
        if rows.ndim != 1 or np.any((rows < 0) | (rows >= self.count)):
            raise IndexError(f"rows: expected a list of numbers below {self.count}")
        spec = {name: _leaves()[name] for name in names}
        out = {k: np.empty((rows.size, *v.shape), v.dtype) for k, v in spec.items()}
        owner = np.searchsorted(self._starts, rows, side="right") - 1
        for shard in np.unique(owner).tolist():
            places = np.flatnonzero(owner == shard)
            local = rows[places] - self._starts[shard]
            arrays = self._arrays(shard)
            reads = {name: arrays[name][local].read() for name in names}
            for name, future in reads.items():
                key = f"{_shard_key(shard)}{name}"
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
    """
    files = _Files(url)
    raw = files.read(MANIFEST)
    if raw is None:
        shards = any(key.startswith(SHARDS) for key in files.list_keys())
        reason = (
            "the import was interrupted: run import again to resume"
            if shards
            else "no dataset here: expected a folder made by import_logs"
        )
        raise InputError(f"{files.path(MANIFEST)}: missing: {reason}")
    dataset = Dataset(files, _parse_manifest(raw, files))
    if verify:
        dataset.verify()
    return dataset
