"""The files of an input that an importer reads."""

import collections
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from rcirl_jax.data.formats.options import number, path_option
from rcirl_jax.data.readers.tables.columnar import is_columnar
from rcirl_jax.data.readers.tables.streams import packing
from rcirl_jax.errors import InputError

# what importers read besides the input itself
READ_BESIDE = (".csv", ".json", ".toml", ".xml", ".osm", ".gpkg")
# folders of maps above an input; the second as nuPlan's archive unpacks
MAP_FOLDERS = ("maps", "nuplan-maps-v1.0")

# bytes; a longer file is read in pieces (at once it takes ten times as much)
LONG_BYTES = 64 * 2**20
PACKED_TIMES = 8  # text that is packed, or in Parquet, is as many times as long
PACKED_ENDINGS = (".gz", ".zst", ".bz2")
TABLE_ENDINGS = (".csv", ".tsv", ".txt", ".parquet", ".feather", ".arrow")


def files_below(
    path: Path, patterns: str | Sequence[str], what: str = "log files"
) -> list[Path]:
    """Returns the file itself, or those at any depth that match a pattern, sorted."""
    if path.is_file():
        return [path]
    wanted = [patterns] if isinstance(patterns, str) else patterns
    found = {file for pattern in wanted for file in path.rglob(pattern)}
    files = sorted(file for file in found if is_input(path, file))
    if not files:
        raise InputError(
            f"{path}: no file matches {', '.join(wanted)}: expected {what}"
        )
    return files


def firsts_of_a_name(files: Iterable[Path]) -> list[Path]:
    """Returns the first of those of one name in one folder: they are the same log."""
    found: dict[tuple[Path, str], Path] = {}
    for file in files:
        found.setdefault((file.parent, table_stem(file)), file)
    return [*found.values()]


def given_map(spec: Mapping) -> Path | None:
    """Returns the file or folder that the option `map` names; None without it."""
    given = path_option(spec, "map")
    if given and not Path(given).exists():
        raise InputError(f"{given}: map: missing: expected a file or folder")
    return Path(given) if given else None


def is_input(folder: Path, file: Path) -> bool:
    """True if it is a file that is neither hidden nor left over from unpacking.

    Hidden are files of macOS (._NAME), backup copies of editors and the made-up
    scenario of INTERACTION's scripts (.TestScenarioForScripts).
    """
    below = file.relative_to(folder).parts
    return file.is_file() and not any(p == "__MACOSX" or p[0] == "." for p in below)


def with_log_names(
    path: Path, files: Sequence[Path], spec: dict, name_of: Callable[[Path], str]
) -> dict:
    """Returns the spec, with names for logs that are called alike in several folders.

    Their relative folder comes first (FOLDER/NAME); every other log keeps its name.
    """
    met = collections.Counter(name_of(file) for file in files)
    names = {
        str(file): (file.relative_to(path).parent / name_of(file)).as_posix()
        for file in files
        if met[name_of(file)] > 1
    }
    return {**spec, "log_names": names} if names else spec


def log_name(file: Path, spec: Mapping, name: str) -> str:
    """Returns `name`, or the one that tells a log from others called alike."""
    return spec.get("log_names", {}).get(str(file), name)


def listing(path: Path) -> list:
    """Returns names, sizes and times of change of all that an importer may read.

    The input, what lies beside it (groups of vehicles, lanes), and folders of maps
    above it.
    """
    files = set(path.rglob("*")) if path.is_dir() else {path}
    beside = path.absolute().parent.glob("*")
    files |= {file for file in beside if file.suffix in READ_BESIDE}
    for above in path.absolute().parents[:5]:
        for name in MAP_FOLDERS:
            files |= set((above / name).rglob("*"))
    stats = [(file, file.stat()) for file in sorted(files) if file.is_file()]
    return [[str(file), stat.st_size, stat.st_mtime_ns] for file, stat in stats]


def table_stem(path: Path) -> str:
    """Returns the name of a table's file without its endings: log of log.csv.gz."""
    name = path.name
    for endings in (PACKED_ENDINGS, TABLE_ENDINGS):
        name = next((name.removesuffix(e) for e in endings if name.endswith(e)), name)
    return name if name != path.name else path.stem


def is_long_file(path: Path, spec: dict) -> bool:
    """True if a file is read in pieces; `long_bytes` of the TOML sets from where.

    It counts bytes of text; a compressed file counts as several times its size.
    """
    limit = number(spec, "long_bytes", LONG_BYTES)
    if not path.is_file():
        return False
    is_packed = packing(path) is not None or is_columnar(path)
    return path.stat().st_size * (PACKED_TIMES if is_packed else 1) > limit
