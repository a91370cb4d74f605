"""What JSON and TOML hold, as types: one line says which value does not fit."""

import contextlib
import re
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


def checked(found: object, kind: type[Kind], where: object) -> Kind:
    """A body as a type; only whole numbers become floats, and lists tuples.

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
