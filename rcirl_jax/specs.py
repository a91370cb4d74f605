"""Where the declarative files are, and how they are read."""

import tomllib
from pathlib import Path

from rcirl_jax.errors import InputError


def spec_root() -> Path:
    """The folder data_specs: the copy in the wheel, else that of the checkout."""
    package = Path(__file__).resolve().parent
    installed = package / "data_specs"
    return installed if installed.is_dir() else package.parent / "data_specs"


def load_toml(path: Path) -> dict:
    """A TOML file as a dict; InputError names the file and the line."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {error}: expected a readable file") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: {error}: expected TOML") from error
