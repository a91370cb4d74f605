"""Formats of tables, declared: which columns they have, and what their cells are.

What a format needs of a table is a `Columns`; what is odd about it is a short hook of
its importer. Numbers have limits by what they are: beyond them no log means anything.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.data.importers.options import section
from rcirl_jax.data.readers.tables.ledger import (
    MAX_BAD_ROWS,
    Ledger,
    allowed_share,
)
from rcirl_jax.data.readers.tables.repair import once
from rcirl_jax.data.readers.tables.table import (
    MAX_PLACE_M,
    MAX_TIME,
    MAX_VELOCITY_MPS,
    Field,
    Table,
    open_table,
    read,
)

Rows = dict[str, np.ndarray]  # field -> [n]
LIMITS = {
    **{"time": MAX_TIME, "place": MAX_PLACE_M, "speed": MAX_VELOCITY_MPS},
    **{"count": 1e12, "number": np.inf, "text": np.inf},
}


def open_log(
    path: Path, spec: Mapping, allowed: float = MAX_BAD_ROWS
) -> tuple[Table, Ledger]:
    """A table as its source TOML says, and what will become of its rows."""
    table = open_table(path, section(spec, "table"))
    share = allowed_share(spec, allowed)
    return table, Ledger(path=path, unit=table.unit, allowed=share)


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
        return [
            Field(
                name=name,
                column=self.called.get(name, name),
                needed=name in self.needed,
                text=kind == "text",
                limit=LIMITS[kind],
                factor=self.factors.get(name, 1.0),
            )
            for name, kind in {**self.needed, **self.optional}.items()
            if name in self.needed or table.has(self.called.get(name, name))
        ]

    def read(self, table: Table, ledger: Ledger) -> Rows:
        """Rows in SI units, each road user once in a frame.

        Args:
          table: of `open_log`.
          ledger: of it, which counts what is dropped.
        """
        rows = read(table, self.fields(table), ledger)
        options = {"places": self.places, "name_of": self.name_of}
        return once(rows, ledger, self.t, self.user, **options)
