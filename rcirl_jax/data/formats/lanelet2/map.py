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
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from rcirl_jax.data.formats.lanelet2.rules import (
    OsmMap,
    bound,
    line_of,
    members,
    speed_limit,
    stop_of,
    tag_of,
)
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
BACKWARDS = "-back"  # appended to the id of a two-way lanelet's other direction


@dataclasses.dataclass(frozen=True)
class _Lanelet:
    """A lanelet driven one way: bounds as nodes in driving direction."""

    id: str
    left: tuple[str, ...]
    right: tuple[str, ...]
    relation: Element


def read_lanelet2(path: Path, project: Projection) -> tuple[tuple[Lane, ...], list]:
    """All lanes for vehicles of a map.

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
    if first.get("x") is not None:
        pairs = [(node.get("x"), node.get("y")) for node in nodes.values()]
    elif tag_of(first, "local_x"):
        tags = [(tag_of(n, "local_x"), tag_of(n, "local_y")) for n in nodes.values()]
        pairs = tags
    else:
        pairs = [(node.get("lat"), node.get("lon")) for node in nodes.values()]
    values = np.array([[_number(text) for text in pair] for pair in pairs])
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if wrong.size:
        name, pair = list(nodes)[wrong[0]], pairs[wrong[0]]
        raise InputError(
            f"{path}: node {name[:40]}: position: {str(pair)[:60]}: "
            "expected two finite numbers"
        )
    degrees = first.get("x") is None and not tag_of(first, "local_x")
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


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return float("nan")


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
            successors=tuple(s for s in following if not _same_road(s, lanelet.id)),
            left=rights.get(lanelet.left),
            right=lefts.get(lanelet.right),
            stop_line=stop_line,
            stop_sign=stop_sign,
        )


def _same_road(a: str, b: str) -> bool:
    return a.removesuffix(BACKWARDS) == b.removesuffix(BACKWARDS)


def _gate(world: OsmMap, lanelet: _Lanelet, end: int) -> tuple:
    """Where a lanelet begins (0) or ends (-1): its two corner points."""
    corners = [world.points[nodes[end]] for nodes in (lanelet.left, lanelet.right)]
    return tuple(np.round(np.concatenate(corners) / SAME_PLACE_M).astype(int))
