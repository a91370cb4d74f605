"""What a CommonRoad file holds besides cars and lanes: signals and missing cars."""

from collections.abc import Iterator
from xml.etree.ElementTree import Element

import numpy as np

from rcirl_jax.data.formats.shapes import arc_length
from rcirl_jax.data.readers.xml import Fields
from rcirl_jax.errors import InputError
from rcirl_jax.types import Ghost, Signal

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


def position(state: Element, fields: Fields, where: str) -> tuple[float, float]:
    """(x, y) m of a state's point, or of the middle of its region."""
    place = fields.child(state, "position", where)
    point = place.find("point")
    if point is None and (middle := region_middle(place, fields, where)) is not None:
        return middle
    point = fields.child(place, "point", f"{where}: position")
    return fields.point(point, where)


def region_middle(
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


def read_signals(
    root: Element, fields: Fields, dt: float, last: float
) -> Iterator[Signal]:
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
        yield _unroll(name, phases, begin, turns, dt)


def _unroll(
    name: str, phases: list[tuple[str, float]], begin: float, turns: int, dt: float
) -> Signal:
    """A cycle that begins at step `begin` and is repeated, as intervals."""
    states, durations = zip(*phases, strict=True)
    ends = np.cumsum(durations)
    within = np.concatenate([[0.0], ends[:-1]])
    steps = begin + np.arange(turns)[:, None] * ends[-1] + within
    return Signal(
        id=name, start=steps.ravel() * dt, state=states * turns, is_recorded=False
    )


def read_ghosts(
    root: Element, fields: Fields, dt: float, lanes: dict[str, np.ndarray]
) -> Iterator[Ghost]:
    """Every planning problem's car, which the converter took out of the traffic."""
    for problem in root.iterfind("planningProblem"):
        where = f"planningProblem {problem.get('id', '(no id)')}"
        initial = fields.child(problem, "initialState", where)
        start = position(initial, fields, where)
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
        yield Ghost(t0=t0, t1=t1, start=start, end=(float(end[0]), float(end[1])))


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
    middle = None if place is None else region_middle(place, fields, where)
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
    near = np.concatenate([_densify(line) for line in lines])
    return near[np.argmin(np.hypot(*(near - coasted).T))]


def _densify(line: np.ndarray) -> np.ndarray:
    """[n, 2] m, about one point a metre along a polyline."""
    arc = arc_length(line)
    at = np.linspace(0.0, arc[-1], int(arc[-1]) + 2)
    return np.stack([np.interp(at, arc, line[:, i]) for i in (0, 1)], axis=1)
