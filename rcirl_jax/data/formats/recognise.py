"""Which format an input is of, where nobody says it: by names of files and columns."""

import itertools
from collections.abc import Iterator
from pathlib import Path

from rcirl_jax.data.formats import IMPORTERS, format_of, module_of
from rcirl_jax.data.formats.files import is_input
from rcirl_jax.data.readers.tables.table import Table, open_table
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.specs import load_toml, spec_root

MAX_FILES = 200  # of a folder that are looked at
TABLES = ("*.csv", "*.tsv", "*.txt", "*.parquet", "*.feather", "*.gz", "*.zst")


def recognised_format(path: Path | None, source: Path | None = None) -> str:
    """The format of an input; synthetic traffic where there is none.

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
    for file in itertools.islice(_candidates(path), MAX_FILES):
        name = _format_of(file, source)
        if name:
            found.setdefault(name, file)
    # a scene's TOML, or a table beside logs of another form, says nothing
    for weak in ("synthetic", "csv"):
        if len(found) > 1:
            found.pop(weak, None)
    if len(found) == 1:
        return next(iter(found))
    if found:
        each = ", ".join(f"{file.name} of {name}" for name, file in found.items())
        raise InputError(f"{path}: format: not given: expected one of them for {each}")
    raise InputError(_unknown(path))


def _candidates(path: Path) -> Iterator[Path]:
    """The input, or what is in the folder: those whose names say most first."""
    yield path
    if path.is_dir():
        names = (name for form in IMPORTERS for name in format_of(form).names)
        for pattern in (*names, *TABLES):
            yield from (
                p for p in path.rglob(pattern) if p.is_dir() or is_input(path, p)
            )


def _format_of(file: Path, source: Path | None) -> str:
    """The format of one file or folder, "" where it is none that is known."""
    for name in IMPORTERS:
        if any(map(file.match, format_of(name).names)):
            return name
    if not file.is_file():
        return ""
    try:
        table = open_table(file)
    except InputError:
        return _told(file, None)
    return _table_format(table, source)


def _table_format(table: Table, source: Path | None) -> str:
    header = {name.lower() for name in table.header}
    for name in IMPORTERS:
        if any(columns <= header for columns in format_of(name).columns):
            return name
    if name := _told(table.path, table):
        return name
    packaged = load_toml(spec_root() / "sources" / "csv.toml")["columns"]
    needed = {packaged[field] for field in ("t", "id", "x", "y")}
    return "csv" if source is not None or needed <= set(table.header) else ""


def _told(file: Path, table: Table | None) -> str:
    """The format that tells a table by more than its columns, "" if none does."""
    for name in IMPORTERS:
        told_by = format_of(name).told_by
        if told_by and module_of(name, told_by).is_log(file, table):
            return name
    return ""


def _unknown(path: Path) -> str:
    """What is wrong with an input of no known format, and what to do."""
    tables = [
        file
        for pattern in TABLES
        for file in ([path] if path.is_file() else path.rglob(pattern))
        if file.match(pattern) and file.is_file()
    ]
    if tables:
        return (
            f"{tables[0]}: format: not given: a table of no known data set: expected "
            "format csv with a source TOML that names its columns, which "
            f"`rcirl import --suggest={tables[0]}` writes"
        )
    return (
        f"{path}: format: not given: no files of a known format: expected "
        f"one of {', '.join(sorted(IMPORTERS))}"
    )
