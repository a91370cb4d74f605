"""Where the declarative files are, and how they are read."""

import tomllib
from pathlib import Path

from rcirl_jax.errors import InputError

MAX_BYTES = 16 * 1024**2  # bytes of a TOML file


def spec_root() -> Path:
    """The folder data_specs: the copy in the wheel, else that of the checkout."""
    package = Path(__file__).resolve().parent
    installed = package / "data_specs"
    return installed if installed.is_dir() else package.parent / "data_specs"


def load_toml(path: Path) -> dict:
    """A TOML file as a dict; InputError names the file and the line."""
    try:
        with Path(path).open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: {error}: expected a readable file") from error
    if len(content) > MAX_BYTES:
        raise InputError(f"{path}: size: expected at most {MAX_BYTES >> 20} MiB")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: {error}: expected a readable file") from error
    try:
        return tomllib.loads(text.replace("\r\n", "\n").replace("\r", "\n"))
    except RecursionError as error:
        raise InputError(f"{path}: nested too deeply: expected TOML") from error
    except ValueError as error:  # also numbers of too many digits
        raise InputError(f"{path}: {error}: expected TOML") from error
