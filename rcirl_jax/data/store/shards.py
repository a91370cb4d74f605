"""One shard: its arrays as zarr3 bytes, what shard.json says, and its verification."""

import hashlib
from collections.abc import Mapping

import numpy as np
import tensorstore as ts

from rcirl_jax.data.store.files import MARK, SHARDS, Files
from rcirl_jax.data.store.manifest import FileEntry, ShardInfo, unseal
from rcirl_jax.data.store.rows import leaf_specs
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.checked import checked

BLOCK_ROWS = 256  # rows of a separately compressed block: ~2.5 MB of scenes, unpacked
ZSTD_LEVEL = 3  # zstd's own default


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
