"""Lanelet2 maps (OSM XML) -> Lanes, shared by the importers that come with one.

Specification: the Lanelet2 documentation (LaneletPrimitives,
LaneletAndAreaTagging, RegulatoryElementTagging). Points are the attributes x, y
(the INTERACTION dataset's .osm_xy), the tags local_x, local_y, or lat, lon.

Traps: the two bounds of a lanelet may be stored in either direction, bounds may
consist of several ways, `one_way = no` lanes are driven both ways, editors
mark removed elements with action="delete", members of lanelets that are
regulatory elements may have an empty role.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from rcirl_jax.data.formats.shapes import (
    MAX_COORDINATE_M,
    MIN_HALF_WIDTH_M,
    arc_length,
    fractions,
    resample,
)
from rcirl_jax.data.readers.xml import read_xml
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane
from rcirl_jax.units import MPH_MPS

# latitude, longitude [n] degrees -> positions [n, 2] m in the log's own frame
Projection = Callable[[np.ndarray, np.ndarray], np.ndarray]

# lanelets for other road users than vehicles
NOT_FOR_VEHICLES = (
    *("walkway", "shared_walkway", "crosswalk", "stairs", "bicycle_lane"),
    *("sidewalk", "pedestrian", "emergency_lane"),
)
MAX_FILE_BYTES = 256 * 1024**2  # bytes, larger files are refused
MIN_STEP_M = 0.25  # m between points of a lane
SAME_PLACE_M = 1e-3  # m, end points that near are one
MAX_LATITUDE = 84.0  # degrees, UTM ends there
MAX_NODES = 5_000_000  # of all bounds; 2500 km of lanes, a point a metre
STOP_SIGNS = ("us_r1_1", "usr1-1", "r1-1", "de206", "206", "stop")
MAX_WAYS = 1000  # of one bound; maps have a few
SPEED_UNITS = {
    "": 1.0 / 3.6,  # Lanelet2: no unit means km/h
    "km/h": 1.0 / 3.6,
    "kmh": 1.0 / 3.6,
    "kph": 1.0 / 3.6,
    "mph": MPH_MPS,
    "mps": 1.0,
    "m/s": 1.0,
}
BACKWARDS = "-back"  # appended to the id of a two-way lanelet's other direction


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rule:
    """What a regulatory element says, read once for all its lanelets."""

    subtype: str
    yields: frozenset[str]  # lanelets that have to give way
    stops: bool  # everybody has to stop
    lines: np.ndarray  # [n, 2, 2] m, end points of its own stop lines
    limit: float | None  # m/s


@dataclasses.dataclass(frozen=True)
class OsmMap:
    """What a file holds; elements by id."""

    path: Path
    points: dict[str, np.ndarray]  # node -> [2] m
    ways: dict[str, Element]
    relations: dict[str, Element]

    @functools.cached_property
    def rules(self) -> dict[str, Rule]:
        """Reads regulatory elements by id; a way that many of them name once."""

        @functools.cache
        def sign(name: str) -> str:
            return tag_of(self.ways[name], "subtype") if name in self.ways else ""

        @functools.cache
        def ends(name: str) -> tuple[str, ...]:
            nodes = bound(self, [name])
            return nodes and (nodes[0], nodes[-1])

        rules = {}
        for key, element in self.relations.items():
            if tag_of(element, "type") != "regulatory_element":
                continue
            subtype, text = tag_of(element, "subtype"), tag_of(element, "sign_type")
            kinds = [sign(name) for name in members(element, "refers", "way")]
            texts = []
            if subtype == "speed_limit":
                # German sign 274 carries its number: de274-60
                numbers = [kind.rpartition("-")[2] for kind in kinds if "274-" in kind]
                texts = [text.rpartition("274-")[2], *numbers]
            own = dict.fromkeys(map(ends, members(element, "ref_line", "way")))
            lines = [line_of(self, nodes) for nodes in own if nodes]
            rules[key] = Rule(
                subtype=subtype,
                yields=frozenset(members(element, "yield", "relation")),
                stops=subtype == "all_way_stop"
                or any(kind.lower() in STOP_SIGNS for kind in (text, *kinds)),
                lines=np.array(lines).reshape(-1, 2, 2),
                limit=_first_speed(texts),
            )
        return rules


@dataclasses.dataclass(frozen=True)
class _Lanelet:
    """A lanelet driven one way: bounds as nodes in driving direction."""

    id: str
    left: tuple[str, ...]
    right: tuple[str, ...]
    relation: Element


def read_lanelet2(path: Path, project: Projection) -> tuple[tuple[Lane, ...], list]:
    """Reads all lanes for vehicles of a map.

    Args:
      path: .osm or .osm_xy file.
      project: used where points are given by latitude and longitude.

    Returns:
      The lanes, and notes about what was left out.

    Raises:
      InputError: not well-formed, a point without a position, or no lane.
    """
    root = read_xml(path, "osm", MAX_FILE_BYTES)
    found = {
        kind: {
            element.get("id", ""): element
            for element in root.iterfind(kind)
            if element.get("action") != "delete"
        }
        for kind in ("node", "way", "relation")
    }
    points = _positions(path, found["node"], project)
    world = OsmMap(path, points, found["way"], found["relation"])
    lanelets, broken, nodes = [], 0, 0
    for name, relation in world.relations.items():
        if tag_of(relation, "type") == "lanelet" and _for_vehicles(relation):
            directions = list(_lanelets(world, name, relation))
            lanelets += directions
            broken += not directions
            nodes += sum(len(one.left) + len(one.right) for one in directions)
            if nodes > MAX_NODES:
                raise InputError(
                    f"{path}: lanelet {name[:40]}: {nodes} nodes up to it: "
                    f"expected up to {MAX_NODES}"
                )
    if not lanelets:
        raise InputError(f"{path}: lanelet: none for vehicles: expected a road map")
    notes = [f"{broken} lanelets without two bounds left out"] if broken else []
    return tuple(_link(world, lanelets)), notes


def _positions(
    path: Path, nodes: dict[str, Element], project: Projection
) -> dict[str, np.ndarray]:
    """Node -> [2] m, by the first node's way of giving positions."""
    if not nodes:
        return {}
    first = next(iter(nodes.values()))
    degrees = False
    if first.get("x") is not None:
        pairs = [(node.get("x"), node.get("y")) for node in nodes.values()]
    elif tag_of(first, "local_x"):
        pairs = [(tag_of(n, "local_x"), tag_of(n, "local_y")) for n in nodes.values()]
    else:
        pairs = [(node.get("lat"), node.get("lon")) for node in nodes.values()]
        degrees = True

    def number(text: str | None) -> float:
        try:
            return float(text or "nan")
        except ValueError:
            return float("nan")

    values = np.array([[number(text) for text in pair] for pair in pairs])
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if wrong.size:
        name, pair = list(nodes)[wrong[0]], pairs[wrong[0]]
        raise InputError(
            f"{path}: node {name[:40]}: position: {str(pair)[:60]}: "
            "expected two finite numbers"
        )
    limits = (MAX_LATITUDE, 180.0) if degrees else (MAX_COORDINATE_M,) * 2
    far = np.flatnonzero(np.any(np.abs(values) > limits, axis=1))
    if far.size:
        raise InputError(
            f"{path}: node {list(nodes)[far[0]][:40]}: position: {pairs[far[0]]}: "
            f"expected at most {limits[0]:g}, {limits[1]:g}"
        )
    if degrees:
        values = project(values[:, 0], values[:, 1])
    return dict(zip(nodes, values, strict=True))


def _for_vehicles(relation: Element) -> bool:
    """By the subtype, unless participants are named one by one."""
    named = [
        (tag.get("k", ""), tag.get("v"))
        for tag in relation.iterfind("tag")
        if tag.get("k", "").startswith("participant:")
    ]
    if named:
        return any("vehicle" in key and value == "yes" for key, value in named)
    return tag_of(relation, "subtype") not in NOT_FOR_VEHICLES


def _lanelets(world: OsmMap, name: str, relation: Element) -> Iterator[_Lanelet]:
    """The lanelet, and its other direction if it is driven both ways."""
    sides = [bound(world, members(relation, r, "way")) for r in ("left", "right")]
    left, right = sides
    if len(left) < 2 or len(right) < 2:
        return
    first, last = world.points[left[0]], world.points[left[-1]]
    begin, end = world.points[right[0]], world.points[right[-1]]
    crossed = np.hypot(*(first - end)) + np.hypot(*(last - begin))
    if np.hypot(*(first - begin)) + np.hypot(*(last - end)) > crossed:
        right = right[::-1]
    a, b = _resample_both(line_of(world, left), line_of(world, right))
    along, across = np.gradient(0.5 * (a + b), axis=0), a - b
    if not np.any(np.diff(0.5 * (a + b), axis=0)):
        return
    if np.sum(along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]) < 0.0:
        left, right = left[::-1], right[::-1]
    yield _Lanelet(name, left, right, relation)
    if tag_of(relation, "one_way") == "no":
        yield _Lanelet(name + BACKWARDS, right[::-1], left[::-1], relation)


def _resample_both(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both lines [m, 2] at the shares of length where either has a point.

    Of shares nearer than MIN_STEP_M only one counts: both bounds of a bend have
    points at almost the same place.
    """
    length = max(float(arc_length(line)[-1]) for line in (a, b))
    at = np.unique(np.concatenate([fractions(a), fractions(b), [0.0, 1.0]]))
    steps = np.round(at * length / MIN_STEP_M)
    at = at[np.unique(steps, return_index=True)[1]]
    at = np.append(at[at < 1.0], 1.0) if at.size > 1 else np.array([0.0, 1.0])
    return resample(a, at), resample(b, at)


def _link(world: OsmMap, lanelets: list[_Lanelet]) -> Iterator[Lane]:
    """Lanes with successors (shared ends) and neighbours (shared bounds)."""
    starts: dict[tuple, list[str]] = {}
    lefts: dict[tuple, str] = {}
    rights: dict[tuple, str] = {}
    for lanelet in lanelets:
        starts.setdefault(_gate(world, lanelet, 0), []).append(lanelet.id)
        lefts.setdefault(lanelet.left, lanelet.id)
        rights.setdefault(lanelet.right, lanelet.id)
    for lanelet in lanelets:
        left, right = _resample_both(
            line_of(world, lanelet.left), line_of(world, lanelet.right)
        )
        half = np.maximum(0.5 * np.hypot(*(left - right).T), MIN_HALF_WIDTH_M)
        following = starts.get(_gate(world, lanelet, -1), [])
        ends = np.stack([left[-1], right[-1]])
        name = lanelet.id.removesuffix(BACKWARDS)
        stop_line, stop_sign = stop_of(world, name, lanelet.relation, ends)
        yield Lane(
            id=lanelet.id,
            centre=0.5 * (left + right),
            left_width=half,
            right_width=half,
            speed_limit=speed_limit(world, lanelet.relation),
            successors=tuple(s for s in following if s.removesuffix(BACKWARDS) != name),
            left=rights.get(lanelet.left),
            right=lefts.get(lanelet.right),
            stop_line=stop_line,
            stop_sign=stop_sign,
        )


def _gate(world: OsmMap, lanelet: _Lanelet, end: int) -> tuple:
    """Where a lanelet begins (0) or ends (-1): its two corner points."""
    corners = [world.points[nodes[end]] for nodes in (lanelet.left, lanelet.right)]
    return tuple(np.round(np.concatenate(corners) / SAME_PLACE_M).astype(int))


# ------------------------------------------------- tags, members, rules


def tag_of(element: Element, key: str) -> str:
    """Returns the value of a tag, "" if the element has none."""
    for tag in element.iterfind("tag"):
        if tag.get("k") == key:
            return (tag.get("v") or "").strip()
    return ""


def members(element: Element, role: str, kind: str) -> list[str]:
    """Ids of a relation's members of one role and kind (way, relation)."""
    return [
        member.get("ref", "")
        for member in element.iterfind("member")
        if member.get("role") == role and member.get("type") == kind
    ]


def bound(world: OsmMap, names: list[str]) -> tuple[str, ...]:
    """Nodes of a bound; its ways joined where they share an end. () if broken."""
    if len(names) > MAX_WAYS:
        raise InputError(
            f"{world.path}: bound with way {names[0][:40]}: {len(names)} ways: "
            f"expected up to {MAX_WAYS}"
        )
    parts = []
    for name in dict.fromkeys(names):
        way = world.ways.get(name)
        nodes = [] if way is None else [n.get("ref", "") for n in way.iterfind("nd")]
        if len(nodes) < 2 or not all(node in world.points for node in nodes):
            return ()
        parts.append(nodes)
    joined = parts.pop(0) if parts else []
    while parts:
        step = _extended(joined, parts)
        if not step:
            return ()
        joined = step
    return tuple(joined)


def _extended(joined: list[str], parts: list[list[str]]) -> list[str]:
    """The line with one more of the parts (which is removed), or []."""
    for place, part in enumerate(parts):
        for nodes in (part, part[::-1]):
            if joined[-1] == nodes[0]:
                del parts[place]
                return joined + nodes[1:]
            if joined[0] == nodes[-1]:
                del parts[place]
                return nodes[:-1] + joined
    return []


def line_of(world: OsmMap, nodes: tuple[str, ...]) -> np.ndarray:
    """Positions [n, 2] m of nodes."""
    return np.array([world.points[node] for node in nodes])


def _rules(world: OsmMap, relation: Element) -> list[Rule]:
    """Regulatory elements that a lanelet refers to, each once."""
    names = dict.fromkeys(
        member.get("ref", "")
        for member in relation.iterfind("member")
        if member.get("type") == "relation"
    )
    return [world.rules[name] for name in names if name in world.rules]


def speed_limit(world: OsmMap, relation: Element) -> float | None:
    """Returns the limit [m/s] of the last rule, or of the lanelet's own tag."""
    limits = [rule.limit for rule in _rules(world, relation) if rule.limit is not None]
    return limits[-1] if limits else _first_speed([tag_of(relation, "speed_limit")])


def _first_speed(texts: list[str]) -> float | None:
    for text in texts:
        # one place for spaces: several take a time that is the square of their number
        match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([a-zA-Z/]*)", text.strip())
        if match is not None and match[2].lower() in SPEED_UNITS:
            speed = float(match[1]) * SPEED_UNITS[match[2].lower()]
            if 0.0 < speed < 90.0:
                return speed
    return None


def stop_of(
    world: OsmMap, name: str, relation: Element, ends: np.ndarray
) -> tuple[np.ndarray | None, bool]:
    """Returns end points [2, 2] m of the stop line; whether everybody has to stop.

    A rule without a line of its own stops traffic at the lanelet's end.
    """
    found, sign = [], False
    for rule in _rules(world, relation):
        concerned = {
            "traffic_light": True,
            "all_way_stop": True,
            "traffic_sign": rule.stops,
            "right_of_way": name in rule.yields,
        }
        if not concerned.get(rule.subtype, False):
            continue
        sign = sign or rule.stops
        found.append(rule.lines)
        if not len(rule.lines) and (rule.subtype == "traffic_light" or rule.stops):
            found.append(ends[None])
    lines = np.concatenate([*found, np.zeros((0, 2, 2))])
    if not len(lines):
        return None, False
    apart = np.hypot(*(lines.mean(axis=1) - ends.mean(axis=0)).T)
    return lines[np.argmin(apart)].copy(), sign  # a view would keep all of them
