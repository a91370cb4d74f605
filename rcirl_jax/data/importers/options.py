"""Options of a source TOML, checked where an importer takes them."""

import math
from collections.abc import Mapping, Sequence

from rcirl_jax.data.importers.tables import number
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind

KINDS = ("vehicle", "cyclist", "pedestrian", "static")


def section(spec: Mapping, key: str) -> dict:
    """A [table] of the source TOML; empty if it has none."""
    value = spec.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"source TOML: {key}: {value}: expected a table [{key}]")
    return value


def positive(spec: Mapping, key: str, default: float) -> float:
    """A number > 0 from a source TOML."""
    value = number(spec, key, default)
    if value <= 0.0:
        raise InputError(f"source TOML: {key}: {value:g}: expected > 0")
    return value


def recording_car(spec: Mapping) -> tuple[tuple[float, float], ...]:
    """`Track.automated` of the car that recorded, by the option `recording_car`."""
    spans = {"human": (), "automated": ((-math.inf, math.inf),)}
    driver = spec.get("recording_car", "automated")
    if driver not in spans:
        raise InputError(
            f"source TOML: recording_car: {driver}: expected one of {', '.join(spans)}"
        )
    return spans[driver]


def choices(
    spec: Mapping, key: str, allowed: Sequence[str], default: Sequence[str]
) -> tuple[str, ...]:
    """A list of names, each one of those allowed."""
    value = spec.get(key, default)
    for name in value if isinstance(value, list | tuple) else [value]:
        if name not in allowed:
            raise InputError(
                f"source TOML: {key}: {name}: expected a list of {', '.join(allowed)}"
            )
    return tuple(value)


def patterns(spec: Mapping, default: Sequence[str]) -> tuple[str, ...]:
    """The option `pattern`: one file name pattern or a list of them."""
    value = spec.get("pattern", list(default))
    found = [value] if isinstance(value, str) else value
    if not isinstance(found, list) or not all(
        isinstance(item, str) and item and not item.startswith("/") for item in found
    ):
        raise InputError(
            f"source TOML: pattern: {value}: expected file names such as {default[0]}"
        )
    return tuple(found)


def kind_of(where: str, field: str, found: str, kinds: Mapping[str, str]) -> Kind:
    """Kind of a road user by its type in the file and [kinds] of the TOML."""
    kind = kinds.get(found)
    if found not in kinds:
        raise InputError(
            f"{where}: {field}: {found}: expected one of {', '.join(kinds) or 'none'} "
            "([kinds] of the source TOML)"
        )
    if kind not in KINDS:
        raise InputError(
            f"source TOML: kinds.{found}: {kind}: expected one of {', '.join(KINDS)}"
        )
    return Kind[kind.upper()]
