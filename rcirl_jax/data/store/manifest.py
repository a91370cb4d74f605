"""What a dataset holds: manifest.json and shard.json, sealed; and one shard.

A shard is its arrays as zarr3 bytes, and shard.json with their checksums.
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Annotated, Any, TypedDict

import msgspec
import numpy as np
import tensorstore as ts

from rcirl_jax.data.store.files import MANIFEST, MARK, SHARDS, Files
from rcirl_jax.data.store.rows import leaf_specs
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import parse_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.units import NUM_TIMES, TIMES_S

BLOCK_ROWS = 256  # rows of a separately compressed block: ~2.5 MB of scenes, unpacked
ZSTD_LEVEL = 3  # zstd's own default
SCHEMA_VERSION = 2  # of manifest.json and shard.json
MAX_ROWS = 2**31  # rows of a dataset
Rows = Annotated[int, msgspec.Meta(ge=0, le=MAX_ROWS)]
Sha256 = Annotated[str, msgspec.Meta(pattern=r"\A[0-9a-f]{64}\Z")]


class FileEntry(TypedDict):
    """A file of a shard."""

    bytes: Annotated[int, msgspec.Meta(ge=0)]
    sha256: Sha256


class ShardInfo(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A committed shard, as its shard.json says."""

    schema_version: int
    index: Rows
    count: Rows
    lineage: list[dict]  # recordings in it, as the import described them
    files: dict[str, FileEntry]  # by key below the shard
    sha256: str  # over the fields above


class ShardEntry(TypedDict):
    """A shard in the manifest: its digest, and what it was made of.

    "recordings" maps their names to the sha256 of what was cut into scenes and of how
    (`importing.RecordingScenes.sha256`); null where nothing was recorded, as of planned
    drives.
    """

    count: Rows
    sha256: str
    recordings: dict[str, str | None]


class Manifest(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    rename={"import_flags": "import"},
):
    """What manifest.json says; "import" is called `import_flags` here."""

    schema_version: int
    count: Rows  # of all shards
    arrays: dict[str, Any]  # leaf -> {"shape", "dtype"} of one row
    time_grid_s: list[float]  # s, `TIMES_S`
    rate_hz: list[float]  # Hz, sampling rates of the recordings
    sources: list[dict]  # {"source", "licence"} of the data
    recordings: list[str]  # names by number, as are the next two
    groups: list[str]
    vehicles: list[str]
    splits: dict[str, list[str]]  # group names per split
    shards: list[ShardEntry]  # by number
    quality: dict  # data-quality report
    import_flags: dict
    hash: str  # sha256 over the canonical manifest without this field


def _canonical(payload: Mapping) -> str:
    return hashlib.sha256(
        json.dumps(
            payload, sort_keys=True, separators=(",", ":"), allow_nan=False
        ).encode()
    ).hexdigest()


def seal(payload: Mapping, field: str) -> bytes:
    """Return JSON bytes of the payload with its own digest as one more field."""
    whole = {**payload, field: _canonical(payload)}
    return (json.dumps(whole, sort_keys=True, indent=1) + "\n").encode()


def unseal(raw: bytes, field: str, name: str) -> dict:
    """Parse `seal`'s bytes; InputError when they are not as written."""
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
    stated = payload.get(field)
    sha = _canonical({k: v for k, v in payload.items() if k != field})
    if sha != stated:
        raise InputError(f"{name}: {field}: contents {sha}: expected {stated}; damaged")
    return payload


def array_table() -> dict[str, dict]:
    """Return shape and dtype of every array, as the manifest states them."""
    return {
        name: {"shape": list(leaf.shape), "dtype": np.dtype(leaf.dtype).name}
        for name, leaf in leaf_specs().items()
    }


def parse_manifest(raw: bytes, files: Files) -> Manifest:
    """Return the manifest from its bytes.

    Raises:
      InputError: something does not fit; names the field.
    """
    name = files.path(MANIFEST)
    manifest = checked(unseal(raw, "hash", name), Manifest, name)
    ours = array_table()
    for leaf in sorted(ours.keys() | manifest.arrays.keys()):
        found, expected = manifest.arrays.get(leaf), ours.get(leaf)
        if found != expected:
            raise InputError(f"{name}: arrays: {leaf}: {found}: expected {expected}")
    if manifest.time_grid_s != TIMES_S.tolist():
        raise InputError(
            f"{name}: time_grid_s: {manifest.time_grid_s}: expected {NUM_TIMES} "
            f"times from 0 to {TIMES_S[-1]} s"
        )
    members = sorted(group for names in manifest.splits.values() for group in names)
    if members != sorted(manifest.groups):
        raise InputError(
            f"{name}: splits: {manifest.splits}: expected every group exactly once"
        )
    total = sum(shard["count"] for shard in manifest.shards)
    if manifest.count != total:
        raise InputError(
            f"{name}: count: {manifest.count}: expected {total}, the sum of its shards"
        )
    return manifest


# ---------------------------------------------------------------------- shards


def shard_key(index: int) -> str:
    """Return the prefix of all keys of a shard."""
    return f"{SHARDS}{index:05d}/"


def layout(shape: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the shapes of an array's blocks of rows, and of the chunk they fill."""
    rows = min(max(shape[0], 1), BLOCK_ROWS)
    return (rows, *shape[1:]), (-(-shape[0] // rows) * rows, *shape[1:])


def _metadata(shape: tuple[int, ...], dtype: np.dtype) -> dict:
    """Return zarr3 metadata: one storage chunk per array, cut into blocks of rows."""
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


def encode(leaves: Mapping[str, np.ndarray]) -> dict[str, bytes]:
    """Return a shard's zarr3 files by key, made in memory and hashed as written."""
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


def describe(data: bytes) -> FileEntry:
    """Return size and sha256 of a file."""
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def shard_info(files: Files, index: int, sha256: str | None = None) -> ShardInfo:
    """Read shard.json.

    Args:
      files: of the dataset.
      index: number of the shard.
      sha256: that the manifest states, if there is one.

    Raises:
      InputError: it is not there, or not as written.
    """
    key = shard_key(index) + MARK
    name, raw = files.path(key), files.read_json(key)
    if raw is None:
        raise InputError(f"{name}: shard {index}: missing: expected sha256 {sha256}")
    info = checked(unseal(raw, "sha256", name), ShardInfo, name)
    if sha256 is not None and info.sha256 != sha256:
        raise InputError(
            f"{name}: shard {index}: sha256 {info.sha256}: expected {sha256}"
        )
    # every array has two files, one large enough to say where its blocks are: of rows
    # without a file zarr makes zeros, so a few bytes cannot claim many rows
    index_bytes = 16 * -(-info.count // BLOCK_ROWS) + 4  # two offsets a block, crc32c
    least = {}
    for leaf, spec in leaf_specs().items():
        least[f"{leaf}/zarr.json"] = 1
        least["/".join([leaf, "c", *"0" * (1 + len(spec.shape))])] = index_bytes
    for file in sorted(least.keys() ^ info.files.keys()):
        raise InputError(f"{name}: files: {file!a}: expected two of every array")
    for file, size in least.items():
        if info.files[file]["bytes"] < size:
            raise InputError(
                f"{name}: files: {file}: {info.files[file]['bytes']} bytes: expected "
                f"{size} at least for {info.count} rows"
            )
    return info


def verify_shard(files: Files, index: int, sha256: str | None = None) -> ShardInfo:
    """Read all of a shard against its checksums; arguments as `shard_info`.

    Raises:
      InputError: names the shard and the file at fault.
    """
    info = shard_info(files, index, sha256)
    stated = {shard_key(index) + file: found for file, found in info.files.items()}
    values = files.read({file: found["bytes"] for file, found in stated.items()})
    for file, value in values.items():
        expected = stated[file]
        found = {"bytes": 0, "sha256": "missing"} if value is None else describe(value)
        if found != expected:
            raise InputError(
                f"{files.path(file)}: shard {index}: {found['bytes']} bytes, sha256 "
                f"{found['sha256']}: expected {expected['bytes']} bytes, sha256 "
                f"{expected['sha256']}; import the logs again"
            )
    return info
