"""manifest.json and shard.json: sealed JSON that says what a dataset holds."""

import hashlib
import json
from collections.abc import Mapping
from typing import Annotated, Any, TypedDict

import msgspec
import numpy as np

from rcirl_jax.data.store.files import MANIFEST, Files
from rcirl_jax.data.store.rows import leaf_specs
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import parse_json
from rcirl_jax.runtime.checked import checked
from rcirl_jax.units import NUM_TIMES, TIMES_S

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
