"""manifest.json and shard.json: sealed JSON that says what a dataset holds."""

import hashlib
import json
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
import numpy as np

from rcirl_jax.data.store.files import MANIFEST, Files
from rcirl_jax.data.store.rows import leaf_specs
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import parse_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.units import NUM_TIMES, TIMES_S

SCHEMA_VERSION = 2  # of manifest.json and shard.json
SHA256 = r"\A[0-9a-f]{64}\Z"
MAX_ROWS = 2**31  # rows of a dataset
Rows = Annotated[int, msgspec.Meta(ge=0, le=MAX_ROWS)]


class ShardInfo(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A committed shard, as its shard.json says."""

    schema_version: int
    index: Rows
    count: Rows
    lineage: list[dict]  # recordings in it, as the import described them
    files: dict[str, Any]  # key below the shard -> {"bytes", "sha256"}
    sha256: str  # over the fields above


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
    shards: list[dict]  # `shard_entry` by shard number
    quality: dict  # data-quality report
    import_flags: dict
    hash: str  # sha256 over the canonical manifest without this field


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """An entry of `ShardInfo.files`."""

    bytes: Annotated[int, msgspec.Meta(ge=0)]
    sha256: Annotated[str, msgspec.Meta(pattern=SHA256)]


class _Recordings(msgspec.Struct):
    """An entry of `ShardInfo.lineage`."""

    name: str


class _Shard(msgspec.Struct):
    """An entry of `Manifest.shards`."""

    count: Rows
    sha256: str
    recordings: dict = {}  # datasets of the first version do not say


def _canonical(payload: Mapping) -> str:
    return hashlib.sha256(
        json.dumps(
            payload, sort_keys=True, separators=(",", ":"), allow_nan=False
        ).encode()
    ).hexdigest()


def seal(payload: Mapping, field: str) -> bytes:
    """JSON bytes of the payload with its own digest as one more field."""
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


def shard_entry(info: ShardInfo) -> dict:
    """What the manifest says of a shard: its digest, and what it was made of.

    "recordings" maps their names to the sha256 of what was cut into scenes and of
    how (`cut.Cut.sha256`); null where nothing was recorded, as of planned drives.
    """
    made_of = {entry["name"]: entry.get("sha256") for entry in info.lineage}
    return {"count": info.count, "sha256": info.sha256, "recordings": made_of}


def parse_shard(raw: bytes, name: str) -> ShardInfo:
    """What shard.json says, from its bytes, or InputError for what does not fit."""
    info = checked(unseal(raw, "sha256", name), ShardInfo, name)
    for file, found in info.files.items():
        if not file.isprintable():
            raise InputError(f"{name}: files: {file!a}: expected a printable key")
        parts = file.split("/")
        if not all(parts) or {".", ".."} & set(parts):
            raise InputError(f"{name}: files: {file}: expected a key below the shard")
        checked(found, _File, f"{name}: files: {file}")
    checked(info.lineage, list[_Recordings], f"{name}: lineage")
    return info


def array_table() -> dict[str, dict]:
    """Shape and dtype of every array, as the manifest states them."""
    return {
        name: {"shape": list(leaf.shape), "dtype": np.dtype(leaf.dtype).name}
        for name, leaf in leaf_specs().items()
    }


def parse_manifest(raw: bytes, files: Files) -> Manifest:
    """The manifest from its bytes, or InputError for what does not fit."""
    name = files.path(MANIFEST)
    manifest = checked(unseal(raw, "hash", name), Manifest, name)
    checked(manifest.shards, list[_Shard], f"{name}: shards")
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
    return manifest


def check_count(manifest: Manifest, name: str) -> None:
    """The rows of a dataset are those of its shards; InputError if not."""
    total = sum(shard["count"] for shard in manifest.shards)
    if manifest.count != total:
        raise InputError(
            f"{name}: count: {manifest.count}: expected {total}, the sum of its shards"
        )
