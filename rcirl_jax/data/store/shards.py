"""One shard: its arrays as zarr3 bytes, and its verification."""

import hashlib
from collections.abc import Mapping

import numpy as np
import tensorstore as ts

from rcirl_jax.data.store.files import MARK, SHARDS, Files
from rcirl_jax.data.store.manifest import ShardInfo, parse_shard
from rcirl_jax.data.store.rows import leaf_specs
from rcirl_jax.errors import InputError

BLOCK_ROWS = 256  # rows of a separately compressed block: ~2.5 MB of scenes, unpacked
ZSTD_LEVEL = 3  # zstd's own default


def shard_key(index: int) -> str:
    """Prefix of all keys of a shard."""
    return f"{SHARDS}{index:05d}/"


def layout(shape: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Shapes of an array's blocks of rows, and of the storage chunk they fill."""
    rows = min(max(shape[0], 1), BLOCK_ROWS)
    return (rows, *shape[1:]), (-(-shape[0] // rows) * rows, *shape[1:])


def _metadata(shape: tuple[int, ...], dtype: np.dtype) -> dict:
    """zarr3 metadata: one storage chunk per array, cut into blocks of rows."""
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


def describe(data: bytes) -> dict:
    """Size and sha256 of a file."""
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def shard_info(files: Files, index: int, sha256: str | None = None) -> ShardInfo:
    """What shard.json says; InputError if it is not there, or not as written."""
    name = files.path(shard_key(index) + MARK)
    mark = files.read_json(shard_key(index) + MARK)
    if mark is None:
        raise InputError(f"{name}: shard {index}: missing: expected sha256 {sha256}")
    info = parse_shard(mark, name)
    if sha256 is not None and info.sha256 != sha256:
        raise InputError(
            f"{name}: shard {index}: sha256 {info.sha256}: expected {sha256}"
        )
    return info


def verify_shard(files: Files, index: int, sha256: str | None = None) -> ShardInfo:
    """Read all of a shard against its checksums; InputError names what is wrong."""
    key = shard_key(index)
    info = shard_info(files, index, sha256)
    _check_files(files.path(key + MARK), info)
    stated = {key + name: found for name, found in info.files.items()}
    sizes = {name: found["bytes"] for name, found in stated.items()}
    for name, size, found in files.digests(sizes):
        expected = stated[name]
        if {"bytes": size, "sha256": found} != expected:
            sha256 = found or ("not taken" if size else "missing")
            raise InputError(
                f"{files.path(name)}: shard {index}: {size} bytes, sha256 "
                f"{sha256}: expected {expected['bytes']} bytes, sha256 "
                f"{expected['sha256']}; import the logs again"
            )
    return info


def _check_files(name: str, info: ShardInfo) -> None:
    """Every array has its two files, one large enough to say where its blocks are.

    Of rows without a file zarr makes zeros; so a few bytes cannot claim many rows.
    """
    least = {}
    index_bytes = 16 * -(-info.count // BLOCK_ROWS) + 4  # two offsets a block, crc32c
    for leaf, spec in leaf_specs().items():
        least[f"{leaf}/zarr.json"] = 1
        least["/".join([leaf, "c", *"0" * (1 + len(spec.shape))])] = index_bytes
    different = sorted(least.keys() ^ info.files.keys())
    if different:
        raise InputError(f"{name}: files: {different[0]}: expected two of every array")
    for file, size in least.items():
        found = info.files[file]["bytes"]
        if found < size:
            raise InputError(
                f"{name}: files: {file}: {found} bytes: expected {size} at least "
                f"for {info.count} rows"
            )
