"""Lanes of leveLXData recordings: highD's markings, and where a map lies."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rcirl_jax.data.formats.files import given_map
from rcirl_jax.data.formats.lanes import StraightLane, parallel_lane
from rcirl_jax.data.recording import check_lanes_length
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane

MARGIN_M = 50.0  # m of lane beyond the first and last position
MAP_FOLDERS = ("maps", "lanelets", "lanelet2")


def marked_lanes(
    path: Path,
    meta: Mapping[str, str],
    along: tuple[float, float],
    limit: float | None,
    rows: tuple[np.ndarray, np.ndarray],
) -> tuple[Lane, ...]:
    """highD: straight lanes between the markings, named as `laneId` names them.

    Args:
      path: the recordingMeta.csv, for errors.
      meta: its row.
      along: m, first and last x.
      limit: m/s, or None.
      rows: y [n] m (up) and x velocity [n] m/s of all rows; a carriageway is
        driven the way its rows are.
    """
    sides = [_markings(path, meta, f"{side}LaneMarkings") for side in SIDES]
    count = sum(marks.size - 1 for marks in sides)
    check_lanes_length(str(path), count * (along[1] - along[0] + 2.0 * MARGIN_M))
    lanes: list[Lane] = []
    number = 1  # lane 1 lies above the first marking
    for side, marks in zip(SIDES, sides, strict=True):
        y, velocity = rows
        inside = (y <= marks[0]) & (y >= marks[-1])
        travel = np.median(velocity[inside]) if inside.any() else SIDES[side]
        lanes += _carriageway(marks, number + 1, travel > 0.0, along, limit)
        number += len(marks)
    return tuple(lanes)


# highD: the upper carriageway is driven towards -x, the lower towards +x
SIDES = {"upper": -1.0, "lower": 1.0}


def _markings(path: Path, meta: Mapping[str, str], field: str) -> np.ndarray:
    """[m] m, y of the markings from top to bottom (y up)."""
    text = meta.get(field, "")
    try:
        marks = -np.array([float(mark) for mark in text.split(";") if mark.strip()])
    except ValueError:
        marks = np.zeros(0)
    if marks.size < 2 or not np.isfinite(marks).all() or np.any(np.diff(marks) >= 0.0):
        raise InputError(
            f"{path}: {field}: '{text[:60]}': expected at least two increasing "
            "numbers separated by ;"
        )
    return marks


def _carriageway(
    marks: np.ndarray,
    first: int,
    forward: bool,
    along: tuple[float, float],
    limit: float | None,
) -> list[Lane]:
    # the lane above (smaller number) is to the left of one driven towards +x
    ends = {"lower": along[0] - MARGIN_M, "upper": along[1] + MARGIN_M}
    numbers, lanes = range(first, first + len(marks) - 1), []
    for number, above, below in zip(numbers, marks, marks[1:], strict=False):
        half, y = 0.5 * (above - below), 0.5 * (above + below)
        around = [number - 1, number + 1] if forward else [number + 1, number - 1]
        ids = [str(n) if n in numbers else None for n in around]
        lane = StraightLane(id=str(number), y=y, forward=forward, **ends)
        lanes.append(parallel_lane(lane, (half, half), ids, limit))
    return lanes


def find_map(path: Path, location: str, spec: dict) -> Path | None:
    """The Lanelet2 map of a recording's location, or None.

    The releases keep maps/lanelets/04_aseag/location4.osm (or
    lanelets/location4.osm) beside the folder `data`. The option `map` names a
    file, or a folder to look into.
    """
    if (given := given_map(spec)) is not None:
        if given.is_file():
            return given
        return _of_location(sorted(given.rglob("*.osm")), location)
    folder = path.resolve().parent
    for place in (folder, folder.parent):
        folders = [place / name for name in MAP_FOLDERS]
        found = [file for inside in folders for file in sorted(inside.rglob("*.osm"))]
        match = _of_location([*sorted(place.glob("*.osm")), *found], location)
        if match is not None:
            return match
    return None


def _of_location(files: list[Path], location: str) -> Path | None:
    """locationN.osm; else the only map in a folder named N_..., N_*.osm, *_N.osm."""
    digits = location.split(".")[0].lstrip("0") or "0"
    if not digits.isdigit():
        return None
    patterns = (
        (rf"location_?0*{digits}", "stem"),
        (rf"0*{digits}_.*", "parent"),
        (rf"0*{digits}_.*", "stem"),
        (rf".*_0*{digits}", "stem"),
    )
    for pattern, part in patterns:
        for file in files:
            if part == "parent" and file.stem.lower().startswith("location"):
                continue
            name = file.parent.name if part == "parent" else file.stem
            if re.fullmatch(pattern, name, flags=re.IGNORECASE):
                return file
    return None
