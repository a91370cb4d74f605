"""NGSIM: the native 18-column text and the portal's CSV.

Column order, units and sizes come from data_specs/sources/ngsim.toml. Local_Y
is the front bumper along the road and Local_X the lateral position from the
left edge, to the right: our x = Local_Y - length / 2, our y = -Local_X. Files
without lateral positions (Local_X = 0) get them from the lane number.

The portal's CSV holds several sites and periods; vehicle and frame numbers
start anew in each. Sites become Recordings of their own; where the file has
Global_Time, it is the clock and rows may come in any order, else Frame_ID. A file
longer than `long_bytes` becomes a Recording per site and minute (`long_logs`).

Traps: spreadsheets export numbers as "1,118,846,979,700"; the releases of the sites
hold every log twice, as text and as CSV, in folders of their own; those of the
arterials have no column Location to say what they are, but 24 columns.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.declared import Columns, Rows, open_log
from rcirl_jax.data.formats.files import (
    firsts_of_a_name,
    input_files,
    is_input,
    is_long_file,
    log_name,
    table_stem,
)
from rcirl_jax.data.formats.ngsim.map import (
    MAX_FRAME_GAP,
    SITE,
    Survey,
    site_recording,
)
from rcirl_jax.data.formats.options import patterns, positive, section, unit_factor
from rcirl_jax.data.readers.long_logs import rows_of
from rcirl_jax.data.readers.tables.rows import RowStats, attach_row_stats
from rcirl_jax.data.readers.tables.table import Field, Table, batches
from rcirl_jax.data.readers.tables.text import BLANKS
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording

CLOCK = "Global_Time"
COLUMNS = {
    **{"Vehicle_ID": "count", "Frame_ID": "time", "Local_Y": "place"},
    **{"v_Vel": "place", "Lane_ID": "count"},
    **{"Local_X": "place", "v_Length": "place", "v_Width": "place"},
    **{"v_Class": "count", CLOCK: "time", "Preceding": "count", SITE: "text"},
}  # column -> what its cells are
NEEDED = tuple(COLUMNS)[:5]
OPTIONAL = tuple(COLUMNS)[5:-1]
APART = ("Preceding",)  # columns in which rows that repeat each other may differ
PLACES = ("Local_Y", "Local_X")  # where a road user is
JUNCTION = "Int_ID"  # a column of arterials, empty for freeways
ARTERIAL_COLUMNS = 24  # of an arterial's native text
LOGS = "trajectories"  # start of the logs' names in the releases


def parts(path: Path, spec: dict) -> list[Path]:
    """The text and CSV files; each can be read alone.

    In folders below only those called trajectories*. Of files in one folder with
    one name that of the first pattern counts: it is the same log.
    """
    if path.is_file():
        return [path]
    wanted = patterns(spec, ["*.txt", "*.csv"])
    found = firsts_of_a_name(
        file
        for pattern in wanted
        for file in path.rglob(pattern)
        if (file.parent == path or file.name.lower().startswith(LOGS))
        and is_input(path, file)
        and "notice" not in file.name.lower()
    )
    return sorted(found) or input_files(path, " or ".join(wanted))


own_name = table_stem  # of a log, as long as no other folder has one called alike


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per file and site; of a long file, per site and minute."""
    for file in parts(path, spec):
        table, stats = _open(file, spec)
        stats.repeats_are_bad = False  # the portal's files hold some
        for made in _recordings(table, spec, stats):
            yield validate_recording(attach_row_stats(made, stats), file)


def _recordings(table: Table, spec: dict, stats: RowStats) -> Iterator[Recording]:
    """Lanes and notes are those of a whole site, also of its minutes."""
    path, frame_s = table.path, positive(spec, "frame_s")
    stamped = _has_stamps(table)
    with rows_of(
        table,
        _fields(table, spec, stamped),
        stats,
        is_long=is_long_file(path, spec),
        may_differ=APART,
        places=PLACES,
    ) as rows:
        sites = rows.recordings()
        known, left_out = _known_sites(path, sites, spec)
        for site in known:
            survey, log = Survey(), log_name(path, spec, own_name(path))
            log = log if len(sites) == 1 else f"{log}-{site}"
            for values in rows.minutes(site):
                survey.add(_complete(values))
            notes = [*left_out, *survey.notes()]  # once, with the first minute
            for piece in rows.slices(site, (MAX_FRAME_GAP + 0.5) * frame_s):
                values = _complete(piece.values)
                values["frame"] = np.round(values["t"] / frame_s)
                name = f"{log}{piece.label}"
                made = site_recording(
                    path, name, values, spec, survey, stamped=stamped, notes=notes
                )
                yield piece.of_log(log, made)
                notes = []


def _known_sites(
    path: Path, sites: Sequence[str | None], spec: dict
) -> tuple[list[str | None], list[str]]:
    """Sites that are read, in order, and a note about the others."""
    if list(sites) == [None]:
        return [None], []
    names = sorted(str(site) for site in sites)
    known = [site for site in names if site in spec.get("locations", names)]
    if not known:
        raise InputError(
            f"{path}: {SITE}: {', '.join(names)}: "
            f"expected one of {', '.join(spec['locations'])}"
        )
    left_out = [site for site in names if site not in known]
    return [*known], [f"left out, no freeway: {', '.join(left_out)}"][: len(left_out)]


def _has_stamps(table: Table) -> bool:
    """Whether Global_Time [ms] is the clock: positive, and not one for all rows."""
    column = _column(table, CLOCK)
    if not table.has(column):
        return False
    if any(cell and not cell.strip("0.") for cell in table.samples(column)):
        return False  # nothing else is read where the first rows say 0
    fields = Columns(needed={CLOCK: COLUMNS[CLOCK]}, called={CLOCK: column})
    uncounted = RowStats(path=table.path)
    read = (part[CLOCK] for part in batches(table, fields.fields(table), uncounted))
    lowest, highest = np.inf, -np.inf
    for part in read:
        if part.size:
            lowest, highest = min(lowest, part.min()), max(highest, part.max())
        if lowest <= 0.0:
            return False
    return bool(highest > lowest)


def _open(path: Path, spec: dict) -> tuple[Table, RowStats]:
    """The portal's table, or the native text, whose columns the TOML names.

    Raises:
      InputError: a column is missing, or it is an arterial's file.
    """
    table, stats = open_log(path, spec)
    if _is_native(table):
        columns = _text_columns(spec)
        if len(table.header) == ARTERIAL_COLUMNS != len(columns):
            raise InputError(
                f"{path}: line 1: {len(table.header)} cells: expected {len(columns)}; "
                "arterials have no straight lanes"
            )
        options = {"names": columns, "skip": 0, **section(spec, "table")}
        table, stats = open_log(path, {**spec, "table": options})
    if table.has(_column(table, JUNCTION)) and not table.has(_column(table, SITE)):
        raise InputError(
            f"{path}: column {SITE}: missing: expected it beside {JUNCTION}; "
            "arterials have no straight lanes"
        )
    return table, stats


def _is_native(table: Table) -> bool:
    """Whether it is the native text, which has no header."""
    if table.layout is None or any(table.has(_column(table, name)) for name in NEEDED):
        return False
    is_numeric = not any(c.isalpha() for c in "".join(table.header))
    return is_numeric or table.layout.delimiter == BLANKS


def _column(table: Table, name: str) -> str:
    """A column's name in the header, without regard to case."""
    return next((n for n in table.header if n.lower() == name.lower()), name)


def _fields(table: Table, spec: dict, stamped: bool) -> list[Field]:
    """Columns that are read, in SI units; those that may be missing are, if there."""
    unit = unit_factor(table.path, "unit", spec["unit"], ("ft", "m"))
    clock = CLOCK if stamped else "Frame_ID"
    named = {clock: "t", "Vehicle_ID": "id", SITE: "recording"}
    actual = {name: _column(table, name) for name in COLUMNS}
    found = {
        named.get(name, name): kind
        for name, kind in COLUMNS.items()
        if name in NEEDED or table.has(actual[name])
    }
    factors = {name: unit for name, kind in found.items() if kind == "place"}
    factors["t"] = 1e-3 if stamped else positive(spec, "frame_s")
    called = {named.get(name, name): column for name, column in actual.items()}
    fields = Columns(needed=found, called=called, factors=factors).fields(table)
    return [dataclasses.replace(field, lower=field.text) for field in fields]


def _complete(rows: Rows) -> Rows:
    """Zeros for optional columns that a file has not."""
    none = np.zeros(rows["t"].size)
    return {name: none for name in OPTIONAL} | rows


def _text_columns(spec: dict) -> list[str]:
    """Column order of the native text."""
    columns = spec.get("columns", [])
    if not isinstance(columns, list) or not all(isinstance(n, str) for n in columns):
        raise InputError(f"source TOML: columns: {columns}: expected a list of names")
    for name in NEEDED:
        if name not in columns:
            raise InputError(f"source TOML: columns: {name}: missing: expected it")
    return columns
