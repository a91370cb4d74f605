"""Writer of `weights.msgpack`, the one file that a planner is handed.

    outer map: magic, schema_version, body (bytes), sha256 of the body
    body map:  features, normaliser, times, gamma, layers, ..., samples

The layout and the scoring equation are in docs/weights_format.md. The same input
gives the same bytes: keys have a fixed or sorted order, and nothing (no clock, no
host name) is added. Every file is read back by `reader` before it is handed out,
so a file that would be refused is never written.
"""

import base64
import dataclasses
import hashlib
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import msgpack
import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.export import reader
from rcirl_jax.runtime.atomic_files import write_whole

PROVENANCE_KEYS = (
    "dataset_sha256",  # text, hash of the data manifest
    "git_commit",  # text
    "seed",  # integer
    "flags",  # map, the flags of the training run
    "metrics",  # map, name -> number
    "versions",  # map, package -> version
    "created",  # text, ISO 8601
)


def pack(
    weights: reader.Reward,
    samples_x: np.ndarray,
    samples_valid: np.ndarray,
    samples_value: np.ndarray,
) -> bytes:
    """Return the bytes of the file, checked by reading them back.

    Args:
      weights: effective weights, any scale pinning already applied. Arrays are
        anything numpy can turn into float32; `file` and `sha256` do not count.
      samples_x: [m, T, F] raw features of the verification samples (before the
        clip and the normaliser, so that a reader checks those too), m <= 256.
      samples_valid: [m, T] bool.
      samples_value: [m] V as the trainer computes it, in full float32.

    Returns:
      The same bytes for the same input.

    Raises:
      InputError: a reader would refuse the file, or the samples' values are not
        those of the weights.
    """
    samples = (samples_x, samples_valid, samples_value)
    return _pack_checked("weights", weights, samples)[0]


def save(
    path: str | os.PathLike[str],
    weights: reader.Reward,
    samples_x: np.ndarray,
    samples_valid: np.ndarray,
    samples_value: np.ndarray,
) -> reader.Reward:
    """Write the file, whole (`write_whole`). Arguments as `pack`.

    Returns:
      The reward as a reader of the file sees it, with the hash that names it.
    """
    target = Path(path)
    samples = (samples_x, samples_valid, samples_value)
    data, reward = _pack_checked(str(target), weights, samples)
    try:
        write_whole(target, data)
    except OSError as error:
        message = f"{target}: path: {error.strerror}: expected a writable file"
        raise InputError(message) from error
    return reward


def save_with_dial(
    source: str | os.PathLike[str], dial: float, target: str | os.PathLike[str]
) -> reader.Reward:
    """Write a weights file again, with the gains on top of its own cost multiplied.

    Args:
      source: weights file with a prior cost.
      dial: > 0, by which the gain is multiplied.
      target: file to write.

    Returns:
      The reward as a reader of the new file sees it; its provenance names the old one.

    Raises:
      InputError: no such weights file, one without a prior cost, or another dial.
    """
    try:
        reward = reader.load_weights(source)
    except reader.WeightsError as error:
        raise InputError(str(error)) from error
    prior = reward.prior_cost
    if prior is None:
        raise InputError(
            f"{source}: prior_cost: none: expected weights on top of an own cost, "
            "whose gain is multiplied"
        )
    if not 0.0 < dial < math.inf:
        raise InputError(
            f"dial: {dial:g}: expected above 0; at 0 the own cost drives alone"
        )
    body = msgpack.unpackb(msgpack.unpackb(Path(source).read_bytes())["body"])
    samples = [
        np.frombuffer(body["samples"][name]["data"], "<f4").reshape(
            body["samples"][name]["shape"]
        )
        for name in ("features", "valid", "value")
    ]
    turned = dataclasses.replace(prior, gain=dial * prior.gain)
    facts = {**reward.provenance, "dial": {"of_sha256": reward.sha256, "times": dial}}
    made = dataclasses.replace(reward, prior_cost=turned, provenance=facts)
    return save(target, made, *samples)


def to_json(data: bytes) -> dict[str, Any]:
    """Return the body as JSON types, as data_specs/reward_weights.schema.json says.

    An array keeps its map {shape, dtype, data}; `data` turns from bytes into
    base64 text, so nothing is lost.

    Args:
      data: bytes of a file.

    Raises:
      WeightsError: a reader would refuse the file.
    """
    reader.decode_weights(data)
    return _json(msgpack.unpackb(msgpack.unpackb(data)["body"]))


def _json(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        return {key: _json(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_json(item) for item in value]
    return base64.b64encode(value).decode() if isinstance(value, bytes) else value


def _pack_checked(
    file: str, weights: reader.Reward, samples: tuple[np.ndarray, ...]
) -> tuple[bytes, reader.Reward]:
    try:
        body = _dump(_body(weights, samples))
        outer = {
            "magic": reader.MAGIC,
            "schema_version": reader.SCHEMA_VERSION,
            "body": body,
            "sha256": hashlib.sha256(body).hexdigest(),
        }
        data = _dump(outer)
    except (OverflowError, RecursionError, TypeError, ValueError) as error:
        # msgpack itself refuses integers over 64 bits and lone surrogates.
        raise InputError(f"{file}: {error}") from error
    try:
        return data, reader.decode_weights(data, file)
    except reader.WeightsError as error:
        raise InputError(str(error)) from error


def _dump(value: dict[str, Any]) -> bytes:
    return cast("bytes", msgpack.packb(value, use_bin_type=True))


def _body(weights: reader.Reward, samples: tuple[np.ndarray, ...]) -> dict[str, Any]:
    """Return the body map, as `reader.BODY` describes it."""
    if len(weights.kernels) != len(weights.biases):
        found = f"{len(weights.biases)} biases"
        raise ValueError(f"biases: {found}: expected one for each kernel")
    for key in PROVENANCE_KEYS:
        if key not in weights.provenance:
            raise ValueError(f"provenance.{key}: missing: expected a value or None")
    columns = zip(weights.names, weights.units, weights.none_values, strict=True)
    layers = zip(weights.kernels, weights.biases, strict=True)
    prior = weights.prior_cost
    row = lambda kind, values: dict(zip(kind[0], values, strict=True))  # noqa: E731
    body = {
        **vars(weights),
        "features": [row(reader.BODY["features"], column) for column in columns],
        "normaliser": vars(weights),
        "layers": [row(reader.BODY["layers"], layer) for layer in layers],
        "prior_cost": None if prior is None else vars(prior),
        "samples": row([reader.BODY["samples"]], samples),
    }
    return _encoded("", body, reader.BODY)


def _encoded(field: str, value: Any, kind: Any) -> Any:  # noqa: ANN401
    """Return what the file holds of a value, by its kind in `reader.BODY`."""
    if isinstance(kind, tuple):
        return None if value is None else _encoded(field, value, kind[0])
    if isinstance(kind, list):
        rows = enumerate(value)
        return [_encoded(f"{field}[{n}]", row, kind[0]) for n, row in rows]
    if isinstance(kind, dict):
        at = f"{field}." if field else ""
        return {key: _encoded(f"{at}{key}", value[key], kind[key]) for key in kind}
    if kind in ("text", "number", "plain"):
        return _plain(value)
    return _array(field, value)


def _array(field: str, value: np.ndarray) -> dict[str, Any]:
    """{shape, dtype, data}: float32, little endian; `tobytes` gives C order."""
    try:
        with np.errstate(over="ignore"):  # to inf, which the reader refuses by place
            array = np.asarray(value, "<f4")
    except (TypeError, ValueError) as error:
        raise ValueError(f"{field}: {error}: expected an array of numbers") from error
    return {"shape": list(array.shape), "dtype": "<f4", "data": array.tobytes()}


def _plain(value: Any) -> Any:  # noqa: ANN401
    """Sort the keys of maps; turn numpy scalars into Python numbers."""
    if isinstance(value, Mapping):
        return {key: _plain(value[key]) for key in sorted(value)}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value
