"""manifest.json and shard.json: sealed JSON that says what a dataset holds."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping

import numpy as np

from rcirl_jax.data.files import MANIFEST, Files
from rcirl_jax.data.rows import leaf_specs
from rcirl_jax.errors import InputError
from rcirl_jax.units import NUM_TIMES, TIMES_S

SCHEMA_VERSION = 1  # of manifest.json and shard.json


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
    shards: list[dict]  # `shard_entry` by shard number
    quality: dict  # data-quality report
    import_flags: dict
    hash: str  # sha256 over the canonical manifest without this field


_MANIFEST_KEYS = tuple(
    "import" if field.name == "import_flags" else field.name
    for field in dataclasses.fields(Manifest)
)


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


def _refuse_constant(text: str) -> None:
    raise ValueError(f"{text} is no JSON number")


def unseal(raw: bytes, field: str, name: str) -> dict:
    """Parse `seal`'s bytes; InputError when they are not as written."""
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


def shard_entry(info: ShardInfo) -> dict:
    """What the manifest says of a shard: its digest, and what it was made of.

    "recordings" maps their names to the sha256 of what was cut into scenes and of
    how (`cut.Cut.sha256`); null where nothing was recorded, as of planned drives.
    """
    made_of = {entry["name"]: entry.get("sha256") for entry in info.lineage}
    return {"count": info.count, "sha256": info.sha256, "recordings": made_of}


def array_table() -> dict[str, dict]:
    """Shape and dtype of every array, as the manifest states them."""
    return {
        name: {"shape": list(leaf.shape), "dtype": np.dtype(leaf.dtype).name}
        for name, leaf in leaf_specs().items()
    }


def parse_manifest(raw: bytes, files: Files) -> Manifest:
    """The manifest from its bytes, or InputError for what does not fit."""
    name = files.path(MANIFEST)
    payload = unseal(raw, "hash", name)
    if set(payload) != set(_MANIFEST_KEYS):
        different = sorted(set(payload) ^ set(_MANIFEST_KEYS))
        raise InputError(f"{name}: {different[0]}: expected {_MANIFEST_KEYS}")
    ours = array_table()
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
