"""CommonRoad lanelets -> Lanes: centre lines, widths, limits, stop lines.

The ids of signs are those of the countries' road traffic acts (`TrafficSignID...` of
commonroad-io); countries without a table of their own use the German ids.
"""

import collections
import contextlib

import numpy as np

from rcirl_jax.data.formats.options import number
from rcirl_jax.data.formats.shapes import fractions, lane_between, resample
from rcirl_jax.data.readers.xml import Node
from rcirl_jax.types import Lane

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
