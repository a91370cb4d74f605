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

import collections
import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.declared import open_log, size_of, track_of
from rcirl_jax.data.formats.files import (
    files_below,
    firsts_of_a_name,
    is_input,
    is_long_file,
    log_name,
    table_stem,
)
from rcirl_jax.data.formats.lanes import StraightLane, straight_lanes
from rcirl_jax.data.formats.options import (
    UNITS,
    number,
    one_of,
    patterns,
    positive,
    section,
)
from rcirl_jax.data.formats.tracks import spans_of, split_tracks
from rcirl_jax.data.readers.long_logs import rows_of
from rcirl_jax.data.readers.tables.rows import Rows, RowStats, attach_row_stats
from rcirl_jax.data.readers.tables.table import Field, Table, batches, fields_of
from rcirl_jax.data.readers.tables.text import BLANKS
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, Recording, Track

CLOCK, SITE = "Global_Time", "Location"
NEEDED = {
    "id": ("Vehicle_ID", "count"),
    "t": ("Frame_ID", "time"),
    "along": ("Local_Y", "place"),
    "speed": ("v_Vel", "place"),
    "lane": ("Lane_ID", "count"),
}  # field -> its column, and what the cells are
OPTIONAL = {
    "across": ("Local_X", "place"),
    "length": ("v_Length", "place"),
    "width": ("v_Width", "place"),
    "class": ("v_Class", "count"),
    "leader": ("Preceding", "count"),
}
JUNCTION = "Int_ID"  # a column of arterials, empty for freeways
NATIVE_COLUMNS, ARTERIAL_COLUMNS = 18, 24  # of texts without a header
LOGS = "trajectories"  # start of the logs' names in the releases
MAX_FRAME_GAP = 1  # frames; a larger gap starts a new track
REUSE_S = 60.0  # s; a step back by more is a number given to another vehicle
MARGIN_M = 50.0  # m of lane beyond the first and last position
SIZE_M = (4.5, 1.8)  # m, a car


def is_log(file: Path, table: Table | None) -> bool:
    """True if it is a text of 18 numbers a line, with blanks between them."""
    del file
    return (
        table is not None
        and table.layout is not None
        and table.layout.delimiter == BLANKS
        and len(table.header) == NATIVE_COLUMNS
        and not any(c.isalpha() for cell in table.header for c in cell)
    )


def parts(path: Path, spec: dict) -> list[Path]:
    """Returns the text and CSV files; each can be read alone.

    In folders below only those called trajectories*. Of files in one folder with
    one name that of the first pattern counts: it is the same log.
    """
    if path.is_file():
        return [path]
    wanted = patterns(spec)
    found = firsts_of_a_name(
        file
        for pattern in wanted
        for file in path.rglob(pattern)
        if (file.parent == path or file.name.lower().startswith(LOGS))
        and is_input(path, file)
        and "notice" not in file.name.lower()
    )
    return sorted(found) or files_below(path, " or ".join(wanted))


own_name = table_stem  # of a log, as long as no other folder has one called alike


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per file and site; of a long file, per site and minute."""
    for file in parts(path, spec):
        table, stats = _open(file, spec)
        stats.repeats_are_bad = False  # the portal's files hold some
        for made in _recordings(table, spec, stats):
            yield validate_recording(attach_row_stats(made, stats), file)


def _open(path: Path, spec: dict) -> tuple[Table, RowStats]:
    """The portal's table, or the native text, whose columns the TOML names."""
    table, stats = open_log(path, spec)
    is_known = any(table.has(column) for column, _ in NEEDED.values())
    is_numeric = not any(c.isalpha() for c in "".join(table.header))
    has_blanks = table.layout is not None and table.layout.delimiter == BLANKS
    if table.layout is not None and not is_known and (is_numeric or has_blanks):
        columns = spec.get("columns", [])
        for name, _ in NEEDED.values():
            if name not in columns:
                raise InputError(f"source TOML: columns: {name}: missing: expected it")
        if len(table.header) == ARTERIAL_COLUMNS != len(columns):
            raise InputError(
                f"{path}: line 1: {len(table.header)} cells: expected {len(columns)}; "
                "arterials have no straight lanes"
            )
        options = {"names": columns, "skip": 0, **section(spec, "table")}
        table, stats = open_log(path, {**spec, "table": options})
    if table.has(JUNCTION) and not table.has(SITE):
        raise InputError(
            f"{path}: column {SITE}: missing: expected it beside {JUNCTION}; "
            "arterials have no straight lanes"
        )
    return table, stats


def _has_stamps(table: Table) -> bool:
    """True if Global_Time [ms] is the clock: positive, not all equal."""
    if table.has(CLOCK):
        fields, uncounted = fields_of(table, {CLOCK: "time"}), RowStats(path=table.path)
        for part in batches(table, fields, uncounted):
            if (stamps := part[CLOCK]).size:
                return bool(0.0 < stamps.min() < stamps.max())
    return False


def _fields(table: Table, spec: dict, stamped: bool) -> list[Field]:
    """Columns that are read, in SI units; those that may be missing are, if there."""
    unit = UNITS[one_of(spec, "unit", ("ft", "m"))]
    known = NEEDED | {f: c for f, c in OPTIONAL.items() if table.has(c[0])}
    kinds = {field: kind for field, (_, kind) in known.items()}
    columns = {field: column for field, (column, _) in known.items()}
    factors = {field: unit for field, kind in kinds.items() if kind == "place"}
    factors["t"] = 1e-3 if stamped else positive(spec, "frame_s")
    other = CLOCK  # the clock that is not used: rows that repeat each other agree in it
    if stamped:
        columns["t"], other = CLOCK, columns["t"]
    if table.has(other):
        kinds["other_clock"], columns["other_clock"] = "time", other
    if table.has(SITE):
        kinds["recording"], columns["recording"] = "text", SITE
    return fields_of(table, kinds, columns=columns, factors=factors, lower=True)


def _recordings(table: Table, spec: dict, stats: RowStats) -> Iterator[Recording]:
    """Lanes and notes are those of a whole site, also of its minutes."""
    path, frame_s = table.path, positive(spec, "frame_s")
    stamped = _has_stamps(table)
    with rows_of(
        table,
        _fields(table, spec, stamped),
        stats,
        is_long=is_long_file(path, spec),
        may_differ=("leader",),
        places=("along", "across"),
    ) as rows:
        sites = rows.recordings()
        known, left_out = _known_sites(path, sites, spec)
        for site in known:
            survey = _Survey(map(_complete, rows.minutes(site)))
            log = log_name(path, spec, own_name(path))
            log = log if len(sites) == 1 else f"{log}-{site}"
            notes = [*left_out, *survey.notes()]  # once, with the first minute
            for part in rows.slices(site, (MAX_FRAME_GAP + 0.5) * frame_s):
                made = Recording(
                    name=f"{log}{part.label}",
                    source=spec["source"],
                    licence=spec["licence"],
                    rate_hz=1.0 / frame_s,
                    start_s=part.start if stamped else None,
                    tracks=_tracks(path, _complete(part.values), spec, survey, stamped),
                    lanes=survey.lanes(path, spec),
                    default_speed_limit=number(spec, "speed_limit"),
                    notes=tuple(notes),
                )
                yield part.of_log(log, made)
                notes = []


def _complete(rows: Rows) -> Rows:
    """Zeros for optional columns that a file has not."""
    return dict.fromkeys(OPTIONAL, np.zeros(rows["t"].size)) | rows


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


class _Survey:
    """The facts that Recordings of a site share, from its rows in any portions.

    Its memory grows with the different values of Local_X, not with the rows.
    """

    def __init__(self, portions: Iterable[Rows]) -> None:
        self.has_lateral = False  # any lateral position
        self._without: dict[str, set[float]] = {"length": set(), "width": set()}
        # lane -> Local_X and how often it is met; ends of Local_Y
        self._across: dict[int, collections.Counter[float]] = {}
        self._along: dict[int, tuple[float, float]] = {}
        for rows in portions:
            self.has_lateral |= bool(np.any(rows["across"] != 0.0))
            for field, users in self._without.items():
                users.update(rows["id"][rows[field] <= 0.0])
            driven = rows["lane"].astype(int)
            for lane in np.unique(driven).tolist():
                x, y = (rows[name][driven == lane] for name in ("across", "along"))
                self._across.setdefault(lane, collections.Counter()).update(x.tolist())
                lower, upper = self._along.get(lane, (np.inf, -np.inf))
                ends = min(lower, float(y.min())), max(upper, float(y.max()))
                self._along[lane] = ends

    def notes(self) -> list[str]:
        """Returns what was missing."""
        notes = []
        if not self.has_lateral:
            notes.append("no lateral positions; built from lane numbers")
        for field, users in self._without.items():
            if users:
                notes.append(f"{len(users)} vehicles without {field}; default by class")
        return notes

    def lanes(self, path: Path, spec: dict) -> tuple[Lane, ...]:
        """Returns a straight lane per lane number, over where it was driven +- 50 m."""
        width, found = number(spec, "lane_width_m"), []
        for lane, (lower, upper) in sorted(self._along.items()):
            y = -width * (lane - 0.5)
            if self.has_lateral:  # the median of values met several times each
                values, counts = np.array(sorted(self._across[lane].items())).T
                last = np.cumsum(counts)
                middle = np.array([(last[-1] - 1) // 2, last[-1] // 2])
                middle = values[np.searchsorted(last, middle, side="right")]
                y = -float(np.mean(middle))
            lower, upper = lower - MARGIN_M, upper + MARGIN_M
            found.append(StraightLane(id=str(lane), y=y, lower=lower, upper=upper))
        lanes = straight_lanes(path, found, width, number(spec, "speed_limit"))
        return tuple(
            dataclasses.replace(
                lane, width_assumed=lane.width_assumed or not self.has_lateral
            )
            for lane in lanes
        )


def _tracks(
    path: Path, rows: Rows, spec: dict, survey: _Survey, stamped: bool
) -> tuple[Track, ...]:
    """Tracks of a site's rows, all or of a minute."""
    frame_s, sizes = positive(spec, "frame_s"), spec.get("sizes", {})
    frame = np.round(rows["t"] / frame_s)
    # whether a row names a vehicle ahead that has no row at that time
    users = np.concatenate([rows["id"], rows["leader"]])
    users = np.unique(users, return_inverse=True)[1].reshape(2, -1)
    times = np.unique(frame, return_inverse=True)[1].reshape(-1)
    own, ahead = users * (times.max() + 1) + times
    rows = {**rows, "t": frame * frame_s}
    rows["leader_missing"] = (rows["leader"] > 0.0) & ~np.isin(ahead, own)
    # with stamps no step back has a meaning
    reuse = 0.0 if stamped else REUSE_S / frame_s
    ids = rows["id"].astype(np.int64)
    tracks = []
    for name, at in split_tracks(path, ids, frame, MAX_FRAME_GAP, reuse):
        part = {field: column[at] for field, column in rows.items()}
        usual = sizes.get(str(int(part["class"][0])), sizes.get("0", SIZE_M))
        part["x"] = part["along"] - 0.5 * size_of(part, usual)[0]
        part["y"] = -part["across"]
        if not survey.has_lateral:
            part["y"] = _lateral_from_lanes(part["lane"], spec)
        missing = spans_of(part["t"], part["leader_missing"])
        tracks.append(track_of(name, part, Kind.VEHICLE, usual, leader_missing=missing))
    return tuple(tracks)


def _lateral_from_lanes(lane: np.ndarray, spec: dict) -> np.ndarray:
    """Lane centres [n] m, each switch spread over `lane_switch_s`.

        y = y_0 + sum_k (y_k - y_{k-1}) S((t - t_k) / 4 s + 1/2),  S(u) = 3u^2 - 2u^3

    with t_k midway between the last sample in the old lane and the first in the
    new one.
    """
    width = number(spec, "lane_width_m")
    span = number(spec, "lane_switch_s") / positive(spec, "frame_s")
    y = np.full(lane.shape, -width * (lane[0] - 0.5))
    samples = np.arange(lane.size)
    for at in np.flatnonzero(np.diff(lane) != 0.0):
        u = np.clip((samples - at - 0.5) / max(span, 1e-9) + 0.5, 0.0, 1.0)
        y -= width * (lane[at + 1] - lane[at]) * u**2 * (3.0 - 2.0 * u)
    return y
