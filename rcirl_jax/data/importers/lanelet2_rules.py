"""Elements of Lanelet2 maps: tags, members, lines, speed limits, stop lines."""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from rcirl_jax.units import MPH_MPS

STOP_SIGNS = ("us_r1_1", "usr1-1", "r1-1", "de206", "206", "stop")
SPEED_UNITS = {
    "": 1.0 / 3.6,  # Lanelet2: no unit means km/h
    "km/h": 1.0 / 3.6,
    "kmh": 1.0 / 3.6,
    "kph": 1.0 / 3.6,
    "mph": MPH_MPS,
    "mps": 1.0,
    "m/s": 1.0,
}


@dataclasses.dataclass(frozen=True)
class OsmMap:
    """What a file holds; elements by id."""

    path: Path
    points: dict[str, np.ndarray]  # node -> [2] m
    ways: dict[str, Element]
    relations: dict[str, Element]


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
    parts = []
    for name in names:
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


def _rules(world: OsmMap, relation: Element) -> Iterator[Element]:
    """Regulatory elements that a lanelet refers to."""
    for member in relation.iterfind("member"):
        rule = world.relations.get(member.get("ref", ""))
        if (
            member.get("type") == "relation"
            and rule is not None
            and tag_of(rule, "type") == "regulatory_element"
        ):
            yield rule


def speed_limit(world: OsmMap, relation: Element) -> float | None:
    """m/s, of a speed_limit rule, or of the lanelet's own tag."""
    texts = [tag_of(relation, "speed_limit")]
    for rule in _rules(world, relation):
        if tag_of(rule, "subtype") == "speed_limit":
            signs = [world.ways.get(n) for n in members(rule, "refers", "way")]
            kinds = [tag_of(sign, "subtype") for sign in signs if sign is not None]
            # German sign 274 carries its number: de274-60
            numbers = [kind.rpartition("-")[2] for kind in kinds if "274-" in kind]
            texts = [tag_of(rule, "sign_type").rpartition("274-")[2], *numbers, *texts]
    found = (_speed(text) for text in texts)
    return next((speed for speed in found if speed is not None), None)


def _speed(text: str) -> float | None:
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-zA-Z/]*)\s*", text)
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
    lines, sign = [], False
    for rule in _rules(world, relation):
        subtype = tag_of(rule, "subtype")
        if subtype not in ("traffic_light", "all_way_stop", "traffic_sign"):
            if subtype != "right_of_way":
                continue
            if name not in members(rule, "yield", "relation"):
                continue
        stops = subtype == "all_way_stop" or _has_stop_sign(world, rule)
        if subtype == "traffic_sign" and not stops:
            continue
        sign = sign or stops
        own = [bound(world, [n]) for n in members(rule, "ref_line", "way")]
        lines += [line_of(world, nodes)[[0, -1]] for nodes in own if nodes]
        if subtype == "traffic_light" or stops:
            lines += [] if any(own) else [ends]
    if not lines:
        return None, False
    middle = ends.mean(axis=0)
    apart = [float(np.hypot(*(line.mean(axis=0) - middle))) for line in lines]
    return lines[int(np.argmin(apart))], sign


def _has_stop_sign(world: OsmMap, rule: Element) -> bool:
    names = [tag_of(rule, "sign_type").lower()]
    for name in members(rule, "refers", "way"):
        if name in world.ways:
            names.append(tag_of(world.ways[name], "subtype").lower())
    return any(name in STOP_SIGNS for name in names)
