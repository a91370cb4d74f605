"""CommonRoad lanelets -> Lanes: centre lines, widths, limits, stop lines."""

from xml.etree.ElementTree import Element

import numpy as np

from rcirl_jax.data.formats.commonroad.signs import Signs
from rcirl_jax.data.formats.options import number
from rcirl_jax.data.formats.shapes import MIN_HALF_WIDTH_M, fractions, resample
from rcirl_jax.data.readers.xml import Fields
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane

MIN_LIMIT_MPS = 5.0  # m/s, where the source TOML says none; lower signs are artefacts


def read_lanes(
    root: Element, fields: Fields, spec: dict
) -> tuple[tuple[Lane, ...], list[str]]:
    """All lanelets of a file as lanes, and notes about what was ignored."""
    signs = Signs(root, fields, number(spec, "min_speed_limit", MIN_LIMIT_MPS))
    lanes = tuple(
        _read_lanelet(element, fields, signs) for element in root.iterfind("lanelet")
    )
    if not lanes:
        raise InputError(f"{fields.path}: lanelet: none: expected a road network")
    return lanes, signs.notes()


def _bound(element: Element, tag: str, fields: Fields, where: str) -> np.ndarray:
    bound = fields.child(element, tag, where)
    points = [fields.point(point, where) for point in bound.iterfind("point")]
    if len(points) < 2:
        raise InputError(f"{fields.path}: {where}: {tag}: expected >= 2 points")
    return np.array(points)


def _read_lanelet(element: Element, fields: Fields, signs: Signs) -> Lane:
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
    stop = element.find("stopLine")
    return Lane(
        id=name,
        centre=0.5 * (left + right),
        left_width=half,
        right_width=half,
        speed_limit=speed_limit,
        successors=tuple(s.get("ref", "") for s in element.iterfind("successor")),
        left=_neighbour(element, "adjacentLeft"),
        right=_neighbour(element, "adjacentRight"),
        stop_line=_stop_line(stop, fields, where, left, right),
        signal_ids=tuple(r.get("ref", "") for r in element.iterfind("trafficLightRef")),
        stop_sign=stop is not None and not signs.stops.isdisjoint(own),
    )


def _neighbour(element: Element, tag: str) -> str | None:
    found = element.find(tag)
    if found is None or found.get("drivingDir") != "same":
        return None
    return found.get("ref")


def _stop_line(
    stop: Element | None,
    fields: Fields,
    where: str,
    left: np.ndarray,
    right: np.ndarray,
) -> np.ndarray | None:
    """End points [2, 2]; a stop line without points lies at the lanelet's end."""
    if stop is None:
        return None
    points = [fields.point(point, where) for point in stop.iterfind("point")]
    return np.array(points) if len(points) == 2 else np.stack([left[-1], right[-1]])
