"""leveLXData drone recordings: highD, inD, rounD, exiD and uniD.

Each recording is three CSV files, XX_tracks, XX_tracksMeta, XX_recordingMeta;
the header of the first tells the two layouts apart. Specification: the format
pages of www.highd-dataset.com and levelxdata.com, and the tools
RobertKrajewski/highD-dataset and ika-rwth-aachen/drone-dataset-tools.

Traps, highD: x, y is the bounding box's upper-left corner, `width` is the
length along x, `height` the width of the car, y points down (ours up), frames
start at 1, speedLimit -1 means none. inD and its sisters: x, y is the centre,
heading is in degrees, width and length of pedestrians and cyclists are 0, lists
are separated by semicolons, the map is a Lanelet2 file of the location in
degrees, moved by the recording's UTM origin, a trailer is a track of its own.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.declared import (
    KINDS,
    Columns,
    Rows,
    open_log,
    unknown_kinds,
)
from rcirl_jax.data.formats.files import files_below, log_name
from rcirl_jax.data.formats.lanelet2.map import read_lanelet2
from rcirl_jax.data.formats.levelx.map import find_map, marked_lanes
from rcirl_jax.data.formats.options import number
from rcirl_jax.data.formats.paths import path_lanes
from rcirl_jax.data.formats.projection import utm, utm_zone
from rcirl_jax.data.formats.tracks import split_tracks, travel_heading
from rcirl_jax.data.readers.tables.rows import RowStats, attach_row_stats
from rcirl_jax.data.readers.tables.table import (
    MAX_PLACE_M,
    Table,
    fields_of,
    open_table,
    read,
)
from rcirl_jax.data.recording import check_span, validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, Recording, Track

SUFFIX, USERS, META = "_tracks.csv", "_tracksMeta.csv", "_recordingMeta.csv"
MOVES = {"vx": "speed", "vy": "speed"}
CORNER = Columns(
    needed={
        **{"frame": "time", "id": "number", "x": "place", "y": "place"},
        **{"length": "place", "width": "place", **MOVES},
    },
    called={"length": "width", "width": "height", "vx": "xVelocity", "vy": "yVelocity"},
    t="frame",
    name_of="{:g}".format,
)
CENTRE = Columns(
    needed={
        **{"frame": "time", "id": "number", "x": "place", "y": "place"},
        **{"heading": "number", "width": "place", "length": "place", **MOVES},
    },
    called={
        **{"id": "trackId", "x": "xCenter", "y": "yCenter"},
        **{"vx": "xVelocity", "vy": "yVelocity"},
    },
    t="frame",
    name_of="{:g}".format,
)
LIFE = ("numFrames", "initialFrame", "finalFrame")  # of a track, in tracksMeta
MAX_GAP_FRAMES = 5.5  # frames missing inside one track
MAX_ID = 2**53  # beyond it float64 does not count
FAR_M = 200.0  # m; a map that far from all tracks is not theirs
SIZE_M = (0.5, 0.5)  # m, length and width of a road user without a box


@dataclasses.dataclass(frozen=True, kw_only=True)
class _User:
    """One row of a tracksMeta.csv."""

    kind: str  # class in lower case
    direction: float  # highD's drivingDirection, 1 towards -x; else 0
    life: tuple[float, float, float]  # its LIFE


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Meta:
    """The one row of a recordingMeta.csv, as text."""

    path: Path
    cells: Mapping[str, str]

    def number(self, field: str, limit: float = np.inf) -> float:
        """A number, finite and within a limit."""
        found = self.cells.get(field, "missing")[:40]
        try:
            value = float(self.cells.get(field, "nan"))
        except ValueError:
            value = float("nan")
        if not (np.isfinite(value) and abs(value) <= limit):
            kind = "finite number" if limit == np.inf else f"number within {limit:g}"
            raise InputError(f"{self.path}: {field}: '{found}': expected a {kind}")
        return value

    @property
    def rate(self) -> float:
        """Frames per second."""
        rate = self.number("frameRate")
        if not 1.0 <= rate <= 1000.0:
            raise InputError(
                f"{self.path}: frameRate: {rate:g}: expected 1 to 1000 1/s"
            )
        return rate

    @property
    def limit(self) -> float | None:
        """The speed limit [m/s]; -1 stands for none."""
        if self.cells.get("speedLimit", "").lower() in ("", "nan"):
            return None
        limit = self.number("speedLimit")
        return limit if limit > 0.0 else None


def parts(path: Path, spec: dict) -> list[Path]:
    """The XX_tracks.csv at any depth of a folder: releases keep them in data/."""
    return files_below(path, "*" + SUFFIX)


def own_name(file: Path) -> str:
    """Name of a log, as long as no other folder has one called alike."""
    return file.name.removesuffix(SUFFIX)


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per XX_tracks.csv."""
    for file in parts(path, spec):
        if not file.name.endswith(SUFFIX):
            raise InputError(f"{file}: name: {file.name}: expected XX{SUFFIX}")
        table, stats = open_log(file, spec)
        made = _recording(table, spec, stats)
        yield validate_recording(attach_row_stats(made, stats), file)


def _other(path: Path, suffix: str) -> Path:
    """The name of the same recording's file with another ending."""
    return path.with_name(path.name.removesuffix(SUFFIX) + suffix)


def _beside(path: Path, suffix: str) -> Path:
    """The file of the same recording with another ending."""
    other = _other(path, suffix)
    if not other.is_file():
        raise InputError(f"{other}: input: missing: expected it beside {path.name}")
    return other


def _read_meta(path: Path) -> _Meta:
    table = open_table(path, {"delimiter": ","})  # semicolons stand inside of cells
    sizes = [len(row) for row in table.head]
    if sizes != [len(table.header)]:
        raise InputError(
            f"{path}: rows: {len(sizes)} of {sizes[:3]} cells: "
            f"expected one of {len(table.header)}"
        )
    texts = map(str.strip, table.head[0])
    return _Meta(path=path, cells=dict(zip(table.header, texts, strict=True)))


def _recording(table: Table, spec: dict, stats: RowStats) -> Recording:
    """Boxes by their corners (highD), or by their centres (inD and its sisters)."""
    path, is_corner = table.path, "xCenter" not in table.header
    columns = CORNER if is_corner else CENTRE
    rows = columns.read(table, stats)
    direction = "drivingDirection" if is_corner else None
    users = _read_users(_beside(path, USERS), columns.called.get("id", "id"), direction)
    meta = _read_meta(_beside(path, META))
    rate = meta.rate
    rows["t"] = (rows["frame"] - rows["frame"].min()) / rate
    if is_corner:
        rows["x"] = rows["x"] + 0.5 * rows["length"]
        rows["y"] = -(rows["y"] + 0.5 * rows["width"])
    ids, pieces = _pieces(path, rows["id"], rows["frame"], users, spec)
    tracks = [
        _track(name, {n: rows[n][part] for n in rows}, users[int(ids[part[0]])], spec)
        for name, part in pieces
    ]
    limit = meta.limit
    if is_corner:
        check_span(str(path), "x", rows["x"])
        along = (float(rows["x"].min()), float(rows["x"].max()))
        velocities = (rows["y"], rows["vx"])
        lanes = marked_lanes(meta.path, meta.cells, along, limit, velocities)
        notes = []
    else:
        lanes, notes = _mapped_lanes(path, meta, tracks, spec)
    default = number(spec, "default_speed_limit")
    return Recording(
        name=log_name(path, spec, own_name(path)),
        source=spec["source"],
        licence=spec["licence"],
        rate_hz=rate,
        tracks=tuple(tracks),
        lanes=lanes,
        default_speed_limit=limit if limit is not None else default,
        notes=(*notes, *_user_notes(set(ids.tolist()), users)),
    )


def _track(name: str, rows: Rows, user: _User, spec: dict) -> Track:
    """One road user without a gap."""
    t, x, y = rows["t"], rows["x"], rows["y"]
    size = [float(np.median(rows[field])) for field in ("length", "width")]
    is_boxed = min(size) > 0.0
    if not is_boxed:
        default = spec.get("sizes", {}).get(user.kind, SIZE_M)
        size = [
            found or float(given) for found, given in zip(size, default, strict=True)
        ]
    heading, standing = None, np.pi if user.direction == 1.0 else 0.0
    if "heading" in rows:
        heading = np.deg2rad(rows["heading"])
        standing = float(heading[0])
    # a road user without a box has no heading either
    if heading is None or (not is_boxed and np.ptp(heading) == 0.0):
        heading = travel_heading(t, x, y, standing)
    return Track(
        id=name,
        kind=KINDS.get(user.kind, Kind.VEHICLE),
        length=size[0],
        width=size[1],
        size_assumed=not is_boxed,
        t=t,
        x=x,
        y=y,
        heading=heading,
        speed=np.hypot(rows["vx"], rows["vy"]),
    )


def _read_users(path: Path, key: str, direction: str | None) -> dict[int, _User]:
    """Track number -> what tracksMeta says of it."""
    rows, *ends = LIFE
    wanted = {key: "number", "class": "text", **dict.fromkeys(ends, "number")}
    wanted |= {direction: "number"} if direction else {}
    source = open_table(path)
    fields = fields_of(source, wanted, {rows: "number"})
    table = read(source, fields, RowStats(path=path, allowed=0.0))
    first, last = (table[end] for end in ends)
    lives = zip(table.get(rows, last - first + 1.0), first, last, strict=True)
    towards = table[direction] if direction else np.zeros(table[key].size)
    kinds = np.char.lower(table["class"])
    return {
        int(name): _User(kind=str(kind), direction=float(way), life=life)
        for name, kind, way, life in zip(table[key], kinds, towards, lives, strict=True)
    }


def _pieces(
    path: Path, names: np.ndarray, frames: np.ndarray, users: dict, spec: dict
) -> tuple[np.ndarray, list[tuple[str, np.ndarray]]]:
    """Track numbers per row, and the rows of each track without a gap."""
    wrong = np.flatnonzero((names != np.round(names)) | (np.abs(names) > MAX_ID))
    if wrong.size:
        raise InputError(
            f"{path}: track number: {names[wrong[0]]:g}: expected a whole number"
        )
    ids = names.astype(np.int64)
    unknown = sorted(set(np.unique(ids).tolist()) - set(users))
    if unknown:
        raise InputError(
            f"{path}: track {unknown[0]}: no row in {_other(path, USERS).name}: "
            "expected one per track"
        )
    pieces = split_tracks(path, ids, frames, MAX_GAP_FRAMES)
    if not spec.get("partial", False):
        _check_whole(path, ids, frames, users)
    return ids, pieces


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
                    f"{expected:.12g} as in {_other(path, USERS).name}; truncated "
                    "file? (of a sample, set partial = true in the source TOML)"
                )


def _user_notes(met: set[int], users: dict[int, _User]) -> list[str]:
    """Tracks without rows, classes that this module does not know, and trailers."""
    missing = len(set(users) - met)
    notes = [f"{missing} tracks of tracksMeta have no rows"] if missing else []
    notes += unknown_kinds("classes", {user.kind for user in users.values()})
    trailers = sum(users[number].kind == "trailer" for number in met)
    if trailers:
        notes.append(f"{trailers} trailers are obstacles of kind cyclist, no experts")
    return notes


def _mapped_lanes(
    path: Path, meta: _Meta, tracks: list[Track], spec: dict
) -> tuple[tuple[Lane, ...], list[str]]:
    """Lanes of the location's Lanelet2 map; else fitted to the paths driven."""
    place = find_map(path, meta.cells.get("locationId", ""), spec)
    why = "no map found"
    if place is not None:
        zone = utm_zone(meta.number("lonLocation", 180.0))
        fields = ("xUtmOrigin", "yUtmOrigin")
        origin = np.array([meta.number(field, MAX_PLACE_M) for field in fields])
        lanes, notes = read_lanelet2(place, lambda a, b: utm(a, b, zone) - origin)
        middle = [np.median([np.median(getattr(t, c)) for t in tracks]) for c in "xy"]
        apart = (float(np.min(np.hypot(*(ln.centre - middle).T))) for ln in lanes)
        if min(apart) < FAR_M:
            return lanes, notes
        why = f"{place.name} lies elsewhere"
    width = number(spec, "lane_width_m")
    lanes = path_lanes(tracks, width, None)
    return lanes, [f"{why}; {len(lanes)} lanes fitted to the longest paths"]
