"""manifest.json and shard.json: sealed JSON that says what a dataset holds."""

import dataclasses
import hashlib
import json
import re
import types
from collections.abc import Callable, Mapping

import numpy as np

from rcirl_jax.data.store.files import MANIFEST, Files
from rcirl_jax.data.store.rows import leaf_specs
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.atomic_files import parse_json
from rcirl_jax.units import NUM_TIMES, TIMES_S

SCHEMA_VERSION = 2  # of manifest.json and shard.json
SHA256 = re.compile("[0-9a-f]{64}")
MAX_ROWS = 2**31  # rows of a dataset


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
        payload = parse_json(raw, finite=True)
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
    payload = unseal(raw, "sha256", name)
    _check_fields(name, payload, SHARD_FORMS)
    for file, found in payload["files"].items():
        if not file.isprintable():
            raise InputError(f"{name}: files: {file!a}: expected a printable key")
        parts = file.split("/")
        if not all(parts) or {".", ".."} & set(parts):
            raise InputError(f"{name}: files: {file}: expected a key below the shard")
        if not _is_described(found):
            raise InputError(
                f"{name}: files: {file}: {found}: expected its bytes and sha256"
            )
    for entry in payload["lineage"]:
        if not isinstance(entry.get("name"), str):
            raise InputError(f"{name}: lineage: {entry}: expected names of recordings")
    return ShardInfo(**payload)


def _check_fields(name: str, payload: Mapping, forms: Mapping[str, str]) -> None:
    """Exactly these fields, each of its form; InputError names one that is not."""
    different = sorted(set(payload) ^ set(forms))
    if different:
        raise InputError(f"{name}: {different[0]}: expected {(*forms,)}")
    for field, form in forms.items():
        if not FORMS[form](payload[field]):
            raise InputError(f"{name}: {field}: {payload[field]}: expected {form}")


def _is_count(value: object) -> bool:
    return type(value) is int and 0 <= value <= MAX_ROWS


def _is_described(value: object) -> bool:
    """Whether it says size and sha256 of a file."""
    if not isinstance(value, dict) or set(value) != {"bytes", "sha256"}:
        return False
    size, sha256 = value["bytes"], value["sha256"]
    is_sha256 = isinstance(sha256, str) and SHA256.fullmatch(sha256) is not None
    return type(size) is int and size >= 0 and is_sha256


def _all(value: object, kind: type | types.UnionType) -> bool:
    return isinstance(value, list) and all(isinstance(item, kind) for item in value)


def _is_splits(value: object) -> bool:
    return isinstance(value, dict) and all(_all(names, str) for names in value.values())


def _is_shard_list(value: object) -> bool:
    return isinstance(value, list) and all(
        isinstance(shard, dict)
        and _is_count(shard.get("count"))
        and isinstance(shard.get("sha256"), str)
        # datasets of the first version say nothing of recordings
        and isinstance(shard.get("recordings", {}), dict)
        for shard in value
    )


FORMS: dict[str, Callable[[object], bool]] = {
    "a number of rows": _is_count,
    "a whole number": _is_count,
    "a list of names": lambda value: _all(value, str),
    "a list of numbers": lambda value: _all(value, int | float),
    "a list of objects": lambda value: _all(value, dict),
    "a text": lambda value: isinstance(value, str),
    "an object": lambda value: isinstance(value, dict),
    "lists of names": _is_splits,
    "shards with count and sha256": _is_shard_list,
}
SHARD_FORMS = {
    "schema_version": "a whole number",
    "index": "a whole number",
    "count": "a number of rows",
    "lineage": "a list of objects",
    "files": "an object",
    "sha256": "a text",
}
MANIFEST_FORMS = {
    "schema_version": "a whole number",
    "count": "a number of rows",
    "arrays": "an object",
    "time_grid_s": "a list of numbers",
    "rate_hz": "a list of numbers",
    "sources": "a list of objects",
    "recordings": "a list of names",
    "groups": "a list of names",
    "vehicles": "a list of names",
    "splits": "lists of names",
    "shards": "shards with count and sha256",
    "quality": "an object",
    "import": "an object",
    "hash": "a text",
}


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
    _check_fields(name, payload, MANIFEST_FORMS)
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
    members = sorted(group for names in payload["splits"].values() for group in names)
    if members != sorted(payload["groups"]):
        raise InputError(
            f"{name}: splits: {payload['splits']}: expected every group exactly once"
        )
    payload["import_flags"] = payload.pop("import")
    return Manifest(**payload)


def check_count(manifest: Manifest, name: str) -> None:
    """The rows of a dataset are those of its shards; InputError if not."""
    total = sum(shard["count"] for shard in manifest.shards)
    if manifest.count != total:
        raise InputError(
            f"{name}: count: {manifest.count}: expected {total}, the sum of its shards"
        )
