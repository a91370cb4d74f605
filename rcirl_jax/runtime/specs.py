"""Finds and reads the declarative files."""

import re
import tomllib
from pathlib import Path

from rcirl_jax.errors import InputError

MAX_BYTES = 16 * 1024**2  # bytes of a TOML file
MAX_PARTS = 32  # of a dotted key; the parser's time and memory grow with their square
MAX_DEPTH = 100  # levels of tables and arrays
# strings and comments, also those that do not end
TEXTS = re.compile(
    r"""
    "{3} (?: [^"\\]++ | \\.? | "(?!"") )*+ (?: "{3,5}+ )?
    | '{3} (?: [^']++ | '(?!'') )*+ (?: '{3,5}+ )?
    | " (?: [^"\\\n]++ | \\[^\n]? )*+ "?
    | ' [^'\n]*+ '?
    | \# [^\n]*+
    """,
    re.DOTALL | re.VERBOSE,
)
LONG_KEY = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{MAX_PARTS}}}")


def spec_root() -> Path:
    """The folder data_specs: the copy in the wheel, else that of the checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "data_specs"
    return installed if installed.is_dir() else package.parent / "data_specs"


def load_toml(path: Path) -> dict:
    """Reads a TOML file as a dict; InputError names the file and the line."""
    try:
        with Path(path).open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        why = error.strerror or error
        raise InputError(f"{path}: {why}: expected a readable file") from error
    if len(content) > MAX_BYTES:
        raise InputError(f"{path}: size: expected at most {MAX_BYTES >> 20} MiB")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: {error}: expected a readable file") from error
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    plain = TEXTS.sub(lambda found: "_" + "\n" * found[0].count("\n"), text)
    if found := LONG_KEY.search(plain):
        line = plain.count("\n", 0, found.start()) + 1
        raise InputError(
            f"{path}: line {line}: {found[0][:40]}...: "
            f"expected at most {MAX_PARTS} parts in a key"
        )
    try:
        table = tomllib.loads(text)
    except RecursionError as error:
        raise InputError(f"{path}: nested too deeply: expected TOML") from error
    except ValueError as error:  # also numbers of too many digits
        raise InputError(f"{path}: {error}: expected TOML") from error
    _check(path, "", table, 1)
    return table


def _check(path: Path, where: str, value: object, depth: int) -> None:
    """Refuses whole numbers above 64 bits, which TOML has not, and deep nesting."""
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise InputError(
            f"{path}: {where}: a number of {value.bit_length()} bits: "
            "expected at most 63 and a sign"
        )
    if isinstance(value, dict | list) and depth > MAX_DEPTH:
        raise InputError(f"{path}: {where}: nested too deeply: expected TOML")
    if isinstance(value, dict):
        for key, item in value.items():
            _check(path, f"{where}.{key}" if where else key, item, depth + 1)
    elif isinstance(value, list):
        for item in value:
            _check(path, where, item, depth + 1)
