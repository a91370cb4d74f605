"""Lanelet2 maps (OSM XML) as published with recordings: a road and a right turn.

In local metres, x east and y north: a road along x at y = 0 with one lane each
way, driven on the right; the eastbound lane is cut at x = TURN_X, where a lane
turns right and leads south. A footpath and a two-way access road lie beside it.
"""

import numpy as np
import pyproj

WIDTH = 3.5  # m, of every lane
TURN_X, RADIUS = 80.0, 15.0  # m, where the right turn begins; of its centre line
NUM_LANES = 7  # for vehicles, both directions of the access road included
EAST_Y, WEST_Y = -0.5 * WIDTH, 0.5 * WIDTH  # m, centre lines


def _arc(radius, count=10):
    angle = np.linspace(0.0, 0.5 * np.pi, count)
    centre = (TURN_X, EAST_Y - RADIUS)
    return [
        (centre[0] + radius * np.sin(a), centre[1] + radius * np.cos(a)) for a in angle
    ]


# way -> points; names are reused by lanelets, so that they share their bounds
WAYS = {
    "border_north": [(160.0, WIDTH), (80.0, WIDTH), (0.0, WIDTH)],
    "middle_1": [(0.0, 0.0), (40.0, 0.0)],
    "middle_2": [(40.0, 0.0), (TURN_X, 0.0)],
    "middle_3": [(TURN_X, 0.0), (160.0, 0.0)],
    # drawn against the direction of travel
    "border_1": [(TURN_X, -WIDTH), (0.0, -WIDTH)],
    "border_3": [(TURN_X, -WIDTH), (160.0, -WIDTH)],
    "turn_left": _arc(RADIUS + 0.5 * WIDTH),
    "turn_right": _arc(RADIUS - 0.5 * WIDTH),
    "south_left": [_arc(RADIUS + 0.5 * WIDTH)[-1], (96.75, -80.0)],
    "south_right": [_arc(RADIUS - 0.5 * WIDTH)[-1], (93.25, -80.0)],
    "path_north": [(0.0, 8.0), (160.0, 8.0)],
    "path_south": [(0.0, 6.0), (160.0, 6.0)],
    "access_left": [(20.0, -20.0), (60.0, -20.0)],
    "access_right": [(20.0, -25.0), (60.0, -25.0)],
    "line": [(93.25, -78.0), (96.75, -78.0)],
    "sign": [(97.5, -78.0), (98.5, -78.0)],
    "half": [(0.0, 30.0)],
}
WAY_TAGS = {
    "line": {"type": "stop_line"},
    "sign": {"type": "traffic_sign", "subtype": "usR1-1"},
}
ROAD = {"type": "lanelet", "subtype": "road", "location": "urban", "one_way": "yes"}
# lanelet -> (left ways, right ways, tags, rules)
LANELETS = {
    "30001": (["middle_1", "middle_2"], ["border_1"], ROAD, ["50000"]),
    "30002": (["middle_3"], ["border_3"], ROAD, ["50000"]),
    "30003": (["turn_left"], ["turn_right"], ROAD, ["50000"]),
    "30004": (["south_left"], ["south_right"], ROAD, ["50000", "50001"]),
    "30005": (["middle_3", "middle_2", "middle_1"], ["border_north"], ROAD, ["50000"]),
    "30006": (
        ["path_north"],
        ["path_south"],
        {**ROAD, "subtype": "walkway", "one_way": "no"},
        [],
    ),
    "30007": (["access_left"], ["access_right"], {**ROAD, "one_way": "no"}, []),
    "30008": (["half"], ["path_north"], ROAD, []),
}
RULES = {
    "50000": ({"subtype": "speed_limit", "sign_type": "50 km/h"}, []),
    "50001": (
        {"subtype": "right_of_way"},
        [
            ("way", "line", "ref_line"),
            ("way", "sign", "refers"),
            ("relation", "30004", "yield"),
            ("relation", "30002", "right_of_way"),
        ],
    ),
}


def degrees(points, zone, origin):
    """[n, 2] latitude and longitude of local metres."""
    project = pyproj.Proj(proj="utm", zone=zone, ellps="WGS84")
    east, north = np.transpose(np.asarray(points, float) + origin)
    longitude, latitude = project(east, north, inverse=True)
    return np.stack([latitude, longitude], axis=1)


def lanelet_map(path, place, shift=(0.0, 0.0), lanelets=None, extra=""):
    """Write the map; `place(points [n, 2]) -> one string of attributes each`."""
    lanelets = LANELETS if lanelets is None else lanelets
    numbers, corners = {}, []
    for points in WAYS.values():
        for point in points:
            key = tuple(np.round(point, 6))
            if key not in numbers:
                numbers[key] = 1000 + len(numbers)
                corners.append(np.add(point, shift))
    lines = ["<?xml version='1.0' encoding='UTF-8'?>", "<osm version='0.6'>"]
    for number, text in zip(numbers.values(), place(np.array(corners)), strict=True):
        lines.append(f"  <node id='{number}' visible='true' version='1' {text} />")
    lines.append("  <node id='5' action='delete' visible='true' />")
    ways = {name: 10000 + place for place, name in enumerate(WAYS)}
    for name, points in WAYS.items():
        tags = WAY_TAGS.get(name, {"type": "line_thin", "subtype": "dashed"})
        refs = [numbers[tuple(np.round(point, 6))] for point in points]
        body = [f"    <nd ref='{ref}' />" for ref in refs] + _tags(tags)
        lines += [f"  <way id='{ways[name]}' version='1'>", *body, "  </way>"]
    for name, (left, right, tags, rules) in lanelets.items():
        members = [("way", ways[w], "left") for w in left]
        members += [("way", ways[w], "right") for w in right]
        # editors write either role
        roles = ("regulatory_element", "")
        members += [("relation", r, roles[i % 2]) for i, r in enumerate(rules)]
        lines += _relation(name, members, tags)
    for name, (tags, members) in RULES.items():
        members = [(kind, ways.get(ref, ref), role) for kind, ref, role in members]
        lines += _relation(name, members, {**tags, "type": "regulatory_element"})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([*lines, extra, "</osm>"]) + "\n")
    return path


def _tags(tags):
    return [f"    <tag k='{key}' v='{value}' />" for key, value in tags.items()]


def _relation(name, members, tags):
    body = [
        f"    <member type='{kind}' ref='{ref}' role='{role}' />"
        for kind, ref, role in members
    ]
    return [
        f"  <relation id='{name}' version='1'>",
        *body,
        *_tags(tags),
        "  </relation>",
    ]


def in_degrees(zone, origin):
    """Placer for lat, lon."""

    def place(points):
        return [
            f"lat='{lat:.11f}' lon='{lon:.11f}'"
            for lat, lon in degrees(points, zone, np.asarray(origin))
        ]

    return place


def in_metres(points):
    """Placer for x, y attributes (.osm_xy)."""
    return [f"x='{x:.4f}' y='{y:.4f}'" for x, y in points]
