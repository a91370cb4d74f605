"""CommonRoad scenario XML, versions 2020a and 2018b.

Every obstacle becomes a Track, every lanelet a Lane, every traffic light a Signal of
the schedule written in the file, every planning problem a MissingAgent (the converter
removed that car from the traffic).

The ids of signs are those of the countries' road traffic acts (`TrafficSignID...` of
commonroad-io); countries without a table of their own use the German ids.
"""

import collections
import contextlib
import csv
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.files import files_below, log_name
from rcirl_jax.data.formats.options import is_file_name, number, one_pattern
from rcirl_jax.data.formats.shapes import (
    arc_length,
    centre_of_area,
    fractions,
    lane_between,
    resample,
)
from rcirl_jax.data.formats.tracks import of_one_name
from rcirl_jax.data.readers.xml import Node, read_xml
from rcirl_jax.data.recording import validate_recording
from rcirl_jax.errors import InputError
from rcirl_jax.types import Kind, Lane, MissingAgent, Recording, Signal, Track

# the country that a file's benchmarkID begins with -> its ids of limits and of stops
LIMITS_AND_STOPS = {
    "ARG": ("R15", "R27"),
    "AUS": ("R4-1", "R1-1"),
    "BEL": ("C43", "B5"),
    "ESP": ("R301", "R2"),
    "FRA": ("B14", "AB4"),
    "GRC": ("P-32", "P-2"),
    "HRV": ("B31", "B02"),
    "PRI": ("R2-1", "R1-1"),
    "RUS": ("3.24", "2.5"),
    "USA": ("R2-1", "R1-1"),
}
GERMAN_LIMITS, GERMAN_STOPS = ("274", "274.1"), ("206",)  # 274.1 begins a zone
# German ids with a number that is no upper limit: masses, sizes, ends, lower limits;
# and those of the plates below a sign, which begin with 10
OTHER_NUMBERS = ("262", "264", "265", "266", "273", "274.2", "275", "278", "310")
PLATES = "10"
COUNTRY = 3  # letters


def read_lanes(root: Node, spec: dict) -> tuple[tuple[Lane, ...], list[str]]:
    """Reads all lanelets of a file as lanes, and notes about what was ignored."""
    limits, stops, notes = _signs(root, number(spec, "min_speed_limit"))
    nodes = root.each("lanelet")
    if not nodes:
        raise root.error("lanelet", "none", "a road network")
    return tuple(_lane(node, limits, stops) for node in nodes), notes


def _signs(root: Node, lowest: float) -> tuple[dict[str, float], set[str], list[str]]:
    """Limits [m/s] from `lowest` on by the ids of signs, ids of stop signs, notes."""
    country = root.element.get("benchmarkID", "").removeprefix("C-")[:COUNTRY]
    own = [*LIMITS_AND_STOPS.values()]  # where it names none, or Zamunda
    if country.isalpha() and country.isupper() and country != "ZAM":
        own = [pair for key, pair in LIMITS_AND_STOPS.items() if key == country]
    limit_ids = {*GERMAN_LIMITS, *(limit for limit, _ in own)}
    stop_ids = {*GERMAN_STOPS, *(stop for _, stop in own)}
    limits: dict[str, float] = {}
    stops: set[str] = set()
    ignored, unknown = 0, collections.Counter[str]()
    for sign in root.each("trafficSign"):
        name = sign.element.get("id", "")
        for element in sign.each("trafficSignElement"):
            # one spelling: r301 as R301, a Greek rho as P, 274-50 as 274
            kind = element.text("trafficSignID").upper()
            kind = kind.replace("\N{GREEK CAPITAL LETTER RHO}", "P")
            begin, _, end = kind.partition("-")
            kind = begin if begin in GERMAN_LIMITS and end.isdigit() else kind
            has_value = element.element.find("additionalValue") is not None
            if kind in stop_ids:
                stops.add(name)
            elif kind in limit_ids and has_value:
                limit = element.number("additionalValue")
                if limit >= lowest:
                    limits[name] = limit
                ignored += limit < lowest
            elif has_value and kind not in OTHER_NUMBERS and kind[:2] != PLATES:
                with contextlib.suppress(ValueError):  # a text is no limit
                    float(element.text("additionalValue"))
                    unknown[kind] += 1
    notes = [f"{ignored} speed limits below {lowest:g} m/s ignored"] if ignored else []
    if unknown:
        kinds = ", ".join(f"{n} {kind[:20]}" for kind, n in unknown.items())
        count = f"{unknown.total()} signs with a number, but of unknown id"
        notes.append(f"{count}: {kinds[:200]}")
    return limits, stops, notes


def _lane(node: Node, limits: dict[str, float], stops: set[str]) -> Lane:
    left, right = (_bound(node, f"{side}Bound") for side in ("left", "right"))
    if len(left) != len(right):
        at = np.unique(np.concatenate([fractions(left), fractions(right)]))
        left, right = resample(left, at), resample(right, at)
    element = node.element

    def refs(tag: str) -> list[str]:
        return [one.get("ref", "") for one in element.iterfind(tag)]

    own = refs(".//trafficSignRef")
    limit = next((limits[sign] for sign in own if sign in limits), None)
    if element.find("speedLimit") is not None:
        limit = node.number("speedLimit")
    stop, line = element.find("stopLine"), None
    if stop is not None:
        ends = [point.point() for point in node.each("stopLine/point")]
        # a stop line without points lies at the lanelet's end
        line = np.array(ends if len(ends) == 2 else [left[-1], right[-1]])
    same = "[@drivingDir='same']"
    return lane_between(
        element.get("id", "(no id)"),
        (left, right),
        speed_limit=limit,
        successors=tuple(refs("successor")),
        left=next(iter(refs(f"adjacentLeft{same}")), None),
        right=next(iter(refs(f"adjacentRight{same}")), None),
        stop_line=line,
        signal_ids=tuple(refs("trafficLightRef")),
        stop_sign=stop is not None and not stops.isdisjoint(own),
    )


def _bound(node: Node, tag: str) -> np.ndarray:
    points = [point.point() for point in node.child(tag).each("point")]
    if len(points) < 2:
        raise node.error(tag, f"{len(points)} points", "two or more")
    return np.array(points)


VERSIONS = ("2018b", "2020a")
GROUPS_UP = 4  # folders above a file in which the table of groups is looked for
MAX_FILE_BYTES = 512 * 1024**2  # bytes, larger files are refused
MAX_STEP = 1e6  # of the clock: a day at 10 Hz
MAX_STANDING = 20_000_000  # samples of standing things: 500 over an hour at 10 Hz
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
OBSTACLES = ("obstacle", "dynamicObstacle", "staticObstacle")  # the first in 2018b
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
    files = files_below(path, one_pattern(spec))
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
    groups = _read_groups(path, spec["groups"])
    for file in parts(path, spec):
        yield validate_recording(_read_file(file, spec, groups), file)


def _read_groups(path: Path, name: str) -> dict[str, str]:
    """File name -> vehicle-disjoint group, from a CSV beside or above the files."""
    if name and not is_file_name(name):
        raise InputError(f"source TOML: groups: {name}: expected a file name")
    folder = (path if path.is_dir() else path.parent).resolve()
    places = [place / name for place in (folder, *folder.parents[:GROUPS_UP])]
    table = next((place for place in places if name and place.is_file()), None)
    if table is None:
        return {}
    try:
        with table.open(newline="", encoding="utf-8-sig") as handle:
            rows = list(csv.DictReader(handle))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{table}: {error}: expected a CSV") from error
    found = [(row.get("file"), row.get("group")) for row in rows]
    for row, pair in enumerate(found, 1):
        if None in pair:
            raise InputError(f"{table}: row {row}: {pair}: expected file,group")
    return {str(file): str(group) for file, group in found}


def _read_file(path: Path, spec: dict, groups: dict[str, str]) -> Recording:
    root = Node(read_xml(path, "commonRoad", MAX_FILE_BYTES), str(path))
    about = root.element.attrib
    version, step = about.get("commonRoadVersion"), about.get("timeStepSize", "missing")
    if version not in VERSIONS:
        raise root.error("commonRoadVersion", version, f"one of {VERSIONS}")
    try:
        dt = float(step)
    except ValueError:
        dt = -1.0
    if not 0.001 <= dt <= 1.0:
        raise root.error("timeStepSize", step, "0.001 to 1 s")
    tracks, notes = _read_tracks(root, dt)
    last = max((float(track.t[-1]) for track in tracks), default=0.0)
    lanes, lane_notes = read_lanes(root, spec)
    limits = [lane.speed_limit for lane in lanes if lane.speed_limit is not None]
    usual = [number(spec, "default_speed_limit")]
    # source and licence by the file's own source attribute
    source = about.get("source", "CommonRoad")
    rules = [r for r in spec.get("provenance", []) if r.get("match", "") in source]
    rule = rules[0] if rules else {"licence": spec["licence"]}
    source = f"{source}: {rule['source']}" if "source" in rule else source
    group = groups.get(path.name)
    if group is None:
        notes.append("no vehicle-disjoint group given; the file is its own group")
    return Recording(
        name=log_name(path, spec, own_name(path)),
        source=f"{source} (CommonRoad {version})",
        licence=rule.get("licence", "unknown"),
        rate_hz=1.0 / dt,
        tracks=tuple(tracks),
        lanes=lanes,
        signals=tuple(_signals(root, dt, last)),
        missing_agents=tuple(_missing_agents(root, dt, lanes)),
        group=path.stem if group is None else group,
        # of lanes without one: the median of the file's, if any
        default_speed_limit=float(np.median(limits or usual)),
        notes=tuple(notes + lane_notes),
    )


# --------------------------------------------------------------------- tracks


def _read_tracks(root: Node, dt: float) -> tuple[list[Track], list[str]]:
    tracks, standing, unrecorded, doubled = [], [], 0, 0
    for element in root.element:
        if element.tag not in OBSTACLES:
            continue
        node = Node(element, f"{root.where}: obstacle {element.get('id')}")
        role = element.tag.removesuffix("Obstacle")
        role = node.text("role") if role == "obstacle" else role
        if role not in ("dynamic", "static"):
            raise node.error("role", role, "dynamic or static")
        kind = KINDS.get(node.text("type").lower(), Kind.VEHICLE)
        if role == "static" or kind == Kind.STATIC:
            standing.append(node)
        elif element.find("trajectory") is None:
            unrecorded += 1
        else:
            states = [node.child("initialState"), *node.each("trajectory/state")]
            rows = np.array([_read_state(state, node.where, dt) for state in states])
            step = np.diff(rows[:, 0], prepend=-np.inf)
            if (step < 0.0).any():
                found = f"{rows[np.argmax(step < 0.0), 0] / dt:g}"
                raise node.error("time", found, "increasing steps")
            doubled += int(np.sum(step == 0.0))  # the first of a step counts
            tracks.append(_track(node, kind, [*rows[step > 0.0].T.copy()]))
    first = min((float(track.t[0]) for track in tracks), default=0.0)
    last = max((float(track.t[-1]) for track in tracks), default=0.0)
    clock = np.arange(round(first / dt), round(last / dt) + 1) * dt
    if len(standing) * clock.size > MAX_STANDING:
        found = f"{len(standing)} static ones over {clock.size} steps"
        raise root.error("obstacles", found, f"up to {MAX_STANDING} samples")
    for node in standing:
        state = node.child("initialState")
        still = (*_position(state), state.scalar("orientation"), 0.0)
        series = [clock, *(np.full(clock.shape, value) for value in still)]
        tracks.append(_track(node, Kind.STATIC, series))
    tracks, notes = of_one_name(tracks)
    if doubled:
        notes.append(f"{doubled} states of a step met twice, one used")
    states = (s for tag in ("initialState", "state") for s in root.element.iter(tag))
    places = (state.find("position") for state in states)
    regions = sum(place is not None and place.find("point") is None for place in places)
    if regions:
        notes.append(f"{regions} states in a region, taken to be in its middle")
    if unrecorded:
        notes.append(f"{unrecorded} obstacles without a trajectory left out")
    return tracks, notes


def _read_state(state: Node, where: str, dt: float) -> tuple[float, ...]:
    """Time [s], x, y [m], heading [rad], speed [m/s] of an obstacle's state."""
    step = state.scalar("time")
    if abs(step) > MAX_STEP:
        raise state.error("time", f"{step:g}", f"steps up to {MAX_STEP:g}")
    state.where = f"{where}: state {step:g}"
    x, y = _position(state)
    return step * dt, x, y, state.scalar("orientation"), state.scalar("velocity")


def _track(node: Node, kind: Kind, series: Sequence[np.ndarray]) -> Track:
    """A track whose positions are those of the centre of its shape's box."""
    t, x, y, heading, speed = series
    length, width, ahead, left, turn = _box(node.child("shape"))
    return Track(
        id=node.element.get("id", "(no id)"),
        kind=kind,
        length=length,
        width=width,
        t=t,
        x=x + ahead * np.cos(heading) - left * np.sin(heading),
        y=y + ahead * np.sin(heading) + left * np.cos(heading),
        heading=heading + turn,
        speed=speed,
    )


def _box(shape: Node) -> tuple[float, float, float, float, float]:
    """A shape's box in the obstacle's own frame.

    Returns:
      Length and width [m], how far its centre lies ahead and to the left of the
      obstacle's position [m], and its turn against the obstacle's heading [rad].
    """
    points = [point.point() for point in shape.each("polygon/point")]
    kinds = [one.tag for one in shape.element]
    kind = next((one for one in ("rectangle", "circle") if one in kinds), None)
    if kind is not None:
        found = shape.child(kind)
        has_centre = found.element.find("center") is not None
        centre = found.child("center").point() if has_centre else (0.0, 0.0)
        if kind == "circle":
            size = 2.0 * found.number("radius")
            return size, size, *centre, 0.0
        size = found.number("length"), found.number("width")
        return *size, *centre, found.number("orientation", 0.0)
    if not points:
        raise InputError(
            f"{shape.where}: {', '.join(kinds) or 'nothing'}: "
            "expected rectangle, circle or polygon"
        )
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    (length, width), (x, y) = (high - low).tolist(), (0.5 * (high + low)).tolist()
    return length, width, x, y, 0.0


def _position(state: Node) -> tuple[float, float]:
    """(x, y) m of a state's point, or of the middle of its region."""
    place = state.child("position")
    if place.element.find("point") is None and (middle := _middle(place)) is not None:
        return middle
    return place.child("point").point()


def _middle(place: Node) -> tuple[float, float] | None:
    """(x, y) m: mean of the centres of a position's shapes; None without any."""
    middles = [np.array(centre.point()) for centre in place.each("*/center")]
    for polygon in place.each("polygon"):
        corners = [corner.point() for corner in polygon.each("point")]
        middles += [centre_of_area(np.array(corners))] if corners else []
    if not middles:
        return None
    x, y = np.mean(middles, axis=0).tolist()
    return x, y


# -------------------------------------------------- signals and missing agents


def _signals(root: Node, dt: float, last: float) -> Iterator[Signal]:
    """Every traffic light's written cycle, unrolled from 0 to after `last` s."""
    left = MAX_INTERVALS
    for light in root.each("trafficLight"):
        phases = []
        for one in light.each("cycle/cycleElement"):
            colour, duration = one.text("color"), one.number("duration")
            if colour.lower() not in COLOURS or not 1.0 <= duration <= MAX_DURATION:
                raise light.error(
                    "cycleElement",
                    f"{colour} for {duration:g}",
                    f"a colour of {sorted(COLOURS)} and a duration of 1 to "
                    f"{MAX_DURATION:g} steps",
                )
            phases.append((COLOURS[colour.lower()], duration))
        if not phases or light.text("active") == "false":
            phases = [("off", max(last, 1.0) / dt)]
        states, durations = zip(*phases, strict=True)
        period = sum(durations)
        # steps; at or before 0
        begin = light.number("cycle/timeOffset", 0.0) % period - period
        turns = max(int((last / dt - begin) // period) + 1, 1)
        left -= turns * len(phases)
        if left < 0:
            raise light.error(
                "cycle",
                f"{turns} turns of {len(phases)}",
                f"up to {MAX_INTERVALS} intervals of all lights",
            )
        ends = np.cumsum(durations)
        within = np.concatenate([[0.0], ends[:-1]])
        steps = begin + np.arange(turns)[:, None] * ends[-1] + within
        name = light.element.get("id", "(no id)")
        yield Signal(
            id=name, start=steps.ravel() * dt, state=states * turns, is_recorded=False
        )


def _missing_agents(
    root: Node, dt: float, lanes: Sequence[Lane]
) -> Iterator[MissingAgent]:
    """Every planning problem's car, which the converter took out of the traffic."""
    for problem in root.each("planningProblem"):
        initial, goals = problem.child("initialState"), problem.each("goalState")
        start, t0 = _position(initial), initial.scalar("time") * dt
        placed = [one for one in goals if one.element.find("position") is not None]
        goal = (placed or goals or [problem.child("goalState")])[0]
        t1 = max(goal.scalar("time") * dt, t0 + dt)
        speed, heading = initial.scalar("velocity"), initial.scalar("orientation")
        ahead = speed * (t1 - t0) * np.array([np.cos(heading), np.sin(heading)])
        x, y = _goal_point(goal, np.array(start) + ahead, lanes)
        yield MissingAgent(t0=t0, t1=t1, start=start, end=(float(x), float(y)))


def _goal_point(
    goal: Node, coasted: np.ndarray, lanes: Sequence[Lane]
) -> Sequence[float]:
    """[2] m, where the missing car is at the goal's time.

    A goal shape's centre; inside goal lanelets the centre-line point nearest to
    where the car gets at its initial speed (the lanelet's end would mean up to
    75 m/s in the NGSIM files); without a position, the coasted point itself.
    """
    for place in goal.each("position"):
        if (middle := _middle(place)) is not None:
            return middle
    refs = [one.get("ref", "") for one in goal.element.iterfind("position/lanelet")]
    centres = {lane.id: lane.centre for lane in lanes}
    lines = [centres[name] for name in dict.fromkeys(refs) if name in centres]
    arcs = [arc_length(line) for line in lines]
    total = sum(float(arc[-1]) for arc in arcs)
    if not total <= MAX_GOAL_M:
        found = f"lanelets of {total:.0f} m"
        raise goal.error("goalState", found, f"up to {MAX_GOAL_M:.0f} m")
    if not lines:
        return coasted.tolist()
    dense = []  # about one point a metre
    for line, arc in zip(lines, arcs, strict=True):
        at = np.linspace(0.0, arc[-1], int(arc[-1]) + 2)
        dense.append(np.stack([np.interp(at, arc, line[:, i]) for i in (0, 1)], axis=1))
    near = np.concatenate(dense)
    return near[np.argmin(np.hypot(*(near - coasted).T))].tolist()
