"""Map features and signal states of a Waymo scenario -> Lanes and Signals.

A lane is a centre line; its width comes from the road lines and road edges that
its boundary segments name. Signals are recorded per lane and step, with the
point on that lane where cars have to stop. A lane that has a signal usually
begins there: it is the path across the junction.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rcirl_jax.data.importers.options import lane_types, number
from rcirl_jax.data.importers.shapes import (
    check_coordinates,
    line_across,
    moves,
)
from rcirl_jax.data.importers.waymo.widths import (
    MAX_POINTS,
    Bounds,
    Segments,
    half_widths,
)
from rcirl_jax.data.readers.wire_columns import Fields, Record
from rcirl_jax.data.recording import MAX_SPEED_MPS
from rcirl_jax.types import Lane, Signal
from rcirl_jax.units import MPH_MPS

# field numbers of map.proto
FEATURE_ID, LANE, ROAD_LINE, ROAD_EDGE, STOP_SIGN = 1, 3, 4, 5, 7
SPEED_LIMIT_MPH, LANE_TYPE, LANE_POLYLINE = 1, 2, 8
ENTRY_LANES, EXIT_LANES = 9, 10
NEIGHBOURS = {"left": 11, "right": 12}
BOUNDARIES = {"left": 13, "right": 14}
LINE_POLYLINE = 2
SIGN_LANE, SIGN_POSITION = 1, 2
LANE_STATES = 1
POINT = {1: "double", 2: "double"}  # x, y
NEIGHBOUR = {1: "int", 2: "int", 3: "int"}  # feature_id, self_start, self_end
BOUNDARY = {1: "int", 2: "int", 3: "int"}  # lane_start, lane_end, feature_id
LANE_STATE = {1: "int", 2: "int", 3: "message"}  # lane, state, stop_point
LANE_TYPES = {0: "undefined", 1: "freeway", 2: "surface_street", 3: "bike_lane"}
DRIVEN = ("undefined", "freeway", "surface_street")
WIDTH_M = 3.5  # m, of lanes without boundaries
# LANE_STATE_*: unknown, arrow stop/caution/go, stop/caution/go, flashing stop/caution
OFF, RED, YELLOW, GREEN = range(4)
NAMES = ("off", "red", "yellow", "green")
COLOURS = np.array([OFF, RED, YELLOW, GREEN, RED, YELLOW, GREEN, OFF, OFF], np.int8)
FLASHING_STOP = 7  # a stop sign, in effect
MAX_COLOURS = 50_000_000  # lanes by steps; 1000 lanes over an hour take 36 million
GAP_S = 2.0  # s, a signal unseen for so long kept its colour if it has it again


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Stop:
    """What the map and the signals say about stopping on one lane."""

    points: dict[int, np.ndarray]  # lane id -> [2] m
    signals: frozenset[int]  # lane ids with a signal
    signs: frozenset[int]  # lane ids that demand a stop at any time


def read_map(
    record: Record,
    features: np.ndarray,
    steps: np.ndarray,
    t: np.ndarray,
    origin: np.ndarray,
    spec: dict,
) -> tuple[tuple[Lane, ...], tuple[Signal, ...], list[str]]:
    """Lanes, signals and notes of one scenario.

    Args:
      record: the scenario.
      features: [n, 2] spans of its map features.
      steps: [len(t) or 0, 2] spans of its dynamic map states.
      t: [T] s, times of the steps.
      origin: [2] m, subtracted from all points.
      spec: source TOML.
    """
    wanted = (FEATURE_ID, LANE, ROAD_LINE, ROAD_EDGE, STOP_SIGN)
    found = [record.walk(span, wanted) for span in features]
    signals, points, flashing = _signals(record, steps, t, origin, spec)
    signs = _stop_signs(record, found, origin)
    stops = _Stop(
        points={**signs, **points},
        signals=frozenset(int(signal.id) for signal in signals),
        signs=frozenset(signs) | flashing,
    )
    lanes, notes = _lanes(record, found, stops, origin, spec)
    return lanes, signals, notes


def _points(record: Record, spans: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Map points [n, 2] m; heights are not read."""
    columns = record.columns(spans, POINT)
    points = np.stack([columns[1], columns[2]], axis=1)
    check_coordinates(record.where, "map points", ("x", "y"), points)
    return points - origin


def _messages(record: Record, found: Sequence[Fields], kind: int) -> dict[int, tuple]:
    """Feature id -> span of its data, of all features of a kind."""
    spans = {}
    for feature in found:
        span = feature.last(kind)
        if span is not None:
            key = feature.whole(FEATURE_ID)
            if key in spans:
                raise record.error(f"map feature {key}: met twice", "once")
            spans[key] = span
    return spans


def _polylines(
    record: Record, parts: dict[int, np.ndarray], origin: np.ndarray
) -> dict[int, np.ndarray]:
    """Feature id -> points [n, 2] m, all decoded in one go."""
    if not parts:
        return {}
    points = _points(record, np.concatenate(list(parts.values())), origin)
    ends = np.cumsum([len(spans) for spans in parts.values()])[:-1]
    return dict(zip(parts, np.split(points, ends), strict=True))


# ---------------------------------------------------------------------- lanes


def _lanes(
    record: Record,
    found: Sequence[Fields],
    stops: _Stop,
    origin: np.ndarray,
    spec: dict,
) -> tuple[tuple[Lane, ...], list[str]]:
    every = {
        key: record.walk(span, range(SPEED_LIMIT_MPH, BOUNDARIES["right"] + 1))
        for key, span in _messages(record, found, LANE).items()
    }
    wanted = lane_types(spec, tuple(LANE_TYPES.values()), DRIVEN)
    driven = {
        key: head
        for key, head in every.items()
        if LANE_TYPES.get(head.whole(LANE_TYPE), "undefined") in wanted
    }
    centres = _polylines(
        record,
        {key: head.spans(LANE_POLYLINE) for key, head in driven.items()},
        origin,
    )
    heads = {key: driven[key] for key, line in centres.items() if moves(line).sum() > 1}
    width = 0.5 * number(spec, "lane_width_m", WIDTH_M)
    bounds = Bounds(_bound_lines(record, found, origin))
    lanes = _built(record, heads, centres, bounds, stops, width)
    notes = []
    if len(every) > len(driven):
        notes.append(
            f"{len(every) - len(driven)} lanes not of type {', '.join(wanted)} left out"
        )
    if len(driven) > len(heads):
        notes.append(f"{len(driven) - len(heads)} lanes of one point left out")
    return lanes, notes


def _built(
    record: Record,
    heads: dict[int, Fields],
    centres: dict[int, np.ndarray],
    bounds: Bounds,
    stops: _Stop,
    default: float,
) -> tuple[Lane, ...]:
    """Lanes of two or more points; `default` half width [m]."""
    if not heads:
        return ()
    order, lines = list(heads.values()), [centres[key] for key in heads]
    left, right = (
        half_widths(lines, bounds, _segments(record, order, side), default)
        for side in ("left", "right")
    )
    beside = [_neighbours(record, order, side) for side in ("left", "right")]
    exits = {key: dict.fromkeys(head.wholes(EXIT_LANES)) for key, head in heads.items()}
    for key, head in heads.items():
        for before in head.wholes(ENTRY_LANES):
            exits.get(before, {})[key] = None
    lanes = []
    for row, (key, head) in enumerate(heads.items()):
        keep = moves(lines[row])
        lane = Lane(
            id=str(key),
            centre=lines[row][keep],
            left_width=left[row][keep],
            right_width=right[row][keep],
            speed_limit=_limit(record, key, head),
            successors=tuple(map(str, exits[key])),
            left=beside[0][row],
            right=beside[1][row],
            signal_ids=(str(key),) if key in stops.signals else (),
            stop_sign=key in stops.signs,
        )
        lanes.append(_stopped(lane, stops.points.get(key)))
    return tuple(lanes)


def _bound_lines(
    record: Record, found: Sequence[Fields], origin: np.ndarray
) -> dict[int, np.ndarray]:
    """Road lines and road edges as points [n, 2] m by feature id."""
    parts = {}
    for kind in (ROAD_LINE, ROAD_EDGE):
        for key, span in _messages(record, found, kind).items():
            spans = record.walk(span, (LINE_POLYLINE,)).spans(LINE_POLYLINE)
            if len(spans):
                parts[key] = spans
    return _polylines(record, parts, origin)


def _segments(record: Record, heads: Sequence[Fields], side: str) -> Segments:
    """What bounds the lanes on one side."""
    spans = [head.spans(BOUNDARIES[side]) for head in heads]
    first, last, line = record.columns(np.concatenate(spans), BOUNDARY).values()
    size = len(record.data)  # no lane has more points
    first, last = np.clip(first, 0, size), np.clip(last, -1, size)
    total = int(np.maximum(last - first + 1, 0).sum())
    if total > MAX_POINTS:
        raise record.error(
            f"{side}_boundaries: {total} points", f"at most {MAX_POINTS}"
        )
    lane = np.repeat(np.arange(len(heads)), [len(own) for own in spans])
    return Segments(lane=lane, first=first, last=last, line=line)


def _neighbours(record: Record, heads: Sequence[Fields], side: str) -> list[str | None]:
    """Per lane the neighbour along its longest part; all go the same way."""
    spans = [head.spans(NEIGHBOURS[side]) for head in heads]
    key, first, last = record.columns(np.concatenate(spans), NEIGHBOUR).values()
    lane = np.repeat(np.arange(len(heads)), [len(own) for own in spans])
    found: list[str | None] = [None] * len(heads)
    for row in np.argsort(last - first, kind="stable"):
        found[lane[row]] = str(int(key[row]))
    return found


def _limit(record: Record, key: int, head: Fields) -> float | None:
    """Speed limit m/s; zero stands for unknown."""
    limit = head.double(SPEED_LIMIT_MPH)
    if not 0.0 <= limit * MPH_MPS < MAX_SPEED_MPS:
        raise record.error(
            f"lane {key}: speed_limit_mph: {limit:g}",
            f"0 to {MAX_SPEED_MPS / MPH_MPS:.0f}",
        )
    return limit * MPH_MPS or None


def _stopped(lane: Lane, point: np.ndarray | None) -> Lane:
    """The lane with its stop line through a point [2] m, if there is one."""
    if point is None:
        return lane
    line = line_across(lane.centre, lane.left_width, lane.right_width, point)
    return dataclasses.replace(lane, stop_line=line)


# -------------------------------------------------------------------- signals


def _stop_signs(
    record: Record, found: Sequence[Fields], origin: np.ndarray
) -> dict[int, np.ndarray]:
    """Lane id -> position [2] m of the sign that governs it."""
    signs: dict[int, np.ndarray] = {}
    for span in _messages(record, found, STOP_SIGN).values():
        sign = record.walk(span, (SIGN_LANE, SIGN_POSITION))
        place = sign.last(SIGN_POSITION)
        if place is not None:
            point = _points(record, np.array([place]), origin)[0]
            signs.update({lane: point for lane in sign.wholes(SIGN_LANE)})
    return signs


def _signals(
    record: Record, steps: np.ndarray, t: np.ndarray, origin: np.ndarray, spec: dict
) -> tuple[tuple[Signal, ...], dict[int, np.ndarray], frozenset[int]]:
    """Signals by the lane they govern, stop points, lanes of flashing red."""
    if len(steps) not in (0, t.size):
        raise record.error(
            f"dynamic_map_states: {len(steps)}", f"{t.size}, one per timestamp"
        )
    spans = [record.walk(step, (LANE_STATES,)).spans(LANE_STATES) for step in steps]
    counts = np.array([len(own) for own in spans], np.int64)
    if not counts.sum():
        return (), {}, frozenset()
    lane, state, stop = record.columns(np.concatenate(spans), LANE_STATE).values()
    bad = np.flatnonzero((state < 0) | (state >= len(COLOURS)))
    if bad.size:
        raise record.error(
            f"lane {lane[bad[0]]}: signal state {state[bad[0]]}",
            f"0 to {len(COLOURS) - 1}",
        )
    ids, rows = np.unique(lane, return_inverse=True)
    if ids.size * t.size > MAX_COLOURS:
        raise record.error(
            f"dynamic_map_states: {ids.size} lanes over {t.size} steps",
            f"at most {MAX_COLOURS} states",
        )
    colours = np.full((ids.size, t.size), OFF, np.int8)
    step = np.repeat(np.arange(len(steps)), counts)
    # of two heads for one lane the first that is known counts: it is written last
    known = np.flatnonzero(COLOURS[state] != OFF)[::-1]
    colours[rows[known], step[known]] = COLOURS[state[known]]
    gap = number(spec, "signal_gap_s", GAP_S)
    signals = tuple(
        _signal(str(key), _bridged(row, t, gap), t)
        for key, row in zip(ids, colours, strict=True)
    )
    has_point = np.flatnonzero(stop[:, 1] > stop[:, 0])[::-1]
    points = _points(record, stop[has_point], origin)
    flashing = np.bincount(rows, state == FLASHING_STOP) > 0.5 * np.bincount(rows)
    return (
        signals,
        dict(zip(lane[has_point].tolist(), points, strict=True)),
        frozenset(ids[flashing].tolist()),
    )


def _bridged(colours: np.ndarray, t: np.ndarray, gap: float) -> np.ndarray:
    """Colours [T] with short unseen times filled between equal colours."""
    known = np.flatnonzero(colours != OFF)
    filled = colours.copy()
    before, after = known[:-1], known[1:]
    fill = (colours[before] == colours[after]) & (t[after] - t[before] <= gap)
    for first, last in zip(before[fill], after[fill], strict=True):
        filled[first:last] = colours[first]
    return filled


def _signal(name: str, colours: np.ndarray, t: np.ndarray) -> Signal:
    first = np.flatnonzero(np.diff(colours, prepend=-1))
    return Signal(
        id=name, start=t[first], state=tuple(NAMES[colour] for colour in colours[first])
    )
