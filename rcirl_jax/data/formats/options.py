"""Options of a source TOML, checked where an importer takes them."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePosixPath

from rcirl_jax.data.formats.format import Format
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.checked import check_names
from rcirl_jax.types import Kind
from rcirl_jax.units import FOOT_M, MPH_MPS

LARGEST = 10**18  # of an integer
# added to a spec: names of the options that the user's own TOML has
USER_KEYS = "stated"
MAX_NAME = 255  # bytes of a file's name
MAX_PATH = 2048  # bytes of a path; systems take 4096, with the folder before it
MAX_PARTS = 32  # of a pattern, which pathlib matches by recursion
UNITS = {
    **{"m": 1.0, "ft": FOOT_M, "km": 1e3, "cm": 1e-2, "mm": 1e-3},
    **{"m/s": 1.0, "ft/s": FOOT_M, "km/h": 1.0 / 3.6, "mph": MPH_MPS},
    **{"kn": 1852.0 / 3600.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    **{"min": 60.0, "h": 3600.0, "day": 86400.0, "rad": 1.0, "deg": math.pi / 180.0},
}  # unit -> its factor to SI
KINDS = ("vehicle", "cyclist", "pedestrian", "static")
TYPES = {
    **{bool: "true or false", str: "a text", list: "a list", dict: "a table"},
    **dict.fromkeys((int, float), "a number"),
}  # of a TOML's values, in words


def number(spec: Mapping, key: str, default: float = math.nan) -> float:
    """Returns a finite number from a source TOML."""
    value = spec.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"source TOML: {key}: {value}: expected a number")
    if not math.isfinite(value):
        raise InputError(f"source TOML: {key}: {value}: expected a finite number")
    return float(value)


def stated(spec: Mapping, key: str) -> float | None:
    """Returns a number > 0 that the user's own TOML states; None where it is a default.

    What a user's TOML says of a site counts as known, a packaged TOML's as a guess.
    """
    return positive(spec, key) if key in spec.get(USER_KEYS, ()) else None


def one_of(spec: Mapping, key: str, allowed: Iterable[str], default: str = "") -> str:
    """Returns an option that is one of some texts."""
    value, names = spec.get(key, default), [*allowed]
    if value not in names:
        raise InputError(
            f"source TOML: {key}: {value}: expected one of {', '.join(names)}"
        )
    return value


def section(spec: Mapping, key: str) -> dict:
    """Returns a [table] of the source TOML; empty if it has none."""
    value = spec.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"source TOML: {key}: {value}: expected a table [{key}]")
    return value


def positive(spec: Mapping, key: str, default: float = math.nan) -> float:
    """Returns a number > 0 from a source TOML."""
    value = number(spec, key, default)
    if value <= 0.0:
        raise InputError(f"source TOML: {key}: {value:g}: expected > 0")
    return value


def recording_car(spec: Mapping) -> tuple[tuple[float, float], ...]:
    """Returns `Track.automated` of the recording car (option `recording_car`)."""
    spans = {"human": (), "automated": ((-math.inf, math.inf),)}
    return spans[one_of(spec, "recording_car", spans, "human")]


def lane_types(
    spec: Mapping, allowed: Sequence[str], default: Sequence[str]
) -> tuple[str, ...]:
    """Returns the option `lane_types`: a list of names, each one of those allowed."""
    value = spec.get("lane_types", default)
    for name in value if isinstance(value, list | tuple) else [value]:
        if name not in allowed:
            raise InputError(
                f"source TOML: lane_types: {name}: expected a list of "
                + ", ".join(allowed)
            )
    return tuple(value)


def patterns(spec: Mapping, default: Sequence[str] = ()) -> tuple[str, ...]:
    """Returns the option `pattern`: one file name pattern or a list of them."""
    value = spec.get("pattern", list(default))
    found = [value] if isinstance(value, str) else value
    if not isinstance(found, list) or not found or not all(map(_is_pattern, found)):
        raise InputError(
            f"source TOML: pattern: {value}: expected file names such as *.csv"
        )
    return tuple(found)


def one_pattern(spec: Mapping) -> str:
    """Returns the option `pattern` of a format that has one only."""
    found = patterns(spec)
    if len(found) != 1:
        raise InputError(f"source TOML: pattern: {list(found)}: expected one")
    return found[0]


def is_file_name(text: str) -> bool:
    """True if it names one file in a folder, and could."""
    return text not in ("", ".", "..") and "/" not in text and _is_name(text)


def _is_name(text: str) -> bool:
    return "\0" not in text and len(text.encode(errors="replace")) <= MAX_NAME


def _is_pattern(item: object) -> bool:
    """True if pathlib takes it, and it stays inside the input.

    Each `**` walks all folders below those of the one before it, so it stands once.
    """
    if not isinstance(item, str) or item.startswith("/"):
        return False
    names = PurePosixPath(item).parts
    others = [name for name in names if name != "**"]
    return (
        0 < len(names) <= MAX_PARTS
        and len(names) - len(others) <= 1
        and all(is_file_name(name) and "**" not in name for name in others)
    )


def path_option(spec: Mapping, key: str) -> str:
    """Returns an option that names a file or folder; "" without one."""
    value = spec.get(key, "")
    names = value.split("/") if isinstance(value, str) else []
    if not names or any(name and not _is_name(name) for name in names):
        raise InputError(f"source TOML: {key}: {value}: expected a path")
    if (size := len(value.encode(errors="replace"))) > MAX_PATH:
        raise InputError(
            f"source TOML: {key}: {value[:40]}...: a path of {size} bytes: "
            f"expected at most {MAX_PATH}"
        )
    return value


def check_options(spec: Mapping, packaged: Mapping, form: Format) -> None:
    """Checks that options are known, and have the types of those that the format has.

    In a table whose values are all of one type any value is of that type.

    Raises:
      InputError: the first one that is not known (with the nearest that is), or has
        another type.
    """
    known = {**packaged, **form.options}
    check_names("source TOML: ", spec, [*known])
    for key, value in spec.items():
        if key not in form.checked:
            _check_type(f"source TOML: {key}", value, known[key])
        if key not in form.free:
            _check_tables(f"source TOML: {key}", value, [known[key]])


def _check_tables(where: str, value: object, known: Sequence) -> None:
    """Tables, also in lists, have the names of known ones."""
    known = [*known, *(item for one in known if isinstance(one, list) for item in one)]
    tables = [one for one in known if isinstance(one, dict)]
    if isinstance(value, dict):
        check_names(f"{where}.", value, [*dict.fromkeys(itertools.chain(*tables))])
        for name, item in value.items():
            below = [table[name] for table in tables if name in table]
            _check_tables(f"{where}.{name}", item, below)
    for item in value if isinstance(value, list) and tables else ():
        _check_tables(where, item, tables)


def _check_type(where: str, value: object, like: object) -> None:
    if _type(value) != _type(like):
        raise InputError(f"{where}: {value}: expected {_type(like)}")
    if isinstance(value, int) and abs(value) > LARGEST:
        raise InputError(f"{where}: {value}: expected at most {LARGEST:g}")
    if isinstance(value, list) and isinstance(like, list):
        for item in value if _is_uniform(like) else ():
            _check_type(where, item, like[0])
    if isinstance(value, dict) and isinstance(like, dict):
        free = next(iter(like.values())) if _is_uniform([*like.values()]) else None
        for name, item in value.items():
            pattern = like.get(name, free)
            if pattern is None:
                continue
            _check_type(f"{where}.{name}", item, pattern)
            if isinstance(pattern, list) and free and len(item) != len(pattern):
                raise InputError(
                    f"{where}.{name}: {item}: expected {len(pattern)} values"
                )


def _type(value: object) -> str:
    return TYPES.get(type(value), "another type")


def _is_uniform(values: Sequence) -> bool:
    """True if all are of one type and, if lists, as long."""
    forms = {(_type(v), len(v) if isinstance(v, list) else 0) for v in values}
    return len(forms) == 1


def kind_of(where: str, found: str, kinds: Mapping[str, str]) -> Kind:
    """Returns the kind of a road user by its type and [kinds] of the TOML."""
    kind = kinds.get(found)
    if found not in kinds:
        raise InputError(
            f"{where}: object_type: {found}: expected one of "
            f"{', '.join(kinds) or 'none'} ([kinds] of the source TOML)"
        )
    if kind not in KINDS:
        raise InputError(
            f"source TOML: kinds.{found}: {kind}: expected one of {', '.join(KINDS)}"
        )
    return Kind[kind.upper()]
