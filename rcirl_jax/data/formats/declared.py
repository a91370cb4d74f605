"""Formats of tables, declared: which columns they have, and what their cells are.

What a format needs of a table is a `Columns`; what is odd about it is a short hook of
its importer. Numbers have limits by what they are: beyond them no log means anything.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from rcirl_jax.data.formats.options import section
from rcirl_jax.data.readers.tables.rows import (
    Rows,
    RowStats,
    allowed_share,
    drop_duplicates,
)
from rcirl_jax.data.readers.tables.table import (
    Field,
    Table,
    fields_of,
    open_table,
    read,
)
from rcirl_jax.types import Kind

KINDS = {
    **dict.fromkeys(("pedestrian", "person", "animal"), Kind.PEDESTRIAN),
    # a trailer is in the way of others like any body that moves, but nobody drives it:
    # only vehicles are experts (Argoverse 2's "unknown" and Waymo's "other" likewise)
    **dict.fromkeys(("bicycle", "bicyclist", "cyclist", "trailer"), Kind.CYCLIST),
    **dict.fromkeys(("car", "van", "truck", "bus", "truck_bus"), Kind.VEHICLE),
    **dict.fromkeys(("motorcycle", "vehicle"), Kind.VEHICLE),
}  # class of a road user, in small letters -> what it is; others are vehicles


def with_numbers_and_texts(spec: dict, packaged: Mapping) -> dict:
    """A user's source TOML, with the packaged one's options that are no tables."""
    plain = (bool, int, float, str)
    return {k: v for k, v in packaged.items() if isinstance(v, plain)} | spec


def open_log(path: Path, spec: Mapping) -> tuple[Table, RowStats]:
    """A table as its source TOML says, and what will become of its rows."""
    table = open_table(path, section(spec, "table"))
    return table, RowStats(path=path, unit=table.unit, allowed=allowed_share(spec))


def unknown_kinds(what: str, found: Iterable[str]) -> list[str]:
    """The note on classes that nobody knows."""
    unknown = sorted(set(found) - {*KINDS})
    return [f"{what} taken for vehicles: {', '.join(unknown)}"] if unknown else []


@dataclasses.dataclass(frozen=True, kw_only=True)
class Columns:
    """The columns of a format's tables."""

    # field -> what its cells are: time, place, speed, count, number or text
    needed: Mapping[str, str]  # a row without one of them is none
    optional: Mapping[str, str] = dataclasses.field(default_factory=dict)
    called: Mapping[str, str] = dataclasses.field(default_factory=dict)  # the column
    factors: Mapping[str, float] = dataclasses.field(default_factory=dict)  # of units
    t: str = "t"
    user: str | None = "id"  # None: a row is of all road users
    places: tuple[str, ...] = ("x", "y")
    name_of: Callable[[Any], str] = str  # an id as the file has it

    def fields(self, table: Table) -> list[Field]:
        """Fields of a table: those needed, and others whose column is there."""
        return fields_of(
            table,
            self.needed,
            self.optional,
            columns=self.called,
            factors=self.factors,
        )

    def read(self, table: Table, stats: RowStats) -> Rows:
        """Rows in SI units, each road user once in a frame.

        Args:
          table: of `open_log`.
          stats: of it, which counts what is dropped.
        """
        rows = read(table, self.fields(table), stats)
        return drop_duplicates(
            rows,
            stats,
            t=self.t,
            user=self.user,
            places=self.places,
            name_of=self.name_of,
        )
