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

from rcirl_jax.data.importers.files import input_files, is_input, is_long_file, log_name
from rcirl_jax.data.importers.ngsim.map import (
    FRAME_S,
    MAX_FRAME_GAP,
    SITE,
    Rows,
    Survey,
    site_recording,
)
from rcirl_jax.data.importers.options import patterns, positive, section, unit_factor
from rcirl_jax.data.readers import long_logs
from rcirl_jax.data.readers.tables.layout import BLANKS
from rcirl_jax.data.readers.tables.ledger import LINE, Ledger, allowed_share
from rcirl_jax.data.readers.tables.repair import single_rows
from rcirl_jax.data.readers.tables.table import (
    MAX_PLACE_M,
    MAX_TIME,
    Field,
    Table,
    batches,
    open_table,
    read,
)
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording

NEEDED = ("Vehicle_ID", "Frame_ID", "Local_Y", "v_Vel", "Lane_ID")
KNOWN = tuple(name.lower() for name in NEEDED)
OPTIONAL = ("Local_X", "v_Length", "v_Width", "v_Class", "Global_Time", "Preceding")
APART = ("Preceding",)  # columns in which rows that repeat each other may differ
PLACES = ("Local_Y", "Local_X")  # where a road user is
JUNCTION = "Int_ID"  # a column of arterials, empty for freeways
ARTERIAL_COLUMNS = 24  # of an arterial's native text
LOGS = "trajectories"  # start of the logs' names in the releases
LENGTHS = ("Local_X", "Local_Y", "v_Length", "v_Width", "v_Vel")
MAX_NUMBER = 1e12  # of a vehicle or lane; larger ones are no numbers of anything
# in the file's unit: what no log can mean
LIMITS = {
    **dict.fromkeys(("Vehicle_ID", "Lane_ID", "v_Class", "Preceding"), MAX_NUMBER),
    **dict.fromkeys(("Frame_ID", "Global_Time"), MAX_TIME),
    **dict.fromkeys(LENGTHS, MAX_PLACE_M),
}


def parts(path: Path, spec: dict) -> list[Path]:
    """The text and CSV files; each can be read alone.

    In folders below only those called trajectories*. Of files in one folder with
    one name that of the first pattern counts: it is the same log.
    """
    if path.is_file():
        return [path]
    wanted = patterns(spec, ["*.txt", "*.csv"])
    found: dict[tuple[Path, str], Path] = {}
    for pattern in wanted:
        for file in path.rglob(pattern):
            own = file.parent == path or file.name.lower().startswith(LOGS)
            if own and is_input(path, file) and "notice" not in file.name.lower():
                found.setdefault((file.parent, file.stem), file)
    return sorted(found.values()) or input_files(path, " or ".join(wanted))


def own_name(file: Path) -> str:
    """Name of a log, as long as no other folder has one called alike."""
    return file.stem


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per file and site; of a long file, per site and minute."""
    for file in parts(path, spec):
        table = _open(file, spec)
        ledger = Ledger(
            path=file,
            unit=table.unit,
            allowed=allowed_share(spec),
            repeats_are_bad=False,  # the portal's files hold some
        )
        read_ = _long_recordings if is_long_file(file, spec) else _whole_recordings
        for made in read_(table, spec, ledger):
            counts, notes = ledger.news()
            notes = (*made.notes, *notes)
            yield validate_recording(
                dataclasses.replace(made, rows=counts, notes=notes), file
            )


def _whole_recordings(table: Table, spec: dict, ledger: Ledger) -> Iterator[Recording]:
    path, values = table.path, read(table, _fields(table, spec), ledger)
    sites = np.unique(values[SITE]).tolist() if SITE in values else [None]
    known, left_out = _known_sites(path, sites, spec)
    frame_s = positive(spec, "frame_s", FRAME_S)
    for site in known:
        rows = slice(None) if site is None else values[SITE] == site
        part = {name: column[rows] for name, column in values.items() if name != SITE}
        part = _complete(part)
        stamped = _has_stamps(part["Global_Time"])
        part["frame"] = _clock(part, frame_s, stamped)
        part["id"], part["t"] = part["Vehicle_ID"], part["frame"]
        compared = [name for name in part if name not in (LINE, *APART)]
        kept = single_rows(part, ledger, compared, "{:g}".format, PLACES)
        part = {name: column[kept] for name, column in part.items()}
        survey = Survey()
        survey.add(part)
        notes = [*left_out, *survey.notes()]
        name = _name(path, site, sites, spec)
        yield site_recording(
            path, name, part, spec, survey, stamped=stamped, notes=notes
        )


def _long_recordings(table: Table, spec: dict, ledger: Ledger) -> Iterator[Recording]:
    """One Recording per site and minute; lanes and notes are the site's."""
    path, frame_s = table.path, positive(spec, "frame_s", FRAME_S)
    fields = _fields(table, spec)
    stamped = _has_stamps_long(table, fields)
    clock, step = ("Global_Time", 1e-3) if stamped else ("Frame_ID", frame_s)
    names = _columns(table.header)
    fields = [
        *(f for f in fields if f.name != SITE),
        Field(name="t", column=names[clock], factor=step, limit=LIMITS[clock]),
        Field(name="id", column=names["Vehicle_ID"]),
        *(dataclasses.replace(f, name="recording") for f in fields if f.name == SITE),
    ]

    def table_of(values: Rows) -> Rows:
        return _complete({**values, "frame": np.round(values["t"] / frame_s)})

    gap_s = (MAX_FRAME_GAP + 0.5) * frame_s
    with long_logs.spilled(
        path,
        lambda show: batches(table, fields, ledger, show),
        ledger,
        wanted=spec.get("locations"),
        apart=APART,
        places=PLACES,
    ) as spill:
        sites = spill.recordings()
        known, left_out = _known_sites(path, sites, spec)
        for site in known:
            survey, log = Survey(), _name(path, site, sites, spec)
            for values in spill.minutes(site):
                survey.add(table_of(values))
            notes = [*left_out, *survey.notes()]  # once, with the first minute
            for piece in spill.pieces(site, gap_s):
                rows, name = table_of(piece.values), f"{log}-{piece.label}"
                made = site_recording(
                    path, name, rows, spec, survey, stamped=stamped, notes=notes
                )
                yield long_logs.piece_of(log, made, piece)
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


def _name(path: Path, site: str | None, sites: Sequence[str | None], spec: dict) -> str:
    """Of a site's recording: the file's alone where it has one site."""
    log = log_name(path, spec, own_name(path))
    return log if len(sites) == 1 else f"{log}-{site}"


def _has_stamps(stamps: np.ndarray) -> bool:
    """Whether Global_Time [ms] is the clock: positive, and not one for all rows."""
    return bool(stamps.min() > 0.0 and stamps.max() > stamps.min())


def _has_stamps_long(table: Table, fields: Sequence[Field]) -> bool:
    """`_has_stamps` of a whole file, read a few MiB at a time."""
    own = [field for field in fields if field.name == "Global_Time"]
    if not own:
        return False
    uncounted = Ledger(path=table.path)
    found = (batch["Global_Time"] for batch in batches(table, own, uncounted))
    ends = [(part.min(), part.max()) for part in found if part.size]
    return bool(ends) and _has_stamps(np.array(ends))


def _clock(rows: Rows, frame_s: float, stamped: bool) -> np.ndarray:
    """Whole frames since the recording's first, from Global_Time if it is there."""
    if stamped:
        stamps = rows["Global_Time"]
        frames = np.round((stamps - stamps.min()) / (1000.0 * frame_s))
    else:
        frames = rows["Frame_ID"] - rows["Frame_ID"].min()
    return np.round(frames)


def _open(path: Path, spec: dict) -> Table:
    """The portal's table, or the native text, whose columns the TOML names.

    Raises:
      InputError: a column is missing, or it is an arterial's file.
    """
    options = section(spec, "table")
    table = open_table(path, options)
    if _is_native(table):
        columns = _text_columns(spec)
        if len(table.header) == ARTERIAL_COLUMNS != len(columns):
            raise InputError(
                f"{path}: line 1: {len(table.header)} cells: expected {len(columns)}; "
                "arterials have no straight lanes"
            )
        table = open_table(path, {"names": columns, "skip": 0, **options})
    lower = [name.lower() for name in table.header]
    if JUNCTION.lower() in lower and SITE.lower() not in lower:
        raise InputError(
            f"{path}: column {SITE}: missing: expected it beside {JUNCTION}; "
            "arterials have no straight lanes"
        )
    return table


def _is_native(table: Table) -> bool:
    """Whether it is the native text, which has no header."""
    if table.layout is None or {n.lower() for n in table.header} & set(KNOWN):
        return False
    is_numeric = not any(c.isalpha() for c in "".join(table.header))
    return is_numeric or table.layout.delimiter == BLANKS


def _columns(header: Sequence[str]) -> dict[str, str]:
    """Column -> its name in the header, without regard to case."""
    actual = {name.lower(): name for name in header}
    return {n: actual.get(n.lower(), n) for n in (*NEEDED, *OPTIONAL, SITE)}


def _fields(table: Table, spec: dict) -> list[Field]:
    """Columns that are read, in SI units; those that may be missing are, if there."""
    factor = unit_factor(table.path, "unit", spec.get("unit", "ft"), ("ft", "m"))
    names = _columns(table.header)
    return [
        Field(
            name=name,
            column=names[name],
            text=name == SITE,
            lower=name == SITE,
            factor=factor if name in LENGTHS else 1.0,
            limit=LIMITS.get(name, np.inf),
        )
        for name in (*NEEDED, *OPTIONAL, SITE)
        if name in NEEDED or names[name] in table.header
    ]


def _complete(rows: Rows) -> Rows:
    """Zeros for optional columns that a file has not."""
    none = np.zeros(rows["Frame_ID"].size)
    return {name: rows.get(name, none) for name in (*NEEDED, *OPTIONAL)} | rows


def _text_columns(spec: dict) -> list[str]:
    """Column order of the native text."""
    columns = spec.get("columns", [])
    if not isinstance(columns, list) or not all(isinstance(n, str) for n in columns):
        raise InputError(f"source TOML: columns: {columns}: expected a list of names")
    for name in NEEDED:
        if name not in columns:
            raise InputError(f"source TOML: columns: {name}: missing: expected it")
    return columns
