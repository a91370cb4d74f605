"""Automatic labels: the human's decision per obstacle and the scene's tags.

The decision is read from the station-time graph with the human's own s(t) as
the profile (Apollo's SpeedDecider rules, with the recorded drive in place of a
planned one): an obstacle that blocks the driver's path is above or below the
profile when it first blocks it.
"""

import numpy as np

from rcirl_jax.types import NUM_TAGS, Decision, Kind, Tag
from rcirl_jax.units import STATION_STEP_M, TIMES_S

LATERAL_BUFFER_M = 0.2  # m, as in features.relations
NUDGE_RANGE_M = 3.0  # m, as in features.relations
FOLLOW_ONSET_S = 0.5  # s, Apollo: a followed car blocks from the start
FOLLOW_DURATION_S = 2.0  # s, Apollo: and for at least this long
NUDGE_SPEED_MPS = 2.0  # m/s faster than the obstacle to count as passing it
MOVING_MPS = 2.0  # m/s
STANDING_MPS = 0.5  # m/s
CRUISE_MPS = 5.0  # m/s
CRUISE_RANGE_MPS = 1.5  # m/s of change while cruising
TURN_RAD = np.deg2rad(30.0)  # rad of heading change along the path
STOP_REACH_M = 12.0  # m from the line within which standing is a stop at it


def blocking(row: dict) -> np.ndarray:
    """[N, T] bool: the obstacle's box overlaps the driver's own path laterally."""
    grid = np.arange(row["path.l"].size) * STATION_STEP_M
    middle = 0.5 * (row["obstacles.s_lower"] + row["obstacles.s_upper"])
    path_l = np.interp(middle, grid, row["path.l"])
    reach = 0.5 * row["ego.width"] + LATERAL_BUFFER_M
    beside = np.maximum(
        row["obstacles.l_lower"] - path_l, path_l - row["obstacles.l_upper"]
    )
    kind = row["obstacles.kind"][:, None]
    return row["obstacles.valid"] & (beside < reach) & (kind != Kind.NONE)


def add_labels(row: dict) -> None:
    """Add `decisions` [N] and `tags` [G] to a scene's row in place."""
    blocks = blocking(row) & row["time_valid"]
    decisions = np.full(row["obstacles.kind"].shape, Decision.IGNORE, np.int32)
    for slot in np.flatnonzero(row["obstacles.kind"] != Kind.NONE).tolist():
        decisions[slot] = _decide(row, slot, blocks[slot])
    row["decisions"] = decisions
    row["tags"] = _tags(row, decisions, blocks)


def _speed(row: dict) -> np.ndarray:
    return np.gradient(row["human.s"], TIMES_S)


def _decide(row: dict, slot: int, blocks: np.ndarray) -> Decision:
    kind = row["obstacles.kind"][slot]
    if kind in (Kind.STOP, Kind.VIRTUAL):
        return _decide_line(row, slot)
    if not blocks.any():
        return _decide_beside(row, slot)
    human, half = row["human.s"], 0.5 * row["ego.length"]
    first = int(np.argmax(blocks))
    if row["obstacles.s_lower"][slot, first] < human[first]:
        came_from_ahead = row["obstacles.s_lower"][slot, 0] > human[0] + half
        enters_later = first > 0 and row["obstacles.valid"][slot, 0]
        passed = came_from_ahead or enters_later
        return Decision.OVERTAKE if passed else Decision.IGNORE
    lasts = np.count_nonzero(blocks) * (TIMES_S[1] - TIMES_S[0])
    onset = TIMES_S[first]
    last = len(blocks) - 1 - int(np.argmax(blocks[::-1]))
    same_way = (
        row["obstacles.s_lower"][slot, last] >= row["obstacles.s_lower"][slot, first]
    )
    if human[last] > row["obstacles.s_upper"][slot, last]:
        return Decision.OVERTAKE
    if onset <= FOLLOW_ONSET_S and lasts >= FOLLOW_DURATION_S and same_way:
        return Decision.FOLLOW
    return Decision.YIELD


def _decide_line(row: dict, slot: int) -> Decision:
    """STOP if the human stands before the line (or at the destination)."""
    valid = row["time_valid"]
    front = row["human.s"] + 0.5 * row["ego.length"]
    line = row["obstacles.s_lower"][slot]
    gap = line - front
    near = (gap > -2.0) & (gap < STOP_REACH_M)
    stands = (_speed(row) < STANDING_MPS) & near & valid
    return Decision.STOP if stands.any() else Decision.IGNORE


def _decide_beside(row: dict, slot: int) -> Decision:
    """NUDGE if the human drives past a slower one within the nudge range."""
    human, half = row["human.s"], 0.5 * row["ego.length"]
    abreast = (row["obstacles.s_lower"][slot] < human + half) & (
        row["obstacles.s_upper"][slot] > human - half
    )
    centre = 0.5 * (row["obstacles.l_lower"][slot] + row["obstacles.l_upper"][slot])
    gap = (
        np.maximum(
            row["obstacles.l_lower"][slot] - row["human.l"],
            row["human.l"] - row["obstacles.l_upper"][slot],
        )
        - 0.5 * row["ego.width"]
    )
    slower = _speed(row) - row["obstacles.speed"][slot] > NUDGE_SPEED_MPS
    passes = abreast & (gap < NUDGE_RANGE_M) & slower
    passes &= row["obstacles.valid"][slot] & row["time_valid"]
    if not passes.any():
        return Decision.IGNORE
    at = int(np.argmax(passes))
    to_left = row["human.l"][at] > centre[at]
    return Decision.NUDGE_LEFT if to_left else Decision.NUDGE_RIGHT


def _tags(row: dict, decisions: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    valid = row["time_valid"]
    speed = _speed(row)[valid]
    s, l = row["human.s"][valid], row["human.l"][valid]
    grid = np.arange(row["path.kappa"].size) * STATION_STEP_M
    driven = grid <= s[-1]
    bend = np.abs(np.sum(row["path.kappa"][driven]) * STATION_STEP_M)
    lane = row["path.lane_left"][0] - row["path.lane_right"][0]
    kind = row["obstacles.kind"]
    ahead = row["obstacles.s_lower"] > row["human.s"]
    body = (kind >= Kind.VEHICLE) & (kind <= Kind.STATIC)
    later = blocks & ahead & body[:, None] & (TIMES_S > FOLLOW_ONSET_S)
    enters = later[:, 1:] & ~blocks[:, :-1] & row["obstacles.valid"][:, :-1]
    tags = np.zeros(NUM_TAGS, bool)
    tags[Tag.STOPPING] = speed[0] > MOVING_MPS and speed[-1] < STANDING_MPS
    tags[Tag.STARTING] = speed[0] < STANDING_MPS and speed[-1] > MOVING_MPS
    tags[Tag.CRUISING] = np.ptp(speed) < CRUISE_RANGE_MPS and speed.min() > CRUISE_MPS
    tags[Tag.FOLLOWING] = np.any(decisions == Decision.FOLLOW)
    tags[Tag.TURNING] = bend > TURN_RAD
    tags[Tag.LANE_CHANGE] = np.abs(l[-1] - l[0]) > 0.5 * lane
    tags[Tag.YIELDING] = np.any(decisions == Decision.YIELD)
    tags[Tag.OVERTAKING] = np.any(decisions == Decision.OVERTAKE)
    tags[Tag.NUDGING] = np.any(decisions >= Decision.NUDGE_LEFT)
    tags[Tag.CUT_IN] = enters.any()
    stop = (kind == Kind.STOP)[:, None] & row["obstacles.valid"]
    tags[Tag.RED_LIGHT] = stop[:, 0].any()
    tags[Tag.STANDING] = speed.max() < STANDING_MPS
    return tags
