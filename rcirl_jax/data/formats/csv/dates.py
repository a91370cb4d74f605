"""How dates that are neither numbers nor ISO's are written."""

import contextlib
import datetime
import itertools
from collections.abc import Sequence

# the day comes first where both orders fit
DATES = ("%d.%m.%Y", "%d.%m.%y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y")
TIMES_OF_DAY = (
    *("%H:%M:%S.%f", "%H:%M:%S,%f", "%H:%M:%S", "%I:%M:%S.%f %p", "%I:%M:%S %p"),
)


def date_pattern(cells: Sequence[str]) -> str:
    """The pattern of strptime that all cells have; "" if none is known."""
    for date, rest in itertools.product(DATES, TIMES_OF_DAY):
        pattern = f"{date} {rest}"
        with contextlib.suppress(ValueError):
            for cell in cells:
                datetime.datetime.strptime(cell, pattern)
            if cells:
                return pattern
    return ""
