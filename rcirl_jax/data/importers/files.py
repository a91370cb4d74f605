"""Which files of an input an importer reads."""

from pathlib import Path

from rcirl_jax.errors import InputError

# what importers read besides the input itself
READ_BESIDE = (".csv", ".json", ".toml", ".xml", ".osm", ".gpkg")


def input_files(path: Path, pattern: str) -> list[Path]:
    """The file itself, or a folder's matching files sorted by name."""
    if path.is_file():
        return [path]
    found = sorted(file for file in path.glob(pattern) if file.is_file())
    if not found:
        raise InputError(f"{path}: no file matches {pattern}: expected log files")
    return found


def listing(path: Path) -> list:
    """Names, sizes and times of change of all that an importer may read.

    The input, what lies beside it (groups of vehicles, lanes), and folders of maps
    above it.
    """
    files = set(path.rglob("*")) if path.is_dir() else {path}
    beside = path.absolute().parent.glob("*")
    files |= {file for file in beside if file.suffix in READ_BESIDE}
    for above in path.absolute().parents[:4]:
        files |= set((above / "maps").rglob("*"))
    stats = [(file, file.stat()) for file in sorted(files) if file.is_file()]
    return [[str(file), stat.st_size, stat.st_mtime_ns] for file, stat in stats]
