"""INTERACTION dataset: drone tracks of every kind of junction, with maps.

Two layouts, told apart by the column case_id: the recordings of 2019
(recorded_trackfiles/SCENE/vehicle_tracks_NNN.csv with pedestrian_tracks_NNN.csv
beside it) and the prediction challenge of 2021 (train/SCENE_train.csv: cases of
4 s, each a Recording here). Maps are Lanelet2 files, maps/SCENE.osm_xy in
metres or maps/SCENE.osm in degrees about (0, 0).

Traps: pedestrians have no heading and no size (columns missing or cells
empty), their numbers are text ("P4"), "pedestrian/bicycle" is one class, frames
may start at 0 or 1, challenge files hold what is asked for in SCENE_obs.csv.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.declared import KINDS, open_log, track_of, unknown_kinds
from rcirl_jax.data.formats.files import files_below, given_map, is_input, log_name
from rcirl_jax.data.formats.lanelet2 import read_lanelet2
from rcirl_jax.data.formats.options import number
from rcirl_jax.data.formats.perception import SIZES_M
from rcirl_jax.data.formats.projection import utm, utm_zone
from rcirl_jax.data.formats.tracks import split_tracks
from rcirl_jax.data.readers.tables.rows import (
    LINE,
    NoRowsError,
    Rows,
    RowStats,
    attach_row_stats,
    drop_duplicates,
)
from rcirl_jax.data.readers.tables.table import fields_of, open_table, read
from rcirl_jax.data.recording import accepted, validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, OpenRoads, Recording, Track

NEEDED = {
    **{"track_id": "text", "timestamp_ms": "time", "agent_type": "text"},
    **{"x": "place", "y": "place", "vx": "speed", "vy": "speed"},
}
OPTIONAL: dict[str, str] = dict.fromkeys(
    ("case_id", "psi_rad", "length", "width"), "number"
)
VEHICLES = "vehicle_tracks_"
PEDESTRIANS = "pedestrian_tracks_"
# files of a release that are no logs: predictions to hand in, 1 s observations
LEFT_OUT = ("_sub.csv", "_obs.csv")
SETS = ("_train", "_val", "_test", "_obs")
# folders below a scene's, made by the data set's own split_train_val_script.py
SPLITS = ("train", "val", "sorted")
EITHER = "pedestrian/bicycle"
MAPS_UP = 5  # folders above a log in which that of the maps is looked for
MAX_GAP_MS = 550.0  # ms missing inside one track


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Scene:
    """The fields that recordings of one file share."""

    path: Path
    spec: dict
    lanes: tuple[Lane, ...] | None  # None: they are estimated
    limit: float  # m/s, of lanes without one
    notes: tuple[str, ...]


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per vehicle file, or per case of a challenge file."""
    for file in parts(path, spec):
        rows, stats = _read(file, spec)
        scene, all_stats = _scene(file, spec), [stats]
        if np.isfinite(rows["case_id"]).any():
            log = log_name(file, spec, file.stem)
            order = np.argsort(rows["case_id"], kind="stable")
            changes = np.flatnonzero(np.diff(rows["case_id"][order])) + 1
            for at in np.split(order, changes):
                case = {field: values[at] for field, values in rows.items()}
                name = f"{log}-case{case['case_id'][0]:g}"
                # all of a file are one group, they share vehicles
                make = functools.partial(_recording, name, case, scene, file.stem)
                yield attach_row_stats(accepted(make, name, file, spec), stats)
            continue
        partner = file.with_name(file.name.replace(VEHICLES, PEDESTRIANS, 1))
        if partner != file and partner.is_file():
            with contextlib.suppress(NoRowsError):  # no pedestrians
                others, stats = _read(partner, spec)
                rows = {k: np.concatenate([rows[k], others[k]]) for k in rows}
                all_stats.append(stats)
        own = own_name(file)
        name = log_name(file, spec, own)
        # logs of one name may be copies of each other
        group = None if name == own else own
        made = _recording(name, rows, scene, group)
        yield validate_recording(attach_row_stats(made, *all_stats), file)


def parts(path: Path, spec: dict) -> list[Path]:
    """Returns the log files below a folder; pedestrians come with vehicles."""
    if path.is_file():
        return [path]
    tables = sorted(file for file in path.rglob("*.csv") if is_input(path, file))
    found = [file for file in tables if _is_log(file)]
    names = set(found)
    kept = [
        file
        for file in found
        if not file.name.startswith(PEDESTRIANS)
        or file.with_name(file.name.replace(PEDESTRIANS, VEHICLES, 1)) not in names
    ]
    return kept or files_below(path, "**/*.csv")


def _is_log(path: Path) -> bool:
    """True if a file has a log's name, or its columns under another name."""
    if path.name.endswith(LEFT_OUT):
        return False
    if path.name.startswith((VEHICLES, PEDESTRIANS)) or path.stem.endswith(SETS):
        return True
    try:
        header = open_table(path).header
    except InputError:
        return False
    return {"track_id", "timestamp_ms"} <= set(header)


def own_name(file: Path) -> str:
    """Returns the name of a log, as long as no other folder has one called alike."""
    if not file.name.startswith((VEHICLES, PEDESTRIANS)):
        return file.stem
    number_ = file.stem.removeprefix(VEHICLES).removeprefix(PEDESTRIANS)
    return f"{_scene_name(file)}-{number_}"


def _scene_name(path: Path) -> str:
    """Name of the place: the folder, or the challenge file without its set."""
    if path.name.startswith((VEHICLES, PEDESTRIANS)):
        folders = [folder.name for folder in path.resolve().parents]
        return next((name for name in folders if name not in SPLITS), folders[0])
    return next(
        (path.stem.removesuffix(s) for s in SETS if path.stem.endswith(s)), path.stem
    )


def _read(path: Path, spec: dict) -> tuple[Rows, RowStats]:
    """All columns this module uses, and counts of the rows.

    NaN where a file or a cell has none; a road user is one of a case.
    """
    table, stats = open_log(path, spec)
    case = {"case_id": "number"} if table.has("case_id") else {}
    rows = read(table, fields_of(table, {**NEEDED, **case}, OPTIONAL), stats)
    rows = dict.fromkeys(OPTIONAL, np.full(rows[LINE].size, np.nan)) | rows
    users, codes = np.unique(rows["track_id"], return_inverse=True)
    cases = np.unique(rows["case_id"], return_inverse=True)[1]
    rows["user"] = (cases * users.size + codes).astype(float)

    def name_of(user: float) -> str:
        return str(users[int(user) % users.size])

    options = {"t": "timestamp_ms", "user": "user", "name_of": name_of}
    return drop_duplicates(rows, stats, **options), stats


def _scene(path: Path, spec: dict) -> _Scene:
    place = _find_map(path, spec)
    limit = number(spec, "default_speed_limit")
    lanes, notes = None, []
    if place is not None:
        zone = utm_zone(0.0)
        origin = utm(np.zeros(1), np.zeros(1), zone)
        lanes, notes = read_lanelet2(place, lambda a, b: utm(a, b, zone) - origin)
        known = [lane.speed_limit for lane in lanes if lane.speed_limit is not None]
        limit = float(np.median(known)) if known else limit
    return _Scene(path=path, spec=spec, lanes=lanes, limit=limit, notes=tuple(notes))


def _find_map(path: Path, spec: dict) -> Path | None:
    """maps/SCENE.osm_xy or .osm in a folder above; the option `map` names one."""
    folders = [folder / "maps" for folder in path.resolve().parents[:MAPS_UP]]
    if (given := given_map(spec)) is not None:
        if given.is_file():
            return given
        folders = [given]
    name = _scene_name(path)
    for folder in folders:
        for ending in (".osm_xy", ".osm"):
            exact = folder / f"{name}{ending}"
            if exact.is_file():
                return exact
        # maps of ZS are called ZS0 and ZS2 in one release and ZS in another; EP0
        # and EP1 are two places
        near = [
            file
            for file in sorted(folder.glob("*.osm*"))
            if is_input(folder, file) and _is_numbered(file.stem, name)
        ]
        if len({file.stem for file in near}) == 1:
            return near[-1]
    return None


def _is_numbered(one: str, other: str) -> bool:
    """True if one of two names is the other with a number behind it."""
    short, long = sorted((one, other), key=len)
    return long.removeprefix(short).isdigit() and not short[-1:].isdigit()


def _recording(name: str, rows: Rows, scene: _Scene, group: str | None) -> Recording:
    stamps, spec = rows["timestamp_ms"], scene.spec
    rows["t"] = (stamps - stamps.min()) / 1000.0
    rows["speed"] = np.hypot(rows["vx"], rows["vy"])
    tracks = tuple(
        _track(label, {field: rows[field][at] for field in rows}, scene)
        for label, at in split_tracks(scene.path, rows["track_id"], stamps, MAX_GAP_MS)
    )
    open_roads = None
    if scene.lanes is None:
        width = number(spec, "lane_width_m")
        open_roads = OpenRoads(width=width, why="no map found")
    kinds = set(np.unique(rows["agent_type"])) - {EITHER}
    return Recording(
        name=name,
        source=spec["source"],
        licence=spec["licence"],
        rate_hz=number(spec, "rate_hz"),
        tracks=tracks,
        lanes=scene.lanes or (),
        open_roads=open_roads,
        group=group,
        default_speed_limit=scene.limit,
        notes=(*scene.notes, *unknown_kinds("agent types", kinds)),
    )


def _track(name: str, rows: Rows, scene: _Scene) -> Track:
    agent = str(rows["agent_type"][0]).lower()
    kind = KINDS.get(agent, Kind.VEHICLE)
    if agent == EITHER:
        fast = number(scene.spec, "cyclist_speed_mps")
        rides = float(np.percentile(rows["speed"], 90.0)) > fast
        kind = Kind.CYCLIST if rides else Kind.PEDESTRIAN
    if np.isfinite(rows["psi_rad"]).all():
        rows["heading"] = rows["psi_rad"]
    return track_of(name, rows, kind, SIZES_M[kind])
