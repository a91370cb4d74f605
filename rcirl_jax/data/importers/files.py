"""Which files of an input an importer reads."""

from pathlib import Path

from rcirl_jax.errors import InputError


def input_files(path: Path, pattern: str) -> list[Path]:
    """The file itself, or a folder's matching files sorted by name."""
    if path.is_file():
        return [path]
    found = sorted(file for file in path.glob(pattern) if file.is_file())
    if not found:
        raise InputError(f"{path}: no file matches {pattern}: expected log files")
    return found
