"""leveLXData drone recordings: highD, inD, rounD, exiD and uniD.

Each recording is three CSV files, XX_tracks, XX_tracksMeta, XX_recordingMeta;
the header of the first tells the two layouts apart. Specification: the format
pages of www.highd-dataset.com and levelxdata.com.

Traps, highD: x, y is the bounding box's upper-left corner, `width` is the
length along x, `height` the width of the car, y points down (ours up), frames
start at 1, speedLimit -1 means none. inD and its sisters: x, y is the centre,
heading is in degrees, width and length of pedestrians and cyclists are 0, lists
are separated by semicolons, the map is a Lanelet2 file of the location in
degrees, moved by the recording's UTM origin, a trailer is a track of its own.
"""

import dataclasses
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.declared import (
    KINDS,
    open_log,
    read_log,
    size_of,
    track_of,
    unknown_kinds,
)
from rcirl_jax.data.formats.files import files_below, given_map, log_name
from rcirl_jax.data.formats.lanelet2 import read_lanelet2
from rcirl_jax.data.formats.lanes import StraightLane, parallel_lane
from rcirl_jax.data.formats.options import number
from rcirl_jax.data.formats.projection import utm, utm_zone
from rcirl_jax.data.formats.tracks import split_tracks
from rcirl_jax.data.readers.tables.rows import Rows, RowStats, attach_row_stats
from rcirl_jax.data.readers.tables.table import Table, fields_of, open_table, read
from rcirl_jax.data.recording import check_lanes_length, check_span, validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, OpenRoads, Recording, Track

SUFFIX, USERS, META = "_tracks.csv", "_tracksMeta.csv", "_recordingMeta.csv"
NEEDED = {
    **{"frame": "time", "id": "number", "x": "place", "y": "place"},
    **{"length": "place", "width": "place", "vx": "speed", "vy": "speed"},
}
VELOCITY = {"vx": "xVelocity", "vy": "yVelocity"}
CORNER = {"length": "width", "width": "height", **VELOCITY}  # highD's columns
CENTRE = {"id": "trackId", "x": "xCenter", "y": "yCenter", **VELOCITY}
# of the map's frame, in recordingMeta
ORIGIN = {"lonLocation": "longitude", "xUtmOrigin": "place", "yUtmOrigin": "place"}
LIFE = ("numFrames", "initialFrame", "finalFrame")  # of a track, in tracksMeta
MAX_GAP_FRAMES = 5.5  # frames missing inside one track
MAX_ID = 2**53  # beyond it float64 does not count
FAR_M = 200.0  # m; a map that far from all tracks is not theirs
SIZE_M = (0.5, 0.5)  # m, length and width of a road user without a box
MARGIN_M = 50.0  # m of lane beyond the first and last position
MAP_FOLDERS = ("maps", "lanelets", "lanelet2")
# highD: the upper carriageway is driven towards -x, the lower towards +x
SIDES = {"upper": -1.0, "lower": 1.0}


@dataclasses.dataclass(frozen=True, kw_only=True)
class _User:
    """One row of a tracksMeta.csv."""

    kind: str  # class in lower case
    direction: float  # highD's drivingDirection, 1 towards -x; else 0
    life: tuple[float, float, float]  # its LIFE


def parts(path: Path, spec: dict) -> list[Path]:
    """Returns XX_tracks.csv at any depth of a folder: releases keep them in data/."""
    return files_below(path, "*" + SUFFIX)


def own_name(file: Path) -> str:
    """Returns the name of a log, as long as no other folder has one called alike."""
    return file.name.removesuffix(SUFFIX)


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per XX_tracks.csv."""
    for file in parts(path, spec):
        if not file.name.endswith(SUFFIX):
            raise InputError(f"{file}: name: {file.name}: expected XX{SUFFIX}")
        table, stats = open_log(file, spec)
        made = _recording(table, spec, stats)
        yield validate_recording(attach_row_stats(made, stats), file)


def _beside(path: Path, suffix: str) -> Path:
    """The file of the same recording with another ending."""
    other = path.with_name(own_name(path) + suffix)
    if not other.is_file():
        raise InputError(f"{other}: input: missing: expected it beside {path.name}")
    return other


def _recording(table: Table, spec: dict, stats: RowStats) -> Recording:
    """Boxes by their corners (highD), or by their centres (inD and its sisters)."""
    path, is_corner = table.path, "xCenter" not in table.header
    columns = CORNER if is_corner else CENTRE
    needed = NEEDED if is_corner else {**NEEDED, "heading": "number"}
    options = {"t": "frame", "name_of": "{:g}".format}
    rows = read_log(table, stats, needed, columns=columns, **options)
    direction = "drivingDirection" if is_corner else None
    users = _read_users(_beside(path, USERS), columns.get("id", "id"), direction)
    # semicolons stand inside of cells
    about = open_table(_beside(path, META), {"delimiter": ","})
    meta = _read_meta(about, {} if is_corner else ORIGIN)
    rate = meta["frameRate"]
    if not 1.0 <= rate <= 1000.0:
        raise InputError(f"{about.path}: frameRate: {rate:g}: expected 1 to 1000 1/s")
    limit = meta.get("speedLimit", np.nan)
    limit = float(limit) if limit > 0.0 else None  # -1 stands for none
    rows["t"] = (rows["frame"] - rows["frame"].min()) / rate
    rows["speed"] = np.hypot(rows["vx"], rows["vy"])
    if is_corner:
        rows["x"] = rows["x"] + 0.5 * rows["length"]
        rows["y"] = -(rows["y"] + 0.5 * rows["width"])
    else:
        rows["heading"] = np.deg2rad(rows["heading"])
    ids = _ids(path, rows, users)
    tracks = [
        _track(name, {n: rows[n][part] for n in rows}, users[int(ids[part[0]])], spec)
        for name, part in split_tracks(path, ids, rows["frame"], MAX_GAP_FRAMES)
    ]
    if not spec.get("partial", False):
        _check_whole(path, ids, rows["frame"], users)
    if is_corner:
        sides = {side: _markings(about, f"{side}LaneMarkings") for side in SIDES}
        lanes, notes = _marked_lanes(path, sides, rows, limit), []
        open_roads = None
    else:
        lanes, open_roads, notes = _mapped_lanes(about, meta, tracks, spec)
    met = set(ids.tolist())
    missing = len(set(users) - met)
    notes += [f"{missing} tracks of tracksMeta have no rows"] if missing else []
    notes += unknown_kinds("classes", {user.kind for user in users.values()})
    if trailers := sum(users[number].kind == "trailer" for number in met):
        notes += [f"{trailers} trailers are obstacles of kind cyclist, no experts"]
    return Recording(
        name=log_name(path, spec, own_name(path)),
        source=spec["source"],
        licence=spec["licence"],
        rate_hz=rate,
        tracks=tuple(tracks),
        lanes=lanes,
        open_roads=open_roads,
        default_speed_limit=limit or number(spec, "default_speed_limit"),
        notes=tuple(notes),
    )


def _read_meta(table: Table, origin: Mapping[str, str]) -> dict[str, float]:
    """The numbers of the one row of a recordingMeta.csv."""
    fields = fields_of(
        table, {"frameRate": "number", **origin}, {"speedLimit": "number"}
    )
    rows = read(table, fields, RowStats(path=table.path, allowed=0.0))
    if rows["frameRate"].size != 1:
        raise InputError(f"{table.path}: rows: several: expected one")
    return {name: float(column[0]) for name, column in rows.items()}


def _track(name: str, rows: Rows, user: _User, spec: dict) -> Track:
    """One road user without a gap; without a box it has no heading either."""
    usual = spec.get("sizes", {}).get(user.kind, SIZE_M)
    kind = KINDS.get(user.kind, Kind.VEHICLE)
    standing = np.pi if user.direction == 1.0 else 0.0
    heading = rows.get("heading")
    if heading is not None and size_of(rows, usual)[2] and np.ptp(heading) == 0.0:
        standing = float(heading[0])
        del rows["heading"]
    return track_of(name, rows, kind, usual, standing=standing)


def _read_users(path: Path, key: str, direction: str | None) -> dict[int, _User]:
    """Track number -> what tracksMeta says of it."""
    rows, *ends = LIFE
    wanted = {key: "number", "class": "text", **dict.fromkeys(ends, "number")}
    wanted |= {direction: "number"} if direction else {}
    source = open_table(path)
    fields = fields_of(source, wanted, {rows: "number"}, lower=True)
    table = read(source, fields, RowStats(path=path, allowed=0.0))
    first, last = (table[end] for end in ends)
    lives = zip(table.get(rows, last - first + 1.0), first, last, strict=True)
    towards = table[direction] if direction else np.zeros(table[key].size)
    return {
        int(name): _User(kind=str(kind), direction=float(way), life=life)
        for name, kind, way, life in zip(
            table[key], table["class"], towards, lives, strict=True
        )
    }


def _ids(path: Path, rows: Rows, users: dict[int, _User]) -> np.ndarray:
    """Track numbers [n], each of which tracksMeta knows."""
    names = rows["id"]
    wrong = np.flatnonzero((names != np.round(names)) | (np.abs(names) > MAX_ID))
    if wrong.size:
        raise InputError(
            f"{path}: track number: {names[wrong[0]]:g}: expected a whole number"
        )
    ids = names.astype(np.int64)
    unknown = sorted(set(np.unique(ids).tolist()) - set(users))
    if unknown:
        raise InputError(
            f"{path}: track {unknown[0]}: no row in {own_name(path)}{USERS}: "
            "expected one per track"
        )
    return ids


def _check_whole(
    path: Path, ids: np.ndarray, frames: np.ndarray, users: dict[int, _User]
) -> None:
    """Every track has the rows that tracksMeta counts: nothing was cut off."""
    order = np.lexsort((frames, ids))
    known, starts, counts = np.unique(ids[order], return_index=True, return_counts=True)
    ends = frames[order][starts], frames[order][starts + counts - 1]
    found = dict(zip(known.tolist(), zip(counts, *ends, strict=True), strict=True))
    for name, user in users.items():
        life = found.get(name, (0, np.nan, np.nan))
        for field, value, expected in zip(LIFE, life, user.life, strict=True):
            if value != expected:
                raise InputError(
                    f"{path}: track {name}: {field}: {value:.12g}: expected "
                    f"{expected:.12g} as in {own_name(path)}{USERS}; truncated "
                    "file? (of a sample, set partial = true in the source TOML)"
                )


def _marked_lanes(
    path: Path, sides: Mapping[str, np.ndarray], rows: Rows, limit: float | None
) -> tuple[Lane, ...]:
    """highD: straight lanes between the markings, named as `laneId` names them.

    A carriageway (`sides`, `_markings` of each) is driven the way its rows are.
    """
    check_span(str(path), "x", rows["x"])
    lower, upper = float(rows["x"].min()), float(rows["x"].max())
    count = sum(marks.size - 1 for marks in sides.values())
    check_lanes_length(str(path), count * (upper - lower + 2.0 * MARGIN_M))
    lanes: list[Lane] = []
    first = 2  # lane 1 lies above the first marking
    for side, marks in sides.items():
        inside = (rows["y"] <= marks[0]) & (rows["y"] >= marks[-1])
        travel = np.median(rows["vx"][inside]) if inside.any() else SIDES[side]
        names = range(first, first + marks.size - 1)
        for name, above, below in zip(names, marks, marks[1:], strict=False):
            # the lane above (smaller number) is to the left of one driven towards +x
            around = [name - 1, name + 1] if travel > 0.0 else [name + 1, name - 1]
            lane = StraightLane(
                id=str(name),
                y=0.5 * (above + below),
                lower=lower - MARGIN_M,
                upper=upper + MARGIN_M,
                forward=bool(travel > 0.0),
            )
            half = 0.5 * (above - below)
            ids = [str(n) if n in names else None for n in around]
            lanes.append(parallel_lane(lane, (half, half), ids, limit))
        first += marks.size
    return tuple(lanes)


def _markings(table: Table, field: str) -> np.ndarray:
    """[m] m, y of the markings from top to bottom (y up)."""
    (text,) = table.samples(field) or [""]
    try:
        marks = -np.array([float(mark) for mark in text.split(";") if mark.strip()])
    except ValueError:
        marks = np.zeros(0)
    if marks.size < 2 or not np.isfinite(marks).all() or np.any(np.diff(marks) >= 0.0):
        raise InputError(
            f"{table.path}: {field}: '{text[:60]}': expected at least two increasing "
            "numbers separated by ;"
        )
    return marks


def _mapped_lanes(
    table: Table, meta: Mapping[str, float], tracks: list[Track], spec: dict
) -> tuple[tuple[Lane, ...], OpenRoads | None, list[str]]:
    """Lanes of the location's Lanelet2 map; else they are open."""
    location = table.samples("locationId") if table.has("locationId") else [""]
    place, why = _find_map(table.path, location[0], spec), "no map found"
    if place is not None:
        zone = utm_zone(meta["lonLocation"])
        origin = np.array([meta["xUtmOrigin"], meta["yUtmOrigin"]])
        lanes, notes = read_lanelet2(place, lambda a, b: utm(a, b, zone) - origin)
        middle = [np.median([np.median(getattr(t, c)) for t in tracks]) for c in "xy"]
        apart = (float(np.min(np.hypot(*(ln.centre - middle).T))) for ln in lanes)
        if min(apart) < FAR_M:
            return lanes, None, notes
        why = f"{place.name} lies elsewhere"
    return (), OpenRoads(width=number(spec, "lane_width_m"), why=why), []


def _find_map(path: Path, location: str, spec: dict) -> Path | None:
    """The Lanelet2 map of a recording's location, or None.

    The releases keep maps/lanelets/04_aseag/location4.osm (or
    lanelets/location4.osm) beside the folder `data`. The option `map` names a
    file, or a folder to look into.
    """
    if (given := given_map(spec)) is not None:
        if given.is_file():
            return given
        return _of_location(sorted(given.rglob("*.osm")), location)
    folder, found = path.resolve().parent, None
    for place in (folder, folder.parent):
        maps = [*sorted(place.glob("*.osm"))]
        for name in MAP_FOLDERS:
            maps += sorted((place / name).rglob("*.osm"))
        found = found or _of_location(maps, location)
    return found


def _of_location(files: list[Path], location: str) -> Path | None:
    """locationN.osm; else the only map in a folder named N_..., N_*.osm, *_N.osm."""
    digits = location.split(".")[0].lstrip("0") or "0"
    forms = (
        rf".*/location_?0*{digits}",
        rf"0*{digits}_.*/(?!location).*",
        rf".*/0*{digits}_.*",
        rf".*/.*_0*{digits}",
    )
    for form in forms if digits.isdigit() else ():
        for file in files:
            name = f"{file.parent.name}/{file.stem}"
            if re.fullmatch(form, name, flags=re.IGNORECASE):
                return file
    return None
