"""CommonRoad scenario XML, versions 2020a and 2018b.

The XML is parsed with entities, DTDs and external references forbidden. Every
obstacle becomes a Track, every lanelet a Lane, every traffic light a Signal of
the schedule written in the file, every planning problem a Ghost (the converter
removed that car from the traffic).
"""

import csv
import dataclasses
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from rcirl_jax.data.formats.commonroad.extras import (
    position,
    read_ghosts,
    read_signals,
)
from rcirl_jax.data.formats.commonroad.map import read_lanes
from rcirl_jax.data.formats.files import files_below, log_name
from rcirl_jax.data.formats.options import is_file_name, one_pattern
from rcirl_jax.data.formats.tracks import of_one_name
from rcirl_jax.data.readers.xml import Fields, read_xml
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, Recording, Track

VERSIONS = ("2018b", "2020a")
GROUPS_UP = 4  # folders above a file in which the table of groups is looked for
MAX_FILE_BYTES = 512 * 1024**2  # bytes, larger files are refused
MAX_STEP = 1e6  # of the clock: a day at 10 Hz
MAX_STANDING = 20_000_000  # samples of standing things: 500 over an hour at 10 Hz
DEFAULT_LIMIT_MPS = 29.06  # m/s, 65 mph, where the source TOML names none
# roots of what lies beside interactive scenarios: SUMO's files, solutions, other maps
OTHER_ROOTS = (
    *("net", "routes", "additional", "configuration", "sumoConfiguration"),
    *("CommonRoadSolution", "osm", "OpenDRIVE", "OpenSCENARIO"),
)
HEAD_BYTES = 65536  # bytes in which a file's root is looked for
# obstacle types; any other type that moves is a vehicle
KINDS = {
    "bicycle": Kind.CYCLIST,
    "pedestrian": Kind.PEDESTRIAN,
    "parkedvehicle": Kind.STATIC,
    "constructionzone": Kind.STATIC,
    "roadboundary": Kind.STATIC,
    "building": Kind.STATIC,
    "pillar": Kind.STATIC,
    "median_strip": Kind.STATIC,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Box:
    """A shape's box in the obstacle's own frame."""

    length: float  # m
    width: float  # m
    x: float = 0.0  # m, of the box centre, ahead of the obstacle's position
    y: float = 0.0  # m, to its left
    turn: float = 0.0  # rad, of the box against the obstacle's heading


def parts(path: Path, spec: dict) -> list[Path]:
    """The XML files but those of other formats; each can be read alone."""
    files = files_below(path, one_pattern(spec, "*.xml"))
    if path.is_dir():
        files = [file for file in files if _root_of(file) not in OTHER_ROOTS] or files
    return files


def _root_of(path: Path) -> str:
    """Name of the root element, "" where the first bytes hold none."""
    with path.open("rb") as handle:
        head = re.sub(rb"<!--.*?(-->|$)", b"", handle.read(HEAD_BYTES), flags=re.DOTALL)
    found = re.search(rb"<([A-Za-z][\w.-]*)", head)
    return "" if found is None else found[1].decode()


def own_name(file: Path) -> str:
    """Name of a log, as long as no other folder has one called alike."""
    return file.stem


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per XML file."""
    groups = _read_groups(path, spec.get("groups", ""))
    for file in parts(path, spec):
        yield validate_recording(_read_file(file, spec, groups), file)


def _read_groups(path: Path, name: str) -> dict[str, str]:
    """File name -> vehicle-disjoint group, from a CSV beside or above the files."""
    if name and not is_file_name(name):
        raise InputError(f"source TOML: groups: {name}: expected a file name")
    folder = (path if path.is_dir() else path.parent).resolve()
    for place in (folder, *folder.parents[:GROUPS_UP]):
        table = place / name
        if not (name and table.is_file()):
            continue
        try:
            with table.open(newline="", encoding="utf-8-sig") as handle:
                reader = csv.DictReader(handle)
                rows, header = list(reader), list(reader.fieldnames or [])
        except (UnicodeDecodeError, csv.Error) as error:
            raise InputError(f"{table}: {error}: expected a CSV") from error
        if not {"file", "group"} <= set(header):
            raise InputError(f"{table}: columns: {header}: expected file,group")
        for number, row in enumerate(rows, 1):
            if row["group"] is None:
                raise InputError(f"{table}: row {number}: expected file,group")
        return {row["file"]: row["group"] for row in rows}
    return {}


def _read_file(path: Path, spec: dict, groups: dict[str, str]) -> Recording:
    root, fields = read_xml(path, "commonRoad", MAX_FILE_BYTES), Fields(path)
    version = root.get("commonRoadVersion", "none")
    if version not in VERSIONS:
        raise InputError(
            f"{path}: commonRoadVersion: {version}: expected one of {VERSIONS}"
        )
    dt = _time_step(path, root)
    tracks, notes = _read_tracks(root, fields, dt)
    last = max((float(track.t[-1]) for track in tracks), default=0.0)
    group = groups.get(path.name)
    if group is None:
        group = path.stem
        notes.append("no vehicle-disjoint group given; the file is its own group")
    lanes, lane_notes = read_lanes(root, fields, spec)
    centres = {lane.id: lane.centre for lane in lanes}
    source, licence = _provenance(root.get("source", "CommonRoad"), spec)
    return Recording(
        name=log_name(path, spec, own_name(path)),
        source=f"{source} (CommonRoad {version})",
        licence=licence,
        rate_hz=1.0 / dt,
        tracks=tuple(tracks),
        lanes=lanes,
        signals=tuple(read_signals(root, fields, dt, last)),
        ghosts=tuple(read_ghosts(root, fields, dt, centres)),
        group=group,
        default_speed_limit=_usual_limit(lanes, spec),
        notes=tuple(notes + lane_notes),
    )


def _provenance(attribute: str, spec: dict) -> tuple[str, str]:
    """Source and licence texts by the file's own source attribute."""
    for rule in spec.get("provenance", []):
        if rule.get("match", "") in attribute:
            source = f"{attribute}: {rule['source']}" if "source" in rule else attribute
            return source, rule.get("licence", "unknown")
    return attribute, spec.get("licence", "unknown")


def _usual_limit(lanes: tuple[Lane, ...], spec: dict) -> float:
    """Limit [m/s] of lanes without one: the median of the file's, if any."""
    limits = [lane.speed_limit for lane in lanes if lane.speed_limit is not None]
    if limits:
        return float(np.median(limits))
    return float(spec.get("default_speed_limit", DEFAULT_LIMIT_MPS))


def _time_step(path: Path, root: Element) -> float:
    text = root.get("timeStepSize", "missing")
    try:
        dt = float(text)
    except ValueError:
        dt = -1.0
    if not 0.001 <= dt <= 1.0:
        raise InputError(f"{path}: timeStepSize: {text}: expected 0.001 to 1 s")
    return dt


def _is_standing(element: Element, fields: Fields) -> bool | None:
    """Whether an obstacle element stands for ever; None for other elements."""
    if element.tag == "obstacle":
        role = (element.findtext("role") or "none").strip()
        if role not in ("dynamic", "static"):
            raise InputError(
                f"{fields.path}: obstacle {element.get('id')}: role: {role}: "
                "expected dynamic or static"
            )
    elif element.tag in ("dynamicObstacle", "staticObstacle"):
        role = element.tag.removesuffix("Obstacle")
    else:
        return None
    kind = (element.findtext("type") or "").strip().lower()
    return role == "static" or KINDS.get(kind) == Kind.STATIC


def _read_tracks(
    root: Element, fields: Fields, dt: float
) -> tuple[list[Track], list[str]]:
    tracks, standing, unrecorded, doubled = [], [], 0, 0
    for element in root:
        stands = _is_standing(element, fields)
        if stands:
            standing.append(element)
        elif stands is False and element.find("trajectory") is not None:
            track, again = _read_moving(element, fields, dt)
            tracks.append(track)
            doubled += again
        elif stands is False:
            unrecorded += 1
    first = min((float(track.t[0]) for track in tracks), default=0.0)
    last = max((float(track.t[-1]) for track in tracks), default=0.0)
    clock = np.arange(round(first / dt), round(last / dt) + 1) * dt
    if len(standing) * clock.size > MAX_STANDING:
        raise InputError(
            f"{fields.path}: obstacles: {len(standing)} static ones over {clock.size} "
            f"steps: expected up to {MAX_STANDING} samples"
        )
    tracks += [_read_standing(element, fields, clock) for element in standing]
    tracks, notes = of_one_name(tracks)
    if doubled:
        notes.append(f"{doubled} states of a step met twice, one used")
    if regions := _regions(root):
        notes.append(f"{regions} states in a region, taken to be in its middle")
    if unrecorded:
        notes.append(f"{unrecorded} obstacles without a trajectory left out")
    return tracks, notes


def _regions(root: Element) -> int:
    """How many states have a region for a place."""
    states = (state for tag in ("initialState", "state") for state in root.iter(tag))
    places = (state.find("position") for state in states)
    return sum(place is not None and place.find("point") is None for place in places)


def _read_moving(element: Element, fields: Fields, dt: float) -> tuple[Track, int]:
    """A track, and how many of its states were left out."""
    where = f"obstacle {element.get('id')}"
    states = [fields.child(element, "initialState", where)]
    states += element.iterfind("trajectory/state")
    rows = np.array([_read_state(state, fields, where, dt) for state in states])
    rows = rows[np.append(True, np.diff(rows[:, 0]) != 0.0)]  # the first of a step
    backwards = np.flatnonzero(np.diff(rows[:, 0]) <= 0.0)
    if backwards.size:
        step = rows[backwards[0] + 1, 0] / dt
        raise InputError(
            f"{fields.path}: {where}: time: {step:g}: expected increasing steps"
        )
    kind = (element.findtext("type") or "unknown").strip().lower()
    track = _track(element, fields, KINDS.get(kind, Kind.VEHICLE), rows.T.copy())
    return track, len(states) - len(rows)


def _read_state(state: Element, fields: Fields, where: str, dt: float) -> tuple:
    step = fields.scalar(state, "time", where)
    if abs(step) > MAX_STEP:
        raise InputError(
            f"{fields.path}: {where}: time: {step:g}: expected steps up to {MAX_STEP:g}"
        )
    where = f"{where}: state {step:g}"
    x, y = position(state, fields, where)
    heading = fields.scalar(state, "orientation", where)
    return step * dt, x, y, heading, fields.scalar(state, "velocity", where)


def _read_standing(element: Element, fields: Fields, clock: np.ndarray) -> Track:
    where = f"obstacle {element.get('id')}"
    state = fields.child(element, "initialState", where)
    x, y = position(state, fields, where)
    heading = fields.scalar(state, "orientation", where)
    still = [np.full(clock.shape, value) for value in (x, y, heading, 0.0)]
    return _track(element, fields, Kind.STATIC, (clock, *still))


def _track(element: Element, fields: Fields, kind: Kind, series: Iterable) -> Track:
    """A track whose positions are those of the box centre."""
    name = element.get("id")
    if name is None:
        raise InputError(f"{fields.path}: {element.tag}: id: missing: expected it")
    box = _read_shape(element, fields, f"obstacle {name}")
    t, x, y, heading, speed = series
    return Track(
        id=name,
        kind=kind,
        length=box.length,
        width=box.width,
        t=t,
        x=x + box.x * np.cos(heading) - box.y * np.sin(heading),
        y=y + box.x * np.sin(heading) + box.y * np.cos(heading),
        heading=heading + box.turn,
        speed=speed,
    )


def _read_shape(element: Element, fields: Fields, where: str) -> _Box:
    where = f"{where}: shape"
    shape = fields.child(element, "shape", where)
    box, circle = shape.find("rectangle"), shape.find("circle")
    if box is not None:
        x, y = _centre(box, fields, where)
        turn = box.find("orientation")
        return _Box(
            length=fields.number(fields.child(box, "length", where), where),
            width=fields.number(fields.child(box, "width", where), where),
            x=x,
            y=y,
            turn=0.0 if turn is None else fields.number(turn, where),
        )
    if circle is not None:
        size = 2.0 * fields.number(fields.child(circle, "radius", where), where)
        x, y = _centre(circle, fields, where)
        return _Box(length=size, width=size, x=x, y=y)
    points = [fields.point(point, where) for point in shape.iterfind("polygon/point")]
    if not points:
        found = ", ".join(child.tag for child in shape) or "nothing"
        raise InputError(
            f"{fields.path}: {where}: {found}: expected rectangle, circle or polygon"
        )
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    (length, width), (x, y) = high - low, 0.5 * (high + low)
    return _Box(length=float(length), width=float(width), x=float(x), y=float(y))


def _centre(shape: Element, fields: Fields, where: str) -> tuple[float, float]:
    centre = shape.find("center")
    return (0.0, 0.0) if centre is None else fields.point(centre, where)
