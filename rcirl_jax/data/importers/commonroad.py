"""CommonRoad scenario XML, versions 2020a and 2018b.

The XML is parsed with entities, DTDs and external references forbidden. Every
obstacle becomes a Track, every lanelet a Lane, every traffic light a Signal of
the schedule written in the file, every planning problem a Ghost (the converter
removed that car from the traffic).
"""

import csv
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import numpy as np

from rcirl_jax.data.importers.files import input_files
from rcirl_jax.data.importers.lanelets import read_lanes
from rcirl_jax.data.importers.xml_fields import Fields
from rcirl_jax.errors import InputError
from rcirl_jax.types import Ghost, Kind, Recording, Signal, Track

VERSIONS = ("2018b", "2020a")
MAX_FILE_BYTES = 512 * 1024**2  # bytes, larger files are refused
COLOURS = {
    "red": "red",
    "redyellow": "red",
    "yellow": "yellow",
    "green": "green",
    "inactive": "off",
}
KINDS = {
    "bicycle": Kind.CYCLIST,
    "motorcycle": Kind.VEHICLE,
    "pedestrian": Kind.PEDESTRIAN,
    "car": Kind.VEHICLE,
    "truck": Kind.VEHICLE,
    "bus": Kind.VEHICLE,
    "taxi": Kind.VEHICLE,
    "priorityvehicle": Kind.VEHICLE,
    "train": Kind.VEHICLE,
}


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """One Recording per XML file."""
    files = input_files(path, spec.get("pattern", "*.xml"))
    groups = _read_groups(path, spec.get("groups", ""))
    for file in files:
        yield _read_file(file, spec, groups)


def _read_groups(path: Path, name: str) -> dict[str, str]:
    folder = path if path.is_dir() else path.parent
    for place in (folder, folder.parent):
        table = place / name
        if name and table.is_file():
            with table.open(newline="", encoding="utf-8") as handle:
                rows = list(csv.DictReader(handle))
            if rows and not {"file", "group"} <= set(rows[0]):
                raise InputError(f"{table}: columns: expected file,group")
            return {row["file"]: row["group"] for row in rows}
    return {}


def parse_xml(path: Path) -> Element:
    """The root element, with entities and external references forbidden."""
    from defusedxml import DefusedXmlException
    from defusedxml import ElementTree as Safe

    if path.stat().st_size > MAX_FILE_BYTES:
        raise InputError(f"{path}: larger than {MAX_FILE_BYTES} bytes: refused")
    try:
        root = Safe.parse(path, forbid_dtd=True).getroot()
    except DefusedXmlException as error:
        kind = type(error).__name__
        raise InputError(f"{path}: {kind}: expected XML without DTD") from error
    except (ParseError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path}: {error}: expected well-formed XML") from error
    if root is None or root.tag != "commonRoad":
        tag = "nothing" if root is None else root.tag
        raise InputError(f"{path}: root: {tag}: expected commonRoad")
    return root


def _read_file(path: Path, spec: dict, groups: dict[str, str]) -> Recording:
    root, fields = parse_xml(path), Fields(path)
    version = root.get("commonRoadVersion", "none")
    if version not in VERSIONS:
        raise InputError(
            f"{path}: commonRoadVersion: {version}: expected one of {VERSIONS}"
        )
    dt = _time_step(path, root)
    tracks = _read_tracks(root, fields, dt)
    if not tracks:
        raise InputError(f"{path}: dynamicObstacle: none: expected road users")
    last = max(float(track.t[-1]) for track in tracks)
    notes = []
    group = groups.get(path.name)
    if group is None:
        group = path.stem
        notes.append("no vehicle-disjoint group given; the file is its own group")
    lanes, lane_notes = read_lanes(root, fields, spec)
    return Recording(
        name=path.stem,
        source=root.get("source", "CommonRoad") + f" ({version})",
        licence=spec.get("licence", "unknown"),
        rate_hz=1.0 / dt,
        tracks=tuple(tracks),
        lanes=lanes,
        signals=tuple(_read_signals(root, fields, dt, last)),
        ghosts=tuple(_read_ghosts(root, fields, dt)),
        group=group,
        default_speed_limit=float(spec.get("default_speed_limit", 29.06)),
        notes=tuple(notes + lane_notes),
    )


def _time_step(path: Path, root: Element) -> float:
    text = root.get("timeStepSize", "missing")
    try:
        dt = float(text)
    except ValueError:
        dt = -1.0
    if not 0.001 <= dt <= 1.0:
        raise InputError(f"{path}: timeStepSize: {text}: expected 0.001 to 1 s")
    return dt


def _read_tracks(root: Element, fields: Fields, dt: float) -> list[Track]:
    tracks, standing = [], []
    for element in root:
        role = (element.findtext("role") or "").strip()
        if element.tag == "dynamicObstacle" or role == "dynamic":
            tracks.append(_read_moving(element, fields, dt))
        elif element.tag == "staticObstacle" or role == "static":
            standing.append(element)
    last = max((float(track.t[-1]) for track in tracks), default=0.0)
    tracks += [_read_standing(element, fields, dt, last) for element in standing]
    seen: set[str] = set()
    for track in tracks:
        if track.id in seen:
            raise InputError(f"{fields.path}: obstacle id: {track.id}: met twice")
        seen.add(track.id)
    return tracks


def _read_moving(element: Element, fields: Fields, dt: float) -> Track:
    name = element.get("id", "(no id)")
    where = f"obstacle {name}"
    states = [fields.child(element, "initialState", where)]
    trajectory = element.find("trajectory")
    if trajectory is not None:
        states += trajectory.findall("state")
    rows = np.array([_read_state(state, fields, where, dt) for state in states])
    backwards = np.flatnonzero(np.diff(rows[:, 0]) <= 0.0)
    if backwards.size:
        step = rows[backwards[0] + 1, 0] / dt
        raise InputError(
            f"{fields.path}: {where}: time: {step:g}: expected increasing steps"
        )
    length, width = _read_shape(element, fields, where)
    kind = (element.findtext("type") or "unknown").strip().lower()
    return Track(
        id=name,
        kind=KINDS.get(kind, Kind.STATIC if kind == "parkedvehicle" else Kind.VEHICLE),
        length=length,
        width=width,
        t=rows[:, 0],
        x=rows[:, 1],
        y=rows[:, 2],
        heading=rows[:, 3],
        speed=rows[:, 4],
    )


def _read_state(state: Element, fields: Fields, where: str, dt: float) -> tuple:
    step = fields.scalar(state, "time", where)
    where = f"{where}: state {step:g}"
    place = fields.child(state, "position", where)
    point = place.find("point")
    if point is None:
        point = place.find("*/center")
    if point is None:
        raise InputError(f"{fields.path}: {where}: position: expected a point")
    x, y = fields.point(point, where)
    heading = fields.scalar(state, "orientation", where)
    return step * dt, x, y, heading, fields.scalar(state, "velocity", where)


def _read_shape(element: Element, fields: Fields, where: str) -> tuple[float, float]:
    shape = fields.child(element, "shape", where)
    box, circle = shape.find("rectangle"), shape.find("circle")
    if box is not None:
        length = fields.number(fields.child(box, "length", where), where)
        return length, fields.number(fields.child(box, "width", where), where)
    if circle is not None:
        radius = fields.number(fields.child(circle, "radius", where), where)
        return 2.0 * radius, 2.0 * radius
    points = [fields.point(point, where) for point in shape.iterfind("polygon/point")]
    if not points:
        raise InputError(f"{fields.path}: {where}: shape: expected a rectangle")
    spread = np.ptp(np.array(points), axis=0)
    return float(spread[0]), float(spread[1])


def _read_standing(element: Element, fields: Fields, dt: float, last: float) -> Track:
    name = element.get("id", "(no id)")
    where = f"obstacle {name}"
    state = fields.child(element, "initialState", where)
    point = fields.child(fields.child(state, "position", where), "point", where)
    x, y = fields.point(point, where)
    heading = fields.scalar(state, "orientation", where)
    t = np.arange(int(round(last / dt)) + 1) * dt
    length, width = _read_shape(element, fields, where)
    return Track(
        id=name,
        kind=Kind.STATIC,
        length=length,
        width=width,
        t=t,
        x=np.full(t.shape, x),
        y=np.full(t.shape, y),
        heading=np.full(t.shape, heading),
        speed=np.zeros(t.shape),
    )


def _read_signals(
    root: Element, fields: Fields, dt: float, last: float
) -> Iterator[Signal]:
    for light in root.iterfind("trafficLight"):
        name = light.get("id", "(no id)")
        where = f"trafficLight {name}"
        cycle = light.find("cycle")
        if cycle is None:
            continue
        phases = []
        for element in cycle.iterfind("cycleElement"):
            colour = (element.findtext("color") or "").strip().lower()
            duration = fields.number(fields.child(element, "duration", where), where)
            if colour not in COLOURS or duration <= 0:
                raise InputError(
                    f"{fields.path}: {where}: cycleElement: {colour} {duration:g}: "
                    f"expected a colour of {sorted(COLOURS)} and a duration > 0"
                )
            phases.append((COLOURS[colour], duration * dt))
        if not phases:
            continue
        offset = light.find("cycle/timeOffset")
        start = fields.number(offset, where) * dt if offset is not None else 0.0
        yield _unroll(name, phases, start, last)


def _unroll(name: str, phases: list, offset: float, last: float) -> Signal:
    """A repeating cycle as intervals from before 0 to after `last`."""
    period = sum(duration for _, duration in phases)
    t = offset - period * (np.floor(offset / period) + 1.0)
    starts, states = [], []
    while t <= last:
        for state, duration in phases:
            starts.append(t)
            states.append(state)
            t += duration
    return Signal(
        id=name, start=np.array(starts), state=tuple(states), is_recorded=False
    )


def _read_ghosts(root: Element, fields: Fields, dt: float) -> Iterator[Ghost]:
    for problem in root.iterfind("planningProblem"):
        where = f"planningProblem {problem.get('id', '(no id)')}"
        initial = fields.child(problem, "initialState", where)
        place = fields.child(initial, "position", where)
        start = fields.point(fields.child(place, "point", where), where)
        t0 = fields.scalar(initial, "time", where) * dt
        goal = problem.find("goalState")
        centre = None if goal is None else goal.find("position/*/center")
        end = _extrapolate(initial, fields, where, start)
        t1 = t0 + 1.0
        if goal is not None and centre is not None:
            end = fields.point(centre, where)
            t1 = max(fields.scalar(goal, "time", where) * dt, t0 + dt)
        yield Ghost(t0=t0, t1=t1, start=start, end=end)


def _extrapolate(
    initial: Element, fields: Fields, where: str, start: tuple[float, float]
) -> tuple[float, float]:
    """Where the missing car is one second later, by its initial velocity."""
    read: Callable[[str], Any] = lambda tag: fields.scalar(initial, tag, where)  # noqa: E731
    speed, heading = read("velocity"), read("orientation")
    return start[0] + speed * np.cos(heading), start[1] + speed * np.sin(heading)
