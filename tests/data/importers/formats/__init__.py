"""Fixtures in the layout of each log format, written by the tests themselves.

One module per format of `IMPORTERS`, with `write(folder) -> Fixture`. The
conformance suite reads each back and compares it with what was written.
"""

import dataclasses
import importlib
import pkgutil
from pathlib import Path
from types import ModuleType

import numpy as np

from rcirl_jax.types import Kind


@dataclasses.dataclass(frozen=True, kw_only=True)
class Written:
    """One road user as the fixture's author meant it, in SI units, box centre."""

    kind: Kind
    length: float  # m
    width: float  # m
    t: np.ndarray  # [n] s, first sample of the recording is 0
    x: np.ndarray  # [n] m
    y: np.ndarray  # [n] m
    heading: np.ndarray  # [n] rad
    speed: np.ndarray  # [n] m/s


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fixture:
    """What a fixture holds and what an importer has to find in it."""

    input: Path  # for --input
    rate_hz: float
    tracks: dict[str, Written]  # by the id that the importer gives
    num_lanes: int  # at least so many lanes; 0 if the format has none
    num_signals: int = 0
    # lanes without a limit, lanes of an unmeasured width, and road users of an
    # unmeasured size: fitted lanes have neither limit nor width, and few logs say how
    # large the car is that recorded them
    assumed: tuple[int, int, int] = (0, 0, 0)
    # position error allowed by the format's rounding
    tolerance_m: float = 0.02
    has_heading: bool = True  # False: computed from the positions
    # files whose truncation, garbling or removal has to be one clear line
    files: tuple[Path, ...] = ()
    # of these, files with checksums: a changed byte is seen, or in no part that is read
    checked: tuple[Path, ...] = ()
    # text file -> pattern whose group is a number that is read, a position if there
    # is one: anything else in its place has to be one clear line
    numbers: dict[Path, str] = dataclasses.field(default_factory=dict)
    # whether text cut between two lines is seen to be cut: rows are counted
    # elsewhere, or the text has an end of its own
    is_counted: bool = False
    # whether a position may be missing here and there (NaN)
    has_holes: bool = False
    # whether a row that cannot be read is dropped and counted
    drops_rows: bool = False


def modules() -> dict[str, ModuleType]:
    """Module name -> module, of every fixture."""
    names = [item.name for item in pkgutil.iter_modules(__path__)]
    found = {name: importlib.import_module(f"{__name__}.{name}") for name in names}
    return {name: module for name, module in found.items() if hasattr(module, "write")}


def format_of(name: str) -> str:
    """The format of a fixture: its module's name, or what the module says by FORMAT."""
    return getattr(modules()[name], "FORMAT", name)


def cell(column: int, separator: str = ",") -> str:
    """Pattern of a table's cells in one column."""
    other = f"[^{separator}\n]*"
    return f"^(?:{other}{separator}){{{column}}}({other})"
