"""CommonRoad scenario XML, versions 2020a and 2018b.

The XML is parsed with entities, DTDs and external references forbidden. Every
obstacle becomes a Track, every lanelet a Lane, every traffic light a Signal of
the schedule written in the file, every planning problem a MissingAgent (the converter
removed that car from the traffic).
"""

import csv
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from rcirl_jax.data.formats.commonroad.map import read_lanes
from rcirl_jax.data.formats.files import files_below, log_name
from rcirl_jax.data.formats.options import is_file_name, one_pattern
from rcirl_jax.data.formats.shapes import arc_length
from rcirl_jax.data.formats.tracks import of_one_name
from rcirl_jax.data.readers.xml import Fields, read_xml
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, MissingAgent, Recording, Signal, Track

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
COLOURS = {
    "red": "red",
    "redyellow": "red",
    "yellow": "yellow",
    "green": "green",
    "inactive": "off",
}
MAX_DURATION = 1e9  # steps of one phase; sums of phases stay exact
MAX_GOAL_M = 1e5  # m, all lanelets of one goal together
MAX_INTERVALS = 5_000_000  # of all lights; 100 lights over a day take a tenth of it
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


def parts(path: Path, spec: dict) -> list[Path]:
    """Lists the XML files but those of other formats; each can be read alone."""
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
    """Returns the name of a log, as long as no other folder has one called alike."""
    return file.stem


def recordings(path: Path, spec: dict) -> Iterator[Recording]:
    """Yields one Recording per XML file."""
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
    text = root.get("timeStepSize", "missing")
    try:
        dt = float(text)
    except ValueError:
        dt = -1.0
    if not 0.001 <= dt <= 1.0:
        raise InputError(f"{path}: timeStepSize: {text}: expected 0.001 to 1 s")
    tracks, notes = _read_tracks(root, fields, dt)
    last = max((float(track.t[-1]) for track in tracks), default=0.0)
    group = groups.get(path.name)
    if group is None:
        group = path.stem
        notes.append("no vehicle-disjoint group given; the file is its own group")
    lanes, lane_notes = read_lanes(root, fields, spec)
    centres = {lane.id: lane.centre for lane in lanes}
    limits = [lane.speed_limit for lane in lanes if lane.speed_limit is not None]
    usual = float(spec.get("default_speed_limit", DEFAULT_LIMIT_MPS))
    # source and licence by the file's own source attribute
    source, licence = root.get("source", "CommonRoad"), spec.get("licence", "unknown")
    for rule in spec.get("provenance", []):
        if rule.get("match", "") in source:
            licence = rule.get("licence", "unknown")
            source = f"{source}: {rule['source']}" if "source" in rule else source
            break
    return Recording(
        name=log_name(path, spec, own_name(path)),
        source=f"{source} (CommonRoad {version})",
        licence=licence,
        rate_hz=1.0 / dt,
        tracks=tuple(tracks),
        lanes=lanes,
        signals=tuple(_signals(root, fields, dt, last)),
        missing_agents=tuple(_missing_agents(root, fields, dt, centres)),
        group=group,
        # of lanes without one: the median of the file's, if any
        default_speed_limit=float(np.median(limits)) if limits else usual,
        notes=tuple(notes + lane_notes),
    )


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
    states = (state for tag in ("initialState", "state") for state in root.iter(tag))
    places = (state.find("position") for state in states)
    regions = sum(place is not None and place.find("point") is None for place in places)
    if regions:
        notes.append(f"{regions} states in a region, taken to be in its middle")
    if unrecorded:
        notes.append(f"{unrecorded} obstacles without a trajectory left out")
    return tracks, notes


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
    x, y = _position(state, fields, where)
    heading = fields.scalar(state, "orientation", where)
    return step * dt, x, y, heading, fields.scalar(state, "velocity", where)


def _read_standing(element: Element, fields: Fields, clock: np.ndarray) -> Track:
    where = f"obstacle {element.get('id')}"
    state = fields.child(element, "initialState", where)
    x, y = _position(state, fields, where)
    heading = fields.scalar(state, "orientation", where)
    still = [np.full(clock.shape, value) for value in (x, y, heading, 0.0)]
    return _track(element, fields, Kind.STATIC, (clock, *still))


def _track(element: Element, fields: Fields, kind: Kind, series: Iterable) -> Track:
    """A track whose positions are those of the box centre."""
    name = element.get("id")
    if name is None:
        raise InputError(f"{fields.path}: {element.tag}: id: missing: expected it")
    t, x, y, heading, speed = series
    length, width, ahead, left, turn = _shape(element, fields, f"obstacle {name}")
    return Track(
        id=name,
        kind=kind,
        length=length,
        width=width,
        t=t,
        x=x + ahead * np.cos(heading) - left * np.sin(heading),
        y=y + ahead * np.sin(heading) + left * np.cos(heading),
        heading=heading + turn,
        speed=speed,
    )


def _shape(
    element: Element, fields: Fields, where: str
) -> tuple[float, float, float, float, float]:
    """A shape's box in the obstacle's own frame.

    Returns:
      Length and width [m], how far its centre lies ahead and to the left of the
      obstacle's position [m], and its turn against the obstacle's heading [rad].
    """
    where = f"{where}: shape"
    shape = fields.child(element, "shape", where)
    box, circle = shape.find("rectangle"), shape.find("circle")
    found = circle if box is None else box
    centre = None if found is None else found.find("center")
    x, y = (0.0, 0.0) if centre is None else fields.point(centre, where)
    if box is not None:
        length = fields.number(fields.child(box, "length", where), where)
        width = fields.number(fields.child(box, "width", where), where)
        turn = box.find("orientation")
        return length, width, x, y, 0.0 if turn is None else fields.number(turn, where)
    if circle is not None:
        size = 2.0 * fields.number(fields.child(circle, "radius", where), where)
        return size, size, x, y, 0.0
    points = [fields.point(point, where) for point in shape.iterfind("polygon/point")]
    if not points:
        tags = ", ".join(child.tag for child in shape) or "nothing"
        raise InputError(
            f"{fields.path}: {where}: {tags}: expected rectangle, circle or polygon"
        )
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    length, width = (high - low).tolist()
    x, y = (0.5 * (high + low)).tolist()
    return length, width, x, y, 0.0


# ----------------------------------------- places, signals and missing agents


def _position(state: Element, fields: Fields, where: str) -> tuple[float, float]:
    """(x, y) m of a state's point, or of the middle of its region."""
    place = fields.child(state, "position", where)
    point = place.find("point")
    if point is None and (middle := _region_middle(place, fields, where)) is not None:
        return middle
    point = fields.child(place, "point", f"{where}: position")
    return fields.point(point, where)


def _region_middle(
    place: Element, fields: Fields, where: str
) -> tuple[float, float] | None:
    """(x, y) m in the middle of the shapes of a position; None without any.

    The mean of the centres of rectangles and circles, and of polygons' corners.
    """
    middles = [fields.point(centre, where) for centre in place.iterfind("*/center")]
    for polygon in place.iterfind("polygon"):
        corners = [fields.point(one, where) for one in polygon.iterfind("point")]
        middles += [np.mean(corners, axis=0)] if corners else []
    if not middles:
        return None
    x, y = np.mean(middles, axis=0).tolist()
    return x, y


def _signals(root: Element, fields: Fields, dt: float, last: float) -> Iterator[Signal]:
    """Every traffic light's written cycle, unrolled from 0 to after `last` s."""
    left = MAX_INTERVALS
    for light in root.iterfind("trafficLight"):
        name = light.get("id", "(no id)")
        where = f"trafficLight {name}"
        phases = []
        for element in light.iterfind("cycle/cycleElement"):
            colour = (element.findtext("color") or "none").strip()
            duration = fields.number(fields.child(element, "duration", where), where)
            if colour.lower() not in COLOURS or not 1.0 <= duration <= MAX_DURATION:
                raise InputError(
                    f"{fields.path}: {where}: cycleElement: {colour} for {duration:g}: "
                    f"expected a colour of {sorted(COLOURS)} and a duration of 1 to "
                    f"{MAX_DURATION:g} steps"
                )
            phases.append((COLOURS[colour.lower()], duration))
        if not phases or (light.findtext("active") or "true").strip() == "false":
            phases = [("off", max(last, 1.0) / dt)]
        offset = light.find("cycle/timeOffset")
        start = fields.number(offset, where) if offset is not None else 0.0
        period = sum(duration for _, duration in phases)
        begin = start % period - period  # steps; at or before 0
        turns = max(int((last / dt - begin) // period) + 1, 1)
        left -= turns * len(phases)
        if left < 0:
            raise InputError(
                f"{fields.path}: {where}: cycle: {turns} turns of {len(phases)}: "
                f"expected up to {MAX_INTERVALS} intervals of all lights"
            )
        states, durations = zip(*phases, strict=True)
        ends = np.cumsum(durations)
        within = np.concatenate([[0.0], ends[:-1]])
        steps = begin + np.arange(turns)[:, None] * ends[-1] + within
        yield Signal(
            id=name, start=steps.ravel() * dt, state=states * turns, is_recorded=False
        )


def _missing_agents(
    root: Element, fields: Fields, dt: float, lanes: dict[str, np.ndarray]
) -> Iterator[MissingAgent]:
    """Every planning problem's car, which the converter took out of the traffic."""
    for problem in root.iterfind("planningProblem"):
        where = f"planningProblem {problem.get('id', '(no id)')}"
        initial = fields.child(problem, "initialState", where)
        start = _position(initial, fields, where)
        t0 = fields.scalar(initial, "time", where) * dt
        goals = problem.findall("goalState")
        if not goals:
            raise InputError(f"{fields.path}: {where}: goalState: missing: expected it")
        placed = [goal for goal in goals if goal.find("position") is not None]
        goal = (placed or goals)[0]
        t1 = max(fields.scalar(goal, "time", where) * dt, t0 + dt)
        speed = fields.scalar(initial, "velocity", where)
        heading = fields.scalar(initial, "orientation", where)
        ahead = speed * (t1 - t0) * np.array([np.cos(heading), np.sin(heading)])
        end = _goal_point(goal, fields, where, np.array(start) + ahead, lanes)
        yield MissingAgent(
            t0=t0, t1=t1, start=start, end=(float(end[0]), float(end[1]))
        )


def _goal_point(
    goal: Element,
    fields: Fields,
    where: str,
    coasted: np.ndarray,
    lanes: dict[str, np.ndarray],
) -> np.ndarray:
    """[2] m, where the missing car is at the goal's time.

    A goal shape's centre; inside goal lanelets the centre-line point nearest to
    where the car gets at its initial speed (the lanelet's end would mean up to
    75 m/s in the NGSIM files); without a position, the coasted point itself.
    """
    place = goal.find("position")
    middle = None if place is None else _region_middle(place, fields, where)
    if middle is not None:
        return np.array(middle)
    names = [ref.get("ref", "") for ref in goal.iterfind("position/lanelet")]
    lines = [lanes[name] for name in dict.fromkeys(names) if name in lanes]
    if not lines:
        return coasted
    total = sum(float(np.hypot(*np.diff(line, axis=0).T).sum()) for line in lines)
    if not total <= MAX_GOAL_M:
        raise InputError(
            f"{fields.path}: {where}: goalState: lanelets of {total:.0f} m: "
            f"expected up to {MAX_GOAL_M:.0f} m"
        )
    dense = []  # about one point a metre
    for line in lines:
        arc = arc_length(line)
        at = np.linspace(0.0, arc[-1], int(arc[-1]) + 2)
        dense.append(np.stack([np.interp(at, arc, line[:, i]) for i in (0, 1)], axis=1))
    near = np.concatenate(dense)
    return near[np.argmin(np.hypot(*(near - coasted).T))]
