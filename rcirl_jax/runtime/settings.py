"""Settings from TOML, JSON or msgpack: values checked against a dataclass's fields."""

import dataclasses
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from rcirl_jax.errors import InputError, did_you_mean
from rcirl_jax.runtime.checked import checked

MOST = 2**31  # numbers are nearer to 0 than this


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
      kind: the dataclass.
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
    """One value as a type; of a dataclass every name is known."""
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):
        return typed_settings(typing.cast(Any, kind), value, f"{where}.")
    made = checked(value, typing.cast(Any, kind), where)
    if not all(abs(number) < MOST for number in _numbers(made)):  # NaN is not below
        raise InputError(f"{where}: {value}: expected numbers between +-{MOST}")
    return made


def _numbers(made: object) -> Iterator[float]:
    """All numbers of a value."""
    if isinstance(made, int | float):
        yield made
    elif isinstance(made, tuple):
        for one in made:
            yield from _numbers(one)


def leaves(tree: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Nested settings as one level: {"a.b": x} of {"a": {"b": x}}."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            found |= leaves(value, f"{above}{name}.")
        else:
            found[above + name] = value
    return found
