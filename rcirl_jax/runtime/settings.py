"""Settings from TOML, JSON or msgpack: values checked against a dataclass's fields."""

import dataclasses
import types
import typing
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from rcirl_jax.errors import InputError, did_you_mean

MOST = 2**31  # numbers are nearer to 0 than this
# how types are called in a message
NAMES = {str: "a text", bool: "true or false"}


def typed_settings(kind: type, found: Mapping[str, Any], where: str = "") -> Any:  # noqa: ANN401
    """A dataclass made of its fields, which are checked as in `typed_fields`.

    Raises:
      InputError: as `typed_fields`.
      ValueError, TypeError: the dataclass refuses its fields, or lacks one.
    """
    return kind(**typed_fields(kind, found, where))


def typed_fields(
    kind: type,
    found: Mapping[str, Any],
    where: str,
    without: Collection[str] = (),
) -> dict[str, Any]:
    """Values as the types of a dataclass's fields: lists as tuples, int as float.

    Args:
      kind: the dataclass; its fields are bool, int, float, str, tuples, dataclasses,
        or one of them or None.
      found: values by the names of fields.
      where: stands before the name in a message, with what parts the two.
      without: fields that may not be given.

    Raises:
      InputError: an unknown name (with the nearest known one); a value of another
        type, not finite, or not within 32 bits.
    """
    hints = typing.get_type_hints(kind)
    known = [f.name for f in dataclasses.fields(kind) if f.name not in without]
    check_names(where, found, known)
    return {n: _value(hints[n], v, f"{where}{n}") for n, v in found.items()}


def check_names(where: str, found: Mapping[str, Any], known: Sequence[str]) -> None:
    """Check that every name is known; `where` is as in `typed_fields`.

    Raises:
      InputError: one is not (with the nearest known one).
    """
    for name in found:
        if name not in known:
            raise InputError(
                f"{where}{name}: unknown: expected some of {', '.join(known)}"
                + did_you_mean(str(name), known)
            )


def _value(kind: Any, value: Any, where: str) -> Any:  # noqa: ANN401
    """One value as a type.

    Raises:
      InputError: it is of another type.
    """
    if typing.get_origin(kind) in {types.UnionType, typing.Union}:
        kinds = typing.get_args(kind)
        if value is None and type(None) in kinds:
            return None
        return _value(next(k for k in kinds if k is not type(None)), value, where)
    parts = typing.get_args(kind)
    if parts and isinstance(value, list):
        kinds = parts[:1] * len(value) if parts[-1] is ... else parts
        if len(kinds) == len(value):
            pairs = enumerate(zip(kinds, value, strict=True))
            return tuple(_value(k, v, f"{where}[{i}]") for i, (k, v) in pairs)
    elif dataclasses.is_dataclass(kind) and isinstance(value, dict):
        return typed_settings(typing.cast(type, kind), value, f"{where}.")
    elif type(value) is kind and kind in NAMES:
        return value
    elif kind in {int, float} and type(value) in {int, kind} and abs(value) < MOST:
        return float(value) if kind is float else value  # NaN is not below
    length = f"a list of {len(parts)}" if parts and parts[-1] is not ... else "a list"
    name = length if parts else NAMES.get(kind, getattr(kind, "__name__", str(kind)))
    raise InputError(f"{where}: {value!r}: expected {name}")
