"""CommonRoad lanelets -> Lanes: centre lines, widths, limits, stop lines.

The ids of signs are those of CommonRoad's own tables (`TrafficSignID...` of
commonroad-io and of its environment model), which are the ones of the countries' road
traffic acts. CommonRoad's default country and those without a table of their own use
the German ids.
"""

import collections
from xml.etree.ElementTree import Element

import numpy as np

from rcirl_jax.data.formats.options import number
from rcirl_jax.data.formats.shapes import MIN_HALF_WIDTH_M, fractions, resample
from rcirl_jax.data.readers.xml import Fields
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane

MIN_LIMIT_MPS = 5.0  # m/s, where the source TOML says none; lower signs are artefacts
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


class _Signs:
    """What the signs of a file say, by the signs' ids.

    Args:
      root: of the file.
      fields: of the file.
      lowest: m/s; limits below are taken for none.
    """

    def __init__(self, root: Element, fields: Fields, lowest: float) -> None:
        country = root.get("benchmarkID", "").removeprefix("C-")[:COUNTRY]
        own = [*LIMITS_AND_STOPS.values()]  # where it names none, or Zamunda
        if country.isalpha() and country.isupper() and country != "ZAM":
            own = [pair for key, pair in LIMITS_AND_STOPS.items() if key == country]
        limits = {*GERMAN_LIMITS, *(limit for limit, _ in own)}
        stops = {*GERMAN_STOPS, *(stop for _, stop in own)}
        self.limits: dict[str, float] = {}  # m/s
        self.stops: set[str] = set()
        self.notes: list[str] = []
        ignored, unknown = 0, collections.Counter[str]()
        for sign in root.iterfind("trafficSign"):
            name = sign.get("id", "")
            for element in sign.iterfind("trafficSignElement"):
                kind = _plain((element.findtext("trafficSignID") or "").strip())
                value = element.find("additionalValue")
                if kind in stops:
                    self.stops.add(name)
                elif kind in limits and value is not None:
                    limit = fields.number(value, f"trafficSign {name}")
                    if limit >= lowest:
                        self.limits[name] = limit
                    ignored += limit < lowest
                elif value is not None and _is_unknown(kind, value):
                    unknown[kind] += 1
        if ignored:
            self.notes.append(f"{ignored} speed limits below {lowest:g} m/s ignored")
        if unknown:
            kinds = ", ".join(f"{n} {kind[:20]}" for kind, n in unknown.items())
            self.notes.append(
                f"{unknown.total()} signs with a number, but of unknown id: "
                f"{kinds[:200]}"
            )


def _plain(kind: str) -> str:
    """An id in one spelling: r301 as R301, a Greek rho as P, 274-50 as 274."""
    plain = kind.upper().replace("\N{GREEK CAPITAL LETTER RHO}", "P")
    name, _, number = plain.partition("-")
    return name if name in GERMAN_LIMITS and number.isdigit() else plain


def _is_unknown(kind: str, value: Element) -> bool:
    """True if the number on a sign has no known meaning."""
    try:
        float(value.text or "")
    except ValueError:
        return False
    return kind not in OTHER_NUMBERS and not kind.startswith(PLATES)


def read_lanes(
    root: Element, fields: Fields, spec: dict
) -> tuple[tuple[Lane, ...], list[str]]:
    """Reads all lanelets of a file as lanes, and notes about what was ignored."""
    signs = _Signs(root, fields, number(spec, "min_speed_limit", MIN_LIMIT_MPS))
    lanes = tuple(
        _read_lanelet(element, fields, signs) for element in root.iterfind("lanelet")
    )
    if not lanes:
        raise InputError(f"{fields.path}: lanelet: none: expected a road network")
    return lanes, signs.notes


def _bound(element: Element, tag: str, fields: Fields, where: str) -> np.ndarray:
    bound = fields.child(element, tag, where)
    points = [fields.point(point, where) for point in bound.iterfind("point")]
    if len(points) < 2:
        raise InputError(f"{fields.path}: {where}: {tag}: expected >= 2 points")
    return np.array(points)


def _read_lanelet(element: Element, fields: Fields, signs: _Signs) -> Lane:
    name = element.get("id", "(no id)")
    where = f"lanelet {name}"
    left = _bound(element, "leftBound", fields, where)
    right = _bound(element, "rightBound", fields, where)
    if len(left) != len(right):
        at = np.unique(np.concatenate([fractions(left), fractions(right)]))
        left, right = resample(left, at), resample(right, at)
    half = np.maximum(0.5 * np.hypot(*(left - right).T), MIN_HALF_WIDTH_M)
    own = [ref.get("ref", "") for ref in element.iter("trafficSignRef")]
    limit = element.find("speedLimit")
    if limit is not None:
        speed_limit: float | None = fields.number(limit, where)
    else:
        limits = (signs.limits[sign] for sign in own if sign in signs.limits)
        speed_limit = next(limits, None)
    stop, stop_line = element.find("stopLine"), None
    if stop is not None:
        ends = [fields.point(point, where) for point in stop.iterfind("point")]
        # a stop line without points lies at the lanelet's end
        ends = ends if len(ends) == 2 else [left[-1], right[-1]]
        stop_line = np.array(ends)
    return Lane(
        id=name,
        centre=0.5 * (left + right),
        left_width=half,
        right_width=half,
        speed_limit=speed_limit,
        successors=tuple(s.get("ref", "") for s in element.iterfind("successor")),
        left=_neighbour(element, "adjacentLeft"),
        right=_neighbour(element, "adjacentRight"),
        stop_line=stop_line,
        signal_ids=tuple(r.get("ref", "") for r in element.iterfind("trafficLightRef")),
        stop_sign=stop is not None and not signs.stops.isdisjoint(own),
    )


def _neighbour(element: Element, tag: str) -> str | None:
    found = element.find(tag)
    if found is None or found.get("drivingDir") != "same":
        return None
    return found.get("ref")
