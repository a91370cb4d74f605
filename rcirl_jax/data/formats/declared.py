"""Formats of tables, declared: which columns they have, and what their cells are.

What a format needs of a table is a `Columns`; what is odd about it is a short hook of
its importer. Numbers have limits by what they are: beyond them no log means anything.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.formats.options import section
from rcirl_jax.data.readers.tables.ledger import Ledger, allowed_share
from rcirl_jax.data.readers.tables.repair import once
from rcirl_jax.data.readers.tables.table import (
    MAX_PLACE_M,
    MAX_TIME,
    MAX_VELOCITY_MPS,
    Field,
    Table,
    fields_of,
    open_table,
    read,
)
from rcirl_jax.types import Kind

Rows = dict[str, np.ndarray]  # field -> [n]
KINDS = {
    **dict.fromkeys(("pedestrian", "person", "animal"), Kind.PEDESTRIAN),
    # a trailer is in the way of others like any body that moves, but nobody drives it:
    # only vehicles are experts (Argoverse 2's "unknown" and Waymo's "other" likewise)
    **dict.fromkeys(("bicycle", "bicyclist", "cyclist", "trailer"), Kind.CYCLIST),
    **dict.fromkeys(("car", "van", "truck", "bus", "truck_bus"), Kind.VEHICLE),
    **dict.fromkeys(("motorcycle", "vehicle"), Kind.VEHICLE),
}  # class of a road user, in small letters -> what it is; others are vehicles
LIMITS = {
    **{"time": MAX_TIME, "place": MAX_PLACE_M, "speed": MAX_VELOCITY_MPS},
    **{"count": 1e12, "number": np.inf, "text": np.inf},
}


def with_numbers_and_texts(spec: dict, packaged: Mapping) -> dict:
    """A user's source TOML, with the packaged one's options that are no tables."""
    plain = (bool, int, float, str)
    return {k: v for k, v in packaged.items() if isinstance(v, plain)} | spec


def open_log(path: Path, spec: Mapping) -> tuple[Table, Ledger]:
    """A table as its source TOML says, and what will become of its rows."""
    table = open_table(path, section(spec, "table"))
    return table, Ledger(path=path, unit=table.unit, allowed=allowed_share(spec))


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
        kinds = {**self.needed, **self.optional}
        return fields_of(
            table,
            [*self.needed],
            [*self.optional],
            texts=[name for name, kind in kinds.items() if kind == "text"],
            limits={name: LIMITS[kind] for name, kind in kinds.items()},
            columns=self.called,
            factors=self.factors,
        )

    def read(self, table: Table, ledger: Ledger) -> Rows:
        """Rows in SI units, each road user once in a frame.

        Args:
          table: of `open_log`.
          ledger: of it, which counts what is dropped.
        """
        rows = read(table, self.fields(table), ledger)
        options = {"places": self.places, "name_of": self.name_of}
        return once(rows, ledger, self.t, self.user, **options)
