"""The plan of each recording's site, kept with a dataset so that a person can look."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from rcirl_jax.data.scenes.lanes import LaneGraph
from rcirl_jax.errors import counted
from rcirl_jax.types import Kind, Recording, Track

MAX_TRACKS = 200  # of a recording, evenly
MAX_PLANS = 12  # recordings of a dataset
STEP_S = 0.5  # s between points of a track
LANE_STEP_M = 3.0  # m between points of a lane
STAYS_S = 1.0  # s on a lane, after which a driver has changed to it
KINDS = {Kind.VEHICLE: "vehicle", Kind.CYCLIST: "cyclist"}


def plan_of(recording: Recording, graph: LaneGraph) -> dict[str, Any]:
    """Makes the plan of a recording, JSON-ready.

    Returns:
      name; lanes: id, centre [[x, y]] m, left and right m, limit m/s or null, assumed,
      stop_line; tracks: kind, points [[x, y, heading rad, speed m/s]]; changes of lane
      [[x, y]], of all vehicles; vehicles: how many there were.
    """
    vehicles = [x for x in recording.tracks if x.kind == Kind.VEHICLE]
    changes = [place for one in vehicles for place in changes_of_lane(one, graph)]
    shown = [*recording.tracks]
    if len(shown) > MAX_TRACKS:
        at = np.linspace(0, len(shown) - 1, MAX_TRACKS).round().astype(int)
        shown = [shown[n] for n in at]
    return {
        "name": recording.name,
        "source": recording.source,
        "vehicles": len(vehicles),
        "default_limit": recording.default_speed_limit,
        "lanes": [
            {
                "id": lane.id,
                "centre": _every(lane.centre, LANE_STEP_M).round(2).tolist(),
                "left": round(float(np.median(lane.left_width)), 2),
                "right": round(float(np.median(lane.right_width)), 2),
                "limit": lane.speed_limit,
                "assumed": lane.width_assumed,
                "stop_line": None
                if lane.stop_line is None
                else lane.stop_line.round(2).tolist(),
            }
            for lane in recording.lanes
        ],
        "tracks": [
            {"kind": KINDS.get(track.kind, "other"), "points": _points(track)}
            for track in shown
        ],
        "changes": changes,
        "notes": list(recording.notes),
    }


def changes_of_lane(track: Track, graph: LaneGraph) -> list[list[float]]:
    """Returns the places [x, y] m at which a driver comes onto the lane beside.

    Pieces that follow each other are one lane. It counts once the driver has been on
    it for STAYS_S.
    """
    names = graph.match(track.x, track.y, track.heading)
    rows = np.flatnonzero(names != "")
    lanes = graph.lines()
    numbers = np.array([lanes[name] for name in names[rows]], int)
    runs = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(rows)]
    found: list[list[float]] = []
    before: list[str] = []  # pieces that were driven last on one lane
    for first, last in itertools.pairwise(runs):
        if first == last or track.t[rows[last - 1]] - track.t[rows[first]] < STAYS_S:
            continue
        driven = list(dict.fromkeys(names[rows[first:last]].tolist()))
        # also one that comes over behind the end of its lane
        is_beside = before and lanes[driven[0]] in graph.lines_beside(lanes[before[0]])
        if is_beside and not graph.follows(before, driven):
            row = rows[first]
            found.append([round(float(x[row]), 1) for x in (track.x, track.y)])
        before = driven
    return found


def _points(track: Track) -> list[list[float]]:
    """Returns x, y, heading, speed every STEP_S."""
    times = np.arange(track.t[0], track.t[-1], STEP_S)
    # the last may lie a rounding behind the end
    rows = np.searchsorted(track.t, np.minimum(times, track.t[-1]))
    columns = (track.x, track.y, track.heading, track.speed)
    return np.stack(columns, axis=1)[rows].round(2).tolist()


def _every(line: np.ndarray, step: float) -> np.ndarray:
    """Returns the points of a line that lie a step apart, and its last."""
    arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    rows = np.unique(np.searchsorted(arc, np.arange(0.0, arc[-1], step)))
    return line[np.append(rows[rows < len(line) - 1], len(line) - 1)]


def facts_of(plan: Mapping[str, Any]) -> str:
    """Says what a plan shows in a line of words."""
    lanes = plan["lanes"]
    limits = sorted({x["limit"] or plan["default_limit"] for x in lanes})
    words = [counted(plan["vehicles"], "vehicle"), f"{len(lanes):,} pieces of lane"]
    if lanes:
        apart = [x["left"] + x["right"] for x in lanes]
        words.append(f"{np.median(apart):.1f} m wide")
        words.append("limit " + ", ".join(f"{x:.0f}" for x in limits[:4]) + " m/s")
    words.append(f"{counted(len(plan['changes']), 'change')} of lane")
    return ", ".join(words)
