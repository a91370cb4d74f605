"""How NGSIM's own text is told, which has no header."""

from pathlib import Path

from rcirl_jax.data.readers.tables.table import Table
from rcirl_jax.data.readers.tables.text import BLANKS

COLUMNS = 18


def is_log(file: Path, table: Table | None) -> bool:
    """Whether it is a text of 18 numbers a line, with blanks between them."""
    del file
    return (
        table is not None
        and table.layout is not None
        and table.layout.delimiter == BLANKS
        and len(table.header) == COLUMNS
        and not any(c.isalpha() for cell in table.header for c in cell)
    )
