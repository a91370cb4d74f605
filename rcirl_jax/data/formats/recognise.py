"""Recognises the format of an input by names of files and columns."""

import contextlib
import itertools
from collections.abc import Iterator
from pathlib import Path

from rcirl_jax.data.formats import IMPORTERS, module_of
from rcirl_jax.data.formats.files import is_input
from rcirl_jax.data.formats.format import FORMATS
from rcirl_jax.data.readers.tables.streams import refuse_pointer
from rcirl_jax.data.readers.tables.table import open_table
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.specs import load_toml, spec_root

MAX_FILES = 200  # of a folder that are looked at
TABLES = ("*.csv", "*.tsv", "*.txt", "*.parquet", "*.feather", "*.gz", "*.zst")


def recognised_format(path: Path | None, source: Path | None = None) -> str:
    """Returns the format of an input; synthetic traffic where there is none.

    Args:
      path: file or folder.
      source: TOML of columns, which makes any other table one of format csv.

    Raises:
      InputError: nothing is recognised, or files of several formats.
    """
    if path is None:
        return "synthetic"
    if not path.exists():
        raise InputError(f"{path}: input: missing: expected a file or folder")
    found: dict[str, Path] = {}
    # the input, or what is in the folder: those whose names say most first
    names = (name for form in FORMATS.values() for name in form.names)
    below = _matching(path, (*names, *TABLES)) if path.is_dir() else ()
    possible = (file for file in below if file.is_dir() or is_input(path, file))
    for file in itertools.islice(itertools.chain([path], possible), MAX_FILES):
        name = _format_of(file, source)
        if name:
            found.setdefault(name, file)
    # a scene's TOML, or a table beside logs of another form, says nothing
    for weak in ("synthetic", "csv"):
        if len(found) > 1:
            found.pop(weak, None)
    if len(found) == 1:
        return next(iter(found))
    files = [path] if path.is_file() else [*_matching(path, TABLES)]
    for file in (*found.values(), *files[:MAX_FILES]):
        refuse_pointer(file)
    if found:
        each = ", ".join(f"{file.name} of {name}" for name, file in found.items())
        raise InputError(f"{path}: format: not given: expected one of them for {each}")
    table = next((f for f in files if f.is_file() and any(map(f.match, TABLES))), None)
    if table is not None:
        tomls = path.glob("*.toml") if path.is_dir() else ()
        there = next((file for file in sorted(tomls) if _is_source(file)), None)
        which = f"which `rcirl import --suggest={table}` writes"
        if there is not None:
            which = f"perhaps {there}, which is there"
        raise InputError(
            f"{table}: format: not given: a table of no known data set: expected "
            f"format csv with a source TOML that names its columns, {which}"
        )
    raise InputError(
        f"{path}: format: not given: no files of a known format: expected "
        f"one of {', '.join(sorted(IMPORTERS))}"
    )


def _is_source(file: Path) -> bool:
    """True for a TOML that says what columns of a table mean."""
    try:
        return "columns" in load_toml(file)
    except InputError:
        return False


def _matching(path: Path, patterns: tuple[str, ...]) -> Iterator[Path]:
    return itertools.chain.from_iterable(map(path.rglob, patterns))


def _format_of(file: Path, source: Path | None) -> str:
    """The format of one file or folder, "" where it is none that is known."""
    for name, form in FORMATS.items():
        if any(map(file.match, form.names)):
            return "" if file.suffix == ".toml" and _is_source(file) else name
    if not file.is_file():
        return ""
    table = None
    with contextlib.suppress(InputError):
        table = open_table(file)
    header = {name.lower() for name in table.header} if table else set()
    for name, form in FORMATS.items():
        if any(columns <= header for columns in form.columns):
            return name
    for name, form in FORMATS.items():  # told by more than columns
        if form.has_is_log and module_of(name).is_log(file, table):
            return name
    packaged = load_toml(spec_root() / "sources" / "csv.toml")["columns"]
    needed = {packaged[field] for field in ("t", "id", "x", "y")}
    is_csv = table and (source is not None or needed <= set(table.header))
    return "csv" if is_csv else ""
