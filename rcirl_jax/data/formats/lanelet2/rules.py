"""Elements of Lanelet2 maps: tags, members, lines, speed limits, stop lines."""

import dataclasses
import functools
import re
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.units import MPH_MPS

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
        """Regulatory elements by id."""
        return _read_rules(self)


def tag_of(element: Element, key: str) -> str:
    """Value of a tag, "" if the element has none."""
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


def _read_rules(world: OsmMap) -> dict[str, Rule]:
    """All regulatory elements; a way that many of them name is looked at once."""

    @functools.cache
    def sign(name: str) -> str:
        return tag_of(world.ways[name], "subtype") if name in world.ways else ""

    @functools.cache
    def ends(name: str) -> tuple[str, ...]:
        nodes = bound(world, [name])
        return nodes and (nodes[0], nodes[-1])

    rules = {}
    for key, element in world.relations.items():
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
        lines = [line_of(world, nodes) for nodes in own if nodes]
        rules[key] = Rule(
            subtype=subtype,
            yields=frozenset(members(element, "yield", "relation")),
            stops=subtype == "all_way_stop"
            or any(kind.lower() in STOP_SIGNS for kind in (text, *kinds)),
            lines=np.array(lines).reshape(-1, 2, 2),
            limit=_first_speed(texts),
        )
    return rules


def _rules(world: OsmMap, relation: Element) -> list[Rule]:
    """Regulatory elements that a lanelet refers to, each once."""
    names = dict.fromkeys(
        member.get("ref", "")
        for member in relation.iterfind("member")
        if member.get("type") == "relation"
    )
    return [world.rules[name] for name in names if name in world.rules]


def speed_limit(world: OsmMap, relation: Element) -> float | None:
    """m/s, of the last speed_limit rule, or of the lanelet's own tag."""
    limits = [rule.limit for rule in _rules(world, relation) if rule.limit is not None]
    return limits[-1] if limits else _first_speed([tag_of(relation, "speed_limit")])


def _first_speed(texts: list[str]) -> float | None:
    found = (_speed(text) for text in texts)
    return next((speed for speed in found if speed is not None), None)


def _speed(text: str) -> float | None:
    # one place for spaces: several take a time that is the square of their number
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([a-zA-Z/]*)", text.strip())
    if match is None or match[2].lower() not in SPEED_UNITS:
        return None
    speed = float(match[1]) * SPEED_UNITS[match[2].lower()]
    return speed if 0.0 < speed < 90.0 else None


def stop_of(
    world: OsmMap, name: str, relation: Element, ends: np.ndarray
) -> tuple[np.ndarray | None, bool]:
    """End points [2, 2] m of the stop line, and whether everybody has to stop.

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
