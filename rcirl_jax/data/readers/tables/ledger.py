"""Rows of a table that were dropped: counted, named once, refused above a share."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording, RowCounts

LINE = "line"  # column: of each row in the file; the number of the row in Parquet
SAID = {
    "unreadable": "unreadable rows dropped; first: {first}",
    "repeated": "rows met twice, used once",  # wherever they stand
    "doubled": "rows of a road user twice in one frame, one used; first: {first}",
}
MAX_BAD_ROWS = 0.01  # share of rows that may be dropped; the option of this name


class NoRowsError(InputError):
    """A table has a header and no rows: of a log, nobody drove."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path}: rows: none: expected rows below the header")
        self.path = path


@dataclasses.dataclass
class Ledger:
    """What became of the rows of one file."""

    path: Path
    unit: str = "line"  # what rows are counted by
    allowed: float = MAX_BAD_ROWS  # share of bad rows
    # whether rows that repeat another are bad; a release is known for them
    repeats_are_bad: bool = True
    read: int = 0
    unreadable: int = 0  # a cell that cannot be read, or a needed one that is empty
    repeated: int = 0  # equal to another in everything that is read
    doubled: int = 0  # a road user that is met twice in one frame
    first: str = ""  # what is wrong with the first bad row
    firsts: dict[str, str] = dataclasses.field(default_factory=dict)  # since `told`
    told: RowCounts = dataclasses.field(default_factory=RowCounts)

    def drop(self, why: str, first: str, count: int = 1) -> None:
        """Count rows; `first` says what is wrong with the first of them."""
        self.firsts.setdefault(why, first)
        if why != "repeated" or self.repeats_are_bad:
            self.first = self.first or first
        setattr(self, why, getattr(self, why) + count)

    @property
    def bad(self) -> int:
        """Rows that count against what is allowed."""
        return self.unreadable + self.doubled + self.repeated * self.repeats_are_bad

    def check(self) -> None:
        """Raises: InputError: no rows, or more bad ones than are allowed."""
        if self.read == 0:
            raise NoRowsError(self.path)
        if self.bad > self.allowed * self.read or self.bad == self.read:
            raise InputError(
                f"{self.path}: {self.first}; {self.bad} of {self.read} rows are bad: "
                f"expected up to {100.0 * self.allowed:g} % (max_bad_rows of the TOML)"
            )

    def news(self) -> tuple[RowCounts, list[str]]:
        """What was counted since the last call, for the report and in words."""
        names = [field.name for field in dataclasses.fields(RowCounts)]
        since = {name: getattr(self, name) - getattr(self.told, name) for name in names}
        notes = [
            f"{since[why]} {what.format(first=self.firsts.pop(why))}"
            for why, what in SAID.items()
            if since[why]
        ]
        self.told = RowCounts(**{name: getattr(self, name) for name in names})
        return RowCounts(**since), notes


def with_news(made: Recording, *ledgers: Ledger) -> Recording:
    """A recording that says what became of its files' rows since the one before it."""
    found = [ledger.news() for ledger in ledgers]
    names = [field.name for field in dataclasses.fields(RowCounts)]
    counts = {name: sum(getattr(rows, name) for rows, _ in found) for name in names}
    notes = [note for _, dropped in found for note in dropped]
    return dataclasses.replace(
        made, rows=RowCounts(**counts), notes=(*made.notes, *notes)
    )


def allowed_share(spec: Mapping, default: float = MAX_BAD_ROWS) -> float:
    """The option `max_bad_rows` of a source TOML."""
    value = spec.get("max_bad_rows", default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"source TOML: max_bad_rows: {value}: expected a number")
    if not 0.0 <= value < 1.0:
        raise InputError(
            f"source TOML: max_bad_rows: {value:g}: expected a share from 0 to below 1"
        )
    return float(value)
