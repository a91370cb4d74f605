"""Map features and signal states of a Waymo scenario -> Lanes and Signals.

A lane is a centre line; its width comes from the road lines and road edges that
its boundary segments name. Signals are recorded per lane and step; a lane that has one
usually begins there: it is the path across the junction.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from rcirl_jax.data.formats.options import lane_types, number
from rcirl_jax.data.formats.perception import STATES, signal_of
from rcirl_jax.data.formats.shapes import (
    MIN_HALF_WIDTH_M,
    check_coordinates,
    distances_to_lines,
    line_across,
    moves,
)
from rcirl_jax.data.readers.protobuf import Message, columns
from rcirl_jax.data.recording import MAX_SPEED_MPS
from rcirl_jax.errors import InputError
from rcirl_jax.types import Lane, Signal
from rcirl_jax.units import MPH_MPS

NEIGHBOUR = ("feature_id", "self_start_index", "self_end_index")
BOUNDARY = ("lane_start_index", "lane_end_index", "boundary_feature_id")
SIDES = ("left", "right")
LANE_TYPES = {0: "undefined", 1: "freeway", 2: "surface_street", 3: "bike_lane"}
DRIVEN = ("undefined", "freeway", "surface_street")
MAX_HALF_WIDTH_M = 5.0  # m; a farther line does not bound the lane
MEASURE_STEP = 4  # points (2 m) between those at which widths are measured
MAX_POINTS = 5_000_000  # of all lanes; 10,000 km of them are no map
# LANE_STATE_*: unknown, arrow stop/caution/go, stop/caution/go, flashing stop/caution
OFF, RED, YELLOW, GREEN = range(len(STATES))
COLOURS = np.array([OFF, RED, YELLOW, GREEN, RED, YELLOW, GREEN, OFF, OFF], np.int8)
FLASHING_STOP = 7  # a stop sign, in effect
MAX_COLOURS = 50_000_000  # lanes by steps; 1000 lanes over an hour take 36 million


def read_map(
    where: str, scenario: Message, t: np.ndarray, origin: np.ndarray, spec: dict
) -> tuple[tuple[Lane, ...], tuple[Signal, ...], list[str]]:
    """Reads lanes, signals and notes of one scenario.

    Args:
      where: names file and record in errors.
      scenario: the message.
      t: [T] s, times of the steps.
      origin: [2] m, subtracted from all points.
      spec: source TOML.
    """
    features = scenario.map_features
    steps = scenario.dynamic_map_states
    signals, points, flashing = _signals(where, steps, t, origin, spec)
    signs: dict[int, np.ndarray] = {}  # lane id -> [2] m, the sign that governs it
    for sign in _by_id(where, features, "stop_sign").values():
        if sign.HasField("position"):
            place = _points(where, [sign.position], origin)[0]
            signs.update(dict.fromkeys(sign.lane, place))
    lanes, notes = _lanes(where, features, {**signs, **points}, origin, spec)
    lit = {signal.id for signal in signals}
    signed = {str(key) for key in signs.keys() | flashing}
    lanes = tuple(
        dataclasses.replace(
            lane,
            signal_ids=(lane.id,) if lane.id in lit else (),
            stop_sign=lane.id in signed,
        )
        for lane in lanes
    )
    return lanes, signals, notes


def _points(where: str, messages: Iterable[Message], origin: np.ndarray) -> np.ndarray:
    """Map points [n, 2] m; heights are not read."""
    points = columns(messages, "x", "y")
    check_coordinates(where, "map points", ("x", "y"), points)
    return points - origin


def _by_id(where: str, features: Iterable[Message], kind: str) -> dict[int, Message]:
    """Feature id -> its data, of all features of a kind."""
    found = {}
    for feature in features:
        if feature.HasField(kind):
            if feature.id in found:
                raise InputError(
                    f"{where}: map feature {feature.id}: met twice: expected once"
                )
            found[feature.id] = getattr(feature, kind)
    return found


def _polylines(
    where: str, lines: Mapping[int, Message], origin: np.ndarray
) -> dict[int, np.ndarray]:
    """Feature id -> points [n, 2] m of its polyline."""
    if not lines:
        return {}
    parts = [line.polyline for line in lines.values()]
    points = _points(where, itertools.chain.from_iterable(parts), origin)
    ends = np.cumsum([len(part) for part in parts])[:-1]
    return dict(zip(lines, np.split(points, ends), strict=True))


# ---------------------------------------------------------------------- lanes


def _lanes(
    where: str,
    features: Sequence[Message],
    stops: Mapping[int, np.ndarray],
    origin: np.ndarray,
    spec: dict,
) -> tuple[list[Lane], list[str]]:
    """Lanes of the wanted types and of two or more points; stops [2] m by lane id."""
    every = _by_id(where, features, "lane")
    wanted = lane_types(spec, tuple(LANE_TYPES.values()), DRIVEN)
    driven = {
        key: lane
        for key, lane in every.items()
        if LANE_TYPES.get(lane.type, "undefined") in wanted
    }
    centres = _polylines(where, driven, origin)
    heads = {key: driven[key] for key, line in centres.items() if moves(line).sum() > 1}
    both = [_by_id(where, features, kind) for kind in ("road_line", "road_edge")]
    lines = {key: line for kind in both for key, line in kind.items() if line.polyline}
    bounds = _polylines(where, lines, origin)
    order, default = list(heads.values()), 0.5 * number(spec, "lane_width_m")
    line_of = [centres[key] for key in heads]
    widths = [_half_widths(where, side, order, line_of, bounds) for side in SIDES]
    beside = [_neighbours(order, side) for side in SIDES]
    exits = {key: dict.fromkeys(head.exit_lanes) for key, head in heads.items()}
    for key, head in heads.items():
        for before in head.entry_lanes:
            exits.get(before, {})[key] = None
    lanes = []
    for row, (key, head) in enumerate(heads.items()):
        keep = moves(line_of[row])
        line = line_of[row][keep]
        found = [side[row] for side in widths]
        usual = np.full(len(line), default)
        sides = [usual if half is None else half[keep] for half in found]
        across, limit = None, head.speed_limit_mph  # zero: unknown
        if (point := stops.get(key)) is not None:
            across = line_across(line, sides[0], sides[1], point)
        if not 0.0 <= limit * MPH_MPS < MAX_SPEED_MPS:
            raise InputError(
                f"{where}: lane {key}: speed_limit_mph: {limit:g}: "
                f"expected 0 to {MAX_SPEED_MPS / MPH_MPS:.0f}"
            )
        lane = Lane(
            id=str(key),
            centre=line,
            left_width=sides[0],
            right_width=sides[1],
            speed_limit=limit * MPH_MPS or None,
            successors=tuple(map(str, exits[key])),
            left=beside[0][row],
            right=beside[1][row],
            stop_line=across,
            width_assumed=any(half is None for half in found),
        )
        lanes.append(lane)
    notes = []
    if others := len(every) - len(driven):
        notes.append(f"{others} lanes not of type {', '.join(wanted)} left out")
    if short := len(driven) - len(heads):
        notes.append(f"{short} lanes of one point left out")
    return lanes, notes


def _half_widths(
    where: str,
    side: str,
    heads: Sequence[Message],
    lanes: Sequence[np.ndarray],
    lines: Mapping[int, np.ndarray],
) -> list[np.ndarray | None]:
    """Distance [n] m of each lane's points from what bounds them on one side.

    A lane names the road lines and edges beside it, each for a range of its points.
    Measured at every fourth point, interpolated between, held beyond; None of lanes
    without a known bound.

    Args:
      where: names file and record in errors.
      side: left or right.
      heads: of the lanes.
      lanes: points [n, 2] m of each lane.
      lines: feature id -> points [m >= 1, 2] m.
    """
    if not heads:
        return []
    lane, table = _of_lanes(heads, f"{side}_boundaries", BOUNDARY)
    first, last, bound = table.T
    sizes = np.array([len(points) for points in lanes], np.int64)
    longest = int(sizes.max())
    first, last = np.clip(first, 0, longest), np.clip(last, -1, longest)
    total = int(np.maximum(last - first + 1, 0).sum())
    if total > MAX_POINTS:
        raise InputError(
            f"{where}: {side}_boundaries: {total} points: expected at most {MAX_POINTS}"
        )
    begins = np.cumsum(sizes) - sizes
    half = np.full(int(sizes.sum()), np.nan)
    last = np.minimum(last, sizes[lane] - 1)
    use = np.flatnonzero(np.isin(bound, [*lines]) & (first <= last))
    if use.size:
        count = (last[use] - first[use]) // MEASURE_STEP + 2
        owner = np.repeat(use, count)
        place = np.arange(owner.size) - np.repeat(np.cumsum(count) - count, count)
        point = np.minimum(first[owner] + MEASURE_STEP * place, last[owner])
        row = begins[lane[owner]] + point
        keys, which = np.unique(bound[owner], return_inverse=True)
        near = [lines[key] for key in keys.tolist()]
        half[row] = distances_to_lines(np.concatenate(lanes)[row], near, which)
    found: list[np.ndarray | None] = []
    for part in np.split(half, begins[1:]):
        known = np.flatnonzero(part <= MAX_HALF_WIDTH_M)  # NaN compares false
        filled = None
        if known.size:
            filled = np.interp(np.arange(part.size), known, part[known])
            filled = np.maximum(filled, MIN_HALF_WIDTH_M)
        found.append(filled)
    return found


def _neighbours(heads: Sequence[Message], side: str) -> list[str | None]:
    """Per lane the neighbour along its longest part; all go the same way."""
    lane, table = _of_lanes(heads, f"{side}_neighbors", NEIGHBOUR)
    key, first, last = table.T
    found: list[str | None] = [None] * len(heads)
    for row in np.argsort(last - first, kind="stable"):
        found[lane[row]] = str(int(key[row]))
    return found


def _of_lanes(
    heads: Sequence[Message], field: str, names: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns a repeated field of lanes: numbers of the lanes [n], int64 [n, names]."""
    parts = [getattr(head, field) for head in heads]
    lane = np.repeat(np.arange(len(heads)), [len(part) for part in parts])
    items = itertools.chain.from_iterable(parts)
    return lane, columns(items, *names, dtype=np.int64)


# -------------------------------------------------------------------- signals


def _signals(
    where: str, steps: Sequence[Message], t: np.ndarray, origin: np.ndarray, spec: dict
) -> tuple[tuple[Signal, ...], dict[int, np.ndarray], frozenset[int]]:
    """Signals by the lane they govern, stop points, lanes of flashing red."""
    if len(steps) not in (0, t.size):
        raise InputError(
            f"{where}: dynamic_map_states: {len(steps)}: "
            f"expected {t.size}, one per timestamp"
        )
    heads = itertools.chain.from_iterable(step.lane_states for step in steps)
    lane, state = columns(heads, "lane", "state", dtype=np.int64).T
    if not lane.size:
        return (), {}, frozenset()
    bad = np.flatnonzero((state < 0) | (state >= len(COLOURS)))
    if bad.size:
        raise InputError(
            f"{where}: lane {lane[bad[0]]}: signal state {state[bad[0]]}: "
            f"expected 0 to {len(COLOURS) - 1}"
        )
    ids, rows = np.unique(lane, return_inverse=True)
    if ids.size * t.size > MAX_COLOURS:
        raise InputError(
            f"{where}: dynamic_map_states: {ids.size} lanes over {t.size} steps: "
            f"expected at most {MAX_COLOURS} states"
        )
    colours = np.full((ids.size, t.size), OFF, np.int8)
    counts = [len(step.lane_states) for step in steps]
    step = np.repeat(np.arange(len(steps)), counts)
    # of two heads for one lane the first that is known counts: it is written last
    known = np.flatnonzero(COLOURS[state] != OFF)[::-1]
    colours[rows[known], step[known]] = COLOURS[state[known]]
    gap = number(spec, "signal_gap_s")
    for row in colours:  # fill short unseen times between equal colours
        known = np.flatnonzero(row != OFF)
        before, after = known[:-1], known[1:]
        fill = (row[before] == row[after]) & (t[after] - t[before] <= gap)
        for first, last in zip(before[fill], after[fill], strict=True):
            row[first:last] = row[first]
    signals = tuple(
        signal_of(str(key), t, row) for key, row in zip(ids, colours, strict=True)
    )
    stops = {
        head.lane: head.stop_point
        for step in reversed(steps)  # of two points of one lane the first counts
        for head in reversed(step.lane_states)
        if head.HasField("stop_point")
    }
    points = _points(where, stops.values(), origin)
    flashing = np.bincount(rows, state == FLASHING_STOP) > 0.5 * np.bincount(rows)
    return (
        signals,
        dict(zip(stops, points, strict=True)),
        frozenset(ids[flashing].tolist()),
    )
