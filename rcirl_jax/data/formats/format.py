"""The declaration of a format, which loads none of its reader."""

import dataclasses
from collections.abc import Mapping
from typing import Any


@dataclasses.dataclass(frozen=True, kw_only=True)
class Format:
    """A log format."""

    # how its files or folders are called
    names: tuple[str, ...] = ()
    # sets of columns, in small letters, of which each tells its tables
    columns: tuple[frozenset[str], ...] = ()
    # module below the folder with `is_log(file, table)`, which tells other tables;
    # table: None where the file is none that can be opened
    told_by: str = ""
    # whether one part (see `importers.parts`) is a file with a few recordings, which a
    # worker reads as a whole
    is_small: bool = False
    # bytes of the longest part, of many recordings, whose scenes may be held at once
    # (docs/formats, "Large inputs"); 0: parts are read by the first process
    shard_bytes: int = 0
    # whether a part is a file that is read in pieces where it is long
    is_cut: bool = False
    # options besides those of its packaged TOML, each with a value of its type; an
    # option that is a table has a value for each of its own
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    # tables in which any name may stand, or whose reader knows which may
    free: tuple[str, ...] = ()
    # options of several types, which the reader checks
    checked: tuple[str, ...] = ("pattern",)


def of_columns(*tables: str) -> tuple[frozenset[str], ...]:
    """`Format.columns` of names with blanks between them."""
    return tuple(frozenset(names.split()) for names in tables)
