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

import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NoReturn, TextIO

import numpy as np

from rcirl_jax.data.importers.files import input_files, is_input, is_long_file, log_name
from rcirl_jax.data.importers.ngsim.map import (
    FRAME_S,
    MAX_FRAME_GAP,
    SITE,
    Survey,
    Table,
    drop_repeated,
    site_recording,
)
from rcirl_jax.data.importers.options import patterns, positive, unit_factor
from rcirl_jax.data.readers import csv_stream, long_logs
from rcirl_jax.data.readers.sparse_tables import (
    MAX_PLACE_M,
    MAX_TIME,
    check_range,
)
from rcirl_jax.data.readers.tables import (
    check_row,
    is_grouped,
    lines_of,
    load_rows,
    read_header,
    read_table,
)
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Recording

NEEDED = ("Vehicle_ID", "Frame_ID", "Local_Y", "v_Vel", "Lane_ID")
OPTIONAL = ("Local_X", "v_Length", "v_Width", "v_Class", "Global_Time", "Preceding")
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
    """One Recording per file and site; of a long CSV, per site and minute."""
    for file in parts(path, spec):
        factor = unit_factor(file, "unit", spec.get("unit", "ft"), ("ft", "m"))
        is_csv = _has_header(file)
        if is_long_file(file, spec):
            found = _long_recordings(file, spec, factor, is_csv)
        else:
            table = _read_csv(file) if is_csv else _read_text(file, spec)
            found = _whole_recordings(file, spec, factor, table)
        for recording in found:
            yield validate_recording(recording, file)


def _whole_recordings(
    path: Path, spec: dict, factor: float, table: Table
) -> Iterator[Recording]:
    for name, limit in LIMITS.items():
        check_range(path, table, (name,), limit)
    for name in LENGTHS:
        table[name] = table[name] * factor
    sites = np.unique(table[SITE]).tolist() if SITE in table else [None]
    known, left_out = _known_sites(path, sites, spec)
    frame_s = positive(spec, "frame_s", FRAME_S)
    for site in known:
        rows = slice(None) if site is None else table[SITE] == site
        part = {name: values[rows] for name, values in table.items() if name != SITE}
        stamped = _has_stamps(part["Global_Time"])
        part["frame"] = _clock(part, frame_s, stamped)
        survey = Survey()
        survey.add(part)
        notes = [*left_out, *survey.notes()]
        name = _name(path, site, sites, spec)
        yield site_recording(
            path, name, part, spec, survey, stamped=stamped, notes=notes
        )


def _long_recordings(
    path: Path, spec: dict, factor: float, is_csv: bool
) -> Iterator[Recording]:
    """One Recording per site and minute; lanes and notes are the site's."""
    frame_s = positive(spec, "frame_s", FRAME_S)
    if is_csv:
        header = _read_header(path)
        read = functools.partial(csv_stream.batches, grouped=is_grouped(path))
    else:
        header, read = _text_columns(spec), functools.partial(_text_batches, spec=spec)
    names = _columns(header)
    for name in NEEDED:
        if names[name] not in header:
            raise InputError(
                f"{path}: column {names[name]}: missing: expected it among {header}"
            )
    stamped = names["Global_Time"] in header and _has_stamps_long(
        path, names["Global_Time"], read
    )
    clock, step = ("Global_Time", 1e-3) if stamped else ("Frame_ID", frame_s)
    fields = [
        csv_stream.Field(
            name="t", column=names[clock], factor=step, limit=LIMITS[clock]
        ),
        csv_stream.Field(name="id", column=names["Vehicle_ID"]),
        *(
            csv_stream.Field(
                name=n,
                column=names[n],
                factor=factor if n in LENGTHS else 1.0,
                limit=LIMITS.get(n, np.inf),
            )
            for n in (*NEEDED, *OPTIONAL)
            if names[n] in header
        ),
    ]
    if is_csv and names[SITE] in header:
        fields.append(
            csv_stream.Field(
                name="recording", column=names[SITE], text=True, lower=True
            )
        )

    def table_of(values: Table) -> Table:
        return _complete({**values, "frame": np.round(values["t"] / frame_s)})

    gap_s = (MAX_FRAME_GAP + 0.5) * frame_s
    with long_logs.spilled(path, fields, spec.get("locations"), read) as spill:
        sites = spill.recordings()
        known, left_out = _known_sites(path, sites, spec)
        for site in known:
            survey, log = Survey(), _name(path, site, sites, spec)
            for values in spill.minutes(site):
                survey.add(table_of(values))
            notes = [*left_out, *survey.notes()]  # once, with the first minute
            for piece in spill.pieces(site, gap_s):
                table, name = table_of(piece.values), f"{log}-{piece.label}"
                drop_repeated(table)
                made = site_recording(
                    path, name, table, spec, survey, stamped=stamped, notes=notes
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


def _has_stamps_long(
    path: Path,
    column: str,
    read: Callable[[Path, list[csv_stream.Field]], Iterator[dict]],
) -> bool:
    """`_has_stamps` of a whole file, read a few MiB at a time."""
    field = csv_stream.Field(name="stamps", column=column)
    found = (batch["stamps"] for batch in read(path, [field]))
    ends = [(part.min(), part.max()) for part in found if part.size]
    return bool(ends) and _has_stamps(np.array(ends))


def _clock(table: Table, frame_s: float, stamped: bool) -> np.ndarray:
    """Whole frames since the recording's first, from Global_Time if it is there."""
    if stamped:
        stamps = table["Global_Time"]
        frames = np.round((stamps - stamps.min()) / (1000.0 * frame_s))
    else:
        frames = table["Frame_ID"] - table["Frame_ID"].min()
    return np.round(frames)


def _has_header(path: Path) -> bool:
    """Whether the file is the portal's CSV rather than the native text."""
    try:
        with path.open(encoding="utf-8-sig") as handle:
            first = next(lines_of(handle), "")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: text: {error}: expected NGSIM rows") from error
    if not first.strip():
        raise InputError(f"{path}: rows: none: expected NGSIM rows")
    return "," in first


def _columns(header: Sequence[str]) -> dict[str, str]:
    """Column -> its name in the header, without regard to case."""
    actual = {name.lower(): name for name in header}
    return {n: actual.get(n.lower(), n) for n in (*NEEDED, *OPTIONAL, SITE)}


def _read_header(path: Path) -> list[str]:
    """Column names; those of an arterial that does not say so are refused."""
    header = read_header(path)
    lower = [name.lower() for name in header]
    if JUNCTION.lower() in lower and SITE.lower() not in lower:
        raise InputError(
            f"{path}: column {SITE}: missing: expected it beside {JUNCTION}; "
            "arterials have no straight lanes"
        )
    return header


def _read_csv(path: Path) -> Table:
    names = _columns(_read_header(path))
    found = read_table(
        path,
        [names[n] for n in NEEDED],
        [names[n] for n in (*OPTIONAL, SITE)],
        [names[SITE]],
        grouped=is_grouped(path),
    )
    table = _complete({n: found[names[n]] for n in names if names[n] in found})
    if SITE in table:
        table[SITE] = np.char.lower(table[SITE])
    return table


def _complete(table: Table) -> Table:
    """Zeros for optional columns that a file has not."""
    none = np.zeros(table["Frame_ID"].size)
    return {name: table.get(name, none) for name in (*NEEDED, *OPTIONAL)} | table


def _text_columns(spec: dict) -> list[str]:
    """Column order of the native text."""
    columns = spec.get("columns", [])
    if not isinstance(columns, list) or not all(isinstance(n, str) for n in columns):
        raise InputError(f"source TOML: columns: {columns}: expected a list of names")
    for name in NEEDED:
        if name not in columns:
            raise InputError(f"source TOML: columns: {name}: missing: expected it")
    return columns


def _read_text(path: Path, spec: dict) -> Table:
    columns = _text_columns(spec)
    wanted = [name for name in (*NEEDED, *OPTIONAL) if name in columns]
    values = np.concatenate(list(_text_rows(path, columns)))
    return _complete({name: values[:, columns.index(name)] for name in wanted})


def _text_batches(
    path: Path, fields: list[csv_stream.Field], spec: dict
) -> Iterator[Table]:
    """`csv_stream.batches` of the native text."""
    columns, start = _text_columns(spec), 1
    for values in _text_rows(path, columns):
        found = {field.name: values[:, columns.index(field.column)] for field in fields}
        yield {
            field.name: csv_stream.in_si(path, found[field.name], field, start)
            for field in fields
        }
        start += len(values)


def _text_rows(path: Path, columns: list[str]) -> Iterator[np.ndarray]:
    """Numbers [n, columns] of the native text, READ_BYTES at a time."""
    try:
        with path.open(encoding="utf-8-sig") as handle:
            for lines in _pieces(handle):
                values = load_rows(lines, "f8", None)
                if len(values) and values.shape[1] != len(columns):
                    raise ValueError(values.shape)
                if not np.isfinite(values).all():
                    raise ValueError(values)
                yield values.reshape(-1, len(columns))
    except ValueError:  # also of bytes that are no text
        _find_bad_line(path, columns)


def _pieces(handle: TextIO) -> Iterator[list[str]]:
    """Lines of READ_BYTES or a little more."""
    lines, held = [], 0
    for line in lines_of(handle):
        lines.append(line)
        held += len(line)
        if held >= csv_stream.READ_BYTES:
            yield lines
            lines, held = [], 0
    if lines:
        yield lines


def _find_bad_line(path: Path, columns: list[str]) -> NoReturn:
    """Name the first line that is not a row of numbers."""
    with path.open(encoding="utf-8", errors="replace") as handle:
        for line, text in enumerate(lines_of(handle), start=1):
            if text.strip():
                cells = text.split()
                if len(cells) == ARTERIAL_COLUMNS != len(columns):
                    raise InputError(
                        f"{path}: line {line}: {len(cells)} cells: expected "
                        f"{len(columns)}; arterials have no straight lanes"
                    )
                check_row(path, line, cells, columns, columns)
    raise InputError(f"{path}: rows: unreadable: expected {len(columns)} numbers each")
