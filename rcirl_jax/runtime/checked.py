"""Bodies of JSON and TOML as types: one line names the value that does not fit.

`checked` gives bodies of files as msgspec structs, `typed_fields` settings as the
fields of a dataclass.
"""

import contextlib
import dataclasses
import re
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import msgspec

from rcirl_jax.errors import InputError, did_you_mean

Kind = TypeVar("Kind")
# msgspec's words: on a field, and on anything else
FIELD = re.compile(
    r"Object (missing required|contains unknown) field `(.*?)`(?: - at `\$(.*)`)?",
    re.DOTALL,
)
VALUE = re.compile(r"(.*?)(?:, got .*?)?(?: - at (?:`key` in )?`\$(.*)`)?", re.DOTALL)
STEP = re.compile(r"\.(\w+)|\[(\d+)\]")  # of a place such as .shards[3].count
WORDS = {
    "array": "a list",
    "bool": "true or false",
    "float": "a number",
    "int": "a whole number",
    "null": "none",
    "object": "an object",
    "str": "a text",
}
MOST = 80  # characters of a value in a message
BOUND = 2**31  # settings' numbers are nearer to 0 than this


def checked(found: object, kind: type[Kind], where: object) -> Kind:
    """Converts a body to a type; only whole numbers become floats, lists tuples.

    Args:
      found: dicts, lists, texts, numbers, true or false, None.
      kind: a `msgspec.Struct`, whose fields may be `Annotated` with bounds; a list or
        dict of such.
      where: "FILE" or "FILE: field", stands before the message.

    Raises:
      InputError: something is missing, unknown to a kind that forbids it, of another
        type or out of bounds; names the field, the value and what was expected.
    """
    try:
        return msgspec.convert(found, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: {_said(found, kind, str(error))}") from error


def _said(found: Any, kind: Any, message: str) -> str:  # noqa: ANN401
    """FIELD: VALUE: EXPECTATION, of msgspec's "EXPECTATION - at `$.FIELD`"."""
    if field := FIELD.fullmatch(message):
        name = f"{field[3] or ''}.{field[2]}".lstrip(".")
        if field[1] == "missing required":
            return f"{name}: missing: expected a value"
        known = () if field[3] else msgspec.structs.fields(kind)
        names = ", ".join(one.encode_name for one in known)
        near = did_you_mean(field[2], [one.encode_name for one in known])
        return f"{name}: unknown: expected {names or 'no such field'}{near}"
    match = VALUE.fullmatch(message)
    words, place = (match[1], match[2] or "") if match else (message, "")
    with contextlib.suppress(LookupError, TypeError):
        for name, number in STEP.findall(place.partition("[...]")[0]):
            found = found[name] if name else found[int(number)]
    wanted = words.removeprefix("Expected ").replace(" | ", "` or `")
    if wanted == words:
        wanted = f"another value ({words.lower()})"
    wanted = re.sub(r"`(\w+)`", lambda part: WORDS.get(part[1], part[1]), wanted)
    value = f"{str(found)[:MOST]}: expected {wanted}"
    return f"{place.lstrip('.')}: {value}" if place else value


def typed_settings(kind: type[Kind], found: Mapping[str, Any], where: str = "") -> Kind:
    """Makes a dataclass of values that are checked as in `typed_fields`.

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
    """Converts values to the types of a dataclass's fields.

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
    """Checks that every name is known; `where` is as in `typed_fields`.

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
    if not all(abs(number) < BOUND for number in _numbers(made)):  # NaN is not below
        raise InputError(f"{where}: {value}: expected numbers between +-{BOUND}")
    return made


def _numbers(made: object) -> Iterator[float]:
    """All numbers of a value."""
    if isinstance(made, int | float):
        yield made
    elif isinstance(made, tuple):
        for one in made:
            yield from _numbers(one)


def leaves(tree: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Flattens nested settings: {"a.b": x} of {"a": {"b": x}}."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            found |= leaves(value, f"{above}{name}.")
        else:
            found[above + name] = value
    return found
