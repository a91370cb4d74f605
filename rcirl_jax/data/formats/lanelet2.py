"""Lanelet2 maps (OSM XML) -> Lanes, shared by the importers that come with one.

Specification: the Lanelet2 documentation. Points are the attributes x, y (the
INTERACTION dataset's .osm_xy), the tags local_x, local_y, or lat, lon.

Traps: the two bounds of a lanelet may be stored in either direction, bounds may
consist of several ways, `one_way = no` lanes are driven both ways, editors
mark removed elements with action="delete", members of lanelets that are
regulatory elements may have an empty role.
"""

import dataclasses
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from rcirl_jax.data.formats.shapes import (
    MAX_COORDINATE_M,
    arc_length,
    fractions,
    lane_between,
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
SEAM_M = 0.05  # m between the ends of two ways of a bound that meet
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


class _Element:
    """Tags of a way or relation; its nodes or members as (kind, role, id)."""

    def __init__(self, element: Element) -> None:
        self.tags = _tags(element)
        self.members = [
            (one.get("type", ""), one.get("role", ""), one.get("ref", ""))
            for one in element
            if one.tag in ("nd", "member")
        ]

    def tag(self, key: str) -> str:
        """Returns the value of a tag, "" if the element has none."""
        return self.tags.get(key, "")

    def of(self, kind: str, role: str) -> list[str]:
        """Returns ids of the members of one kind (way, relation) and role."""
        return [ref for k, r, ref in self.members if (k, r) == (kind, role)]


def _tags(element: Element) -> dict[str, str]:
    tags = element.iterfind("tag")
    return {tag.get("k", ""): (tag.get("v") or "").strip() for tag in tags}


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Rule:
    """A regulatory element, read once for all its lanelets."""

    subtype: str
    yields: frozenset[str]  # lanelets that have to give way
    stops: bool  # everybody has to stop
    lines: np.ndarray  # [n, 2, 2] m, end points of its own stop lines
    limit: float | None  # m/s


@dataclasses.dataclass(frozen=True)
class _Lanelet:
    """A lanelet driven one way: bounds as nodes in driving direction."""

    id: str
    left: tuple[str, ...]
    right: tuple[str, ...]
    element: _Element


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
    world = _World(path, project)
    lanelets, broken, nodes = [], 0, 0
    for name, element in world.relations.items():
        if element.tag("type") != "lanelet" or not _is_for_vehicles(element):
            continue
        directions = list(world.directions(name, element))
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
    return tuple(world.lanes(lanelets)), notes


def _is_for_vehicles(element: _Element) -> bool:
    """By the subtype, unless participants are named one by one."""
    start = "participant:"
    named = {key: v for key, v in element.tags.items() if key.startswith(start)}
    if named:
        return any("vehicle" in key and v == "yes" for key, v in named.items())
    return element.tag("subtype") not in NOT_FOR_VEHICLES


def _positions(
    path: Path, nodes: dict[str, Element], project: Projection
) -> dict[str, np.ndarray]:
    """Node -> [2] m, by the first node's way of giving positions."""
    if not nodes:
        return {}
    first = next(iter(nodes.values()))
    keys, limits = ("lat", "lon"), (MAX_LATITUDE, 180.0)
    found = [node.attrib for node in nodes.values()]
    if first.get("x") is not None or "local_x" in _tags(first):
        keys, limits = ("x", "y"), (MAX_COORDINATE_M, MAX_COORDINATE_M)
        if first.get("x") is None:
            keys, found = ("local_x", "local_y"), map(_tags, nodes.values())
    pairs = [tuple(one.get(key) or "nan" for key in keys) for one in found]

    def number(text: str) -> float:
        try:
            return float(text)
        except ValueError:
            return float("nan")

    values = np.array([[number(text) for text in pair] for pair in pairs])
    wrong = np.flatnonzero(~(np.abs(values) <= limits).all(axis=1))
    if wrong.size:
        name, pair = list(nodes)[wrong[0]], pairs[wrong[0]]
        raise InputError(
            f"{path}: node {name[:40]}: position: {str(pair)[:60]}: "
            f"expected numbers up to {limits[0]:g}, {limits[1]:g}"
        )
    if keys[0] == "lat":
        values = project(values[:, 0], values[:, 1])
    return dict(zip(nodes, values, strict=True))


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


class _World:
    """The elements of a file by id."""

    def __init__(self, path: Path, project: Projection) -> None:
        self.path = path
        nodes, ways, relations = (
            {
                element.get("id", ""): element
                for element in root.iterfind(kind)
                if element.get("action") != "delete"
            }
            for root in [read_xml(path, "osm", MAX_FILE_BYTES)]
            for kind in ("node", "way", "relation")
        )
        self.points = _positions(path, nodes, project)  # [2] m
        self.relations = {name: _Element(one) for name, one in relations.items()}
        self.subtypes: dict[str, str] = {}  # of ways
        self.ways: dict[str, list[str]] = {}  # nodes; of whole ways only
        for name, one in ways.items():
            way = _Element(one)
            self.subtypes[name] = way.tag("subtype")
            refs = way.of("", "")
            if len(refs) > 1 and all(node in self.points for node in refs):
                self.ways[name] = refs
        self.rules = {
            name: self._rule(one)
            for name, one in self.relations.items()
            if one.tag("type") == "regulatory_element"
        }

    def _rule(self, element: _Element) -> _Rule:
        subtype, text = element.tag("subtype"), element.tag("sign_type")
        kinds = [self.subtypes.get(name, "") for name in element.of("way", "refers")]
        texts = []
        if subtype == "speed_limit":
            # German sign 274 carries its number: de274-60
            numbers = [kind.rpartition("-")[2] for kind in kinds if "274-" in kind]
            texts = [text.rpartition("274-")[2], *numbers]
        ways = [self.ways.get(name) for name in element.of("way", "ref_line")]
        ends = dict.fromkeys((way[0], way[-1]) for way in ways if way)
        return _Rule(
            subtype=subtype,
            yields=frozenset(element.of("relation", "yield")),
            stops=subtype == "all_way_stop"
            or any(kind.lower() in STOP_SIGNS for kind in (text, *kinds)),
            lines=np.array([self._line(pair) for pair in ends]).reshape(-1, 2, 2),
            limit=_first_speed(texts),
        )

    def directions(self, name: str, element: _Element) -> Iterator[_Lanelet]:
        """Yields a lanelet, and its other direction if it is driven both ways."""
        left, right = (self._bound(element.of("way", r)) for r in ("left", "right"))
        if len(left) < 2 or len(right) < 2:
            return
        (first, last), (begin, end) = (
            (self.points[side[0]], self.points[side[-1]]) for side in (left, right)
        )
        crossed = np.hypot(*(first - end)) + np.hypot(*(last - begin))
        if np.hypot(*(first - begin)) + np.hypot(*(last - end)) > crossed:
            right = right[::-1]
        a, b = _resample_both(self._line(left), self._line(right))
        along, across = np.gradient(0.5 * (a + b), axis=0), a - b
        if not np.any(np.diff(0.5 * (a + b), axis=0)):
            return
        if np.sum(along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]) < 0.0:
            left, right = left[::-1], right[::-1]
        yield _Lanelet(name, left, right, element)
        if element.tag("one_way") == "no":
            yield _Lanelet(name + BACKWARDS, right[::-1], left[::-1], element)

    def _line(self, nodes: Sequence[str]) -> np.ndarray:
        """Positions [n, 2] m of nodes."""
        return np.array([self.points[node] for node in nodes])

    def _bound(self, names: list[str]) -> tuple[str, ...]:
        """Nodes of a bound; its ways joined where their ends meet. () if broken."""
        if len(names) > MAX_WAYS:
            raise InputError(
                f"{self.path}: bound with way {names[0][:40]}: {len(names)} ways: "
                f"expected up to {MAX_WAYS}"
            )
        if not names or not self.ways.keys() >= set(names):
            return ()
        joined, *parts = (self.ways[name] for name in dict.fromkeys(names))
        while parts:
            joined = self._extended(joined, parts)
            if not joined:
                return ()
        return tuple(joined)

    def _extended(self, joined: list[str], parts: list[list[str]]) -> list[str]:
        """The line with one more of the parts (which is removed), or []."""
        for place, part in enumerate(parts):
            for nodes in (part, part[::-1]):
                if self._meet(joined[-1], nodes[0]):
                    del parts[place]
                    return joined + nodes[1:]
                if self._meet(joined[0], nodes[-1]):
                    del parts[place]
                    return nodes[:-1] + joined
        return []

    def _meet(self, one: str, other: str) -> bool:
        """True for one node, and for two at one place (exports double them)."""
        if one == other:
            return True
        gap = np.subtract(self.points[one], self.points[other])
        return bool(np.hypot(*gap) <= SEAM_M)

    def _gate(self, lanelet: _Lanelet, end: int) -> tuple:
        """Returns the two corner points at a lanelet's begin (0) or end (-1)."""
        corners = self._line([nodes[end] for nodes in (lanelet.left, lanelet.right)])
        return tuple(np.round(corners.ravel() / SAME_PLACE_M).astype(int))

    def lanes(self, lanelets: list[_Lanelet]) -> Iterator[Lane]:
        """Yields lanes with successors (shared ends) and neighbours (shared bounds)."""
        starts: dict[tuple, list[str]] = {}
        lefts: dict[tuple, str] = {}
        rights: dict[tuple, str] = {}
        for one in lanelets:
            starts.setdefault(self._gate(one, 0), []).append(one.id)
            lefts.setdefault(one.left, one.id)
            rights.setdefault(one.right, one.id)
        for one in lanelets:
            left, right = _resample_both(self._line(one.left), self._line(one.right))
            name = one.id.removesuffix(BACKWARDS)
            refs = [ref for kind, _, ref in one.element.members if kind == "relation"]
            rules = [self.rules[r] for r in dict.fromkeys(refs) if r in self.rules]
            limits = [rule.limit for rule in rules if rule.limit is not None]
            limits = limits or [_first_speed([one.element.tag("speed_limit")])]
            ends = np.stack([left[-1], right[-1]])
            stop_line, stop_sign = _stop_of(rules, name, ends)
            yield lane_between(
                one.id,
                (left, right),
                speed_limit=limits[-1],  # of the last rule, or of the lanelet itself
                successors=tuple(
                    other
                    for other in starts.get(self._gate(one, -1), ())
                    if other.removesuffix(BACKWARDS) != name
                ),
                left=rights.get(one.left),
                right=lefts.get(one.right),
                stop_line=stop_line,
                stop_sign=stop_sign,
            )


def _first_speed(texts: list[str]) -> float | None:
    for text in texts:
        # one place for spaces: several take a time that is the square of their number
        match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([a-zA-Z/]*)", text.strip())
        if match is not None and match[2].lower() in SPEED_UNITS:
            speed = float(match[1]) * SPEED_UNITS[match[2].lower()]
            if 0.0 < speed < 90.0:
                return speed
    return None


def _stop_of(
    rules: list[_Rule], name: str, ends: np.ndarray
) -> tuple[np.ndarray | None, bool]:
    """End points [2, 2] m of a lanelet's stop line; whether everybody has to stop.

    A rule without a line of its own stops traffic at the lanelet's end.
    """
    found, sign = [], False
    for rule in rules:
        concerned = {
            "traffic_light": True,
            "all_way_stop": True,
            "traffic_sign": rule.stops,
            "right_of_way": name in rule.yields,
        }
        if concerned.get(rule.subtype, False):
            sign = sign or rule.stops
            found.append(rule.lines)
            if not len(rule.lines) and (rule.subtype == "traffic_light" or rule.stops):
                found.append(ends[None])
    lines = np.concatenate([*found, np.zeros((0, 2, 2))])
    if not len(lines):
        return None, False
    apart = np.hypot(*(lines.mean(axis=1) - ends.mean(axis=0)).T)
    return lines[np.argmin(apart)].copy(), sign  # a view would keep all of them
